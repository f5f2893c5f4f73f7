"""How alike two views of a stylised scene are where both show the same points (short- and long-range consistency)."""

from typing import Dict, Optional, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestyle_ns.metrics.image import Metric, perceptual_metrics
from sparsestyle_ns.metrics.warping import Correspondence, Surface, correspond, sample_picture
from sparsestyle_ns.utils.progress import track

RANGES = {"short": 1, "long": 7}
"""Frames between the two views of a pair, as in Stylos and Styl3R."""
SSIM_SIGMA, SSIM_RADIUS, SSIM_CONSTANTS = 1.5, 5, (0.01**2, 0.03**2)
"""The Gaussian window of SSIM, 11 × 11, and what keeps its quotients finite (Wang et al. 2004)."""

Picture = Float[Tensor, "H W 3"]
Mask = Bool[Tensor, "H W"]


def masked_rmse(first: Picture, second: Picture, visible: Mask) -> Float[Tensor, ""]:
    """Root of the mean squared difference over visible pixels and channels; NaN where none is visible."""
    return (first - second)[visible].square().mean().sqrt()


def masked_ssim(first: Picture, second: Picture, visible: Mask) -> Float[Tensor, ""]:
    """Mean SSIM (Wang et al. 2004) of pictures in [0, 1], by visible pixels alone; NaN where none is visible."""
    offsets = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, device=first.device, dtype=first.dtype)
    profile = torch.exp(-0.5 * (offsets / SSIM_SIGMA).square())
    window = torch.outer(profile, profile)[None, None] / profile.sum().square()
    mask = visible.to(first.dtype)[None, None]
    share = F.conv2d(mask, window, padding=SSIM_RADIUS).clamp_min(torch.finfo(first.dtype).tiny)

    def mean(values: Float[Tensor, "C 1 H W"]) -> Float[Tensor, "C 1 H W"]:
        return F.conv2d(values * mask, window, padding=SSIM_RADIUS) / share

    x, y = (picture.permute(2, 0, 1)[:, None] for picture in (first, second))
    mean_x, mean_y = mean(x), mean(y)
    variance_x, variance_y = mean(x * x) - mean_x.square(), mean(y * y) - mean_y.square()
    covariance = mean(x * y) - mean_x * mean_y
    c1, c2 = SSIM_CONSTANTS
    likeness = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    likeness = likeness / ((mean_x.square() + mean_y.square() + c1) * (variance_x + variance_y + c2))
    return likeness[:, 0].mean(dim=0)[visible].mean()


def masked_distance(metric: Metric, first: Picture, second: Picture, visible: Mask) -> float:
    """A perceptual distance of visible pixels, by a metric that is a mean over pixels, 0 where pictures are equal."""
    # What isn't visible is black in both pictures, and the mean is divided by the visible share.
    mask = visible[..., None]
    pictures = (torch.where(mask, picture, 0.0).permute(2, 0, 1)[None].cpu() for picture in (first, second))
    return float(metric(*pictures)) / float(visible.float().mean())


@torch.no_grad()
def pair_consistency(first: Picture, second: Picture, correspondence: Correspondence) -> Dict[str, float]:
    """`rmse`, `ssim` and `perceptual_metrics` of a view and another warped to it; nothing where they share no pixel."""
    visible = correspondence.visible
    if not visible.any():
        return {}
    first, second = first.clamp(0.0, 1.0), second.clamp(0.0, 1.0)
    warped, metrics = sample_picture(second, correspondence.pixels), perceptual_metrics(first.shape[:2])
    return {
        "rmse": float(masked_rmse(first, warped, visible)),
        "ssim": float(masked_ssim(first, warped, visible)),
        **{name: masked_distance(metric, first, warped, visible) for name, metric in metrics.items()},
    }


class PathGeometry:
    """Which pixels of a path's frames show the same points, by what each frame shows of the unstylised scene."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.pairs = {}
        for name, gap in RANGES.items():
            starts = track(range(len(surfaces) - gap), f"Matching frames, {name} range")
            self.pairs[name] = [correspond(surfaces[t], surfaces[t + gap]) for t in starts]

    def visible_share(self, name: str) -> Optional[float]:
        """Share of pixels that count in a range's pairs; None where the path has no such pair."""
        shares = [float(pair.visible.float().mean()) for pair in self.pairs[name]]
        return sum(shares) / len(shares) if shares else None

    def consistency(self, frames: Sequence[Float[Tensor, "H W 3"]]) -> Dict[str, float]:
        """`short_rmse`, `short_ssim` …, `long_rmse` …: means over all pairs of the range that share a pixel."""
        means = {}
        for name, gap in RANGES.items():
            pairs = track(self.pairs[name], f"Consistency, {name} range")
            values = [pair_consistency(frames[t], frames[t + gap], pair) for t, pair in enumerate(pairs)]
            kept = [value for value in values if value]
            for key in kept[0] if kept else ():
                means[f"{name}_{key}"] = sum(value[key] for value in kept) / len(kept)
        return means

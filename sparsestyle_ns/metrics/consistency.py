"""How alike two views of a stylised scene are where both show the same points (short- and long-range consistency)."""

import statistics
from typing import Dict, List, Optional, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestyle_ns.core.similarity import masked_ssim
from sparsestyle_ns.metrics.image import Metric, perceptual_metrics
from sparsestyle_ns.metrics.warping import Correspondence, Surface, correspond, sample_picture
from sparsestyle_ns.utils.progress import track

RANGES = {"short": 1, "long": 7}
"""Frames between the two views of a pair, as in Stylos and Styl3R."""
PERCEPTUAL_EVERY = 3
"""Perceptual distances are of every third pair: they take most of the time, and neighbours say the same."""

Picture = Float[Tensor, "H W 3"]
Mask = Bool[Tensor, "H W"]


def masked_rmse(first: Picture, second: Picture, visible: Mask) -> Float[Tensor, ""]:
    """Root of the mean squared difference over visible pixels and channels; NaN where none is visible."""
    return (first - second)[visible].square().mean().sqrt()


def masked_distance(metric: Metric, first: Picture, second: Picture, visible: Mask) -> float:
    """A perceptual distance of visible pixels, by a metric that is a mean over pixels, 0 where pictures are equal."""
    # What isn't visible is black in both pictures, and the mean is divided by the visible share.
    mask = visible[..., None]
    pictures = (torch.where(mask, picture, 0.0).permute(2, 0, 1)[None].cpu() for picture in (first, second))
    return float(metric(*pictures)) / float(visible.float().mean())


@torch.no_grad()
def pair_consistency(
    first: Picture, second: Picture, correspondence: Correspondence, perceptual: bool = True
) -> Dict[str, float]:
    """`rmse`, `ssim` and, unless told not to, `perceptual_metrics` of a view and another warped to it.

    Nothing where they share no pixel.
    """
    visible = correspondence.visible
    if not visible.any():
        return {}
    first, second = first.clamp(0.0, 1.0), second.clamp(0.0, 1.0)
    warped = sample_picture(second, correspondence.pixels)
    metrics = perceptual_metrics(first.shape[:2]) if perceptual else {}
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
        """`short_rmse`, `short_ssim` …, `long_rmse` …: means over the pairs of the range that share a pixel.

        Of the perceptual distances over every third pair of these.
        """
        means = {}
        for name, gap in RANGES.items():
            values: Dict[str, List[float]] = {}
            shared = [t for t, pair in enumerate(self.pairs[name]) if pair.visible.any()]
            for place, t in enumerate(track(shared, f"Consistency, {name} range")):
                perceptual = place % PERCEPTUAL_EVERY == 0
                found = pair_consistency(frames[t], frames[t + gap], self.pairs[name][t], perceptual)
                for key, value in found.items():
                    values.setdefault(key, []).append(value)
            means.update({f"{name}_{key}": statistics.fmean(each) for key, each in values.items()})
        return means

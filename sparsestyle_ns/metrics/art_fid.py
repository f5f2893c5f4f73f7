"""ArtFID: (1 + LPIPS) · (1 + FID), low where content is kept and the style is near (Wright and Ommer 2022, Eq. 1).

LPIPS is between each stylised picture and its content; FID between stylised pictures and paintings, in the features of
an Inception-v3 that was trained on art. It is measured where both weight files are in the torch hub cache.

Its authors compare thousands of pictures with as many paintings. A scene has a few views and one painting, so here all
are resized and cut into overlapping squares. Figures rank rows that are measured alike, not beside others'.
"""

import functools
import math
from pathlib import Path
from typing import Dict, List, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sparsestyle_ns.metrics.image import ALEXNET_FILE, lpips_metric
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.weight_files import check_tensor, hub_file, read_state

ART_INCEPTION_FILE = "art_inception.pth"
HEADS = ("fc1.", "fc2.", "AuxLogits1.", "AuxLogits2.")
"""Classifiers in that file, which the features don't need."""
SQUARE, SHORTER_SIDE, STEP = 299, 448, 75
"""Pixels: side of the squares, shorter side of what they are cut from, and way from one to the next, at most."""


def frechet_distance(first: Float[Tensor, "n C"], second: Float[Tensor, "m C"]) -> float:
    """FID of two samples of features: |μ − μ'|² + tr Σ + tr Σ' − 2 tr (Σ Σ')^½ (Heusel et al. 2017, Eq. 6).

    With X and X' the centred samples over √(n − 1) and √(m − 1), Σ = XᵀX and Σ' = X'ᵀX', so that the last trace is the
    sum of the singular values of X X'ᵀ, however singular the covariances are. A sample of one has the covariance 0. The
    result, in units of the features squared, is 0 where mean and covariance are equal.
    """
    samples = [sample.double() for sample in (first, second)]
    means = [sample.mean(dim=0) for sample in samples]
    x, y = ((sample - mean) / math.sqrt(max(1, len(sample) - 1)) for sample, mean in zip(samples, means, strict=True))
    shared = torch.linalg.svdvals(x @ y.T).sum()
    distance = (means[0] - means[1]).square().sum() + x.square().sum() + y.square().sum() - 2.0 * shared
    return max(0.0, float(distance))


def resized(picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "1 3 h w"]:
    """A picture in [0, 1] with a shorter side of `SHORTER_SIDE` pixels (bilinear, antialiased), on the CPU."""
    scale = SHORTER_SIDE / min(picture.shape[:2])
    size = [round(scale * length) for length in picture.shape[:2]]
    batch = picture.detach().clamp(0.0, 1.0).cpu().permute(2, 0, 1)[None]
    return F.interpolate(batch, size=size, mode="bilinear", antialias=True, align_corners=False).clamp(0.0, 1.0)


def squares(picture: Float[Tensor, "1 3 h w"]) -> Float[Tensor, "squares 3 side side"]:
    """Overlapping squares of `SQUARE` pixels from border to border, at even steps of `STEP` pixels at most."""
    tops, lefts = (
        torch.linspace(0, room, 1 + math.ceil(room / STEP)).round().long().tolist()
        for room in (length - SQUARE for length in picture.shape[2:])
    )
    return torch.cat([picture[..., top : top + SQUARE, left : left + SQUARE] for top in tops for left in lefts])


@functools.lru_cache(maxsize=1)
def load_art_inception(path: Path) -> nn.Module:
    """ArtFID's Inception-v3, from pictures in [0, 1] to 2048 features; an `InputError` for another network's file."""
    from torchvision.models import inception_v3

    with torch.device("meta"):  # torch's random state stays untouched
        network = inception_v3(weights=None, aux_logits=False, init_weights=False, transform_input=False)
    network.fc = nn.Identity()
    expected = network.state_dict()
    try:
        state = read_state(path)
        for name in state:
            if name not in expected and not str(name).startswith(HEADS):
                raise ValueError(f"{name} belongs to another network")
        found = {name: check_tensor(state, name, value.shape).to(value.dtype) for name, value in expected.items()}
    except ValueError as error:
        raise InputError(
            f"{path} is not the Inception-v3 of ArtFID's authors ({error}): fetch their {ART_INCEPTION_FILE} again, or "
            "take the file away to measure without ArtFID."
        ) from error
    network.load_state_dict(found, assign=True)
    return network.eval().requires_grad_(False)


def missing_weights() -> List[str]:
    """The files that ArtFID needs and the torch hub cache doesn't have."""
    return [name for name in (ART_INCEPTION_FILE, ALEXNET_FILE) if not hub_file(name).is_file()]


def why_left_out(figures: Dict[str, float]) -> str:
    """A sentence on ArtFID where `figures` don't have it; nothing where they do."""
    if "art_fid" in figures:
        return ""
    folder, missing = hub_file(ART_INCEPTION_FILE).parent, " and ".join(missing_weights())
    reason = f"it needs {missing} in {folder}" if missing else "there was no painting to measure against"
    return f"ArtFID is left out: {reason}."


class ArtFID:
    """ArtFID of pictures that are added one by one; they and the painting in [0, 1]."""

    def __init__(self, network: nn.Module, painting: Float[Tensor, "3 H W"]) -> None:
        self.network = network
        self._style = self._features(resized(painting.permute(1, 2, 0)))
        self._stylised: List[Tensor] = []
        self._lpips: List[float] = []

    @classmethod
    def against(cls, painting: Float[Tensor, "3 H W"]) -> Optional["ArtFID"]:
        """With the weights in the torch hub cache; None where some are missing."""
        return None if missing_weights() else cls(load_art_inception(hub_file(ART_INCEPTION_FILE)), painting)

    @torch.no_grad()
    def _features(self, picture: Float[Tensor, "1 3 h w"]) -> Float[Tensor, "squares 2048"]:
        return self.network(squares(picture))

    def add(self, stylised: Float[Tensor, "H W 3"], content: Float[Tensor, "H W 3"]) -> None:
        """Adds a stylised picture, and what it must stay like."""
        first, second = resized(stylised), resized(content)
        metric = lpips_metric(first.shape[2:])
        assert metric is not None
        self._lpips.append(float(metric(first, second)))
        self._stylised.append(self._features(first))

    def figures(self) -> Dict[str, float]:
        """`art_fid` of all pictures so far, of which there is one at least; 1 is the least that it can be."""
        distance = frechet_distance(torch.cat(self._stylised), self._style)
        return {"art_fid": (1.0 + sum(self._lpips) / len(self._lpips)) * (1.0 + distance)}

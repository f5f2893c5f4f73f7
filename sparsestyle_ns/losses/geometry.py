"""Regularisers of stage 1 that speak of geometry alone; the distortion loss is with the weights it is made of."""

from jaxtyping import Float
from torch import Tensor


def depth_roughness(depth: Float[Tensor, "patches side side"]) -> Float[Tensor, ""]:
    """Mean squared difference of neighbouring depths on patches (RegNeRF, Eq. 3)."""
    down, right = depth[:, 1:] - depth[:, :-1], depth[:, :, 1:] - depth[:, :, :-1]
    return down.square().mean() + right.square().mean()


def near_density(
    density: Float[Tensor, "rays samples"], edges: Float[Tensor, "rays edges"], reach: float
) -> Float[Tensor, ""]:
    """Mean density of the samples that begin within `reach` of the ray's start (FreeNeRF's occlusion loss, Eq. 4).

    Args:
        density: σ of each sample.
        edges: the samples' borders, in [0, 1].
        reach: part of the ray that counts as near the camera, in (0, 1].
    """
    return (density * (edges[:, :-1] < reach)).mean()

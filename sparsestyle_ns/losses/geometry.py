"""What stage 1 asks of geometry besides colours; the distortion is with the weights it is made of."""

from jaxtyping import Float
from torch import Tensor


def near_density(
    density: Float[Tensor, "rays samples"], edges: Float[Tensor, "rays edges"], reach: float
) -> Float[Tensor, ""]:
    """Mean density of the samples that begin within `reach` of the ray's start (FreeNeRF's occlusion loss, Eq. 4).

    Edges are the samples' borders, in [0, 1]; `reach` is the part of the ray that counts as near the camera, in (0, 1].
    """
    return (density * (edges[:, :-1] < reach)).mean()


def matched_depth_loss(
    weights: Float[Tensor, "rays samples"], edges: Float[Tensor, "rays edges"], s: Float[Tensor, "rays 1"]
) -> Float[Tensor, ""]:
    """Mean over rays of Σ w_i |s_i − s| + 1 − Σ w_i: how far from a known point a ray ends.

    s_i are the middles of the samples. Light that goes on counts as farthest away, at distance 1. The absolute value
    keeps a wrong match from outweighing right ones. One at an end of its segment lies outside of the scene and is
    wrong: it doesn't count. Weights aren't negative, and at most 1 in sum; borders and points lie in [0, 1].
    """
    middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
    missed = (weights * (middles - s).abs()).sum(dim=-1) + 1.0 - weights.sum(dim=-1)
    inside = ((s > 0) & (s < 1)).squeeze(-1)
    return (missed * inside).sum() / inside.sum().clamp(min=1)

"""What stage 1 asks of colours, geometry and unseen views; the distortion is with the weights it is made of."""

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.precision import at_least_float32
from sparsestyle_ns.losses.nnfm import nnfm_loss


def reconstruction_loss(rendered: Float[Tensor, "*batch 3"], photo: Float[Tensor, "*batch 3"]) -> Float[Tensor, ""]:
    """L_recon: squared error of rendered colour, averaged over rays and channels (Eq. 4)."""
    return (at_least_float32(rendered) - photo).square().mean()


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

    s_i are the middles of the samples, whose borders lie in [0, 1]; light that goes on counts as at distance 1. A point
    at an end of its segment, s ≤ 0 or s ≥ 1, lies outside of the scene and doesn't count.
    """
    middles = 0.5 * (edges[:, 1:] + edges[:, :-1])
    missed = (weights * (middles - s).abs()).sum(dim=-1) + 1.0 - weights.sum(dim=-1)
    inside = ((s > 0) & (s < 1)).squeeze(-1)
    return (missed * inside).sum() / inside.sum().clamp(min=1)


def pooled_features(features: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C"]:
    """Means of feature maps over their places: what pictures show, wherever they show it."""
    return at_least_float32(features).mean(dim=(-2, -1))


def semantic_loss(embeddings: Float[Tensor, "B C"], targets: Float[Tensor, "B C"]) -> Float[Tensor, ""]:
    """Mean of 1 − cos(φ, φ*), in [0, 2] (DietNeRF's semantic consistency, Jain et al. 2021, there ½ |φ − φ*|²).

    Targets, each of its render's photo, get no gradient. An embedding no longer than `style_index.SHORTEST` has no
    direction: it counts as cosine 0 and gets a gradient of zero.

    Example:
        >>> semantic_loss(torch.tensor([[1.0, 0.0], [2.0, 2.0]]), torch.tensor([[0.0, 3.0], [1.0, 1.0]]))
        tensor(0.5000)
    """
    return nnfm_loss(embeddings, targets, neighbors=torch.arange(len(targets), device=targets.device))

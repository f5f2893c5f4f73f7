"""The semantic loss: whether a view that nobody photographed could be one of the same scene."""

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.precision import at_least_float32
from sparsestyle_ns.losses.nnfm import nnfm_loss


def pooled_features(features: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C"]:
    """Means of feature maps over their places: what pictures show, wherever they show it."""
    return at_least_float32(features).mean(dim=(-2, -1))


def semantic_loss(embeddings: Float[Tensor, "B C"], targets: Float[Tensor, "B C"]) -> Float[Tensor, ""]:
    """Mean of 1 − cos(φ, φ*) over pairs of embeddings (DietNeRF's semantic consistency, Jain et al. 2021).

    DietNeRF writes it as ½ |φ − φ*|² of embeddings of length 1, which is the same.

    An embedding no longer than `style_index.SHORTEST` has no direction: it counts as cosine 0 and gets a gradient of
    zero. Targets, each of its render's photo, get none.

    Returns:
        A scalar in [0, 2]; in [0, 1] for embeddings that are never negative.

    Example:
        >>> semantic_loss(torch.tensor([[1.0, 0.0], [2.0, 2.0]]), torch.tensor([[0.0, 3.0], [1.0, 1.0]]))
        tensor(0.5000)
    """
    return nnfm_loss(embeddings, targets, neighbors=torch.arange(len(targets), device=targets.device))

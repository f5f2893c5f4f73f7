"""How far a picture is from a painting in what its features have in common, wherever they are."""

import torch
from jaxtyping import Float
from torch import Tensor


def gram_matrix(features: Float[Tensor, "N C"]) -> Float[Tensor, "C C"]:
    """(1/N) Σ f fᵀ: how much of each pair of channels occurs together (Gatys et al. 2016, Eq. 3, over the pixels)."""
    return features.T @ features / len(features)


def gram_distance(gram: Float[Tensor, "C C"], style_gram: Float[Tensor, "C C"]) -> Float[Tensor, ""]:
    """|G − G_style|² / |G_style|²: 0 for equal statistics, 1 for features that have all vanished.

    Gatys et al. (2016), Eq. 4, but for the scale: relative to the style, it means the same for every network.
    """
    return torch.linalg.matrix_norm(gram - style_gram).square() / torch.linalg.matrix_norm(style_gram).square()

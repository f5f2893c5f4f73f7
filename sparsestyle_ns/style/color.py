"""Palette transfer: the affine map of colours that gives a scene the mean and covariance of a painting's colours.

As in ARF, μ is a mean colour and Σ a covariance; the subscript c stands for content, s for style.
"""

from typing import Optional

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.utils.errors import InputError

Mean = Float[Tensor, "3"]
Covariance = Float[Tensor, "3 3"]

SMALLEST_SPREAD = 1 / 255
"""Standard deviation, in units of the colour range, below which a direction counts as a rounding error."""


def color_moments(
    colors: Float[Tensor, "*batch 3"], weights: Optional[Float[Tensor, "*batch"]] = None
) -> tuple[Mean, Covariance]:
    """Mean μ = Σ_i w_i c_i / Σ_i w_i and covariance Σ_i w_i (c_i − μ)(c_i − μ)ᵀ / Σ_i w_i, w ≥ 0, in float64.

    An `InputError` where no weight is positive.
    """
    points = colors.reshape(-1, 3).double()
    weight = torch.ones_like(points[:, :1]) if weights is None else weights.reshape(-1, 1).double()
    total = weight.sum()
    if not total > 0:
        raise InputError("There is no colour to take a palette from: give an image in which some pixel counts.")
    mean = (weight * points).sum(dim=0) / total
    centred = points - mean
    return mean, (weight * centred).T @ centred / total


def gaussian_distance(
    first_mean: Mean, first_covariance: Covariance, second_mean: Mean, second_covariance: Covariance
) -> Float[Tensor, ""]:
    """2-Wasserstein distance between two Gaussians, in float64 (Dowson and Landau 1982).

    W² = |μ_1 − μ_2|² + tr(Σ_1 + Σ_2 − 2 (Σ_1^½ Σ_2 Σ_1^½)^½).
    """
    first, second = first_covariance.double(), second_covariance.double()
    root = _square_root(first)
    shared = torch.linalg.eigvalsh(root @ second @ root).clamp_min(0).sqrt().sum()
    spread = (first.trace() + second.trace() - 2 * shared).clamp_min(0)
    return ((first_mean.double() - second_mean.double()).square().sum() + spread).sqrt()


def _square_root(covariance: Covariance) -> Float[Tensor, "3 3"]:
    variances, axes = torch.linalg.eigh(covariance)
    return (axes * variances.clamp_min(0).sqrt()) @ axes.T


def palette_transform(
    content_mean: Mean, content_covariance: Covariance, style_mean: Mean, style_covariance: Covariance
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """The map c ↦ A c + b that gives the content's colours the style's mean and covariance.

    A = Σ_s^½ Σ_c^−½ with symmetric square roots and b = μ_s − A μ_c (ARF, Sec. 4).

    The inverse of a singular Σ_c, as of a grey photo, would turn rounding errors into paint. So along an eigenvector of
    Σ_c with a standard deviation σ below `SMALLEST_SPREAD` the gain isn't 1/σ but falls in proportion to σ, from
    1/`SMALLEST_SPREAD` to 0: the map is continuous, its gain bounded, and what doesn't vary gets the style's mean.

    Colours are in [0, 1], A and b in float64.
    """
    variances, axes = torch.linalg.eigh(content_covariance.double())
    spreads = variances.clamp_min(0).sqrt()
    gains = torch.where(spreads >= SMALLEST_SPREAD, 1 / spreads, spreads / SMALLEST_SPREAD**2)
    whitening = (axes * gains) @ axes.T
    matrix = _square_root(style_covariance.double()) @ whitening
    return matrix, style_mean.double() - matrix @ content_mean.double()

"""The style loss: nearest neighbour feature matching (NNFM; ARF, Sec. 4)."""

from typing import Optional

import torch
from jaxtyping import Float, Int
from torch import Tensor

CHUNK_SIZE = 2048
"""Feature vectors compared at once; 2048 × 2048 similarities are 16 MiB in float32."""

SHORTEST = 1e-12
"""Vectors no longer than this have no direction."""


def nearest_neighbors(
    features: Float[Tensor, "N C"], style_features: Float[Tensor, "M C"], chunk_size: int = CHUNK_SIZE
) -> Int[Tensor, " N"]:
    """For each feature vector the style's most similar one, by cosine.

    The search is exact and compares everything with everything, but holds at most `chunk_size`² similarities at a
    time, so its memory does not grow with the number of pixels. No gradient passes.

    Args:
        features: one vector a row.
        style_features: the style's vectors, one a row, M ≥ 1.
        chunk_size: rows of either compared at once, 1 or more. It changes memory and time, not the answer.

    Returns:
        Rows of `style_features`, 0 … M − 1; of several equally similar ones the first.

    Raises:
        ValueError: there are no style features.
    """
    if len(style_features) == 0:
        raise ValueError("there is no style feature to match: the style image gave none")
    with torch.no_grad():
        directions, style_directions = _directions(features), _directions(style_features)
        chunks = [_nearest_of_chunk(rows, style_directions, chunk_size) for rows in directions.split(chunk_size)]
        return torch.cat(chunks)


def nnfm_loss(
    features: Float[Tensor, "N C"],
    style_features: Float[Tensor, "M C"],
    neighbors: Optional[Int[Tensor, " N"]] = None,
    chunk_size: int = CHUNK_SIZE,
) -> Float[Tensor, ""]:
    """Mean cosine distance between each feature vector and its nearest style feature (L_style of Eq. 5).

    (1/N) Σ_i min_j (1 − cos(f_i, s_j)) (ARF, Sec. 4). The choice of j is taken as given when differentiating, as it
    is constant almost everywhere, and the style gets no gradient.

    Args:
        features: what the rendered view gives, one vector a pixel of its feature map. A vector of length zero has
            no direction: it counts as cosine 0 and gets a gradient of zero.
        style_features: what the style image gives, one vector a row.
        neighbors: the rows of `style_features` that `nearest_neighbors` gave, where they are known; searched otherwise.
        chunk_size: see `nearest_neighbors`.

    Returns:
        A scalar in [0, 2]; in [0, 1] for features that are never negative, such as those after a ReLU.

    Example:
        >>> maps = torch.rand(1, 768, 47, 63)
        >>> vectors = maps.permute(0, 2, 3, 1).flatten(0, 2)
        >>> nnfm_loss(vectors, style_features=vectors).abs() < 1e-5
        tensor(True)
    """
    if neighbors is None:
        neighbors = nearest_neighbors(features, style_features, chunk_size)
    matches = _directions(style_features.detach()[neighbors])
    cosines = (_directions(features) * matches).sum(dim=-1)
    return (1 - cosines).mean()


def _nearest_of_chunk(
    directions: Float[Tensor, "n C"], style_directions: Float[Tensor, "M C"], chunk_size: int
) -> Int[Tensor, " n"]:
    best = directions.new_full((len(directions),), -torch.inf)
    nearest = torch.zeros(len(directions), dtype=torch.long, device=directions.device)
    for start in range(0, len(style_directions), chunk_size):
        similarities = directions @ style_directions[start : start + chunk_size].T
        values, rows = similarities.max(dim=1)
        nearest = torch.where(values > best, rows + start, nearest)
        best = torch.maximum(values, best)
    return nearest


def _directions(vectors: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
    """Vectors of length 1, or of length 0, and without gradient, where there is no direction."""
    length = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    # The lower bound alone would give a finite value too, but a gradient of 1 / SHORTEST.
    return torch.where(length > SHORTEST, vectors / length.clamp_min(SHORTEST), 0.0)

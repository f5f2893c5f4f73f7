"""The style loss: nearest neighbour feature matching (NNFM; ARF, Sec. 4)."""

from typing import Optional, Union

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestyle_ns.core.precision import at_least_float32, without_autocast
from sparsestyle_ns.losses.style_index import SHORTEST, StyleIndex, check_style, unit_vectors
from sparsestyle_ns.losses.stylization_loss import PaintingFeatures, StylizationLoss, StylizedView

CHUNK_SIZE = 2048
"""Feature vectors compared at once; 2048 × 2048 similarities are 16 MiB in float32."""


class NNFMLoss(StylizationLoss):
    """L_style of Eq. 5: each feature vector of a view against its nearest one of the painting."""

    weight = 1.0

    def __init__(self, painting: PaintingFeatures) -> None:
        self.index = StyleIndex(painting.rows)

    def __call__(self, view: StylizedView) -> Float[Tensor, ""]:
        """See `nnfm_loss`."""
        return nnfm_loss(view.features, self.index)


@without_autocast
def nearest_neighbors(
    features: Float[Tensor, "N C"],
    style_features: Union[Float[Tensor, "M C"], StyleIndex],
    chunk_size: int = CHUNK_SIZE,
) -> Int[Tensor, " N"]:
    """For each feature vector the style's most similar one, by cosine.

    The search compares everything with everything, `chunk_size` rows of either at a time; a `StyleIndex`, made once for
    a style, gives the same answer faster: the first of several equally similar ones. A `ValueError` without any.
    """
    if isinstance(style_features, StyleIndex):
        return style_features.nearest(features)
    check_style(style_features)
    with torch.no_grad():
        directions, style_directions = unit_vectors(features), unit_vectors(style_features)
        chunks = [_nearest_of_chunk(rows, style_directions, chunk_size) for rows in directions.split(chunk_size)]
        return torch.cat(chunks)


@without_autocast
def nnfm_loss(
    features: Float[Tensor, "N C"],
    style_features: Union[Float[Tensor, "M C"], StyleIndex],
    neighbors: Optional[Int[Tensor, " N"]] = None,
) -> Float[Tensor, ""]:
    """Mean cosine distance between each feature vector and its nearest style feature (L_style of Eq. 5), in [0, 2].

    (1/N) Σ_i min_j (1 − cos(f_i, s_j)) (ARF, Sec. 4). The choice of j is taken as given when differentiating, as it
    is constant almost everywhere, and the style gets no gradient.

    Features have lengths up to 1e18. One no longer than `SHORTEST` has no direction: it counts as cosine 0 and gets a
    gradient of zero. `neighbors` are what `nearest_neighbors` gave, where it is known.

    Example:
        >>> vectors = torch.rand(2961, 768)
        >>> nnfm_loss(vectors, style_features=vectors).abs() < 1e-5
        tensor(True)
    """
    if neighbors is None:
        neighbors = nearest_neighbors(features, style_features)
    is_index = isinstance(style_features, StyleIndex)
    matches = style_features.directions_of(neighbors) if is_index else unit_vectors(style_features.detach()[neighbors])
    features = at_least_float32(features)
    length = torch.linalg.vector_norm(features, dim=-1)
    # The features' directions themselves would be one more large tensor to fill, keep and differentiate.
    cosines = torch.linalg.vecdot(features, matches) / length.clamp_min(SHORTEST)
    return (1 - torch.where(length > SHORTEST, cosines.clamp(-1.0, 1.0), 0.0)).mean()


def _nearest_of_chunk(
    directions: Float[Tensor, "n C"], style_directions: Float[Tensor, "M C"], chunk_size: int
) -> Int[Tensor, " n"]:
    maxima = [(directions @ part.T).max(dim=1) for part in style_directions.split(chunk_size)]
    values, rows = (torch.stack(each) for each in zip(*maxima, strict=True))
    best = values.argmax(dim=0)
    return rows.gather(0, best[None])[0] + chunk_size * best

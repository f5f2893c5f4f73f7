"""Losses of whole distributions: the painting's colours and textures, each in the painting's shares; not in the paper.

The style loss lets every place of a view choose the painting's most similar feature, so many places choose the same
few; being a cosine, it doesn't see how strong a feature is either, and colour hardly at all. Left alone it ends with a
few of the painting's colours, ever more contrast, and grain. A sliced Wasserstein distance (Heitz et al. 2021 compare
it with Gram matrices as a style loss) is zero only where a view has all of what the painting has, as often.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.feature_maps import feature_rows
from sparsestyle_ns.core.precision import at_least_float32, without_autocast
from sparsestyle_ns.core.sliced import random_directions, sliced_distance
from sparsestyle_ns.losses.style_index import unit_vectors
from sparsestyle_ns.losses.stylization_loss import PaintingFeatures, StylizationLoss, StylizedView

MOST_COMPARED = 1 << 14
"""Points that are compared, drawn anew in each iteration where there are more."""
LEAST_COLOR_SPREAD, LEAST_TEXTURE_SPREAD = (1 / 255) ** 2, 1e-4
"""Variances that a painting of one colour, or of one texture, counts as having."""


class _SlicedLoss(StylizationLoss):
    """Sliced 2-Wasserstein distance of a view's points from the painting's, squared, over the painting's variance.

    0 for the painting's own distribution; about 1 for its mean alone.
    """

    num_directions: int

    def __init__(self, points: Float[Tensor, "points D"], least_spread: float) -> None:
        points = at_least_float32(points)
        self.points = _drawn(points, torch.Generator().manual_seed(0))
        self.spread = points.var(dim=0, correction=0).sum().clamp(min=least_spread)

    @without_autocast
    def distance(self, points: Float[Tensor, "points D"], step: int) -> Float[Tensor, ""]:
        generator = torch.Generator().manual_seed(step)
        points = _drawn(at_least_float32(points), generator)
        # Drawn on the CPU, the same are drawn for every device; nothing waits for a copy that is on its way.
        directions = random_directions(points.shape[-1], self.num_directions, generator).to(points, non_blocking=True)
        return sliced_distance(points, self.points.to(points), directions) / self.spread.to(points)


class ColorLoss(_SlicedLoss):
    """How far a view's colours are from the painting's, all of them together."""

    weight = 5.0
    num_directions = 16

    def __init__(self, painting: PaintingFeatures) -> None:
        super().__init__(feature_rows(painting.image[None]), LEAST_COLOR_SPREAD)

    def __call__(self, view: StylizedView) -> Float[Tensor, ""]:
        """See `_SlicedLoss`."""
        return self.distance(view.colors, view.step)


class TextureLoss(_SlicedLoss):
    """How far a view's unit feature vectors are from the painting's, all of them together."""

    weight = 1.0
    num_directions = 64

    def __init__(self, painting: PaintingFeatures) -> None:
        super().__init__(unit_vectors(painting.rows), LEAST_TEXTURE_SPREAD)

    def __call__(self, view: StylizedView) -> Float[Tensor, ""]:
        """See `_SlicedLoss`."""
        return self.distance(unit_vectors(view.features), view.step)


def _drawn(points: Float[Tensor, "points D"], generator: torch.Generator) -> Float[Tensor, "kept D"]:
    """Points drawn at random with the generator, which is on the CPU; all of them where there are few."""
    if len(points) <= MOST_COMPARED:
        return points
    places = torch.randint(len(points), (MOST_COMPARED,), generator=generator)
    return points[places.to(points.device, non_blocking=True)]

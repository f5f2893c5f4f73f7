"""What a stylisation loss is: one term of the sum that stage 2 minimises (Eq. 5)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class PaintingFeatures:
    """A painting as losses see it.

    Attributes:
        image: RGB in [0, 1].
        rows: its feature vectors, one a row.
    """

    image: Float[Tensor, "3 H W"]
    rows: Float[Tensor, "rows C"]


@dataclass(frozen=True)
class StylizedView:
    """A rendered view, and what it must stay like.

    Attributes:
        image: the stylised picture, RGB.
        features: its feature vectors where the scene covers it, one a row; differentiable.
        content: those of the content picture, row for row.
    """

    image: Float[Tensor, "H W 3"]
    features: Float[Tensor, "rows C"]
    content: Float[Tensor, "rows C"]


class StylizationLoss(ABC):
    """A loss of views, made once for a painting.

    Args:
        painting: what the views are to become like.

    Attributes:
        weight: in the sum, unless the run's settings say otherwise; 0 is off, and costs nothing.
    """

    weight: ClassVar[float] = 0.0

    def __init__(self, painting: PaintingFeatures) -> None:  # noqa: B027 - a loss may need nothing of the painting
        pass

    @abstractmethod
    def __call__(self, view: StylizedView) -> Float[Tensor, ""]:
        """The loss of one view, 0 or more."""

"""What a stylisation loss is: one term of the sum that stage 2 minimises (Eq. 5)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Optional

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class PaintingFeatures:
    """A painting as losses see it: RGB in [0, 1] at the size at which the network sees it, and its feature vectors.

    The size matters: reduced, thin lines are less dark, and a painting's colours lie closer together.
    """

    image: Float[Tensor, "3 H W"]
    rows: Float[Tensor, "rows C"]


class Content(NamedTuple):
    """What a view must stay like: a picture in [0, 1], and the feature network's view of it."""

    picture: Float[Tensor, "H W 3"]
    features: Float[Tensor, "1 C h w"]


@dataclass(frozen=True)
class StylizedView:
    """A rendered view, and what it must stay like."""

    image: Float[Tensor, "H W 3"]
    picture: Float[Tensor, "H W 3"]
    """The content picture."""
    features: Float[Tensor, "rows C"]
    """Of the picture, where the scene covers it; differentiable."""
    content: Float[Tensor, "rows C"]
    """Those of the content picture."""
    colors: Float[Tensor, "pixels 3"]
    """Of the picture, where the scene covers it; differentiable."""
    covered: Optional[Bool[Tensor, "H W"]] = None
    """Where the scene covers the picture; None: everywhere."""
    kept_structure: float = 0.0
    """The SSIM of brightness to the content picture that it keeps at least."""
    step: int = 0
    """The iteration, for what a loss draws at random."""


class StylizationLoss(ABC):
    """A loss of views, made once for the painting that they are to become like."""

    weight: ClassVar[float] = 0.0
    """In the sum, unless the run's settings say otherwise; 0 is off."""

    def __init__(self, painting: PaintingFeatures) -> None:  # noqa: B027 - a loss may need nothing of the painting
        pass

    @abstractmethod
    def __call__(self, view: StylizedView) -> Float[Tensor, ""]:
        """The loss of one view, 0 or more."""

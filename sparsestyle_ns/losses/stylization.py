"""The losses of stage 2 by name, and what a stylised view is compared with."""

from dataclasses import dataclass
from typing import Collection, Dict, Optional, Type

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.feature_maps import covered_rows, feature_rows
from sparsestyle_ns.losses.content import ContentLoss
from sparsestyle_ns.losses.nnfm import NNFMLoss
from sparsestyle_ns.losses.sliced import ColorLoss, TextureLoss
from sparsestyle_ns.losses.structure import StructureLoss
from sparsestyle_ns.losses.stylization_loss import Content, PaintingFeatures, StylizationLoss, StylizedView
from sparsestyle_ns.style.backbone import Backbone

LOSSES: Dict[str, Type[StylizationLoss]] = {
    "content": ContentLoss,
    "style": NNFMLoss,
    "colors": ColorLoss,
    "textures": TextureLoss,
    "structure": StructureLoss,
}
"""A new one is a file with a `StylizationLoss`, and its entry here."""


def default_weights() -> Dict[str, float]:
    """Each loss's own weight."""
    return {name: loss.weight for name, loss in LOSSES.items()}


@dataclass(frozen=True)
class Losses:
    """What an iteration minimises: its losses by name, not weighted, and their weights in this iteration."""

    values: Dict[str, Float[Tensor, ""]]
    weights: Dict[str, float]

    def terms(self) -> Dict[str, Float[Tensor, ""]]:
        """The summands of L_total (Eq. 5), as `NAME_loss`."""
        return {f"{name}_loss": self.weights[name] * value for name, value in self.values.items()}

    def metrics(self) -> Dict[str, Tensor | float]:
        """The values without their gradients, and λ, the weight of the content loss (Eq. 6)."""
        values = {name: value.detach() for name, value in self.values.items()}
        return {**values, "lambda": self.weights.get("content", 0.0)}


def fit_side(image: Float[Tensor, "B C H W"], longer_side: int, smallest_side: int = 1) -> Float[Tensor, "B C h w"]:
    """An image resized (bilinear, antialiased) to a longer side of so many pixels, and no side below the smallest."""
    scale = longer_side / max(image.shape[-2:])
    size = tuple(max(smallest_side, round(length * scale)) for length in image.shape[-2:])
    return (
        image
        if size == image.shape[-2:]
        else F.interpolate(image, size=size, mode="bilinear", antialias=True, align_corners=False)
    )


def sample_rows(rows: Float[Tensor, "rows C"], count: int) -> Float[Tensor, "kept C"]:
    """`count` of the rows, drawn at random but the same each time, in their order; all where there are no more."""
    if count >= len(rows):
        return rows
    drawn = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:count]
    return rows[drawn.sort().values.to(rows.device)]


class StyleTargets:
    """A painting in [0, 1] as the feature network sees it, and the losses of pictures against it (the terms of Eq. 5).

    Not a module of the model: a stylised checkpoint holds neither the network nor the painting.

    Args:
        feature_side: longer side, in pixels, at which the network sees all pictures; the smaller,
            the wider strokes are.
        style_features: at most so many of the style image's feature vectors count, drawn at random; None: all.
        losses: names of those that are asked for.
        kept_structure: the SSIM of brightness to the content picture that a view keeps at least, in [0, 1].
    """

    def __init__(
        self,
        backbone: Backbone,
        style_image: Float[Tensor, "3 H W"],
        feature_side: int,
        style_features: Optional[int] = None,
        losses: Collection[str] = ("content", "style"),
        kept_structure: float = 0.0,
    ) -> None:
        self.backbone, self.feature_side, self.kept_structure = backbone, feature_side, kept_structure
        self.style_image = style_image
        with torch.no_grad():
            rows = self.style_rows()
            rows = rows if style_features is None else sample_rows(rows, style_features)
            painting = PaintingFeatures(self.style_picture, rows)
            self.by_name = {name: LOSSES[name](painting) for name in losses}

    def features(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "1 C h w"]:
        """The network's view of a picture."""
        return self.backbone(fit_side(image.permute(2, 0, 1)[None], self.feature_side, self.backbone.smallest_side))

    def content(self, picture: Float[Tensor, "H W 3"]) -> Content:
        """A picture that a view must stay like, without gradients."""
        with torch.no_grad():
            return Content(picture, self.features(picture))

    @property
    def style_picture(self) -> Float[Tensor, "3 h w"]:
        """The style image at the size at which the network sees it."""
        return fit_side(self.style_image[None], self.feature_side, self.backbone.smallest_side)[0]

    @torch.no_grad()
    def style_rows(self) -> Float[Tensor, "rows C"]:
        """The style image's feature vectors, as the network gives them."""
        return feature_rows(self.backbone(self.style_picture[None]))

    def view(
        self,
        image: Float[Tensor, "H W 3"],
        content: Content,
        accumulation: Optional[Float[Tensor, "H W"]] = None,
        step: int = 0,
    ) -> StylizedView:
        """A rendered picture in [0, 1], ready for the losses; what counts is where the accumulation is above half."""
        maps = self.features(image), content.features, image.permute(2, 0, 1)[None]
        rows = (covered_rows(each, accumulation) for each in maps)
        covered = None if accumulation is None else accumulation > 0.5
        return StylizedView(image, content.picture, *rows, covered, self.kept_structure, step)

    def losses(self, view: StylizedView) -> Dict[str, Float[Tensor, ""]]:
        """The losses of a view, by name, not weighted."""
        return {name: loss(view) for name, loss in self.by_name.items()}

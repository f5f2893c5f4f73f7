"""What a stylised view is compared with: features of the style image and of the content picture of each view."""

from typing import Optional, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.losses.content import content_loss
from sparsestyle_ns.losses.nnfm import StyleIndex, nnfm_loss
from sparsestyle_ns.style.painting import SMALLEST_SIDE
from sparsestyle_ns.style.vgg import VGGFeatures


def fit_side(image: Float[Tensor, "B C H W"], longer_side: int) -> Float[Tensor, "B C h w"]:
    """An image enlarged or reduced (bilinear, antialiased) so that its longer side has this many pixels.

    The shorter side gets at least `SMALLEST_SIDE`.
    """
    height, width = image.shape[-2:]
    scale = longer_side / max(height, width)
    size = (max(SMALLEST_SIDE, round(height * scale)), max(SMALLEST_SIDE, round(width * scale)))
    if size == (height, width):
        return image
    return F.interpolate(image, size=size, mode="bilinear", antialias=True, align_corners=False)


def feature_rows(features: Float[Tensor, "B C h w"]) -> Float[Tensor, "rows C"]:
    """A feature map's vectors, one a row."""
    return features.permute(0, 2, 3, 1).flatten(0, 2)


def sample_rows(rows: Float[Tensor, "rows C"], count: int) -> Float[Tensor, "kept C"]:
    """`count` of the rows, drawn at random but the same each time, in their order; all where there are no more."""
    if count >= len(rows):
        return rows
    drawn = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:count]
    return rows[drawn.sort().values.to(rows.device)]


def covered_rows(
    features: Float[Tensor, "1 C h w"], accumulation: Optional[Float[Tensor, "H W"]]
) -> Float[Tensor, "rows C"]:
    """Those of a feature map's vectors that show the scene; all where no pixel does, or without `accumulation`."""
    rows = feature_rows(features)
    if accumulation is None:
        return rows
    covered = F.interpolate(accumulation[None, None].float(), size=features.shape[-2:], mode="area").flatten() > 0.5
    return rows[covered] if covered.any() else rows


class StyleTargets:
    """Style and content losses of an image against fixed targets (the two terms of Eq. 5).

    Kept out of the model's modules: a stylised checkpoint holds neither the network nor the painting.

    Args:
        backbone: gives the features.
        style_image: in [0, 1], on the device of the network.
        feature_side: longer side, in pixels, at which the network sees rendered and content pictures.
        style_side: longer side at which it sees the style image; it sets how large strokes are.
        style_features: at most so many of the style image's feature vectors count, drawn at random; None: all.
    """

    def __init__(
        self,
        backbone: VGGFeatures,
        style_image: Float[Tensor, "3 H W"],
        feature_side: int,
        style_side: int,
        style_features: Optional[int] = None,
    ) -> None:
        self.backbone = backbone
        self.feature_side = feature_side
        self.style_side = style_side
        self.style_image = style_image
        with torch.no_grad():
            rows = self.style_rows()
            self.style = StyleIndex(rows if style_features is None else sample_rows(rows, style_features))

    def features(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "1 768 h w"]:
        """The network's view of a picture."""
        return self.backbone(fit_side(image.permute(2, 0, 1)[None], self.feature_side))

    @torch.no_grad()
    def style_rows(self) -> Float[Tensor, "rows 768"]:
        """The style image's feature vectors, as the network gives them; the index keeps their directions alone."""
        return feature_rows(self.backbone(fit_side(self.style_image[None], self.style_side)))

    def losses(
        self,
        image: Float[Tensor, "H W 3"],
        content: Float[Tensor, "1 768 h w"],
        accumulation: Optional[Float[Tensor, "H W"]] = None,
    ) -> Tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """L_style and L_content of a rendered picture.

        Args:
            image: the picture, in [0, 1].
            content: features of the picture that it must stay like.
            accumulation: how opaque the scene is in each pixel. Where it is less than half, the picture shows a
                background that nothing can stylise, and its features don't count. None: all count.
        """
        features, target = (covered_rows(maps, accumulation) for maps in (self.features(image), content))
        return nnfm_loss(features, self.style), content_loss(features, target)

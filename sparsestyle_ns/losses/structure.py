"""The structure loss: what a view must keep of the light and dark of its content picture; not in the paper.

The content loss holds features, so a large weight of it takes the strokes away, and a small one lets strong patterns
dissolve the scene. This one holds the structure that people recognise things by, and only as much of it as is asked
for: a view that keeps more pays nothing.
"""

from typing import Optional

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchvision.transforms.functional import rgb_to_grayscale

from sparsestyle_ns.core.precision import at_least_float32, without_autocast
from sparsestyle_ns.core.similarity import masked_ssim
from sparsestyle_ns.losses.stylization_loss import StylizationLoss, StylizedView


class StructureLoss(StylizationLoss):
    """How much of the structure that a view has to keep is lost."""

    weight = 2.0

    def __call__(self, view: StylizedView) -> Float[Tensor, ""]:
        """See `structure_loss`."""
        return structure_loss(view.image, view.picture, view.kept_structure, view.covered)


@without_autocast
def structure_loss(
    image: Float[Tensor, "H W 3"],
    picture: Float[Tensor, "H W 3"],
    kept: float,
    covered: Optional[Bool[Tensor, "H W"]] = None,
) -> Float[Tensor, ""]:
    """max(0, kept − SSIM) of the brightness of pictures in [0, 1], in [0, 1 + kept].

    `kept` is in [0, 1]. SSIM (Wang et al. 2004) is a mean over covered pixels; over all where none is, or without
    `covered`. The second picture gets no gradient.

    Example:
        >>> picture = torch.rand(20, 20, 3)
        >>> structure_loss(picture, picture, kept=1.0) < 1e-5
        tensor(True)
    """
    first, second = (
        rgb_to_grayscale(at_least_float32(each).permute(2, 0, 1)).permute(1, 2, 0) for each in (image, picture.detach())
    )
    if covered is None:
        covered = torch.ones(image.shape[:2], dtype=torch.bool, device=image.device)
    # Where they are isn't asked: a GPU would be waited for.
    likeness = masked_ssim(first, second, covered | ~covered.any())
    return (kept - likeness).clamp(min=0.0)

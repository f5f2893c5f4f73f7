"""The content loss: how far the features of a rendered view have moved from those of its photograph."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.precision import at_least_float32
from sparsestyle_ns.losses.stylization_loss import StylizationLoss, StylizedView


class ContentLoss(StylizationLoss):
    """L_content of Eq. 5; its weight is λ0 (Eq. 6). The paper's is 10, for a loss in other units."""

    weight = 2.0

    def __call__(self, view: StylizedView) -> Float[Tensor, ""]:
        """See `content_loss`."""
        return content_loss(view.features, view.content)


def content_loss(features: Float[Tensor, "*shape"], target: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Squared error of features, relative to the size of the target's (L_content of Eq. 5).

    mean((f − f*)²) / mean(f*²): 0 for equal features, 1 for features that have all vanished. The target gets no
    gradient; where it is all zero, the squared error is returned as it is. A `ValueError` for different shapes.

    The paper, like ARF (Sec. 4), takes the squared error alone, whose size depends on the network's activations. By the
    division, λ means the same for every backbone.

    Example:
        >>> content_loss(torch.tensor([3.0, 0.0]), torch.tensor([0.0, 4.0]))
        tensor(1.5625)
    """
    if features.shape != target.shape:
        raise ValueError(f"features are {tuple(features.shape)} and the target {tuple(target.shape)}: they must agree")
    features, target = at_least_float32(features), at_least_float32(target.detach())
    # In units of the largest number of the target no square of it overflows, and none underflows that matters.
    largest = target.abs().amax()
    unit = torch.where(largest > 0, largest, 1.0)
    scaled = target / unit
    size = torch.where(largest > 0, scaled.square().mean(), 1.0)
    return F.mse_loss(features / unit, scaled) / size

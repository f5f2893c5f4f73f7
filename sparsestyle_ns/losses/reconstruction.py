"""The reconstruction loss of stage 1."""

from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.precision import at_least_float32


def reconstruction_loss(rendered: Float[Tensor, "*batch 3"], photo: Float[Tensor, "*batch 3"]) -> Float[Tensor, ""]:
    """L_recon: squared error of rendered colour, averaged over rays and channels (Eq. 4)."""
    return (at_least_float32(rendered) - photo).square().mean()

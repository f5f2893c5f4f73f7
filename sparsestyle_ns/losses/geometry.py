"""A regulariser of stage 1 that speaks of density alone; the distortion is with the weights it is made of."""

from jaxtyping import Float
from torch import Tensor


def near_density(
    density: Float[Tensor, "rays samples"], edges: Float[Tensor, "rays edges"], reach: float
) -> Float[Tensor, ""]:
    """Mean density of the samples that begin within `reach` of the ray's start (FreeNeRF's occlusion loss, Eq. 4).

    Args:
        density: σ of each sample.
        edges: the samples' borders, in [0, 1].
        reach: part of the ray that counts as near the camera, in (0, 1].
    """
    return (density * (edges[:, :-1] < reach)).mean()

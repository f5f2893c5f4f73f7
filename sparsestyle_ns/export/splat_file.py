"""Gaussians as files of other programs: the PLY of the reference implementation (Kerbl et al. 2023)."""

import math

import numpy as np
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.export.gaussians import Gaussians
from sparsestyle_ns.utils.ply import encode_ply, floats

CONSTANT_HARMONIC = 0.5 / math.sqrt(math.pi)
"""Of degree 0; a colour is 0.5 more than this times its coefficient."""
REST = 45
"""Coefficients of degrees 1 to 3, which are 0: colour is the same from everywhere."""
FULL_FLOATS, SMALL_FLOATS = 62, 17
"""Numbers of a Gaussian in the file, with and without them."""


def coefficients(colors: Float[Tensor, "gaussians 3"]) -> Float[Tensor, "gaussians 3"]:
    """Of the harmonic of degree 0, from colours as they are displayed."""
    return (colors - 0.5) / CONSTANT_HARMONIC


def encode_splats(gaussians: Gaussians, small: bool = False) -> bytes:
    """A binary PLY file with the reference's fields in their order; a `small` one leaves out f_rest_*.

    Scales are logarithms, opacities logits, quaternions of length 1 with w first, and normals 0.
    """
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [] if small else [f"f_rest_{number}" for number in range(REST)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rows = np.zeros((len(gaussians), len(names)), "<f4")
    rotations = gaussians.rotations / gaussians.rotations.norm(dim=-1, keepdim=True)
    rows[:, 0:3], rows[:, 6:9] = gaussians.means.numpy(), coefficients(gaussians.colors).numpy()
    rows[:, -8] = gaussians.logits.numpy()
    rows[:, -7:-4], rows[:, -4:] = gaussians.log_scales.numpy(), rotations.numpy()
    return encode_ply(("vertex", floats(*names), rows))

"""What may take the hash grid's place in the residual field: sines and cosines, or nothing (Sec. 4.2, the ablations).

Both have the hash grid's two steps, `locate` and `interpolate`, though locating does nothing here.
"""

from typing import Protocol

from jaxtyping import Float
from nerfstudio.field_components.encodings import FieldComponent
from torch import Tensor

from sparsestyle_ns.field_components.hash_grid import GridLocation
from sparsestyle_ns.field_components.positional_encoding import positional_encoding


class PointEncoding(Protocol):
    """What the residual field asks of an encoding."""

    def get_out_dim(self) -> int:
        """Numbers a point."""

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """What is needed of points in [0, 1]³, and stays the same while the encoding learns."""

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points encoded"]:
        """The encoding of located points."""


class FrequencyEncoding(FieldComponent):
    """γ(x) of Eq. 1 with more octaves: ten have waves of 2π/512, shorter than three cells of the finest hash level."""

    def __init__(self, num_levels: int) -> None:
        super().__init__(in_dim=3, out_dim=3 * (1 + 2 * num_levels))
        self.num_levels = num_levels

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """The points as they are."""
        return GridLocation(positions, None)

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points encoded"]:
        """γ at the points."""
        return positional_encoding(2.0 * location.positions - 1.0, self.num_levels)


class NoEncoding(FrequencyEncoding):
    """No numbers at all: the residual field is left with e_c."""

    def __init__(self) -> None:
        super().__init__(num_levels=0)
        self.out_dim = 0

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points 0"]:
        """Nothing."""
        return location.positions[:, :0]

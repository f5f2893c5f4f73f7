"""What may take the hash grid's place in the residual field: sines and cosines, or nothing (Sec. 4.2, ablations)."""

from typing import Union

from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.field_components.hash_grid import GridLocation, HashGrid
from sparsestyle_ns.field_components.positional_encoding import PositionalEncoding
from sparsestyle_ns.field_components.tiny_cuda_grid import TinyCudaGrid


class FrequencyEncoding(PositionalEncoding):
    """γ(x) of Eq. 1 with more octaves: ten have waves of 2π/512, shorter than three cells of the finest hash level."""

    def __init__(self, num_levels: int) -> None:
        super().__init__(in_dim=3, num_levels=num_levels)

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """The points as they are."""
        return GridLocation(positions, None)

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points encoded"]:
        """γ at the points."""
        return self(2.0 * location.positions - 1.0)


class NoEncoding(FrequencyEncoding):
    """No numbers at all: the residual field is left with e_c."""

    def __init__(self) -> None:
        super().__init__(num_levels=0)
        self.out_dim = 0

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points 0"]:
        """Nothing."""
        return location.positions[:, :0]


PointEncoding = Union[HashGrid, TinyCudaGrid, FrequencyEncoding, NoEncoding]
"""`locate` gives what stays the same of points in [0, 1]³ while it learns, `interpolate` the encoding there."""

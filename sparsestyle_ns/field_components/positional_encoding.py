"""Sinusoidal positional encoding γ(x) with the exponents of the paper: sin and cos of 2^k x, k = 0 … L − 1, plus x.

nerfstudio's `NeRFEncoding` multiplies by 2π, so it can't give these frequencies exactly.
"""

from typing import Optional, Union

import torch
from jaxtyping import Float
from nerfstudio.field_components.encodings import FieldComponent
from torch import Tensor

from sparsestyle_ns.field_components.hash_grid import GridLocation, HashGrid
from sparsestyle_ns.field_components.tiny_cuda_grid import TinyCudaGrid


def positional_encoding(
    x: Float[Tensor, "*batch dim"], num_levels: int, level_weights: Optional[Float[Tensor, "levels"]] = None
) -> Float[Tensor, "*batch encoded"]:
    """γ(x) of Eq. 1: [x, sin(x), cos(x), sin(2x), cos(2x), …, sin(2^(L−1) x), cos(2^(L−1) x)].

    Args:
        x: coordinates, of any length unit; useful when they lie in about [−1, 1]. 2^(L−1) x must be below float32's
            largest number; angles of half-precision coordinates are computed, and returned, in float32.
        num_levels: L, the number of octaves. 0 gives x alone.
        level_weights: one factor in [0, 1] for each octave (see `revealed_levels`), or None for all ones.

    Returns:
        dim · (1 + 2 L) values in the order above; within an octave first all sines, then all cosines.
    """
    if num_levels == 0:
        return x
    x = x.to(torch.promote_types(x.dtype, torch.float32))
    frequencies = torch.exp2(torch.arange(num_levels, device=x.device, dtype=x.dtype))
    angles = x[..., None, :] * frequencies[:, None]
    waves = torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1)
    if level_weights is not None:
        waves = waves * level_weights.to(waves)[:, None]
    return torch.cat([x, waves.flatten(start_dim=-2)], dim=-1)


def revealed_levels(fraction: float, num_levels: int) -> Float[Tensor, "levels"]:
    """Weights that reveal the octaves one after another as `fraction` goes from 0 to 1 (FreeNeRF, Eq. 3).

    Octave k has weight clip(fraction · L − k, 0, 1): none at 0, all at 1.
    """
    octaves = torch.arange(num_levels, dtype=torch.float32)
    return torch.clamp(fraction * num_levels - octaves, 0.0, 1.0)


class PositionalEncoding(FieldComponent):
    """`positional_encoding` with `num_levels` octaves as a nerfstudio field component."""

    def __init__(self, in_dim: int, num_levels: int) -> None:
        super().__init__(in_dim=in_dim, out_dim=in_dim * (1 + 2 * num_levels))
        self.num_levels = num_levels
        self.level_weights: Optional[Tensor] = None

    def forward(self, in_tensor: Float[Tensor, "*batch dim"]) -> Float[Tensor, "*batch encoded"]:
        """γ(x), each octave multiplied by `level_weights` where those are set."""
        return positional_encoding(in_tensor, self.num_levels, self.level_weights)


class FrequencyEncoding(PositionalEncoding):
    """γ(x) in the hash grid's place (Sec. 4.2, ablations): ten octaves end near three of its finest cells."""

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

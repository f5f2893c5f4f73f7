"""Multi-resolution hash grid ψ(x) (Sec. 3.1; instant-ngp, Sec. 3): what depends on positions, and what learns.

`HashGrid.locate` prepares points, once where they stay the same from step to step. `locate_corners` and `interpolate`
are the readable form in torch, which runs anywhere; CPU and CUDA have kernels that do the same in one pass.
"""

from importlib.util import find_spec
from types import ModuleType
from typing import NamedTuple, Optional, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from nerfstudio.field_components.encodings import FieldComponent
from torch import Tensor, nn

from sparsestyle_ns.field_components import hash_grid_kernels
from sparsestyle_ns.utils.machine import numbers_on

HASH_PRIMES = (1, 2654435761, 805459861)
"""π1, π2, π3 of the spatial hash (instant-ngp, Eq. 4)."""


class Corners(NamedTuple):
    """The eight corners of the cells that points lie in."""

    rows: Int[Tensor, "points levels 8"]
    """Of the joined table."""
    weights: Float[Tensor, "points levels 8"]
    """Trilinear; they sum to 1 on each level."""


class GridLocation(NamedTuple):
    """Where points lie in a hash grid."""

    positions: Float[Tensor, "points 3"]
    """In [0, 1]."""
    corners: Optional[Corners]
    """None where there are kernels, which work them out faster than they could read them."""

    @property
    def num_bytes(self) -> int:
        """Memory that the location takes."""
        return sum(part.nbytes for part in (self.positions, *(self.corners or ())))


def grid_resolutions(num_levels: int, min_resolution: int, max_resolution: int) -> Tuple[int, ...]:
    """N_m = ⌊N_min b^m⌋ with b = exp((ln N_max − ln N_min)/(M − 1)), m = 0 … M − 1 (Sec. 3.1).

    The rounding down allows for floating-point error, so that the last level has N_max and not N_max − 1.
    """
    if num_levels == 1:
        return (min_resolution,)
    growth = (max_resolution / min_resolution) ** (1.0 / (num_levels - 1))
    return tuple(int(min_resolution * growth**level + 1e-6) for level in range(num_levels))


def hash_corners(corners: Int[Tensor, "*batch 3"], table_size: int) -> Int[Tensor, "*batch"]:
    """Table rows of integer grid corners: (x π1 ⊕ y π2 ⊕ z π3) mod T (instant-ngp, Eq. 4); T a power of two."""
    x, y, z = (corners[..., axis] * prime for axis, prime in enumerate(HASH_PRIMES))
    return (x ^ y ^ z) & (table_size - 1)


def locate_corners(positions: Float[Tensor, "points 3"], resolutions: Tuple[int, ...], table_size: int) -> Corners:
    """Table rows and trilinear weights of points in [0, 1]³ on each level.

    Level m's rows start at m · T of the joined table.
    """
    scale = numbers_on(resolutions, positions.device, positions.dtype)
    scaled = positions[:, None] * scale[:, None]
    lower = scaled.floor()
    fraction = scaled - lower
    offsets = numbers_on([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], positions.device)
    corners = lower.long()[:, :, None] + offsets
    near = torch.where(offsets.bool(), fraction[:, :, None], 1.0 - fraction[:, :, None])
    level_start = torch.arange(len(resolutions), device=positions.device)[:, None] * table_size
    return Corners((hash_corners(corners, table_size) + level_start).int(), near.prod(dim=-1))


def interpolate(table: Float[Tensor, "rows features"], corners: Corners) -> Float[Tensor, "points encoded"]:
    """Weighted sums of table rows: for each point and level, the eight corners' features; levels one after another.

    Differentiable in the table; corners are taken as given.
    """
    points, levels, _ = corners.rows.shape
    rows, weights = corners.rows.flatten(0, 1), corners.weights.flatten(0, 1).to(table.dtype)
    sums = F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")
    return sums.view(points, levels * table.shape[-1])


def fused_kernels(device: torch.device) -> Optional[ModuleType]:
    """The module whose `gather` and `scatter` do the grid's work in one pass on a device; None where there is none."""
    if device.type == "cpu":
        return hash_grid_kernels
    if device.type == "cuda" and find_spec("triton") is not None:  # it comes with torch for CUDA on Linux
        from sparsestyle_ns.field_components import hash_grid_triton

        return hash_grid_triton
    return None


class _Fused(torch.autograd.Function):
    """`locate_corners` and `interpolate` in one pass over the points, in either direction."""

    @staticmethod
    def forward(ctx, table: Tensor, positions: Tensor, resolutions: Tuple[int, ...], kernels: ModuleType) -> Tensor:
        ctx.save_for_backward(positions)
        ctx.resolutions, ctx.kernels, ctx.shape = resolutions, kernels, table.shape
        return kernels.gather(table.view(len(resolutions), -1, table.shape[-1]), positions, resolutions)

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tuple[Tensor, None, None, None]:
        levels = (len(ctx.resolutions), ctx.shape[0] // len(ctx.resolutions), ctx.shape[1])
        (positions,) = ctx.saved_tensors
        table_grad = ctx.kernels.scatter(grad, positions, ctx.resolutions, levels)
        return table_grad.view(ctx.shape), None, None, None


class HashGrid(FieldComponent):
    """ψ(x): `num_levels` grids of features, each hashed into a table.

    Resolutions are cells along the cube's side on the first and the last level; rows start uniform in ± `init_scale`.
    """

    def __init__(
        self,
        num_levels: int = 8,
        min_resolution: int = 128,
        max_resolution: int = 512,
        features_per_level: int = 4,
        log2_table_size: int = 19,
        init_scale: float = 1e-4,
    ) -> None:
        super().__init__(in_dim=3, out_dim=num_levels * features_per_level)
        self.resolutions = grid_resolutions(num_levels, min_resolution, max_resolution)
        self.table_size = 2**log2_table_size
        table = torch.empty(num_levels * self.table_size, features_per_level)
        self.table = nn.Parameter(table.uniform_(-init_scale, init_scale))

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """Where points are; those outside [0, 1]³ are moved to the border."""
        positions = positions.to(self.table.dtype).clamp(0.0, 1.0)
        if fused_kernels(positions.device) is not None:
            return GridLocation(positions, None)
        return GridLocation(positions, locate_corners(positions, self.resolutions, self.table_size))

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points encoded"]:
        """ψ at located points; differentiable in the table."""
        if location.corners is not None:
            return interpolate(self.table, location.corners)
        return _Fused.apply(self.table, location.positions, self.resolutions, fused_kernels(self.table.device))

    def forward(self, in_tensor: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch encoded"]:
        """ψ(x) at positions in [0, 1]³."""
        flat = self.interpolate(self.locate(in_tensor.reshape(-1, 3)))
        return flat.view(*in_tensor.shape[:-1], self.get_out_dim())

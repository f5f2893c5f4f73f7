"""Multi-resolution hash grid ψ(x) (Sec. 3.1; instant-ngp, Sec. 3): what depends on positions, and what learns.

`HashGrid.locate` gives the table rows and interpolation weights of points; `HashGrid.interpolate` gathers and sums.
Points that stay the same from step to step are located once.
"""

import warnings
from typing import NamedTuple, Optional, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from nerfstudio.field_components.encodings import FieldComponent
from torch import Tensor, nn

HASH_PRIMES = (1, 2654435761, 805459861)
"""π1, π2, π3 of the spatial hash (instant-ngp, Eq. 4)."""


class GridLocation(NamedTuple):
    """Where points lie in a hash grid.

    Attributes:
        indices: rows of the joined table, the eight corners of each point's cell on each level.
        weights: trilinear weights of those corners; they sum to 1 on each level.
        scatter: `scatter_matrix` of these two, or None. With it the backward pass is fast on a CPU.
    """

    indices: Int[Tensor, "points levels 8"]
    weights: Float[Tensor, "points levels 8"]
    scatter: Optional[Tensor] = None

    @property
    def num_bytes(self) -> int:
        """Memory that the location takes."""
        dense = sum(part.numel() * part.element_size() for part in (self.indices, self.weights))
        if self.scatter is None:
            return dense
        return dense + 4 * len(self.scatter) + 8 * self.weights.numel()


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


def locate(positions: Float[Tensor, "points 3"], resolutions: Tuple[int, ...], table_size: int) -> GridLocation:
    """Table rows and trilinear weights of points in [0, 1]³ on each level; points outside are moved to the border.

    Level m's rows start at m · T of the joined table.
    """
    scale = torch.tensor(resolutions, device=positions.device, dtype=positions.dtype)
    scaled = positions.clamp(0.0, 1.0)[:, None] * scale[:, None]
    lower = scaled.floor()
    fraction = scaled - lower
    offsets = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], device=positions.device)
    corners = lower.long()[:, :, None] + offsets
    near = torch.where(offsets.bool(), fraction[:, :, None], 1.0 - fraction[:, :, None])
    level_start = torch.arange(len(resolutions), device=positions.device)[:, None] * table_size
    return GridLocation((hash_corners(corners, table_size) + level_start).int(), near.prod(dim=-1))


class _GatherSum(torch.autograd.Function):
    """Weighted sums of table rows, whose backward pass is a product with a sparse matrix where one is at hand."""

    @staticmethod
    def forward(ctx, table: Tensor, location: GridLocation) -> Tensor:
        ctx.location, ctx.rows = location, len(table)
        points, levels, corners = location.indices.shape
        bags = (points * levels, corners)
        weights = location.weights.to(table.dtype).reshape(bags)
        sums = F.embedding_bag(location.indices.reshape(bags), table, per_sample_weights=weights, mode="sum")
        return sums.view(points, levels * table.shape[-1])

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tuple[Tensor, None]:
        indices, weights, scatter = ctx.location
        features = grad.shape[-1] // indices.shape[1]
        bags = grad.reshape(-1, features)
        if scatter is not None:
            return scatter @ bags, None
        parts = weights.to(grad.dtype).reshape(-1, 8, 1) * bags[:, None]
        table_grad = grad.new_zeros(ctx.rows, features).index_add_(0, indices.flatten().long(), parts.flatten(0, 1))
        return table_grad, None


def interpolate(table: Float[Tensor, "rows features"], location: GridLocation) -> Float[Tensor, "points encoded"]:
    """Weighted sums of table rows: for each point and level, the eight corners' features; levels one after another.

    Differentiable in the table; locations are taken as given.
    """
    return _GatherSum.apply(table, location)


def scatter_matrix(location: GridLocation, rows: int) -> Tensor:
    """The matrix whose product with gradients of sums gives the gradient of the table: [rows, points · levels], CSR.

    On a CPU it makes the backward pass several times as fast as adding gradients up one by one; building it takes
    about as long as one backward pass without it, so it pays for locations that are used again and again.
    """
    indices = location.indices.flatten()
    order = torch.argsort(indices, stable=True)
    starts = F.pad(torch.cumsum(torch.bincount(indices, minlength=rows), dim=0), (1, 0))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse (CSR tensor support is in beta|invariant checks)")
        return torch.sparse_csr_tensor(
            starts.int(),
            (order // 8).int(),
            location.weights.flatten()[order],
            size=(rows, indices.numel() // 8),
            check_invariants=False,
        )


class HashGrid(FieldComponent):
    """ψ(x): `num_levels` grids of features, each hashed into a table.

    Args:
        num_levels: M.
        min_resolution: N_min, cells along the cube's side on the first level.
        max_resolution: N_max, on the last.
        features_per_level: length of a table row.
        log2_table_size: log2 of the rows a level has.
        init_scale: rows start uniform in ± this.
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
        """`locate` on this grid's levels; positions in [0, 1]³."""
        return locate(positions, self.resolutions, self.table_size)

    def for_reuse(self, location: GridLocation) -> GridLocation:
        """The same location, prepared to be interpolated at many times."""
        if location.indices.device.type != "cpu":
            return location
        return location._replace(scatter=scatter_matrix(location, len(self.table)))

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points encoded"]:
        """`interpolate` in this grid's tables."""
        return interpolate(self.table, location)

    def forward(self, in_tensor: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch encoded"]:
        """ψ(x) at positions in [0, 1]³."""
        flat = self.interpolate(self.locate(in_tensor.reshape(-1, 3)))
        return flat.view(*in_tensor.shape[:-1], self.get_out_dim())

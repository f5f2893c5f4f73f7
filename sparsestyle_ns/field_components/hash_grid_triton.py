"""The hash grid on a CUDA device: rows, weights and sums in one kernel in either direction.

Gradients of rows that several points share are added up atomically, in no fixed order: their last bits differ by run.
"""

from typing import Tuple

import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.utils.machine import numbers_on

POINTS_PER_PROGRAM = 128


@triton.jit
def _cell(positions, resolution, points, inside):
    """Integer and fractional parts of grid coordinates, for each axis."""
    x = tl.load(positions + points * 3, mask=inside, other=0.0) * resolution
    y = tl.load(positions + points * 3 + 1, mask=inside, other=0.0) * resolution
    z = tl.load(positions + points * 3 + 2, mask=inside, other=0.0) * resolution
    x0, y0, z0 = tl.floor(x), tl.floor(y), tl.floor(z)
    return x0.to(tl.uint32), y0.to(tl.uint32), z0.to(tl.uint32), x - x0, y - y0, z - z0


@triton.jit
def _corner(x, y, z, fx, fy, fz, corner: tl.constexpr, table_size: tl.constexpr):
    """Row, counted from the level's first, and weight of one of a cell's corners (instant-ngp, Eq. 4)."""
    dx: tl.constexpr = corner // 4
    dy: tl.constexpr = corner // 2 % 2
    dz: tl.constexpr = corner % 2
    row = ((x + dx) ^ ((y + dy) * 2654435761) ^ ((z + dz) * 805459861)) & (table_size - 1)
    wx = fx if dx else 1.0 - fx
    wy = fy if dy else 1.0 - fy
    wz = fz if dz else 1.0 - fz
    return row.to(tl.int64), wx * wy * wz


@triton.jit
def _gather(
    table,
    positions,
    resolutions,
    encoded,
    num_points,
    levels: tl.constexpr,
    table_size: tl.constexpr,
    features: tl.constexpr,
    padded: tl.constexpr,
    block: tl.constexpr,
):
    level = tl.program_id(1)
    points = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    feature = tl.arange(0, padded)
    inside = points < num_points
    valid = inside[:, None] & (feature < features)[None, :]
    x, y, z, fx, fy, fz = _cell(positions, tl.load(resolutions + level), points, inside)
    first = table + level.to(tl.int64) * table_size * features
    total = tl.full((block, padded), 0.0, dtype=encoded.dtype.element_ty)
    for corner in tl.static_range(8):
        row, weight = _corner(x, y, z, fx, fy, fz, corner, table_size)
        values = tl.load(first + row[:, None] * features + feature[None, :], mask=valid, other=0.0)
        total += weight[:, None] * values
    out = encoded + (points[:, None] * levels + level) * features + feature[None, :]
    tl.store(out, total, mask=valid)


@triton.jit
def _scatter(
    table_grad,
    positions,
    resolutions,
    grad,
    num_points,
    levels: tl.constexpr,
    table_size: tl.constexpr,
    features: tl.constexpr,
    padded: tl.constexpr,
    block: tl.constexpr,
):
    level = tl.program_id(1)
    points = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    feature = tl.arange(0, padded)
    inside = points < num_points
    valid = inside[:, None] & (feature < features)[None, :]
    x, y, z, fx, fy, fz = _cell(positions, tl.load(resolutions + level), points, inside)
    first = table_grad + level.to(tl.int64) * table_size * features
    values = tl.load(grad + (points[:, None] * levels + level) * features + feature[None, :], mask=valid, other=0.0)
    for corner in tl.static_range(8):
        row, weight = _corner(x, y, z, fx, fy, fz, corner, table_size)
        tl.atomic_add(first + row[:, None] * features + feature[None, :], weight[:, None] * values, mask=valid)


def gather(
    table: Float[Tensor, "levels rows features"], positions: Float[Tensor, "points 3"], resolutions: Tuple[int, ...]
) -> Float[Tensor, "points encoded"]:
    """ψ(x), as `hash_grid_kernels.gather`."""
    encoded = table.new_empty(len(positions), table.shape[0] * table.shape[2])
    _launch(_gather, table.detach().contiguous(), positions, resolutions, encoded, table.shape)
    return encoded


def scatter(
    grad: Float[Tensor, "points encoded"],
    positions: Float[Tensor, "points 3"],
    resolutions: Tuple[int, ...],
    table_shape: Tuple[int, int, int],
) -> Float[Tensor, "levels rows features"]:
    """The gradient of `gather`'s table, from that of its result."""
    table_grad = grad.new_zeros(table_shape)
    _launch(_scatter, table_grad, positions, resolutions, grad.contiguous(), table_shape)
    return table_grad


def _programs(num_points: int, levels: int) -> Tuple[int, int]:
    """How many programs there are: blocks of points first, as CUDA allows 2³¹ − 1 there and 65,535 beside."""
    return triton.cdiv(num_points, POINTS_PER_PROGRAM), levels


def _launch(kernel, table, positions, resolutions, values, table_shape: Tuple[int, int, int]) -> None:
    levels, rows, features = table_shape
    if len(positions) == 0:
        return
    kernel[_programs(len(positions), levels)](
        table,
        positions.contiguous(),
        numbers_on(resolutions, positions.device, positions.dtype),
        values,
        len(positions),
        levels=levels,
        table_size=rows,
        features=features,
        padded=triton.next_power_of_2(features),
        block=POINTS_PER_PROGRAM,
    )

"""The hash grid on a CPU: rows, weights and sums in one pass, nothing written down in between.

Reading kept rows and weights back from memory takes longer than working them out again (two cores, 700,000 samples of a
fern view: 0.21 s to work them out and sum, 0.67 s to read them and sum), and half a kilobyte for each sample is saved.
"""

from functools import cache
from typing import Callable, Tuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.utils.numba_kernels import even_parts, kernel, run_on_threads

_ONE = np.uint32(1)
_PRIME_Y = np.uint32(2654435761)
_PRIME_Z = np.uint32(805459861)


@kernel
def _cell(position, resolution, mask):
    """Rows, counted from the level's first, and trilinear weights of the eight corners around a point in [0, 1]³."""
    x, y, z = position[0] * resolution, position[1] * resolution, position[2] * resolution
    x0, y0, z0 = np.floor(x), np.floor(y), np.floor(z)
    fx, fy, fz = x - x0, y - y0, z - z0
    one = position.dtype.type(1)  # a plain 1 would make float64 of float32
    gx, gy, gz = one - fx, one - fy, one - fz
    # Unsigned products overflow as the hash wants it (instant-ngp, Eq. 4); the prime of x is 1.
    hx, hy, hz = np.uint32(x0), np.uint32(y0) * _PRIME_Y, np.uint32(z0) * _PRIME_Z
    ix, iy, iz = hx + _ONE, hy + _PRIME_Y, hz + _PRIME_Z
    rows = (
        np.int64((hx ^ hy ^ hz) & mask),
        np.int64((hx ^ hy ^ iz) & mask),
        np.int64((hx ^ iy ^ hz) & mask),
        np.int64((hx ^ iy ^ iz) & mask),
        np.int64((ix ^ hy ^ hz) & mask),
        np.int64((ix ^ hy ^ iz) & mask),
        np.int64((ix ^ iy ^ hz) & mask),
        np.int64((ix ^ iy ^ iz) & mask),
    )
    weights = (
        gx * gy * gz,
        gx * gy * fz,
        gx * fy * gz,
        gx * fy * fz,
        fx * gy * gz,
        fx * gy * fz,
        fx * fy * gz,
        fx * fy * fz,
    )
    return rows, weights


@cache
def _kernels(features: int) -> Tuple[Callable[..., None], Callable[..., None]]:
    """Forward and backward pass for table rows of this length, which the compiler must know to unroll the sums."""

    @kernel
    def gather(positions, table, resolution, level, start, end, encoded):
        mask = np.uint32(table.shape[1] - 1)
        for point in range(start, end):
            rows, weights = _cell(positions[point], resolution, mask)
            for feature in range(features):
                total = weights[0] * table[level, rows[0], feature]
                for corner in range(1, 8):
                    total += weights[corner] * table[level, rows[corner], feature]
                encoded[point, level, feature] = total

    @kernel
    def scatter(positions, table_grad, resolution, level, grad):
        mask = np.uint32(table_grad.shape[1] - 1)
        for point in range(len(positions)):
            rows, weights = _cell(positions[point], resolution, mask)
            for corner in range(8):
                for feature in range(features):
                    table_grad[level, rows[corner], feature] += weights[corner] * grad[point, level, feature]

    return gather, scatter


def gather(
    table: Float[Tensor, "levels rows features"], positions: Float[Tensor, "points 3"], resolutions: Tuple[int, ...]
) -> Float[Tensor, "points encoded"]:
    """ψ(x): on each level the weighted sum of the rows of the eight corners around a point.

    Positions lie in [0, 1]; they and the table are float32 or float64. A level has a power of two of rows, and its
    resolution is in cells along the cube's side.
    """
    levels, _, features = table.shape
    encoded = table.new_empty(len(positions), levels, features)
    arrays = positions.contiguous().numpy(), table.detach().numpy(), encoded.numpy()
    scale = arrays[0].dtype.type
    pieces = even_parts(len(positions), max(1, torch.get_num_threads() // levels))
    parts = [
        (arrays[0], arrays[1], scale(resolution), level, start, end, arrays[2])
        for level, resolution in enumerate(resolutions)
        for start, end in pieces
    ]
    run_on_threads(_kernels(features)[0], parts)
    return encoded.flatten(1)


def scatter(
    grad: Float[Tensor, "points encoded"],
    positions: Float[Tensor, "points 3"],
    resolutions: Tuple[int, ...],
    table_shape: Tuple[int, int, int],
) -> Float[Tensor, "levels rows features"]:
    """The gradient of `gather`'s table, from that of its result; sums run in the order of the points, always."""
    table_grad = grad.new_zeros(table_shape)
    values = grad.reshape(len(grad), table_shape[0], table_shape[2]).contiguous().numpy()
    arrays = positions.contiguous().numpy(), table_grad.numpy()
    scale = arrays[0].dtype.type
    parts = [(*arrays, scale(resolution), level, values) for level, resolution in enumerate(resolutions)]
    run_on_threads(_kernels(table_shape[2])[1], parts)
    return table_grad

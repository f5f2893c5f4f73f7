"""Rays as compiled kernels on a CPU see them, and the arithmetic that these kernels share."""

from typing import NamedTuple, Optional

import numpy as np
import torch

from sparsestyle_ns.core import spaces
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.utils.numba_kernels import inlined

RAYS_PER_PART = 2048
"""Rays that a thread follows before it takes the next part: they end early or late, and threads shouldn't wait."""

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_LEAST_DISPARITY = np.float32(0.5 / spaces.MAX_DISTANCE)
_LOG2_E, _LN2_HIGH, _LN2_LOW = np.float32(1.4426950), np.float32(0.693359375), np.float32(-2.1219444e-4)
_TERMS = tuple(np.float32(1.0 / factorial) for factorial in (2, 6, 24, 120, 720))
_BIAS, _MANTISSA = np.int32(127), np.int32(23)  # of a float32's exponent; and bits below it


class Lines(NamedTuple):
    """Rays, in the two forms that segments have."""

    values: np.ndarray
    """Six numbers a ray: start and extent of a straight segment in field coordinates, or origin, in the contraction's
    unit, and direction of a ray that it bends."""
    hit: np.ndarray
    """Whether a ray meets the scene."""
    bent: bool
    unbounded: bool
    """Whether the last interval is infinite."""
    spaced: np.ndarray
    """For bent rays, g of the distance at s = 0, and how much further g is at s = 1."""
    edges: np.ndarray
    """Borders of the samples in s, the same for every ray."""


def lines_of(segments: Segments, num_steps: int, unbounded: bool) -> Optional[Lines]:
    """Segments with the borders of so many even steps; None of those that have no compiled form.

    These are segments on a GPU, in other numbers than float32, and parts of bent ones.
    """
    spaced, bent = torch.zeros(2), isinstance(segments, spaces.ContractedSegments)
    if bent and segments.ends is None:
        parts = segments.origins, segments.directions
        ends = spaces.spacing(torch.tensor([segments.near, spaces.MAX_DISTANCE]))
        spaced = torch.stack([ends[0], ends[1] - ends[0]])
    elif isinstance(segments, spaces.LinearSegments):
        parts = segments.start, segments.extent
    else:
        return None
    if any(part.device.type != "cpu" or part.dtype != torch.float32 for part in parts):
        return None
    return Lines(
        values=torch.cat(parts, dim=-1).numpy(),
        hit=segments.hit.numpy(),
        bent=bent,
        unbounded=unbounded,
        spaced=spaced.numpy(),
        edges=even_edges(1, num_steps, segments.hit.device)[0].numpy(),
    )


@inlined
def point_at(lines, line, s):
    """Field coordinates at s of a ray, given by its six numbers."""
    if not lines.bent:
        return line[0] + s * line[3], line[1] + s * line[4], line[2] + s * line[5]
    spaced = lines.spaced[0] + s * lines.spaced[1]
    distance = spaced + spaced if spaced < _HALF else _HALF / max(_ONE - spaced, _LEAST_DISPARITY)
    x, y, z = line[0] + distance * line[3], line[1] + distance * line[4], line[2] + distance * line[5]
    norm = max(abs(x), abs(y), abs(z))
    scale = _HALF if norm < _ONE else (_ONE - _HALF / norm) / norm
    return x * scale, y * scale, z * scale


@inlined
def length_between(lines, line, start, end):
    """δ from one s to another, in field coordinates; a bent ray's is its chord."""
    x0, y0, z0 = point_at(lines, line, start)
    x1, y1, z1 = point_at(lines, line, end)
    x, y, z = x1 - x0, y1 - y0, z1 - z0
    return np.sqrt(x * x + y * y + z * z)


@inlined
def scaled(coordinate, size):
    """Where a coordinate lies on an axis of `size` units; outside of the cube (and for NaN) at its border."""
    share = _HALF * coordinate + _HALF
    return np.float32(size) * (min(share, _ONE) if share > _ZERO else _ZERO)


@inlined
def exponential(x):
    """e^x for x from -87 to 88, to 3e-7 of it: a polynomial of what is left of a power of 2 (Cody and Waite 1980)."""
    power = np.floor(x * _LOG2_E + _HALF)
    rest = (x - power * _LN2_HIGH) - power * _LN2_LOW
    square = rest * rest
    series = (
        _ONE
        + rest
        + square * (_TERMS[0] + rest * _TERMS[1] + square * (_TERMS[2] + rest * _TERMS[3] + square * _TERMS[4]))
    )
    return series * np.int32((np.int32(power) + _BIAS) << _MANTISSA).view(np.float32)

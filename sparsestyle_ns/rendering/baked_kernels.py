"""Rays through a baked volume on a CPU: from camera to pixel in one pass, nothing written down in between."""

from typing import NamedTuple

import numpy as np

from sparsestyle_ns.core.spaces import MAX_DISTANCE
from sparsestyle_ns.core.volrend import MAX_OPTICAL_DEPTH
from sparsestyle_ns.utils.numba_kernels import kernel

LOOKAHEAD = 6
"""Samples of a ray that may turn out to be missing before the ray waits for them."""
NO_CELL = -1
"""Stands for no missing sample in the list of a ray."""

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_SHADE = np.float32(1.0 / 255.0)
_DEPTH_CAP = np.float32(MAX_OPTICAL_DEPTH)
_UNSEEN = np.float32(2e-4)  # of a ray's weight: with less, a sample has no colour, only opacity
_ENDLESS, _FARTHEST = np.float32(np.inf), np.float32(1e6)
_CAREFUL = np.float32(2 * 0.999)  # the cube's side, but for rounding
_LEAST_DISPARITY = np.float32(0.5 / MAX_DISTANCE)
_BYTE, _NO_BYTE = np.uint64(255), np.uint64(0)
_BITS_8, _BITS_16, _BITS_24, _BITS_32, _BITS_40, _BITS_48, _BITS_56 = (np.uint64(8 * byte) for byte in range(1, 8))


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


class Voxels(NamedTuple):
    """What rays go through: see `Occupancy` and `BakedVolume`, and `DENSITY_UNIT` and what follows it there."""

    clearance: np.ndarray
    """Of each cell of the occupancy's: how many cells away the nearest occupied one is, along the axis on which it is
    farthest; 0 of an occupied cell."""
    slots: np.ndarray
    words: np.ndarray
    """The eight codes of a voxel, the first in the lowest byte, by slot and place in the brick."""
    resolution: int
    unit: np.float32
    step: np.float32
    rounding: np.float32


@kernel
def _point(lines, ray, s):
    """Field coordinates at s."""
    line = lines.values[ray]
    if not lines.bent:
        return line[0] + s * line[3], line[1] + s * line[4], line[2] + s * line[5]
    spaced = lines.spaced[0] + s * lines.spaced[1]
    distance = spaced + spaced if spaced < _HALF else _HALF / max(_ONE - spaced, _LEAST_DISPARITY)
    x, y, z = line[0] + distance * line[3], line[1] + distance * line[4], line[2] + distance * line[5]
    norm = max(abs(x), abs(y), abs(z))
    scale = _HALF if norm < _ONE else (_ONE - _HALF / norm) / norm
    return x * scale, y * scale, z * scale


@kernel
def _length(lines, ray, sample):
    """δ of a sample, in field coordinates."""
    x0, y0, z0 = _point(lines, ray, lines.edges[sample])
    x1, y1, z1 = _point(lines, ray, lines.edges[sample + 1])
    x, y, z = x1 - x0, y1 - y0, z1 - z0
    return np.sqrt(x * x + y * y + z * z)


@kernel
def _scaled(coordinate, size):
    """Where a coordinate lies on an axis of `size` units; outside of the cube (and for NaN) at its border."""
    share = _HALF * coordinate + _HALF
    return np.float32(size) * (min(share, _ONE) if share > _ZERO else _ZERO)


@kernel
def _empty_steps(clearance, x, y, z, length):
    """How many steps of a length, from this point on, surely lie in empty cells; 0 in an occupied one."""
    size = clearance.shape[0]
    i, j, k = int(_scaled(x, size)), int(_scaled(y, size)), int(_scaled(z, size))
    cells = clearance[min(i, size - 1), min(j, size - 1), min(k, size - 1)]
    if cells <= 1:
        return int(cells)
    # From any point of a cell it is a cell less to the nearest occupied one.
    leap = np.float32(cells - 1) * _CAREFUL / (np.float32(size) * length)
    return 1 + int(leap) if leap < _FARTHEST else 1  # no number passes neither


@kernel
def _words(voxels, i, j, k):
    """The eight corners of a cell, from (0, 0, 0), (0, 0, 1) … to (1, 1, 1)."""
    slots, words = voxels.slots, voxels.words
    x0, y0, z0 = (i & 6) << 6 | (i & 1) << 2, (j & 6) << 4 | (j & 1) << 1, (k & 6) << 2 | (k & 1)
    i1, j1, k1 = i + 1, j + 1, k + 1
    x1, y1, z1 = (i1 & 6) << 6 | (i1 & 1) << 2, (j1 & 6) << 4 | (j1 & 1) << 1, (k1 & 6) << 2 | (k1 & 1)
    i, j, k, i1, j1, k1 = i >> 3, j >> 3, k >> 3, i1 >> 3, j1 >> 3, k1 >> 3
    slot = slots[i, j, k]
    if i == i1 and j == j1 and k == k1:  # two cells in three
        return (
            words[slot, x0 | y0 | z0],
            words[slot, x0 | y0 | z1],
            words[slot, x0 | y1 | z0],
            words[slot, x0 | y1 | z1],
            words[slot, x1 | y0 | z0],
            words[slot, x1 | y0 | z1],
            words[slot, x1 | y1 | z0],
            words[slot, x1 | y1 | z1],
        )
    return (
        words[slot, x0 | y0 | z0],
        words[slots[i, j, k1], x0 | y0 | z1],
        words[slots[i, j1, k], x0 | y1 | z0],
        words[slots[i, j1, k1], x0 | y1 | z1],
        words[slots[i1, j, k], x1 | y0 | z0],
        words[slots[i1, j, k1], x1 | y0 | z1],
        words[slots[i1, j1, k], x1 | y1 | z0],
        words[slots[i1, j1, k1], x1 | y1 | z1],
    )


@kernel
def _corner_weights(fx, fy, fz):
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    return (
        gx * gy * gz,
        gx * gy * fz,
        gx * fy * gz,
        gx * fy * fz,
        fx * gy * gz,
        fx * gy * fz,
        fx * fy * gz,
        fx * fy * fz,
    )


@kernel
def _densities(words, weights):
    """Whether all corners are known, and the trilinear means of their first two bytes, the densities' codes."""
    known, a, b = True, _ZERO, _ZERO
    for corner in range(8):
        weight, word = weights[corner], words[corner]
        known &= (word & _BYTE) != _NO_BYTE
        a += weight * np.float32(word & _BYTE)
        b += weight * np.float32(word >> _BITS_8 & _BYTE)
    return known, a, b


@kernel
def _colors(words, weights):
    """The trilinear means of the corners' other six bytes: the style's colour and the coarse one."""
    c, d, e, f, g, h = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for corner in range(8):
        weight, word = weights[corner], words[corner]
        c += weight * np.float32(word >> _BITS_16 & _BYTE)
        d += weight * np.float32(word >> _BITS_24 & _BYTE)
        e += weight * np.float32(word >> _BITS_32 & _BYTE)
        f += weight * np.float32(word >> _BITS_40 & _BYTE)
        g += weight * np.float32(word >> _BITS_48 & _BYTE)
        h += weight * np.float32(word >> _BITS_56)
    return c, d, e, f, g, h


@kernel
def _density(voxels, code):
    """The density that has this code."""
    if code - _ONE <= voxels.rounding:
        return _ZERO
    return voxels.unit * (np.exp(voxels.step * (code - _ONE)) - _ONE)


@kernel
def _transmitted(density, length, infinite):
    """exp(−τ) of a sample."""
    if density <= _ZERO:
        return _ONE
    return np.exp(-_DEPTH_CAP if infinite else -min(density * length, _DEPTH_CAP))


@kernel
def _between(first, second, share):
    """From the first at a share of 0 to the second at 1, exactly at both."""
    return (_ONE - share) * first + share * second


@kernel
def march_rays(rays, start, end, lines, voxels, second, shares, min_transmittance, sums, missing):
    """Adds up the samples of `rays[start:end]`, as `render_packed` does.

    Args:
        second: the same with another style, or None; what becomes of None is compiled without it.
        shares: of the style in the density and in the colour, and of the second style in the style (see `mixing`).
        sums: result, by ray: rgb, Σw and Σws of the mixed field, and the same of the coarse one.
        missing: result, by place in `rays`: the cells of samples whose corners aren't known yet, by their lower
            corner's index among all voxels. A ray that has any has to be marched again.
    """
    last, top = len(lines.edges) - 2, voxels.resolution
    density_share, color_share, blend = shares
    for place in range(start, end):
        ray = rays[place]
        if not lines.hit[ray]:
            continue
        lacking = 0
        r, g, b, opacity, moment = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
        coarse_r, coarse_g, coarse_b, coarse_opacity, coarse_moment = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
        light, coarse_light = _ONE, _ONE
        length = _length(lines, ray, 0)
        following = 0
        while following <= last:
            sample, following = following, following + 1
            if coarse_light <= min_transmittance or lacking == LOOKAHEAD:
                break
            s = _HALF * (lines.edges[sample] + lines.edges[sample + 1])
            x, y, z = _point(lines, ray, s)
            infinite = lines.unbounded and sample == last
            if not infinite:
                empty = _empty_steps(voxels.clearance, x, y, z, _ENDLESS if lines.bent else length)
                if empty > 0:
                    following = sample + empty
                    if lines.unbounded:
                        following = min(following, last)
                    continue
            u, v, w = _scaled(x, top), _scaled(y, top), _scaled(z, top)
            i, j, k = min(int(u), top - 1), min(int(v), top - 1), min(int(w), top - 1)
            fu, fv, fw = u - np.float32(i), v - np.float32(j), w - np.float32(k)
            words, near = _words(voxels, i, j, k), _corner_weights(fu, fv, fw)
            known, code, style_code = _densities(words, near)
            density = _density(voxels, code)
            style_density = density if style_code == code else _density(voxels, style_code)
            if second is not None:
                second_words = _words(second, i, j, k)
                both, _, other_code = _densities(second_words, near)
                known &= both
                style_density = _between(style_density, _density(second, other_code), blend)
            if not known:
                missing[place, lacking] = (i * top + j) * top + k
                lacking += 1
                continue
            if lines.bent:
                length = _length(lines, ray, sample)
            left = _transmitted(density, length, infinite)
            coarse_weight = coarse_light * (_ONE - left)
            coarse_light *= left
            if style_density != density:
                left = _transmitted(_between(density, style_density, density_share), length, infinite)
            weight = light * (_ONE - left)
            light *= left
            coarse_opacity += coarse_weight
            coarse_moment += coarse_weight * s
            opacity += weight
            moment += weight * s
            if max(coarse_weight, weight) < _UNSEEN:
                continue
            style_r, style_g, style_b, own_r, own_g, own_b = _colors(words, near)
            if second is not None:
                other = _colors(second_words, near)
                style_r = _between(style_r, other[0], blend)
                style_g = _between(style_g, other[1], blend)
                style_b = _between(style_b, other[2], blend)
            coarse_r += coarse_weight * own_r
            coarse_g += coarse_weight * own_g
            coarse_b += coarse_weight * own_b
            r += weight * _between(own_r, style_r, color_share)
            g += weight * _between(own_g, style_g, color_share)
            b += weight * _between(own_b, style_b, color_share)
        sums[ray, 0], sums[ray, 1], sums[ray, 2] = _SHADE * r, _SHADE * g, _SHADE * b
        sums[ray, 3], sums[ray, 4] = opacity, moment
        sums[ray, 5], sums[ray, 6], sums[ray, 7] = _SHADE * coarse_r, _SHADE * coarse_g, _SHADE * coarse_b
        sums[ray, 8], sums[ray, 9] = coarse_opacity, coarse_moment

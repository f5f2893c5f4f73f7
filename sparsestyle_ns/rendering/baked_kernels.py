"""Rays through a baked volume on a CPU: from camera to pixel in one pass, nothing written down in between."""

from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sparsestyle_ns.core.volrend import MAX_OPTICAL_DEPTH
from sparsestyle_ns.rendering.lines import exponential, length_between, point_at, scaled
from sparsestyle_ns.utils.numba_kernels import inlined, kernel

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
_BYTE, _NO_BYTE = np.uint64(255), np.uint64(0)


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


@inlined
def _empty_steps(clearance, x, y, z, length):
    """How many steps of a length, from this point on, surely lie in empty cells; 0 in an occupied one."""
    size = clearance.shape[0]
    last = np.uint32(size - 1)
    i, j, k = np.uint32(scaled(x, size)), np.uint32(scaled(y, size)), np.uint32(scaled(z, size))
    cells = clearance[np.uintp(min(i, last)), np.uintp(min(j, last)), np.uintp(min(k, last))]
    if cells <= 1:
        return int(cells)
    # From any point of a cell it is a cell less to the nearest occupied one.
    leap = np.float32(cells - 1) * _CAREFUL / (np.float32(size) * length)
    return 1 + int(leap) if leap < _FARTHEST else 1  # no number passes neither


@inlined
def _slot(slots, i, j, k):
    return slots[np.uintp(i), np.uintp(j), np.uintp(k)]  # without a sign, an index isn't asked whether it is negative


@inlined
def _word(words, slot, place):
    return words[np.uintp(slot), np.uintp(place)]


@inlined
def _words(voxels, i, j, k):
    """The eight corners of a cell, from (0, 0, 0), (0, 0, 1) … to (1, 1, 1)."""
    slots, words = voxels.slots, voxels.words
    x0, y0, z0 = (i & 6) << 6 | (i & 1) << 2, (j & 6) << 4 | (j & 1) << 1, (k & 6) << 2 | (k & 1)
    i1, j1, k1 = i + 1, j + 1, k + 1
    x1, y1, z1 = (i1 & 6) << 6 | (i1 & 1) << 2, (j1 & 6) << 4 | (j1 & 1) << 1, (k1 & 6) << 2 | (k1 & 1)
    i, j, k, i1, j1, k1 = i >> 3, j >> 3, k >> 3, i1 >> 3, j1 >> 3, k1 >> 3
    slot = _slot(slots, i, j, k)
    if i == i1 and j == j1 and k == k1:  # two cells in three
        return (
            _word(words, slot, x0 | y0 | z0),
            _word(words, slot, x0 | y0 | z1),
            _word(words, slot, x0 | y1 | z0),
            _word(words, slot, x0 | y1 | z1),
            _word(words, slot, x1 | y0 | z0),
            _word(words, slot, x1 | y0 | z1),
            _word(words, slot, x1 | y1 | z0),
            _word(words, slot, x1 | y1 | z1),
        )
    return (
        _word(words, slot, x0 | y0 | z0),
        _word(words, _slot(slots, i, j, k1), x0 | y0 | z1),
        _word(words, _slot(slots, i, j1, k), x0 | y1 | z0),
        _word(words, _slot(slots, i, j1, k1), x0 | y1 | z1),
        _word(words, _slot(slots, i1, j, k), x1 | y0 | z0),
        _word(words, _slot(slots, i1, j, k1), x1 | y0 | z1),
        _word(words, _slot(slots, i1, j1, k), x1 | y1 | z0),
        _word(words, _slot(slots, i1, j1, k1), x1 | y1 | z1),
    )


@inlined
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


@inlined
def _are_known(words):
    """Whether all corners have been evaluated."""
    known = True
    for corner in range(8):
        known &= (words[corner] & _BYTE) != _NO_BYTE
    return known


@intrinsic
def _mean(typing_context, words, weights):
    """The trilinear means of the corners' eight bytes: codes of both densities, the style's colour, the coarse one.

    In vectors of eight numbers, which the compiler doesn't find by itself, and added up in pairs: a sample's light has
    to wait for these sums.
    """

    def generate(context, builder, signature, arguments):
        corners = [cgutils.unpack_tuple(builder, argument, 8) for argument in arguments]
        vector, index = ir.VectorType(ir.FloatType(), 8), ir.IntType(32)
        unset, firsts = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(index, 8), [0] * 8)
        parts = []
        for word, weight in zip(*corners, strict=True):
            codes = builder.uitofp(builder.bitcast(word, ir.VectorType(ir.IntType(8), 8)), vector)
            weight = builder.shuffle_vector(builder.insert_element(unset, weight, index(0)), unset, firsts)
            parts.append(builder.fmul(codes, weight, flags=("contract",)))
        while len(parts) > 1:
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [builder.fadd(first, second, flags=("contract",)) for first, second in pairs]
        means = [builder.extract_element(parts[0], index(place)) for place in range(8)]
        return context.make_tuple(builder, signature.return_type, means)

    return types.UniTuple(types.float32, 8)(words, weights), generate


@inlined
def _density(voxels, code):
    """The density that has this code."""
    if code - _ONE <= voxels.rounding:
        return _ZERO
    return voxels.unit * (exponential(voxels.step * (code - _ONE)) - _ONE)


@inlined
def _transmitted(density, length, infinite):
    """exp(−τ) of a sample."""
    if density <= _ZERO:
        return _ONE
    return exponential(-_DEPTH_CAP if infinite else -min(density * length, _DEPTH_CAP))


@inlined
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
    middles = _HALF * (lines.edges[1:] + lines.edges[:-1])
    density_share, color_share, blend = shares
    for place in range(start, end):
        ray = rays[place]
        if not lines.hit[ray]:
            continue
        values = lines.values[ray]
        line = values[0], values[1], values[2], values[3], values[4], values[5]
        lacking = 0
        r, g, b, opacity, moment = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
        coarse_r, coarse_g, coarse_b, coarse_opacity, coarse_moment = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
        light, coarse_light = _ONE, _ONE
        length = length_between(lines, line, lines.edges[0], lines.edges[1])
        following = 0
        while following <= last:
            sample, following = following, following + 1
            if coarse_light <= min_transmittance or lacking == LOOKAHEAD:
                break
            s = middles[sample]
            x, y, z = point_at(lines, line, s)
            infinite = lines.unbounded and sample == last
            if not infinite:
                empty = _empty_steps(voxels.clearance, x, y, z, _ENDLESS if lines.bent else length)
                if empty > 0:
                    following = sample + empty
                    if lines.unbounded:
                        following = min(following, last)
                    continue
            u, v, w = scaled(x, top), scaled(y, top), scaled(z, top)
            i, j, k = min(int(u), top - 1), min(int(v), top - 1), min(int(w), top - 1)
            fu, fv, fw = u - np.float32(i), v - np.float32(j), w - np.float32(k)
            words, near = _words(voxels, i, j, k), _corner_weights(fu, fv, fw)
            known, mean = _are_known(words), _mean(words, near)
            code, style_code = mean[0], mean[1]
            density = _density(voxels, code)
            style_density = density if style_code == code else _density(voxels, style_code)
            if second is not None:
                second_words = _words(second, i, j, k)
                known &= _are_known(second_words)
                other = _mean(second_words, near)
                style_density = _between(style_density, _density(second, other[1]), blend)
            if not known:
                missing[place, lacking] = (i * top + j) * top + k
                lacking += 1
                continue
            if lines.bent:
                length = length_between(lines, line, lines.edges[sample], lines.edges[sample + 1])
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
            style_r, style_g, style_b, own_r, own_g, own_b = mean[2:]
            if second is not None:
                style_r = _between(style_r, other[2], blend)
                style_g = _between(style_g, other[3], blend)
                style_b = _between(style_b, other[4], blend)
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

"""`few_samples` on a CPU: a ray is cut into stretches in one pass, nothing written down in between."""

from typing import NamedTuple

import numpy as np

from sparsestyle_ns.core.volrend import MAX_OPTICAL_DEPTH
from sparsestyle_ns.rendering.lines import exponential, length_between, point_at, scaled
from sparsestyle_ns.utils.numba_kernels import inlined, kernel

_ZERO, _HALF, _ONE, _THIRD = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(1 / 3)
_DEPTH_CAP = np.float32(MAX_OPTICAL_DEPTH)
_THIN = np.float32(0.01)  # an optical depth below which 1 - exp(-τ) has lost digits
_DARK = np.float32(1e-7)  # of the light: what is behind doesn't say where to look more closely
_EPSILON, _LEAST_SUM = np.float32(np.finfo(np.float32).eps), np.float32(1e-12)


class Settings(NamedTuple):
    """What rays are looked at with: see `few_samples`, whose names these are."""

    log_density: np.ndarray
    occupied: np.ndarray
    """One occupied cell, where none is known to be empty."""
    fine_steps: int
    fine_even_share: np.float32
    rounds: int
    share: np.float32
    """Of the stretches' mass, that is spread evenly."""
    share_within: np.float32
    least_weight: np.float32
    """Stretches with no more have no sample; below 0 all have one."""
    tiny: np.float32


@inlined
def _row(size):
    return np.empty(size, np.float32)


@inlined
def _is_occupied(occupied, x, y, z):
    size = occupied.shape[0]
    i, j, k = int(scaled(x, size)), int(scaled(y, size)), int(scaled(z, size))
    return occupied[np.uintp(min(i, size - 1)), np.uintp(min(j, size - 1)), np.uintp(min(k, size - 1))]


@inlined
def _on_axis(coordinate, size):
    """The cell centres on both sides of a coordinate, and how far it is from the first to the second."""
    place = min(max(scaled(coordinate, size) - _HALF, _ZERO), np.float32(size - 1))
    lower = int(place)
    return np.uintp(lower), np.uintp(min(lower + 1, size - 1)), place - np.float32(lower)


@inlined
def _mixed(first, second, share):
    return first + share * (second - first)


@inlined
def _volume_density(log_density, x, y, z):
    """See `DensityVolume.density`."""
    i, i1, fx = _on_axis(x, log_density.shape[0])
    j, j1, fy = _on_axis(y, log_density.shape[1])
    k, k1, fz = _on_axis(z, log_density.shape[2])
    near = _mixed(
        _mixed(log_density[i, j, k], log_density[i, j, k1], fz),
        _mixed(log_density[i, j1, k], log_density[i, j1, k1], fz),
        fy,
    )
    far = _mixed(
        _mixed(log_density[i1, j, k], log_density[i1, j, k1], fz),
        _mixed(log_density[i1, j1, k], log_density[i1, j1, k1], fz),
        fy,
    )
    return exponential(_mixed(near, far, fx))


@inlined
def _stopped(depth):
    """1 − exp(−τ)."""
    if depth < _THIN:
        return depth * (_ONE - _HALF * depth * (_ONE - _THIRD * depth))
    return _ONE - exponential(-min(depth, _DEPTH_CAP))


@inlined
def _look(lines, line, settings, edges, count, until_dark, depth, lengths):
    """Optical depths by the volume, and lengths, of a ray's steps; 0 in empty cells.

    With `until_dark`, what no light reaches has no depth.
    """
    extent = np.sqrt(line[3] * line[3] + line[4] * line[4] + line[5] * line[5])
    behind = _ZERO
    dark = -np.log(_DARK)
    for step in range(count):
        x, y, z = point_at(lines, line, _HALF * (edges[step] + edges[step + 1]))
        depth[step] = _ZERO
        if not _is_occupied(settings.occupied, x, y, z):
            lengths[step] = _ZERO
            continue
        if lines.bent:
            lengths[step] = length_between(lines, line, edges[step], edges[step + 1])
        else:
            lengths[step] = (edges[step + 1] - edges[step]) * extent
        if until_dark and behind > dark:
            continue
        depth[step] = min(_volume_density(settings.log_density, x, y, z) * lengths[step], _DEPTH_CAP)
        behind += depth[step]


@inlined
def _weigh(depth, count, weights):
    """The weights of steps, or of stretches, by their depths."""
    light = _ONE
    for step in range(count):
        weights[step] = light * _stopped(depth[step])
        light *= exponential(-depth[step])


@inlined
def _over_sum(values, count):
    """What values are multiplied by for a sum of 1; any number where all are 0."""
    total = 0.0
    for step in range(count):
        total += values[step]
    return _ONE / max(np.float32(total), _LEAST_SUM)


@inlined
def _accumulate(mass, count, until):
    """Sums of steps' values up to each border."""
    total = 0.0
    until[0] = _ZERO
    for step in range(count):
        total += mass[step]
        until[step + 1] = total


@inlined
def _quantiles(edges, until, count, parts, borders):
    """`sample_pdf`: borders that cut so many steps into parts of equal mass, `until` of which lies before each edge."""
    total = until[count]
    borders[0], borders[parts] = edges[0], edges[count]
    right = 1
    for border in range(1, parts):
        wanted = np.float32(border) / np.float32(parts)
        while right < count and until[right] / total <= wanted:
            right += 1
        left, next_ = until[right - 1] / total, until[right] / total
        part = min(max((wanted - left) / max(next_ - left, _EPSILON), _ZERO), _ONE)
        borders[border] = _mixed(edges[right - 1], edges[right], part)


@inlined
def _place(edges, count, s, tiny, first):
    """The step that a point lies in, no earlier than `first`, and how far in it is, from 0 to 1."""
    step = first
    while step < count - 1 and edges[step + 1] <= s:
        step += 1
    part = (s - edges[step]) / max(edges[step + 1] - edges[step], tiny)
    return step, min(max(part, _ZERO), _ONE)


@inlined
def _gather(edges, until, moment, count, parts, tiny, borders, centers):
    """Borders half-way between the centres of the mass on both sides (see `few_samples._gathered`)."""
    step, part = _place(edges, count, borders[0], tiny, 0)
    mass_before = _mixed(until[step], until[step + 1], part)
    moment_before = _mixed(moment[step], moment[step + 1], part)
    for border in range(1, parts + 1):
        step, part = _place(edges, count, borders[border], tiny, step)
        mass, weighted = _mixed(until[step], until[step + 1], part), _mixed(moment[step], moment[step + 1], part)
        center = (weighted - moment_before) / max(mass - mass_before, tiny)
        centers[border - 1] = min(max(center, borders[border - 1]), borders[border])
        mass_before, moment_before = mass, weighted
    for border in range(1, parts):
        borders[border] = _HALF * (centers[border - 1] + centers[border])


@kernel
def cut_rays(start, end, lines, settings, least_light, kept, s, lengths, depth):
    """Cuts the rays from `start` to `end` into stretches.

    Args:
        least_light: with less in front of it, an unbounded space's last step is not looked at.
        kept: result, [rays, samples]: whether a stretch has a sample; an unbounded space's last step comes last.
        s, lengths, depth: results: see `few_samples.Stretches`; anything where there is no sample.
    """
    steps, fine = len(lines.edges) - 1, settings.fine_steps
    count = kept.shape[1]
    if lines.unbounded:
        steps, count = steps - 1, count - 1
    most = max(steps, fine)
    edges, borders, centers = _row(fine + 1), _row(count + 1), _row(count)
    taus, spans, weights, mass = _row(most), _row(most), _row(most), _row(most)
    until, moment = np.empty(most + 1), np.empty(most + 1)
    for ray in range(start, end):
        for sample in range(kept.shape[1]):
            kept[ray, sample] = False
        if not lines.hit[ray]:
            continue
        values = lines.values[ray]
        line = values[0], values[1], values[2], values[3], values[4], values[5]
        _look(lines, line, settings, lines.edges, steps, True, taus, spans)
        _weigh(taus, steps, weights)
        for step in range(steps):  # a surface may lie at the end of a step that hardly shows it
            mass[step] = max(weights[max(step - 1, 0)], weights[step], weights[min(step + 1, steps - 1)])
        near, evenly = _over_sum(mass, steps), _over_sum(spans, steps)
        for step in range(steps):
            mass[step] = _mixed(near * mass[step], evenly * spans[step], settings.fine_even_share) + settings.tiny
        _accumulate(mass, steps, until)
        _quantiles(lines.edges, until, steps, fine, edges)
        _look(lines, line, settings, edges, fine, False, taus, spans)
        _weigh(taus, fine, weights)
        near, evenly = _over_sum(weights, fine), _over_sum(spans, fine)
        for step in range(fine):
            mass[step] = _mixed(near * weights[step], evenly * spans[step], settings.share) + settings.tiny
        _accumulate(mass, fine, until)
        _quantiles(edges, until, fine, count, borders)
        for step in range(fine):
            mass[step] *= _HALF * (edges[step] + edges[step + 1])
        _accumulate(mass, fine, moment)
        for _ in range(settings.rounds):
            _gather(edges, until, moment, fine, count, settings.tiny, borders, centers)
        for step in range(fine):
            mass[step] = _mixed(near * weights[step], evenly * spans[step], settings.share_within) + settings.tiny
        _accumulate(mass, fine, until)
        step, part = _place(edges, fine, borders[0], settings.tiny, 0)
        middle, before = 0, _mixed(until[step], until[step + 1], part)
        light, total_depth = _ONE, _ZERO
        for sample in range(count):
            first, share = step, part
            step, part = _place(edges, fine, borders[sample + 1], settings.tiny, step)
            after = _mixed(until[step], until[step + 1], part)
            half = 0.5 * (before + after)
            while middle < fine - 1 and until[middle + 1] <= half:
                middle += 1
            within = (half - until[middle]) / max(until[middle + 1] - until[middle], settings.tiny)
            s[ray, sample] = _mixed(edges[middle], edges[middle + 1], min(max(np.float32(within), _ZERO), _ONE))
            tau, length = part * taus[step] - share * taus[first], part * spans[step] - share * spans[first]
            for between in range(first, step):
                tau += taus[between]
                length += spans[between]
            tau, length = max(tau, _ZERO), max(length, _ZERO)
            lengths[ray, sample], depth[ray, sample] = length, tau
            kept[ray, sample] = length > _ZERO and light * _stopped(tau) > settings.least_weight
            light *= exponential(-min(tau, _DEPTH_CAP))
            total_depth += tau
            before = after
        if lines.unbounded:
            kept[ray, count] = exponential(-min(total_depth, _DEPTH_CAP)) > least_light
            s[ray, count] = _HALF * (lines.edges[steps] + lines.edges[steps + 1])
            lengths[ray, count], depth[ray, count] = np.inf, _ZERO

"""Rays as compiled kernels see them, against the segments that they are made of."""

import numpy as np
import pytest
import torch
from test_baked import SPACES, rays_of

from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.rendering.lines import exponential, length_between, lines_of, point_at, scaled
from sparsestyle_ns.utils.numba_kernels import kernel

STEPS = 12


@kernel
def points_and_lengths(lines, points, lengths):
    for ray in range(len(lines.hit)):
        values = lines.values[ray]
        line = values[0], values[1], values[2], values[3], values[4], values[5]
        for border in range(len(lines.edges)):
            points[ray, border, 0], points[ray, border, 1], points[ray, border, 2] = point_at(
                lines, line, lines.edges[border]
            )
        for step in range(len(lines.edges) - 1):
            lengths[ray, step] = length_between(lines, line, lines.edges[step], lines.edges[step + 1])


@kernel
def exponentials(values, results):
    for index in range(len(values)):
        results[index] = exponential(values[index])


@kernel
def places(values, size, results):
    for index in range(len(values)):
        results[index] = scaled(values[index], size)


@pytest.mark.parametrize("space", SPACES)
def test_points_and_lengths_are_those_of_the_segments(space):
    segments = SPACES[space].segments(*rays_of(space))
    lines = lines_of(segments, STEPS, SPACES[space].unbounded)
    edges = torch.linspace(0.0, 1.0, STEPS + 1).expand(len(segments.hit), -1)
    points, lengths = torch.zeros(*edges.shape, 3), torch.zeros(len(edges), STEPS)
    points_and_lengths(lines, points.numpy(), lengths.numpy())
    torch.testing.assert_close(points, segments.positions(edges), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(lengths, segments.lengths(edges), atol=1e-5, rtol=1e-5)
    assert lines.unbounded == SPACES[space].unbounded
    assert np.array_equal(lines.hit, segments.hit.numpy())


def test_the_exponential_is_right_from_the_smallest_to_the_largest_number():
    values = np.linspace(-87.0, 88.0, 100_001, dtype=np.float32)
    results = np.empty_like(values)
    exponentials(values, results)
    assert np.abs(results / np.exp(values.astype(np.float64)) - 1.0).max() < 3e-7


def test_places_lie_between_the_ends_of_their_axis_whatever_the_coordinate():
    values = np.array([-1.0, 0.0, 1.0, -3.0, 5.0, np.inf, -np.inf, np.nan], dtype=np.float32)
    results = np.empty_like(values)
    places(values, 8, results)
    assert results.tolist() == [0.0, 4.0, 8.0, 0.0, 8.0, 8.0, 0.0, 0.0]


def test_segments_of_another_kind_have_no_compiled_form():
    class Spiral(Segments):
        hit = torch.ones(1, dtype=torch.bool)
        positions = lengths = distance = at_distance = _part = None

    assert lines_of(Spiral(), STEPS, unbounded=False) is None


def test_parts_of_bent_segments_and_other_numbers_have_no_compiled_form():
    rays = rays_of("contracted")
    bent = SPACES["contracted"].segments(*rays)
    near = torch.full((len(bent.hit), 1), 0.5)
    assert lines_of(bent.between(near, 2.0 * near), STEPS, unbounded=False) is None
    straight = SPACES["box"].segments(*(part.double() for part in rays_of("box")))
    assert lines_of(straight, STEPS, unbounded=False) is None

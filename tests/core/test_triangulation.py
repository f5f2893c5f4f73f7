"""Where two rays meet, and how far they miss each other."""

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from sparsestyle_ns.core.triangulation import distances_to_meeting, reprojection_errors


def rays_to(points, seed=0, noise=0.0):
    """Rays to points from two cameras each, off by random angles of about `noise` radians."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(2, len(points), 3, generator=generator, dtype=torch.float64)
    directions = normalize(points - origins, dim=-1)
    turned = directions + noise * torch.randn(directions.shape, generator=generator, dtype=torch.float64)
    return origins, normalize(turned, dim=-1)


POINTS = 5.0 + torch.rand(30, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def test_rays_meet_where_they_lead():
    origins, directions = rays_to(POINTS)
    distances = distances_to_meeting(origins, directions)
    torch.testing.assert_close(origins + distances[..., None] * directions, POINTS.expand(2, -1, -1))
    assert reprojection_errors(origins, directions, 0.0).max() < 1e-8


def test_turned_away_from_each_other_lines_meet_behind_the_cameras():
    origins, directions = rays_to(POINTS)
    torch.testing.assert_close(distances_to_meeting(origins, -directions), -distances_to_meeting(origins, directions))


def test_a_ray_that_passes_another_is_measured_where_it_comes_nearest_and_a_parallel_one_never():
    origins = torch.tensor([[[0.0, 0, 0], [0, 0, 0]], [[-2.0, 0.5, -3], [1, 0, 0]]])
    directions = torch.tensor([[[0.0, 0, -1], [0, 0, -1]], [[1.0, 0, 0], [0, 0, -1]]])
    assert distances_to_meeting(origins, directions).tolist() == [[3.0, torch.inf], [2.0, torch.inf]]


def test_a_hand_worked_pair_that_passes_at_a_distance():
    # One ray along z from the origin, one along x from (-3, 0.2, 4): they pass 0.2 apart, at 4 and at 3.
    origins = torch.tensor([[[0.0, 0.0, 0.0]], [[-3.0, 0.2, 4.0]]])
    directions = torch.tensor([[[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]])
    torch.testing.assert_close(distances_to_meeting(origins, directions), torch.tensor([[4.0], [3.0]]))
    expected = torch.atan(torch.tensor([[0.1 / 4], [0.1 / 3]]))
    torch.testing.assert_close(reprojection_errors(origins, directions, 0.0), expected)


def test_the_error_is_the_angle_to_the_middle_between_the_rays():
    origins, directions = rays_to(POINTS, noise=0.01)
    distances = distances_to_meeting(origins, directions)
    middle = (origins + distances[..., None] * directions).mean(dim=0)
    cosine = (normalize(middle - origins, dim=-1) * directions).sum(dim=-1)
    expected = torch.from_numpy(np.arccos(cosine.numpy()))
    torch.testing.assert_close(reprojection_errors(origins, directions, 0.0), expected, atol=1e-7, rtol=1e-5)


def test_parallel_rays_and_points_behind_a_camera_count_for_nothing():
    origins = torch.tensor([[[0.0, 0, 0], [0.0, 0, 0]], [[1.0, 0, 0], [1.0, 0, 0]]], requires_grad=True)
    ahead, apart = [0.0, 0.0, 1.0], normalize(torch.tensor([0.5, 0.0, 1.0]), dim=-1).tolist()
    directions = torch.tensor([[ahead, ahead], [ahead, apart]])
    distances = distances_to_meeting(origins, directions)
    assert distances[:, 0].isinf().all() and (distances[:, 1] < 0).all()
    errors = reprojection_errors(origins, directions, 0.0)
    assert (errors == 0).all()
    errors.sum().backward()
    assert (origins.grad == 0).all()


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_gradients_are_finite_also_where_rays_meet(noise):
    origins, directions = (part.requires_grad_() for part in rays_to(POINTS, noise=noise))
    reprojection_errors(origins, directions, 0.0).square().sum().backward()
    assert origins.grad.isfinite().all() and directions.grad.isfinite().all()

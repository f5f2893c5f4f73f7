"""NDC maps against hand-worked numbers and against the image of points sampled along the world ray."""

import math

import pytest
import torch
from reference import ndc_points

from sparsestyle_ns.core.ndc import ndc_distance, ndc_parameter, ndc_rays

FOCAL_OVER_HALF_SIZE = (1.6, 2.1)


def forward_rays(*batch, dtype=torch.float64, seed=0):
    """Rays of cameras about the origin that look along -z, up to about 45 degrees aside."""
    generator = torch.Generator().manual_seed(seed)
    origins = 0.4 * torch.randn(*batch, 3, generator=generator, dtype=dtype)
    directions = torch.rand(*batch, 3, generator=generator, dtype=dtype) * 2 - 1
    directions[..., 2] = -1
    return origins, torch.nn.functional.normalize(directions, dim=-1)


def matrix_projection(points, focal_over_half_size, near):
    """The same map as homogeneous coordinates and a division, the way it is derived (NeRF, appendix C)."""
    scale_x, scale_y = focal_over_half_size
    matrix = torch.tensor(
        [[scale_x, 0, 0, 0], [0, scale_y, 0, 0], [0, 0, -1, -2 * near], [0, 0, -1, 0]], dtype=points.dtype
    )
    projected = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1) @ matrix.T
    return projected[..., :3] / projected[..., 3:]


def test_a_hand_worked_point_and_ray():
    # 2f/w = 2, 2f/h = 3, n = 1. The ray from (1, 0, 0) towards (0, 1, -2) meets z = -1 in (1, 0.5, -1), whose image is
    # (2 * 1 / 1, 3 * 0.5 / 1, -1). Its vanishing point is (2 * 0 / 2, 3 * 1 / 2, 1), so d' = (-2, 0, 2).
    origins, directions, valid = ndc_rays(torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, -2]), (2.0, 3.0))
    assert origins.tolist() == [2.0, 1.5, -1.0]
    assert directions.tolist() == [-2.0, 0.0, 2.0]
    assert valid.tolist() == [True]
    # Half way through NDC the point is at z = -n / (1 - 0.5) = -2: (1, 1, -2), with the image (1, 1.5, 0).
    assert ndc_points(torch.tensor([1.0, 1, -2]), (2.0, 3.0)).tolist() == [1.0, 1.5, 0.0]
    distance = ndc_distance(torch.tensor([0.5]), torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, -2]))
    assert distance.tolist() == [1.0]


@pytest.mark.parametrize("near", [0.3, 1.0, 2.5])
def test_points_agree_with_the_projection_matrix(near):
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points[:, 2] = -points[:, 2].abs() - 0.1
    torch.testing.assert_close(
        ndc_points(points, FOCAL_OVER_HALF_SIZE, near), matrix_projection(points, FOCAL_OVER_HALF_SIZE, near)
    )


def test_the_near_plane_is_at_minus_one_and_infinity_at_plus_one():
    points = torch.tensor([[0.5, -0.25, -2.0], [0.5, -0.25, -1e12]], dtype=torch.float64)
    z = ndc_points(points, FOCAL_OVER_HALF_SIZE, near=2.0)[:, 2]
    torch.testing.assert_close(z, torch.tensor([-1.0, 1.0], dtype=torch.float64))


def test_a_camera_at_the_origin_sees_exactly_the_square():
    width, height, focal = 12, 8, 10.0
    corners = torch.tensor([[x, y, -1.0] for x in (-0.6, 0.6) for y in (-0.4, 0.4)])  # (w/2f, h/2f)
    origins, directions, _ = ndc_rays(torch.zeros(4, 3), corners, (2 * focal / width, 2 * focal / height))
    expected = torch.tensor([[x, y] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    torch.testing.assert_close(origins[:, :2], expected)
    torch.testing.assert_close((origins + directions)[:, :2], expected)


@pytest.mark.parametrize("batch", [(), (7,), (2, 3, 5)])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-10), (torch.float32, 1e-4)])
def test_a_ray_in_ndc_runs_through_the_images_of_its_world_points(batch, dtype, tolerance):
    near = 0.8
    origins, directions = forward_rays(*batch, dtype=dtype)
    ndc_origins, ndc_directions, valid = ndc_rays(origins, directions, FOCAL_OVER_HALF_SIZE, near)
    assert valid.all() and valid.shape == (*batch, 1)
    for t in (0.0, 0.1, 0.5, 0.9, 0.99):
        distance = ndc_distance(torch.full((*batch, 1), t, dtype=dtype), origins, directions, near)
        expected = matrix_projection(origins + distance * directions, FOCAL_OVER_HALF_SIZE, near)
        # Distances reach about 100, so float32 loses some of its seven digits in 1 + 2n/z.
        torch.testing.assert_close(ndc_origins + t * ndc_directions, expected, atol=tolerance, rtol=tolerance)
        assert ndc_origins.dtype == ndc_directions.dtype == distance.dtype == dtype


def test_the_ray_agrees_with_the_formula_of_the_paper():
    near = 0.8
    o, d = forward_rays(20)
    ndc_origins, ndc_directions, _ = ndc_rays(o, d, FOCAL_OVER_HALF_SIZE, near)
    o = o - (near + o[:, 2:]) / d[:, 2:] * d
    a, b = FOCAL_OVER_HALF_SIZE
    (ox, oy, oz), (dx, dy, dz) = o.unbind(-1), d.unbind(-1)
    torch.testing.assert_close(ndc_origins, torch.stack([-a * ox / oz, -b * oy / oz, 1 + 2 * near / oz], dim=-1))
    expected = torch.stack([-a * (dx / dz - ox / oz), -b * (dy / dz - oy / oz), -2 * near / oz], dim=-1)
    torch.testing.assert_close(ndc_directions, expected)


def test_distance_is_the_inverse_of_projection():
    near = 1.0
    origins, directions = forward_rays(4, 6)
    world_distance = torch.linspace(3.0, 500.0, 6, dtype=torch.float64)[:, None]
    z = ndc_points(origins + world_distance * directions, FOCAL_OVER_HALF_SIZE, near)[..., 2:]
    t = (z + 1) / 2  # z' = -1 + 2 t'
    torch.testing.assert_close(ndc_distance(t, origins, directions, near), world_distance.expand(4, 6, 1))
    torch.testing.assert_close(ndc_parameter(world_distance, origins, directions, near), t)


def test_distance_grows_along_the_samples_of_a_ray_that_share_its_origin():
    origins, directions = forward_rays(5)
    t = torch.linspace(0, 0.999, 32, dtype=torch.float64)[:, None]
    distance = ndc_distance(t, origins[:, None], directions[:, None])
    assert distance.shape == (5, 32, 1)
    assert (distance.diff(dim=1) > 0).all()


def test_infinity_is_infinitely_far_or_at_the_cap():
    origins, directions = forward_rays(3)
    t = torch.tensor([[1.0]], dtype=torch.float64)
    assert (ndc_distance(t, origins, directions) == math.inf).all()
    assert (ndc_distance(t, origins, directions, max_distance=1e3) == 1e3).all()
    assert (ndc_distance(t - 1e-9, origins, directions, max_distance=1e3) == 1e3).all()


def test_no_gradient_is_lost_to_infinity():
    origins, directions = forward_rays(3)
    t = torch.tensor([[0.5], [1.0], [0.9]], dtype=torch.float64, requires_grad=True)
    ndc_distance(t, origins, directions, max_distance=1e3).sum().backward()
    assert t.grad.isfinite().all()
    assert (t.grad[[0, 2]] > 0).all() and t.grad[1] == 0


def test_an_origin_beyond_the_near_plane_starts_behind_itself():
    origin, direction = torch.tensor([0.0, 0.0, -3.0]), torch.tensor([0.0, 0.0, -1.0])
    assert ndc_distance(torch.tensor([0.0]), origin, direction).tolist() == [-2.0]
    # z = -1 / (1 - t') passes the origin, z = -3, at t' = 2/3.
    torch.testing.assert_close(ndc_distance(torch.tensor([2 / 3]), origin, direction), torch.tensor([0.0]))


@pytest.mark.parametrize(
    "direction", [(1.0, 0.0, 0.0), (0.6, 0.0, 0.8), (0.0, 0.0, 1.0), (1.0, 0.0, -1e-9), (0.0, 0.0, 0.0)]
)
def test_rays_that_never_reach_the_near_plane_are_told_apart_and_finite(direction):
    origins = torch.tensor([[0.3, -0.2, 0.1], [0.3, -0.2, 0.1]], requires_grad=True)
    directions = torch.tensor([direction, (0.0, 0.0, -1.0)], requires_grad=True)
    ndc_origins, ndc_directions, valid = ndc_rays(origins, directions, FOCAL_OVER_HALF_SIZE)
    distance = ndc_distance(torch.full((2, 1), 0.5), origins, directions)
    assert valid.squeeze(-1).tolist() == [False, True]
    # They take the place of the ray straight ahead from the same origin.
    assert torch.equal(ndc_origins[0], ndc_origins[1])
    assert torch.equal(ndc_directions[0], ndc_directions[1])
    assert torch.equal(distance[0], distance[1])
    (ndc_origins.sum() + ndc_directions.sum() + distance.sum()).backward()
    assert origins.grad.isfinite().all() and directions.grad.isfinite().all()
    assert (directions.grad[0] == 0).all()


def test_points_on_or_behind_the_camera_plane_are_finite_and_outside_the_box():
    points = torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.2, 1.0], [0.0, 0.0, 0.0]])
    images = ndc_points(points, FOCAL_OVER_HALF_SIZE)
    assert images.isfinite().all()
    assert (images[:, 2] < -1).all()


def test_gradients_of_points_match_finite_differences():
    points, _ = forward_rays(6)
    points[:, 2] = -1.5 - points[:, 2].abs()
    assert torch.autograd.gradcheck(lambda p: ndc_points(p, FOCAL_OVER_HALF_SIZE, 0.7), points.requires_grad_())


def test_gradients_of_rays_and_distances_match_finite_differences():
    origins, directions = (tensor.requires_grad_() for tensor in forward_rays(4))
    assert torch.autograd.gradcheck(lambda o, d: ndc_rays(o, d, FOCAL_OVER_HALF_SIZE, 0.7)[:2], (origins, directions))
    t = torch.tensor([[0.0], [0.2], [0.6], [0.9]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t, o, d: ndc_distance(t, o, d, 0.7), (t, origins, directions))

import pytest
import torch

from sparsestyle_ns.losses.geometry import matched_depth_loss, near_density


def test_only_density_that_begins_near_the_camera_counts():
    density = torch.tensor([[1.0, 2.0, 4.0], [8.0, 16.0, 32.0]])
    edges = torch.tensor([[0.0, 0.25, 0.5, 1.0], [0.0, 0.1, 0.2, 1.0]])
    # Within 0.25 begin the first sample of the one ray and all three of the other; a border at 0.25 is no longer near.
    assert near_density(density, edges, reach=0.25).item() == pytest.approx((1 + 8 + 16 + 32) / 6)
    assert near_density(density, edges, reach=1.0).item() == pytest.approx(63 / 6)


def test_only_near_density_gets_a_gradient():
    density = torch.ones(1, 4, requires_grad=True)
    near_density(density, torch.linspace(0, 1, 5)[None], reach=0.3).backward()
    assert density.grad.tolist() == [[0.25, 0.25, 0, 0]]


def test_the_gradient_matches_finite_differences():
    density = torch.rand(3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    edges = torch.linspace(0, 1, 5).expand(3, -1)
    assert torch.autograd.gradcheck(lambda d: near_density(d, edges, reach=0.6), (density,))


def test_rays_are_as_far_from_matched_points_as_their_light_ends_from_them():
    edges = torch.linspace(0, 1, 5).expand(3, -1)  # middles: 0.125, 0.375, 0.625, 0.875
    weights = torch.tensor([[0.0, 1.0, 0, 0], [0.5, 0, 0, 0.25], [0, 0, 0, 0]])
    aim = torch.tensor([[0.375], [0.625], [0.5]])
    # The second ray: half of its light ends 0.5 before the point, a quarter 0.25 behind it, and a quarter goes on.
    assert matched_depth_loss(weights, edges, aim).item() == pytest.approx((0 + 0.25 + 0.0625 + 0.25 + 1) / 3)


def test_matched_points_at_the_ends_of_the_scene_do_not_count():
    edges, weights = torch.linspace(0, 1, 5).expand(3, -1), torch.full((3, 4), 0.25)
    of_all = matched_depth_loss(weights, edges, torch.tensor([[0.0], [0.3], [1.0]]))
    assert of_all == matched_depth_loss(weights[1:2], edges[1:2], torch.tensor([[0.3]]))
    assert matched_depth_loss(weights, edges, torch.tensor([[0.0], [1.0], [0.0]])) == 0


def test_the_gradient_of_the_matched_depth_loss_matches_finite_differences():
    weights = 0.2 * torch.rand(3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    edges = torch.linspace(0, 1, 5, dtype=torch.float64).expand(3, -1)
    aim = torch.tensor([[0.2], [0.5], [1.0]], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda w: matched_depth_loss(w, edges, aim), (weights.requires_grad_(),))

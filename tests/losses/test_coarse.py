import pytest
import torch
from reference import semantic_loss as slow_semantic_loss

from sparsestyle_ns.losses.coarse import (
    matched_depth_loss,
    near_density,
    pooled_features,
    reconstruction_loss,
    semantic_loss,
)


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


def test_the_gradient_of_near_density_matches_finite_differences():
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


def test_the_reconstruction_loss_of_two_pixels_worked_out_by_hand():
    rendered = torch.tensor([[0.5, 0.0, 1.0], [0.2, 0.2, 0.2]])
    photo = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.2, 0.5]])
    assert reconstruction_loss(rendered, photo).item() == pytest.approx((0.25 + 1 + 0.09) / 6)


@pytest.mark.parametrize("batch", [(1,), (5,), (2, 3, 4)])
def test_reconstruction_is_the_mean_squared_error_whatever_the_shape(batch):
    generator = torch.Generator().manual_seed(0)
    rendered, photo = (torch.rand(*batch, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    pairs = list(zip(rendered.flatten().tolist(), photo.flatten().tolist(), strict=True))
    expected = sum((r - p) ** 2 for r, p in pairs) / len(pairs)
    assert reconstruction_loss(rendered, photo).item() == pytest.approx(expected, rel=1e-12)


def test_a_perfect_picture_costs_nothing():
    photo = torch.rand(4, 3, generator=torch.Generator().manual_seed(1))
    assert reconstruction_loss(photo, photo) == 0


def test_the_gradient_of_reconstruction_matches_finite_differences():
    generator = torch.Generator().manual_seed(2)
    rendered, photo = (torch.rand(4, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(lambda r: reconstruction_loss(r, photo), (rendered.requires_grad_(),))


def maps(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_semantic_loss_is_one_less_the_cosine_of_the_maps_means():
    renders, photos = maps(3, 5, 4, 6), maps(3, 5, 2, 7, seed=1)
    expected = [slow_semantic_loss(a.tolist(), b.tolist()) for a, b in zip(renders, photos, strict=True)]
    found = semantic_loss(pooled_features(renders), pooled_features(photos))
    assert found.item() == pytest.approx(sum(expected) / 3, rel=1e-12)


def test_a_picture_that_shows_the_same_elsewhere_costs_nothing_and_brightness_does_not_count():
    renders = maps(2, 5, 4, 6).clamp(min=0)
    photos = 3 * renders.roll((1, 2), dims=(2, 3))
    assert semantic_loss(pooled_features(renders), pooled_features(photos)).item() == pytest.approx(0.0, abs=1e-12)


def test_the_gradient_of_the_semantic_loss_matches_finite_differences_and_photos_get_none():
    renders, photos = maps(2, 4, 3, 2).requires_grad_(), pooled_features(maps(2, 4, 3, 2, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda r: semantic_loss(pooled_features(r), photos), (renders,))
    semantic_loss(pooled_features(renders), photos).backward()
    assert photos.grad is None

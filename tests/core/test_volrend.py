import math

import pytest
import reference
import torch

from sparsestyle_ns.core.volrend import (
    MAX_OPTICAL_DEPTH,
    dense_weights,
    distortion,
    effective_samples,
    optical_depth,
    packed_sum,
    packed_transmittance,
    packed_weights,
)

COUNTS = [3, 0, 1, 7, 0, 0, 2, 0]
"""Samples of eight ragged rays; the last has none."""


@pytest.fixture
def depth():
    return 2 * torch.rand(sum(COUNTS), generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.fixture
def ray_indices():
    return torch.repeat_interleave(torch.arange(len(COUNTS)), torch.tensor(COUNTS))


def random_weights(*shape, seed=0):
    """Weights and ascending borders in [0, 1] of rays."""
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(*shape, generator=generator, dtype=torch.float64) / shape[-1]
    edges = torch.rand(*shape[:-1], shape[-1] + 1, generator=generator, dtype=torch.float64).sort(dim=-1).values
    return weights, edges


def test_a_ray_of_five_samples_worked_out_by_hand():
    density = torch.tensor([2.0, 0.0, 1.0, 4.0, 1.0])
    interval = torch.tensor([0.5, 3.0, 1.0, 0.5, 1.0]) * math.log(2)
    depth = optical_depth(density, interval)
    # Half of the light goes at the first sample, none at the second, half of the rest at the third, three quarters of
    # the quarter left at the fourth, and half of the last sixteenth at the fifth.
    torch.testing.assert_close(dense_weights(depth), torch.tensor([1 / 2, 0, 1 / 4, 3 / 16, 1 / 32]))
    ray_indices = torch.zeros(5, dtype=torch.long)
    torch.testing.assert_close(
        packed_transmittance(depth, ray_indices, 1), torch.tensor([1, 1 / 2, 1 / 2, 1 / 4, 1 / 16])
    )
    torch.testing.assert_close(packed_weights(depth, ray_indices, 1), dense_weights(depth))


@pytest.mark.parametrize("shape", [(1,), (9,), (4, 1), (4, 9), (2, 3, 5)])
def test_dense_weights_are_those_of_light_lost_sample_by_sample(shape):
    depth = 3 * torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = [reference.weights(ray) for ray in depth.reshape(-1, shape[-1]).tolist()]
    torch.testing.assert_close(dense_weights(depth), torch.tensor(expected, dtype=torch.float64).view(shape))


def test_packed_weights_are_the_dense_weights_of_each_ray(depth, ray_indices):
    expected = torch.cat([dense_weights(ray) for ray in depth.split(COUNTS)])
    torch.testing.assert_close(packed_weights(depth, ray_indices, len(COUNTS)), expected)


def test_packed_and_dense_weights_have_the_same_gradient(depth, ray_indices):
    importance = torch.randn(len(depth), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    packed, dense = depth.clone().requires_grad_(), depth.clone().requires_grad_()
    (importance * packed_weights(packed, ray_indices, len(COUNTS))).sum().backward()
    (importance * torch.cat([dense_weights(ray) for ray in dense.split(COUNTS)])).sum().backward()
    torch.testing.assert_close(packed.grad, dense.grad)


def test_removed_samples_in_front_of_a_surface_feel_that_they_would_hide_it():
    # One ray among many, with two samples of depth 0 in front of a surface: ∂w_surface/∂τ_front is −w_surface.
    generator = torch.Generator().manual_seed(3)
    depth = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    depth[:, :2] = 0
    depth = depth.flatten().requires_grad_()
    weights = packed_weights(depth, torch.arange(200).repeat_interleave(3), 200)
    weights.view(200, 3)[:, 2].sum().backward()
    expected = -weights.detach().view(200, 3)[:, 2:].expand(-1, 2)
    torch.testing.assert_close(depth.grad.view(200, 3)[:, :2], expected)


def test_gradients_of_weights_match_finite_differences(depth, ray_indices):
    dense = depth[:12].view(3, 4).clone().requires_grad_()
    assert torch.autograd.gradcheck(dense_weights, (dense,))
    assert torch.autograd.gradcheck(
        lambda d: packed_weights(d, ray_indices, len(COUNTS)), (depth.clone().requires_grad_(),)
    )


def test_no_rays_and_no_samples_give_nothing():
    none, no_rays = torch.zeros(0), torch.zeros(0, dtype=torch.long)
    assert packed_weights(none, no_rays, 5).shape == (0,)
    assert packed_weights(none, no_rays, 0).shape == (0,)
    assert packed_sum(torch.zeros(0, 3), no_rays, 2).tolist() == [[0, 0, 0], [0, 0, 0]]


def test_packed_sum_adds_up_each_ray(depth, ray_indices):
    values = torch.stack([depth, 2 * depth], dim=-1)
    expected = torch.stack([ray.sum(dim=0) for ray in values.split(COUNTS)])
    torch.testing.assert_close(packed_sum(values, ray_indices, len(COUNTS)), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_infinite_last_interval_takes_all_light_that_is_left(dtype):
    interval = torch.tensor([0.1, 0.1, math.inf], dtype=dtype)
    density = torch.tensor([1.0, 2.0, 1e-6], dtype=dtype)
    assert dense_weights(optical_depth(density, interval)).sum().item() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_infinite_last_interval_without_density_takes_none(dtype):
    depth = optical_depth(torch.zeros(3, dtype=dtype), torch.tensor([0.1, 0.1, math.inf], dtype=dtype))
    assert depth.tolist() == [0, 0, 0]
    assert dense_weights(depth).tolist() == [0, 0, 0]


@pytest.mark.parametrize("density", [0.0, 1e-30, 1.0])
def test_the_gradient_through_an_infinite_interval_does_not_swamp_all_others(density):
    # A sample that the residual field has emptied (σ_f = 0) passes its gradient on to weights that all samples share.
    # Intervals are at most the cube's diagonal, so gradients of ordinary samples are of the order of 1.
    density = torch.tensor(density, requires_grad=True)
    dense_weights(optical_depth(density[None], torch.tensor([math.inf]))).sum().backward()
    assert 0 <= density.grad <= MAX_OPTICAL_DEPTH


def test_optical_depth_is_capped_where_nothing_gets_through_any_more():
    depth = optical_depth(torch.tensor([1e6, 30.0]), torch.tensor([1e3, 2.0]))
    assert depth.tolist() == [MAX_OPTICAL_DEPTH, 60.0]


@pytest.mark.parametrize("highest", [1e-6, 1.0, 1e3, 1e30])
def test_weights_of_a_ray_sum_to_at_most_one_however_dense_it_is(highest):
    generator = torch.Generator().manual_seed(4)
    # Densities of all orders of magnitude up to the highest.
    exponents = torch.rand(500, 40, generator=generator) * 12 - 12
    depth = optical_depth(highest * 10**exponents, torch.full((500, 40), 0.5))
    ray_indices = torch.arange(500).repeat_interleave(40)
    for weights in (dense_weights(depth), packed_weights(depth.flatten(), ray_indices, 500).view(500, 40)):
        assert (weights >= 0).all()
        assert weights.double().sum(dim=-1).max().item() <= 1 + 1e-6


def test_a_veil_in_front_of_a_wall_is_not_lost_in_the_rounding_of_the_wall():
    # The veil's optical depth has to survive next to the wall's, which is ten thousand times as large.
    depth = torch.stack([torch.linspace(0.001, 0.01, 200), torch.linspace(33.0, 79.9, 200)], dim=-1)
    expected = torch.tensor([reference.weights(ray) for ray in depth.tolist()])
    # Products of two float32 numbers.
    torch.testing.assert_close(dense_weights(depth), expected, rtol=3e-7, atol=0)


def test_opaque_rays_before_it_do_not_disturb_a_ray():
    # A million samples at the cap sum to 8e7, of which float64 resolves 1.5e-8; float32 would resolve 8.
    wall = torch.full((1_000_000,), MAX_OPTICAL_DEPTH - 0.1)
    ray = torch.tensor([1e-3, 0.2, 1e-4, 1.5])
    depth = torch.cat([wall, ray])
    ray_indices = torch.cat([torch.arange(1000).repeat_interleave(1000), torch.full((4,), 1000)])
    torch.testing.assert_close(packed_weights(depth, ray_indices, 1001)[-4:], dense_weights(ray), rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize("shape", [(1, 1), (5, 8), (2, 3, 4)])
def test_distortion_is_the_sum_over_all_pairs(shape):
    weights, edges = random_weights(*shape)
    rays = zip(weights.reshape(-1, shape[-1]).tolist(), edges.reshape(-1, shape[-1] + 1).tolist(), strict=True)
    expected = torch.tensor([reference.distortion(*ray) for ray in rays], dtype=torch.float64).view(shape[:-1])
    torch.testing.assert_close(distortion(weights, edges), expected)


def test_the_gradient_of_distortion_matches_finite_differences():
    weights, edges = (tensor.requires_grad_() for tensor in random_weights(2, 5, seed=1))
    assert torch.autograd.gradcheck(distortion, (weights, edges))


def test_distortion_is_smallest_when_all_weight_lies_in_one_place():
    edges = torch.linspace(0, 1, 11)
    surface, two_surfaces, fog = torch.zeros(10), torch.zeros(10), torch.full((10,), 0.1)
    surface[4] = 1
    two_surfaces[[1, 8]] = 0.5
    assert distortion(surface, edges).item() == pytest.approx(0.1 / 3)
    assert distortion(surface, edges) < distortion(fog, edges) < distortion(two_surfaces, edges)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_weight_spread_evenly_over_n_samples_counts_as_n(count):
    weights = torch.zeros(3, 7)
    weights[:, :count] = torch.tensor([1e-3, 0.5, 1.0])[:, None] / count
    assert effective_samples(weights).tolist() == pytest.approx([count] * 3)


def test_a_ray_without_weight_counts_as_no_samples():
    weights = torch.zeros(2, 4, requires_grad=True)
    counted = effective_samples(weights)
    counted.sum().backward()
    assert counted.tolist() == [0, 0]
    assert weights.grad.isfinite().all()

"""The sliced Wasserstein distance."""

import math

import pytest
import torch

from sparsestyle_ns.core.sliced import quantiles, random_directions, sliced_distance


def directions(dimensions: int, count: int = 4000) -> torch.Tensor:
    return random_directions(dimensions, count, torch.Generator().manual_seed(0)).double()


def cloud(count: int, dimensions: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(count, dimensions, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_the_order_of_points_does_not_matter():
    points = cloud(40, 3)
    assert sliced_distance(points, points[torch.randperm(40)], directions(3)) == pytest.approx(0.0, abs=1e-24)


@pytest.mark.parametrize("dimensions", [1, 3, 20])
def test_a_shift_is_as_far_as_it_is_long(dimensions):
    points, shift = cloud(30, dimensions), cloud(1, dimensions, seed=2)
    distance = sliced_distance(points + shift, points, directions(dimensions))
    assert distance.item() == pytest.approx(shift.square().sum().item(), rel=0.1)


def test_equal_variances_in_other_shapes_differ():
    generator = torch.Generator().manual_seed(3)
    signs = torch.randint(0, 2, (2000, 3), generator=generator).double() * 2 - 1
    assert sliced_distance(signs, cloud(2000, 3), directions(3, 50)) > 0.02
    assert sliced_distance(cloud(2000, 3, 5), cloud(2000, 3), directions(3, 50)) < 0.01


def test_along_one_line_it_is_the_best_assignment():
    first, second = cloud(7, 1), cloud(7, 1, seed=4)
    costs = (first - second.T).square()
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(costs.numpy())
    expected = costs[rows, columns].mean().item()
    assert sliced_distance(first, second, torch.ones(1, 1, dtype=torch.float64)).item() == pytest.approx(expected)


def test_clouds_of_different_sizes_are_compared_by_quantiles():
    few, many = torch.linspace(0, 1, 11)[:, None], torch.linspace(0, 1, 1001)[:, None]
    for clouds in ((few, many), (many, few)):
        assert sliced_distance(*clouds, torch.ones(1, 1)).item() < 1e-2**2 * 25
    torch.testing.assert_close(quantiles(torch.arange(4.0)[:, None], 2)[:, 0], torch.tensor([0.5, 2.5]))


def test_gradients_are_right():
    points = cloud(9, 3).requires_grad_()
    lines = directions(3, 5)
    assert torch.autograd.gradcheck(lambda p: sliced_distance(p, cloud(9, 3, seed=6), lines), points)
    assert torch.autograd.gradcheck(lambda p: sliced_distance(p, cloud(5, 3, seed=6), lines), points)
    assert torch.autograd.gradcheck(lambda p: sliced_distance(p, cloud(14, 3, seed=6), lines), points)


def test_directions_are_unit_vectors_in_all_directions():
    drawn = directions(5)
    torch.testing.assert_close(drawn.norm(dim=0), torch.ones(4000).double())
    assert drawn.mean(dim=1).abs().max() < 5 / math.sqrt(4000 * 5)


def test_without_points_there_is_no_distance():
    with pytest.raises(ValueError, match="both need some"):
        sliced_distance(cloud(0, 3), cloud(2, 3), directions(3))

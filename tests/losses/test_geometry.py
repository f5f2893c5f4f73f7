import pytest
import torch

from sparsestyle_ns.losses.geometry import near_density


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

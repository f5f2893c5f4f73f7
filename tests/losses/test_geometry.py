import pytest
import torch

from sparsestyle_ns.losses.geometry import depth_roughness, near_density


def test_the_roughness_of_a_patch_worked_out_by_hand():
    depth = torch.tensor([[[1.0, 2.0], [4.0, 4.0]]])
    # Downwards 3 and 2, rightwards 1 and 0.
    assert depth_roughness(depth).item() == pytest.approx((9 + 4) / 2 + (1 + 0) / 2)


def test_roughness_is_the_mean_over_all_neighbours_of_all_patches():
    depth = torch.rand(3, 4, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    down, right = [], []
    for patch in depth.tolist():
        for y in range(4):
            for x in range(4):
                if y < 3:
                    down.append((patch[y + 1][x] - patch[y][x]) ** 2)
                if x < 3:
                    right.append((patch[y][x + 1] - patch[y][x]) ** 2)
    expected = sum(down) / len(down) + sum(right) / len(right)
    assert depth_roughness(depth).item() == pytest.approx(expected, rel=1e-12)


def test_a_flat_patch_is_smooth_and_patches_do_not_touch():
    depth = torch.tensor([1.0, 50.0])[:, None, None].expand(2, 5, 5)
    assert depth_roughness(depth).item() == 0


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


def test_gradients_match_finite_differences():
    depth = torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(depth_roughness, (depth,))

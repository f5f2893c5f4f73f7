"""Rotations by a vector, and the similarity between two sets of camera poses."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from sparsestyle_ns.core.rotations import Similarity, rotation_matrix, similarity_between


def poses(count=4, seed=0):
    """Camera poses all over the place, in double precision."""
    generator = torch.Generator().manual_seed(seed)
    turns = rotation_matrix(torch.randn(count, 3, generator=generator, dtype=torch.float64))
    positions = torch.randn(count, 3, 1, generator=generator, dtype=torch.float64)
    return torch.cat([turns, positions], dim=-1)


def test_a_quarter_turn_about_z_takes_x_to_y():
    turned = rotation_matrix(torch.tensor([0.0, 0.0, math.pi / 2])) @ torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(turned, torch.tensor([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-6, 1e-3, 1.0, 3.0, 10.0])
def test_it_is_scipys_rotation_vector(size):
    vectors = size * torch.randn(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = torch.from_numpy(Rotation.from_rotvec(vectors.numpy()).as_matrix())
    torch.testing.assert_close(rotation_matrix(vectors), expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("size", [0.0, 1e-3, 1.0])
def test_its_gradient_is_that_of_finite_differences_also_at_0(size):
    vectors = size * torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert torch.autograd.gradcheck(rotation_matrix, vectors.requires_grad_())


@pytest.mark.parametrize("count", [2, 3, 8])
def test_a_similarity_is_found_again(count):
    turn = rotation_matrix(torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64))
    known = Similarity(turn, 2.5, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))
    first = poses(count)
    found = similarity_between(first, known.of_poses(first))
    torch.testing.assert_close(found.of_poses(first), known.of_poses(first))
    assert found.scale == pytest.approx(2.5)
    torch.testing.assert_close(torch.linalg.det(found.rotation), torch.tensor(1.0, dtype=torch.float64))


def test_cameras_on_a_line_settle_the_turn_about_it_by_where_they_look():
    first = poses(3)
    first[..., 3] = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    turn = rotation_matrix(torch.tensor([0.8, 0.0, 0.0], dtype=torch.float64))
    found = similarity_between(first, Similarity(turn, 1.0, torch.zeros(3, dtype=torch.float64)).of_poses(first))
    torch.testing.assert_close(found.rotation, turn)


def test_of_noisy_poses_it_is_the_best_on_average():
    first = poses(6)
    noise = 0.02 * torch.randn(6, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    noisy = torch.cat([first[..., :3] @ rotation_matrix(noise), first[..., 3:] + noise[..., None]], dim=-1)
    moved = similarity_between(first, noisy).of_poses(first)
    # No other scale and no other place lays the positions nearer.
    error = (moved - noisy)[..., 3].square().sum()
    for change in (1.001, 0.999):
        assert (noisy[..., 3] - change * moved[..., 3]).square().sum() > error
    torch.testing.assert_close(moved[..., 3].mean(dim=0), noisy[..., 3].mean(dim=0))


def test_cameras_in_one_place_keep_their_size():
    first = poses(3)
    first[..., 3] = 1.0
    assert similarity_between(first, first).scale == 1.0

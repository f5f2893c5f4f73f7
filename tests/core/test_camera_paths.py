"""The path that consistency is measured on."""

import math

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from sparsestyle_ns.core.camera_paths import ARC_STEP, NUM_FRAMES, at_poses, measuring_path, unseen_places
from sparsestyle_ns.utils.errors import InputError


def cameras_at(positions: torch.Tensor, looking_at: torch.Tensor) -> Cameras:
    back = torch.nn.functional.normalize(positions - looking_at, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]]), back), dim=-1)
    poses = torch.stack([right, torch.linalg.cross(back, right), back, positions], dim=-1)
    return Cameras(poses, fx=30.0, fy=31.0, cx=16.0, cy=12.0, width=32, height=24)


def ring(count: int, radius: float = 4.0, height: float = 1.0) -> Cameras:
    angles = 2 * math.pi * torch.arange(count) / count + 0.3
    positions = torch.stack([radius * angles.cos(), radius * angles.sin(), torch.full_like(angles, height)], dim=-1)
    return cameras_at(positions + torch.tensor([0.5, -0.2, 0.0]), torch.tensor([0.5, -0.2, 0.0]))


def row(count: int) -> Cameras:
    positions = torch.stack([torch.linspace(-1, 1, count), torch.full((count,), -5.0), torch.zeros(count)], dim=-1)
    return cameras_at(positions, torch.zeros(3))


def test_cameras_that_look_one_way_are_passed_in_their_order() -> None:
    path = measuring_path(row(3))
    assert len(path) >= max(16, NUM_FRAMES)
    middle = (len(path) - 1) // 2
    for frame, camera in ((0, 0), (middle, 1), (len(path) - 1, 2)):
        torch.testing.assert_close(
            path.camera_to_worlds[frame], row(3).camera_to_worlds[camera].float(), atol=1e-5, rtol=0
        )
    steps = path.camera_to_worlds[1:, :, 3] - path.camera_to_worlds[:-1, :, 3]
    torch.testing.assert_close(steps, steps[:1].expand_as(steps), atol=1e-5, rtol=0)


def test_cameras_all_around_are_measured_on_an_arc_that_looks_at_the_middle() -> None:
    path = measuring_path(ring(8))
    poses = path.camera_to_worlds
    assert len(path) == NUM_FRAMES
    torch.testing.assert_close(poses[0], ring(8).camera_to_worlds[0], atol=1e-4, rtol=0)
    offsets = poses[:, :, 3] - torch.tensor([0.5, -0.2, 0.0])
    torch.testing.assert_close(offsets.norm(dim=-1), torch.full((NUM_FRAMES,), math.sqrt(17.0)), atol=1e-4, rtol=0)
    angles = torch.atan2(offsets[:, 1], offsets[:, 0])
    torch.testing.assert_close(angles.diff(), torch.full((NUM_FRAMES - 1,), ARC_STEP), atol=1e-4, rtol=0)
    torch.testing.assert_close(poses[:, :, 2], torch.nn.functional.normalize(offsets, dim=-1), atol=1e-4, rtol=0)
    turns = poses[:, :, :3]
    identity = torch.eye(3).expand(NUM_FRAMES, 3, 3)
    torch.testing.assert_close(turns.transpose(1, 2) @ turns, identity, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(NUM_FRAMES), atol=1e-5, rtol=0)


def test_unseen_places_are_between_cameras_that_look_one_way() -> None:
    places = unseen_places(row(3), 100)
    x = places.camera_to_worlds[:, 0, 3]
    assert len(places) >= 100
    torch.testing.assert_close(x, torch.linspace(-1, 1, len(places)), atol=1e-5, rtol=0)


def test_unseen_places_are_all_around_where_cameras_are() -> None:
    offsets = unseen_places(ring(5), 100).camera_to_worlds[:, :, 3] - torch.tensor([0.5, -0.2, 0.0])
    torch.testing.assert_close(offsets.norm(dim=-1), torch.full((100,), math.sqrt(17.0)), atol=1e-4, rtol=0)
    torch.testing.assert_close(offsets.mean(dim=0), torch.tensor([0.0, 0.0, 1.0]), atol=1e-4, rtol=0)


def test_cameras_are_put_at_poses_with_the_first_ones_lens() -> None:
    cameras = ring(5)
    moved = at_poses(cameras.camera_to_worlds[3:], cameras)
    torch.testing.assert_close(moved.camera_to_worlds, cameras.camera_to_worlds[3:])
    assert moved.fx.tolist() == [[30.0], [30.0]] and moved.height.tolist() == [[24], [24]]


def test_the_path_is_the_same_each_time_and_has_the_training_cameras_lens() -> None:
    first, second = measuring_path(ring(5)), measuring_path(ring(5))
    # Up to rounding, which differs with where torch's vectors lie in memory.
    torch.testing.assert_close(first.camera_to_worlds, second.camera_to_worlds, atol=1e-6, rtol=0)
    assert (first.fx[3].item(), first.fy[3].item(), first.width[3].item(), first.height[3].item()) == (30, 31, 32, 24)


def test_one_camera_makes_no_path() -> None:
    with pytest.raises(InputError, match="train on two or more"):
        measuring_path(row(3)[:1])

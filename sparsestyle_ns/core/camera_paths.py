"""How a scene was captured, and paths of cameras that follow from it; a pose's columns: right, up, back, position."""

import itertools
import math

import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_utils import get_interpolated_poses
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.nn.functional import normalize

from sparsestyle_ns.utils.errors import InputError

MAX_SPREAD = 45.0
"""Degrees by which a camera of a forward-facing capture may look aside from the mean viewing direction."""
NUM_FRAMES, ARC_STEP = 16, math.radians(2.0)
"""Frames of the measuring path, at least, and the angle between those of an arc."""
FLIGHT_STEPS = 20
"""Poses of a flight that a frame chooses from, so that its speed can change without jerks."""


def viewing_spread(poses: Float[Tensor, "cameras 3 4"]) -> float:
    """Largest angle, in degrees, between a camera's viewing direction and the mean of all; 180 where they cancel."""
    directions = normalize(-poses[:, :, 2].double(), dim=-1)
    mean = directions.mean(dim=0)
    if mean.norm() < 1e-6:
        return 180.0
    return float((directions @ normalize(mean, dim=0)).clamp(-1.0, 1.0).acos().max().rad2deg())


def is_forward_facing(poses: Float[Tensor, "cameras 3 4"]) -> bool:
    """Whether all cameras look one way, within 45 degrees (`MAX_SPREAD`) of their mean direction: NDC is for those."""
    return viewing_spread(poses) <= MAX_SPREAD


def meeting_point(poses: Float[Tensor, "cameras 3 4"]) -> Float[Tensor, "3"]:
    """The point nearest to all viewing axes, by least squares; of parallel axes, the one nearest to the origin."""
    axes = normalize(poses[:, :, 2].double(), dim=-1)
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    target = (across @ poses[:, :, 3:].double()).sum(dim=0)
    return (torch.linalg.pinv(across.sum(dim=0), hermitian=True) @ target)[:, 0].to(poses.dtype)


def measuring_path(cameras: Cameras) -> Cameras:
    """The path on which consistency is measured, one camera a frame; an `InputError` for fewer than two cameras.

    Where the training cameras look one way, it leads from each to the next in equal steps; where they stand all around,
    it is an arc around the point that they look at, level with them on average, in steps of 2° from the first one on.
    """
    if len(cameras) < 2:
        raise InputError("Consistency is measured between training views, and there is one; train on two or more.")
    poses = cameras.camera_to_worlds.cpu().float()
    return at_poses(poses_between(poses) if is_forward_facing(poses) else poses_around(poses), cameras)


def showing_path(cameras: Cameras, frames: int) -> Cameras:
    """A closed path, one camera a frame: through the cameras and back, slow where it turns, or one turn around all."""
    poses = cameras.camera_to_worlds.cpu().float()
    if not is_forward_facing(poses):
        return unseen_places(cameras, frames)
    fine = poses_between(poses, FLIGHT_STEPS * frames)
    place = 0.5 - 0.5 * torch.cos(torch.arange(frames) * (2.0 * math.pi / frames))
    return at_poses(fine[(place * (len(fine) - 1)).round().long()], cameras)


def unseen_places(cameras: Cameras, count: int) -> Cameras:
    """`count` cameras or a few more, at equal steps: from each training camera to the next, or on the circle of all."""
    # In float64, whose rounding, which differs with where vectors lie in memory, doesn't reach the float32 result.
    poses = cameras.camera_to_worlds.cpu().double()
    if is_forward_facing(poses):
        return at_poses(poses_between(poses, count), cameras)
    return at_poses(poses_around(poses, 2.0 * math.pi / count, count), cameras)


def at_poses(poses: Float[Tensor, "frames 3 4"], cameras: Cameras) -> Cameras:
    """Cameras at these poses, on the device of `cameras` and with the lens of the first of them, undistorted."""
    count = len(poses)
    return Cameras(
        camera_to_worlds=poses.to(cameras.camera_to_worlds),
        **{name: getattr(cameras, name)[:1].expand(count, 1) for name in ("fx", "fy", "cx", "cy", "width", "height")},
    )


def poses_between(poses: Float[Tensor, "cameras 3 4"], frames: int = NUM_FRAMES) -> Float[Tensor, "all 3 4"]:
    """Poses from each camera to the next; equally many, `frames` at least in all, in each gap."""
    steps = -(-(frames - 1) // (len(poses) - 1))
    path = [poses[0]]
    for first, second in itertools.pairwise(poses):
        between = get_interpolated_poses(first.numpy(), second.numpy(), steps + 1)
        path += [torch.tensor(pose[:3], dtype=poses.dtype) for pose in between[1:]]
    return torch.stack(path)


def poses_around(
    poses: Float[Tensor, "cameras 3 4"], step: float = ARC_STEP, frames: int = NUM_FRAMES
) -> Float[Tensor, "frames 3 4"]:
    """An arc of so many poses, `step` radians apart, around the point closest to all optical axes, with z up."""
    center = meeting_point(poses)
    offsets = poses[:, :, 3] - center
    height = offsets[:, 2].mean()
    radius = offsets[:, :2].norm(dim=-1).mean()
    start = torch.atan2(offsets[0, 1], offsets[0, 0])
    angles = start + step * torch.arange(frames, dtype=poses.dtype)
    circle = [radius * torch.cos(angles), radius * torch.sin(angles), height.expand(frames)]
    positions = center + torch.stack(circle, dim=-1)
    back = normalize(positions - center, dim=-1)
    right = normalize(torch.linalg.cross(back.new_tensor([[0.0, 0.0, 1.0]]), back), dim=-1)
    return torch.stack([right, torch.linalg.cross(back, right), back, positions], dim=-1)


def most_central(cameras: Cameras) -> int:
    """The camera that the others stand around: the nearest to their mean position."""
    positions = cameras.camera_to_worlds[..., 3]
    return int((positions - positions.mean(dim=0)).norm(dim=-1).argmin())

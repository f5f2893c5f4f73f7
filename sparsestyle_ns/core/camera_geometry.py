"""What the poses of a scene's cameras, with columns right, up, back and position, say about how it was captured."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

MAX_SPREAD = 45.0
"""Degrees by which a camera of a forward-facing capture may look aside from the mean viewing direction."""


def viewing_spread(poses: Float[Tensor, "cameras 3 4"]) -> float:
    """Largest angle, in degrees, between a camera's viewing direction and the mean of all; 180 where they cancel."""
    directions = normalize(-poses[:, :, 2].double(), dim=-1)
    mean = directions.mean(dim=0)
    if mean.norm() < 1e-6:
        return 180.0
    return float((directions @ normalize(mean, dim=0)).clamp(-1.0, 1.0).acos().max().rad2deg())


def is_forward_facing(poses: Float[Tensor, "cameras 3 4"]) -> bool:
    """Whether all cameras look one way: within 45 degrees (`MAX_SPREAD`) of their mean direction.

    This one test decides between NDC and the other layouts of space, and between camera paths that pass through the
    cameras and paths that circle around what they look at.
    """
    return viewing_spread(poses) <= MAX_SPREAD


def meeting_point(poses: Float[Tensor, "cameras 3 4"]) -> Float[Tensor, "3"]:
    """The point nearest to all viewing axes, by least squares; of parallel axes, the one nearest to the origin."""
    axes = normalize(poses[:, :, 2].double(), dim=-1)
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    target = (across @ poses[:, :, 3:].double()).sum(dim=0)
    return (torch.linalg.pinv(across.sum(dim=0), hermitian=True) @ target)[:, 0].to(poses.dtype)

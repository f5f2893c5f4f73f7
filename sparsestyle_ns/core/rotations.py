"""Rotations that can be learned, and the similarity that lays one set of camera poses over another."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


def rotation_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation about a vector by its length in radians (Rodrigues' formula), with a gradient at 0, too.

    R = I + (sin θ / θ) K + ((1 − cos θ) / θ²) K², K the matrix of the cross product with the vector.
    """
    # The square root has no gradient at 0; below a millionth of a radian both factors are their limits.
    square = vector.square().sum(dim=-1, keepdim=True)[..., None]
    tiny = square < 1e-12
    angle = torch.where(tiny, 1.0, square).sqrt()
    first = torch.where(tiny, 1.0, torch.sin(angle) / angle)
    second = torch.where(tiny, 0.5, 2.0 * (torch.sin(0.5 * angle) / angle).square())
    cross = _cross_matrix(vector)
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + first * cross + second * (cross @ cross)


def _cross_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    x, y, z = vector.unbind(dim=-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


class Similarity(NamedTuple):
    """x → scale · rotation x + translation."""

    rotation: Float[Tensor, "3 3"]
    scale: float
    translation: Float[Tensor, "3"]

    def of_poses(self, poses: Float[Tensor, "cameras 3 4"]) -> Float[Tensor, "cameras 3 4"]:
        """Where cameras stand and look after it; pictures don't change by it."""
        axes = self.rotation @ poses[..., :3]
        positions = self.scale * poses[..., 3] @ self.rotation.T + self.translation
        return torch.cat([axes, positions[..., None]], dim=-1)


def similarity_between(poses: Float[Tensor, "cameras 3 4"], others: Float[Tensor, "cameras 3 4"]) -> Similarity:
    """The similarity that lays camera poses over others of the same cameras.

    Its rotation is the mean of those between the cameras' axes, which few positions, often on a line, don't settle;
    scale and translation then are the positions' best by least squares. A scale of 1 where all stand in one place.
    """
    left, _, right = torch.linalg.svd((others[..., :3] @ poses[..., :3].transpose(-1, -2)).sum(dim=0))
    mirror = torch.ones_like(left[0])
    mirror[2] = torch.linalg.det(left @ right)
    rotation = left @ torch.diag(mirror) @ right
    mean, other_mean = poses[..., 3].mean(dim=0), others[..., 3].mean(dim=0)
    turned, other = (poses[..., 3] - mean) @ rotation.T, others[..., 3] - other_mean
    spread = float(turned.square().sum())
    scale = float((turned * other).sum()) / spread if spread > 0 else 1.0
    scale = scale if scale > 0 else 1.0
    return Similarity(rotation, scale, other_mean - scale * rotation @ mean)

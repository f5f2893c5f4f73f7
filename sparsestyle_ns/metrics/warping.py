"""Carrying a picture from one camera to another by the geometry that both see, and which pixels may be carried.

The geometry is the *unstylised* scene's, so that a stylised picture can't hide its flicker in geometry of its own.
Pixel coordinates are (column, row) with the centre of the first pixel at (0.5, 0.5), as in nerfstudio.
"""

from dataclasses import dataclass
from typing import NamedTuple, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

MIN_COVERAGE = 0.5
"""Opacity from which a pixel shows a surface; others show a background, which moves by no geometry."""


@dataclass
class Pinhole:
    """A camera without distortion; lengths in pixels, horizontal and vertical."""

    camera_to_world: Float[Tensor, "3 4"]
    """Right, up, back and position, one a column."""
    focal: Tuple[float, float]
    center: Tuple[float, float]

    def project(self, points: Float[Tensor, "*batch 3"]) -> Tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixel coordinates of world points, (0, 0) for those behind the camera, and which lie in front of it."""
        x, y, z = ((points - self.camera_to_world[:, 3]) @ self.camera_to_world[:, :3]).unbind(dim=-1)
        in_front = z < 0
        depth = torch.where(in_front, -z, 1.0)
        columns, rows = self.center[0] + self.focal[0] * x / depth, self.center[1] - self.focal[1] * y / depth
        return torch.where(in_front[..., None], torch.stack([columns, rows], dim=-1), 0.0), in_front


@dataclass
class Surface:
    """The world points of the unstylised scene that a camera's pixels show, and which show any."""

    camera: Pinhole
    points: Float[Tensor, "H W 3"]
    covered: Bool[Tensor, "H W"]


class Correspondence(NamedTuple):
    """Where the pixels of one view are found in another, and whether that one shows the same point there."""

    pixels: Float[Tensor, "H W 2"]
    visible: Bool[Tensor, "H W"]


def pixel_centers(height: int, width: int, like: Tensor) -> Float[Tensor, "H W 2"]:
    """Coordinates of the pixels' centres."""
    rows = torch.arange(height, device=like.device, dtype=like.dtype) + 0.5
    columns = torch.arange(width, device=like.device, dtype=like.dtype) + 0.5
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)


def sample_picture(picture: Float[Tensor, "H W C"], pixels: Float[Tensor, "h w 2"]) -> Float[Tensor, "h w C"]:
    """A picture read at pixel coordinates, bilinearly; beyond its outermost pixel centres as at the border."""
    height, width = picture.shape[:2]
    grid, image = 2.0 * pixels / pixels.new_tensor([width, height]) - 1.0, picture.permute(2, 0, 1)
    read = F.grid_sample(image[None], grid[None], mode="bilinear", padding_mode="border", align_corners=False)
    return read[0].permute(1, 2, 0)


def is_occluded(forward: Float[Tensor, "*batch 2"], backward: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
    """Whether going there and back doesn't end where it began: |f + b|² > 0.01 (|f|² + |b|²) + 0.5 (Lai et al. 2018).

    f is a pixel's flow to the other view, b that of the place it leads to, back; both in pixels.
    """
    error = (forward + backward).square().sum(dim=-1)
    size = forward.square().sum(dim=-1) + backward.square().sum(dim=-1)
    return error > 0.01 * size + 0.5


def correspond(first: Surface, second: Surface) -> Correspondence:
    """Where the second view shows what the first one's pixels show.

    Both must show a surface there, and the way there and back agree (`is_occluded`).
    """
    height, width = second.covered.shape
    pixels, in_front = second.camera.project(first.points)
    inside = ((pixels >= 0) & (pixels <= pixels.new_tensor([width, height]))).all(dim=-1)
    forward = pixels - pixel_centers(*first.covered.shape, pixels)
    returning, back_in_front = first.camera.project(second.points)
    # Infinity is no number to interpolate with: what can't be seen from the first camera leads nowhere near.
    backward_flow = torch.where(back_in_front[..., None], returning - pixel_centers(height, width, pixels), 1e6)
    usable = sample_picture(second.covered.to(pixels)[..., None], pixels)[..., 0] > 0.999
    occluded = is_occluded(forward, sample_picture(backward_flow, pixels))
    return Correspondence(pixels, first.covered & in_front & inside & usable & ~occluded)

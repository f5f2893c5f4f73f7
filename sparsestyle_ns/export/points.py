"""Coloured points on the surfaces that a scene's training views see, and how well they stand for the scene."""

from dataclasses import dataclass
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.rendering.render import straight_color

MIN_ACCUMULATION = 0.5
"""Rays with less weight than this see no surface."""
MAX_JUMP = 0.1
"""Share by which depth may differ between neighbouring pixels on one surface."""
MAX_DEPTH = 10.0
"""What is farther away than this many times the median depth is background, not shape."""


@dataclass
class Points:
    """Surface points in the coordinates of nerfstudio's cameras.

    Attributes:
        positions: in world units.
        colors: in [0, 1].
        origins: where the camera that saw a point stood.
    """

    positions: Float[Tensor, "points 3"]
    colors: Float[Tensor, "points 3"]
    origins: Float[Tensor, "points 3"]


def surface_points(camera: Cameras, picture: Dict[str, Tensor]) -> Points:
    """The points that one camera sees, one a pixel.

    Left out are pixels that see hardly anything, the far background, and those at the edge of something nearer: their
    mean depth lies where nothing is.

    Args:
        camera: one pinhole.
        picture: its render without background: rgb, accumulation and depth, (H, W, channels).
    """
    bundle = camera.generate_rays(camera_indices=0, keep_shape=True)
    depth, solid = picture["depth"], picture["accumulation"][..., 0] > MIN_ACCUMULATION
    if not solid.any():
        return Points(*torch.empty(3, 0, 3))
    solid = solid & (depth[..., 0] < MAX_DEPTH * depth[solid].median()) & ~at_edge(depth[..., 0])
    origins = bundle.origins[solid]
    return Points(origins + depth[solid] * bundle.directions[solid], picture["rgb"][solid], origins)


def without_background(picture: Dict[str, Tensor], background: Optional[Float[Tensor, "3"]]) -> Dict[str, Tensor]:
    """A render with the colours of its surfaces alone, where pixels also show some background between them."""
    return {**picture, "rgb": straight_color(picture["rgb"], picture["accumulation"], background)}


def at_edge(depth: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Pixels whose depth differs from that of one of the four neighbours by more than `MAX_JUMP`."""
    edge = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (0, 1):
        size = depth.shape[axis] - 1
        first, second = depth.narrow(axis, 0, size), depth.narrow(axis, 1, size)
        jump = (first - second).abs() > MAX_JUMP * torch.minimum(first, second)
        edge.narrow(axis, 0, size).logical_or_(jump)
        edge.narrow(axis, 1, size).logical_or_(jump)
    return edge


def joined(parts: Sequence[Points]) -> Points:
    """All points of several clouds."""
    return Points(*(torch.cat([getattr(part, name) for part in parts]) for name in ("positions", "colors", "origins")))


def encode_ply(points: Points) -> bytes:
    """A binary PLY file: x, y, z as floats, red, green, blue as bytes."""
    names = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    rows = np.empty(len(points.positions), dtype=names)
    for column, (name, _) in enumerate(names[:3]):
        rows[name] = points.positions[:, column].numpy()
    for column, (name, _) in enumerate(names[3:]):
        rows[name] = (255.0 * points.colors[:, column]).round().byte().numpy()
    properties = "".join(f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    return header.encode("ascii") + rows.tobytes()


class Likeness(NamedTuple):
    """How like a view's exact render a picture of points or of a mesh is.

    Attributes:
        covered: share of the pixels with a surface, in [0, 1], on which the picture shows anything; 0 without any.
        psnr: on those pixels, in dB; None where there are none.
    """

    covered: float
    psnr: Optional[float]


def likeness(colors: Float[Tensor, "H W 3"], shown: Bool[Tensor, "H W"], picture: Dict[str, Tensor]) -> Likeness:
    """Compares a picture that shows something on some pixels with an exact render."""
    solid = picture["accumulation"][..., 0] > MIN_ACCUMULATION
    both = solid & shown
    if not both.any():
        return Likeness(0.0, None)
    error = (colors[both] - picture["rgb"][both]).square().mean()
    return Likeness(float(both.sum() / solid.sum()), float(-10.0 * torch.log10(error)))


def splat(points: Points, camera: Cameras) -> Tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """What one pinhole camera sees of points a pixel wide: colours, and where there are any."""
    width, height = int(camera.width), int(camera.height)
    pose = camera.camera_to_worlds[0]
    local = (points.positions - pose[:, 3]) @ pose[:, :3]
    depth = -local[:, 2]
    column = torch.floor(float(camera.cx) + float(camera.fx) * local[:, 0] / depth)
    row = torch.floor(float(camera.cy) - float(camera.fy) * local[:, 1] / depth)
    seen = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = (row * width + column)[seen].long()
    nearest = torch.full((height * width,), torch.inf).scatter_reduce_(0, pixel, depth[seen], "amin")
    front = depth[seen] == nearest[pixel]
    colors = torch.zeros(height * width, 3)
    colors[pixel[front]] = points.colors[seen][front]
    return colors.view(height, width, 3), nearest.isfinite().view(height, width)


def cross_likeness(parts: List[Points], cameras: Cameras, pictures: List[Dict[str, Tensor]]) -> List[Likeness]:
    """How like each view's exact render the points of all other views are, seen from there."""
    return [
        likeness(*splat(joined(parts[:index] + parts[index + 1 :]), cameras[index : index + 1]), picture)
        for index, picture in enumerate(pictures)
    ]

"""Coloured points on the surfaces that a scene's training views see, and how well they stand for the scene."""

from pathlib import Path
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.nn import functional as F

from sparsestyle_ns.evaluation.held_out import MIN_ACCUMULATION
from sparsestyle_ns.export.stylised_scene import StylisedScene, exact_pictures
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.rendering.render import straight_color
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_output
from sparsestyle_ns.utils.ply import RGB, encode_ply, floats

MAX_JUMP = 0.1
"""Share by which depth may differ between neighbouring pixels on one surface."""
MAX_DEPTH = 10.0
"""What is farther away than this many times the median depth is background, not shape."""


class Points(NamedTuple):
    """Surface points in nerfstudio's world units, colours in [0, 1], and where the camera that saw a point stood."""

    positions: Float[Tensor, "points 3"]
    colors: Float[Tensor, "points 3"]
    origins: Float[Tensor, "points 3"]


def export_points(scene: StylisedScene, output_path: Path) -> None:
    """Writes the training views' surface points as PLY, and prints how well those of the others show each view."""
    pictures, parts = surfaces(scene)
    points = joined(parts)
    if len(points.positions) == 0:
        raise InputError("The views show no surface point, so there is nothing to write; train the coarse field more.")
    write_output(output_path, encode_points(points), "The points", "scene.ply")
    print(f"{len(points.positions):,} points, in nerfstudio's coordinates")
    if len(parts) > 1:
        print("Each view as the points of all others show it, one pixel each, against the exact render:")
        print_likeness(scene.names, cross_likeness(parts, scene.cameras, pictures))


def surfaces(scene: StylisedScene) -> Tuple[List[Dict[str, Tensor]], List[Points]]:
    """Full renders of the training views, with the colours of surfaces alone, and the points that each sees."""
    pictures, background = exact_pictures(scene), scene.model.background
    background = None if background is None else background.cpu()
    for picture in pictures:
        picture["rgb"] = straight_color(picture["rgb"], picture["accumulation"], background)
    return pictures, [surface_points(scene.cameras[i : i + 1], picture) for i, picture in enumerate(pictures)]


def surface_points(camera: Cameras, picture: Dict[str, Tensor]) -> Points:
    """The points that one camera sees, one a pixel.

    Left out are pixels that see hardly anything, the far background, and those at the edge of something nearer: their
    mean depth lies where nothing is. `picture` is the camera's render without background: rgb, accumulation and depth.
    """
    bundle = camera.generate_rays(camera_indices=0, keep_shape=True)
    depth, solid = picture["depth"], picture["accumulation"][..., 0] > MIN_ACCUMULATION
    if not solid.any():
        return Points(*torch.empty(3, 0, 3))
    solid = solid & (depth[..., 0] < MAX_DEPTH * depth[solid].median()) & ~at_edge(depth[..., 0])
    origins = bundle.origins[solid]
    return Points(origins + depth[solid] * bundle.directions[solid], picture["rgb"][solid], origins)


def at_edge(depth: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Pixels whose depth differs from that of one of the four neighbours by more than `MAX_JUMP`."""
    padded = F.pad(depth[None], (1, 1, 1, 1), mode="replicate")[0]
    neighbours = torch.stack([padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]])
    return ((neighbours - depth).abs() > MAX_JUMP * torch.minimum(neighbours, depth)).any(dim=0)


def joined(parts: Sequence[Points]) -> Points:
    """All points of several clouds."""
    return Points(*map(torch.cat, zip(*parts, strict=True)))


def encode_points(points: Points) -> bytes:
    """A binary PLY file: x, y, z as floats, red, green, blue as bytes."""
    rows = np.empty(len(points.positions), dtype=[("position", "<f4", 3), ("color", "u1", 3)])
    rows["position"] = points.positions.numpy()
    rows["color"] = (255.0 * points.colors).round().byte().numpy()
    return encode_ply(("vertex", (*floats("x", "y", "z"), *RGB), rows))


class Likeness(NamedTuple):
    """How like an exact render a picture is: share of its surfaces covered, in [0, 1], and PSNR there in dB, if any."""

    covered: float
    psnr: Optional[float]


def likeness(colors: Float[Tensor, "H W 3"], shown: Bool[Tensor, "H W"], picture: Dict[str, Tensor]) -> Likeness:
    """Compares a picture that shows something on some pixels with an exact render."""
    solid = picture["accumulation"][..., 0] > MIN_ACCUMULATION
    both = solid & shown
    if not both.any():
        return Likeness(0.0, None)
    return Likeness(float(both.sum() / solid.sum()), psnr(colors[both], picture["rgb"][both]))


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


def print_likeness(names: List[str], found: List[Likeness]) -> None:
    """A line for each view."""
    for name, (covered, value) in zip(names, found, strict=True):
        if value is None:
            print(f"  {name}: none of its surfaces is covered, so there is no PSNR")
        else:
            print(f"  {name}: {100 * covered:.0f}% of its surfaces covered, PSNR there {value:.1f} dB")

"""Cameras of the page: the training views as pinholes, and how far the user may turn away from the opening one.

A turned camera is the opening one, first pitched about its own right axis and then yawed about the scene's up axis,
both through a target on its line of sight. The page does the same (`turnedPose` in cameras.js).
"""

import math
from dataclasses import dataclass
from typing import List, Optional, Tuple

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from sparsestyle_ns.core.spaces import BoxSpace, ForwardFacingSpace, Space

STEEPEST = 85.0
"""Degrees above or below the horizon that a camera may look from."""
LEAST_TURN, MOST_TURN = 5.0, 30.0
"""Degrees that a camera may turn in a forward-facing scene; beyond what photos show, fields have arbitrary values."""
BEYOND_PHOTOS = 1.5
"""How far cameras of a forward-facing scene may turn, as a multiple of the largest angle between two photos."""
SURVEY_SIDE = 96
"""Pixels along the longer side of the pictures by which it is found out what can be seen."""


@dataclass
class Orbit:
    """Where the camera of a page may go.

    Attributes:
        opening: number of the camera it starts with.
        target: the point it turns about, in world units.
        up: the axis of yaw.
        yaw, pitch: lowest and highest angle, in degrees, from the opening camera.
        distance: nearest and farthest, as multiples of the opening camera's distance from the target.
    """

    opening: int
    target: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    yaw: Tuple[float, float]
    pitch: Tuple[float, float]
    distance: Tuple[float, float]


def pinholes(cameras: Cameras, longest: Optional[int] = None) -> Cameras:
    """The same cameras without distortion, which a page doesn't draw, with at most `longest` pixels a side."""
    names = ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height")
    plain = Cameras(**{name: getattr(cameras, name) for name in names}, camera_type=CameraType.PERSPECTIVE)
    if longest is not None and longest < (side := int(max(cameras.width.max(), cameras.height.max()))):
        plain.rescale_output_resolution(longest / side)
    return plain


def make_orbit(space: Space, cameras: Cameras, opening: int, depth: float) -> Orbit:
    """Where the camera may go from `opening` and still show what the photos have shown.

    Around an object (box) the target is beside its centre, elsewhere at the depth of what the camera sees, `depth`, in
    world units.
    """
    pose = cameras.camera_to_worlds[opening]
    position, forward = pose[:, 3], -pose[:, 2]
    if isinstance(space, BoxSpace):
        center = 0.5 * (space.minimum + space.maximum).cpu()
        depth = max(float((center - position) @ forward), 1e-3)
    target = position + depth * forward
    if isinstance(space, ForwardFacingSpace):
        around = torch.nn.functional.normalize(cameras.camera_to_worlds[..., 3] - target, dim=-1)
        widest = math.degrees(math.acos(float((around @ around.T).amin().clamp(-1.0, 1.0))))
        turn = min(max(BEYOND_PHOTOS * widest, LEAST_TURN), MOST_TURN)
        # NDC has nothing in front of the near plane: a camera beyond it would see what is behind it.
        nearest = 1.0 - 0.5 * min(space.near / depth, 1.0)
        return Orbit(opening, target, torch.tensor([0.0, 1.0, 0.0]), (-turn, turn), (-turn, turn), (nearest, 1.3))
    up = torch.tensor([0.0, 0.0, 1.0])  # nerfstudio's worlds stand upright
    elevation = math.degrees(math.asin(float((-forward @ up).clamp(-1.0, 1.0))))
    pitch = (min(0.0, -STEEPEST - elevation), max(0.0, STEEPEST - elevation))
    return Orbit(opening, target, up, (-180.0, 180.0), pitch, (0.4, 2.5))


def turned(orbit: Orbit, cameras: Cameras, yaw: float, pitch: float) -> Cameras:
    """The opening camera, turned by angles in degrees."""
    camera = pinholes(cameras[orbit.opening : orbit.opening + 1])
    pose = camera.camera_to_worlds[0]
    turn = rotation(orbit.up, yaw) @ rotation(pose[:, 0], -pitch)
    moved = turn @ pose
    moved[:, 3] = orbit.target + turn @ (pose[:, 3] - orbit.target)
    camera.camera_to_worlds = moved[None]
    return camera


def rotation(axis: Float[Tensor, "3"], degrees: float) -> Float[Tensor, "3 3"]:
    """Rotation about a unit vector by the right-hand rule."""
    cross = torch.linalg.cross(torch.eye(3), axis.expand(3, 3))  # cross @ v is axis × v
    return torch.matrix_exp(math.radians(degrees) * cross)


def survey(orbit: Orbit, cameras: Cameras) -> List[Cameras]:
    """Small cameras that see what the page may show: the photos', and turns of the opening one, at most 30° apart."""
    views = [cameras[index : index + 1] for index in range(len(cameras))]
    ranges = orbit.yaw, orbit.pitch
    angles = [torch.linspace(low, high, max(3, math.ceil((high - low) / 30.0) + 1)) for low, high in ranges]
    views += [turned(orbit, cameras, yaw, pitch) for yaw, pitch in torch.cartesian_prod(*angles).tolist()]
    return [pinholes(view, SURVEY_SIDE) for view in views]

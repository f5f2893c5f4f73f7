"""Cameras that aren't quite right: stage 1 learns how far each is off, together with the field.

As BARF (Lin et al. 2021) and Nope-NeRF (Bian et al. 2023) do, by colours; and as SPARF (Truong et al. 2023), by points
that two photos share. Poses that bundle adjustment found in many such points can't be bettered so, and stay.
"""

import copy
from typing import Optional, Tuple

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor, nn

from sparsestyle_ns.core.camera_paths import meeting_point
from sparsestyle_ns.core.rotations import rotation_matrix, similarity_between
from sparsestyle_ns.core.triangulation import reprojection_errors
from sparsestyle_ns.data.scene_info import NDC, scene_info
from sparsestyle_ns.effects.decisions import Decisions, Measurement
from sparsestyle_ns.effects.matched_colors import not_measurable
from sparsestyle_ns.effects.matched_depth import triangulate
from sparsestyle_ns.effects.scene import LONGEST_SIDE, Scene

MAX_MISS = 0.2
"""Pixels of photos of 504 from which on cameras are off: good ones have 0.10 to 0.14, ones off by 0.1 degrees 0.33."""
DISTORTION_POWERS = (2, 4, 6, 8, 1, 1)
"""Powers of the focal length by which k1 to k4, p1 and p2 change so that the lens moves each pixel as before."""


def measure_pose_refinement(scene: Scene) -> Measurement:
    """By how much two photos' rays to a matched point miss each other, in the median, in pixels (`miss_in_pixels`)."""
    unknown = not_measurable(scene)
    if unknown:
        return Measurement(False, unknown, None, MAX_MISS)
    rays = triangulate(scene, scene.sure_matches)
    miss = float(miss_in_pixels(rays.origins.view(2, -1, 3), rays.directions.view(2, -1, 3), scene.cameras).median())
    whose = "estimated" if scene_info(scene.outputs).poses_estimated else "known"
    words = f"pixels by which rays to {len(rays) // 2} matched points miss each other (median); poses are {whose}"
    return Measurement(miss >= MAX_MISS, words, miss, MAX_MISS)


def miss_in_pixels(
    origins: Float[Tensor, "2 points 3"], directions: Float[Tensor, "2 points 3"], cameras: Cameras
) -> Float[Tensor, "2 points"]:
    """`reprojection_errors` in pixels of the size at which photos are matched; `cameras` are those of the photos."""
    longest = torch.maximum(cameras.width, cameras.height)
    focal = cameras.fx * longest.clamp(max=LONGEST_SIDE) / longest
    return reprojection_errors(origins, directions, 0.0) * float(focal.mean())


class CameraRefinement(nn.Module):
    """Where each photo was taken, as a change of what the dataparser says; none at 0.

    A camera turns and moves along its own axes (right, up, back): R exp(ω), o + u R t. Focal lengths stay as they are:
    in forward-facing scenes the depth of everything makes up for them (docs/method.md).

    Args:
        poses: camera-to-world, as the dataparser has them.
        unit: u, in the world, such that turns in radians and moves in units change a picture alike (`moving_unit`).
    """

    axes: Float[Tensor, "views 3 3"]

    def __init__(self, poses: Float[Tensor, "views 3 4"], unit: float) -> None:
        super().__init__()
        self.unit, self.learns = unit, True
        self.register_buffer("axes", poses[..., :3].float().clone(), persistent=False)
        self.turn = nn.Parameter(torch.zeros(len(poses), 3))
        self.move = nn.Parameter(torch.zeros(len(poses), 3))

    def forward(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], views: Int[Tensor, "rays"]
    ) -> Tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
        """Rays of the photos' pixels by the refined cameras; differentiable while these learn."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and self.learns):
            turned, moved = self._changed_axes()
            turns = turned @ torch.linalg.inv(self.axes)  # which files give no better than nearly orthogonal
            return origins + moved[views], torch.einsum("nij,nj->ni", turns[views], directions)

    def _changed_axes(self) -> Tuple[Float[Tensor, "views 3 3"], Float[Tensor, "views 3"]]:
        """The cameras' axes as they are turned, and how far they moved, in the world."""
        turned = self.axes @ rotation_matrix(self.turn)
        return turned, self.unit * torch.einsum("nij,nj->ni", self.axes, self.move)

    @torch.no_grad()
    def cameras(self, cameras: Cameras) -> Cameras:
        """The refined cameras of those that the dataparser gives for the same photos."""
        turned, moved = (part.to(cameras.camera_to_worlds) for part in self._changed_axes())
        refined = copy.deepcopy(cameras)
        positions = cameras.camera_to_worlds[..., 3] + moved
        refined.camera_to_worlds = torch.cat([turned, positions[..., None]], dim=-1)
        return refined


def carried_along(cameras: Cameras, given: Cameras, refined: Cameras) -> Cameras:
    """Cameras of the world of `given` ones in that of the same ones `refined`, by the similarity between these.

    Their focal lengths change as those do, for lenses that move each pixel as before.
    """
    moved = copy.deepcopy(cameras)
    poses = (each.camera_to_worlds.double() for each in (given, refined))
    own = cameras.camera_to_worlds
    moved.camera_to_worlds = similarity_between(*poses).of_poses(own.double()).to(own)
    factor = float((refined.fx / given.fx).mean())
    moved.fx, moved.fy = cameras.fx * factor, cameras.fy * factor
    if cameras.distortion_params is not None:
        powers = cameras.distortion_params.new_tensor(DISTORTION_POWERS)
        moved.distortion_params = cameras.distortion_params * factor**powers
    return moved


def moving_unit(cameras: Cameras, ndc: Optional[NDC]) -> float:
    """How far the nearest things are, about, in the world: a camera that moves by this moves pictures by a radian.

    In NDC the distance of the near plane, else half that of the point that all cameras look at.
    """
    if ndc is not None:
        return ndc.near
    poses = cameras.camera_to_worlds
    return 0.5 * float((poses[..., 3] - meeting_point(poses)).norm(dim=-1).median())


def build_camera_refinement(effects: Decisions, cameras: Cameras, ndc: Optional[NDC]) -> Optional[CameraRefinement]:
    """What stage 1 learns of the cameras; None where the effect is off."""
    if not effects.on("pose_refinement"):
        return None
    return CameraRefinement(cameras.camera_to_worlds, moving_unit(cameras, ndc))

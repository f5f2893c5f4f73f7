"""A run's scene along the measuring path: what it looks like before and after stylising, and where its surfaces are."""

from dataclasses import dataclass
from typing import Dict, List

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.metrics.consistency import RANGES, PathGeometry
from sparsestyle_ns.metrics.warping import MIN_COVERAGE, Pinhole, Surface
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.utils.progress import track


@dataclass
class PathFrames:
    """Frames of the measuring path, and what they show of the unstylised scene; on the CPU."""

    stylised: List[Float[Tensor, "H W 3"]]
    coarse: List[Float[Tensor, "H W 3"]]
    surfaces: List[Surface]

    def figures(self) -> Dict[str, float]:
        """Consistency of the stylised frames, and as `ceiling_…` that of the unstylised ones under the same masks.

        `short_visible` and `long_visible` are the shares of pixels that count.
        """
        geometry = PathGeometry(self.surfaces)
        values = geometry.consistency(self.stylised)
        values.update({f"ceiling_{key}": value for key, value in geometry.consistency(self.coarse).items()})
        shares = {f"{name}_visible": geometry.visible_share(name) for name in RANGES}
        return {**values, **{key: share for key, share in shares.items() if share is not None}}


@torch.no_grad()
def render_path(model: HierStyleModel, cameras: Cameras) -> PathFrames:
    """Renders a path's frames, each exactly, and finds the world points that the unstylised scene shows there.

    `depth_coarse` is a distance in world units along a unit direction in every space, NDC too, so that the points are
    in the world, where cameras project.
    """
    frames = PathFrames([], [], [])
    for index in track(range(len(cameras)), "Measuring path"):
        camera = cameras[index : index + 1].to(model.device)
        with model.display.rendering("exact"):
            outputs = model.get_outputs_for_camera(camera)
        rays = camera.generate_rays(camera_indices=0, keep_shape=True)
        points = rays.origins + outputs["depth_coarse"] * rays.directions
        focal, center = (float(camera.fx), float(camera.fy)), (float(camera.cx), float(camera.cy))
        pinhole = Pinhole(camera.camera_to_worlds[0].cpu(), focal, center)
        covered = (outputs["accumulation_coarse"] > MIN_COVERAGE).squeeze(-1)
        frames.stylised.append(outputs["rgb"].clamp(0.0, 1.0).cpu())
        frames.coarse.append(outputs["rgb_coarse"].clamp(0.0, 1.0).cpu())
        frames.surfaces.append(Surface(pinhole, points.cpu(), covered.cpu()))
    return frames

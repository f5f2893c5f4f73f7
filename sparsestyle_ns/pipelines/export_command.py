"""nerfstudio's `ns-export`: what it would stumble over on these runs is said before."""

from typing import Any

import torch
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.pipelines.base_pipeline import Pipeline

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import say

MADE_OTHERWISE = {
    "ExportGaussianSplat": "has no Gaussians yet; have them made by sparsestyle export RUN --format splat",
    "ExportMarchingCubesMesh": "has no signed distances; take ns-export poisson --normal-method open3d",
}
"""Commands, by their classes, that need what these runs don't have."""
BOX = ("obb_center", "obb_rotation", "obb_scale")
"""Options that place a box of points, all or none of them."""
RAYS_TRIED = 1 << 14
"""Rays of the photos of which at least one has to end in such a box."""


def check_export(command: Any) -> None:
    """InputError for a command of ns-export that can't be done with these runs."""
    why = MADE_OTHERWISE.get(type(command).__name__)
    if why is not None:
        raise InputError(f"A run of this method {why}.")
    if getattr(command, "normal_method", "open3d") != "open3d":
        raise InputError("A run of this method has no normals of its own; add --normal-method open3d.")
    for option in ("num_points", "num_rays_per_batch", "downscale_factor", "batch_size", "px_per_uv_triangle"):
        if getattr(command, option, 1) < 1:
            raise InputError(f"--{option.replace('_', '-')} is {getattr(command, option)}; give 1 or more.")
    box = [getattr(command, option, None) for option in BOX]
    if None in box and box != [None] * 3:
        say("--obb-center, --obb-rotation and --obb-scale have an effect only together.")


@torch.no_grad()
def check_box(command: Any, pipeline: Pipeline) -> None:
    """InputError where the box of a command of ns-export holds no surface that the photos see.

    nerfstudio would look for points in it for ever.
    """
    box = [getattr(command, option, None) for option in BOX]
    if None in box or not hasattr(command, "num_points"):
        return
    box, ends = OrientedBox.from_params(*box), []
    count = 0
    while count < RAYS_TRIED:
        rays, _ = pipeline.datamanager.next_train(0)
        outputs = pipeline.model(rays)
        ends.append(rays.origins + rays.directions * outputs["depth"])
        if (box.within(ends[-1]) & (outputs["accumulation"].squeeze(-1) > 0.5)).any():
            return
        count += len(rays)
    found = torch.cat(ends)
    low, high = (", ".join(f"{each:.2g}" for each in found.quantile(share, dim=0)) for share in (0.05, 0.95))
    raise InputError(
        f"The box of --obb-center, --obb-rotation and --obb-scale holds no surface: none of {count} rays of the photos "
        f"ends in it. Most end between ({low}) and ({high}); place the box there, or leave it out."
    )

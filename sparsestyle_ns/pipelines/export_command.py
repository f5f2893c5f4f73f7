"""nerfstudio's `ns-export`: what it would stumble over on these runs is said before."""

from typing import Any

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import say

MADE_OTHERWISE = {
    "ExportGaussianSplat": "has no Gaussians yet; have them made by sparsestyle export RUN --format splat",
    "ExportMarchingCubesMesh": "has no signed distances; take ns-export poisson --normal-method open3d",
}
"""Commands, by their classes, that need what these runs don't have."""


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
    box = [getattr(command, option, None) for option in ("obb_center", "obb_rotation", "obb_scale")]
    if None in box and box != [None] * 3:
        say("--obb-center, --obb-rotation and --obb-scale have an effect only together.")

"""nerfstudio's `ns-export`: what it would stumble over on these runs is said before."""

import math
from typing import Any, Mapping

import torch
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.pipelines.base_pipeline import Pipeline

from sparsestyle_ns.pipelines.nerfstudio_options import unused
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import say

MADE_OTHERWISE = {
    "ExportGaussianSplat": "has no Gaussians yet; have them made by sparsestyle export RUN --format splat",
    "ExportMarchingCubesMesh": "has no signed distances; take ns-export poisson --normal-method open3d",
}
"""Commands, by their classes, that need what these runs don't have."""
LEAST_POINTS = 100
"""Of a cloud, by which each has neighbours."""
BOX = ("obb_center", "obb_rotation", "obb_scale")
"""Options that place a box of points, all or none of them."""
LEAST: Mapping[str, float] = {
    **dict.fromkeys(("num_rays_per_batch", "downscale_factor", "batch_size", "px_per_uv_triangle"), 1),
    **{"num_points": 1, "num_pixels_per_side": 8, "target_num_faces": 4},
    **{"std_ratio": 0.001, "refinement_epsilon": 0.0},
}
"""Numbers that nerfstudio, or the libraries that it hands them to, need at least."""
WHY = "ns-export poisson takes points from everywhere, or from the box of --obb-center, --obb-rotation and --obb-scale"
NOT_OF_POISSON = dict.fromkeys(("use_bounding_box", "bounding_box_min", "bounding_box_max"), WHY)
"""Options of that command that nerfstudio doesn't read."""
RAYS_TRIED = 1 << 14
"""Rays of the photos of which at least one has to end in such a box."""


def check_export(command: Any) -> None:
    """InputError for a command of ns-export that can't be done with these runs."""
    why = MADE_OTHERWISE.get(type(command).__name__)
    if why is not None:
        raise InputError(f"A run of this method {why}.")
    if getattr(command, "normal_method", "open3d") != "open3d":
        raise InputError("A run of this method has no normals of its own; add --normal-method open3d.")
    for option, least in LEAST.items():
        value = getattr(command, option, None)
        if value is not None and not least <= value < math.inf:
            raise InputError(f"{flag(option)} is {value}; give {least} or more.")
    counts = [getattr(command, option, math.inf) for option in ("num_points", "num_rays_per_batch")]
    if max(counts) < LEAST_POINTS:  # whole batches are taken
        raise InputError(f"--num-points is {counts[0]}; give {LEAST_POINTS} or more.")
    _check_grid(command)
    for line in unused(command, NOT_OF_POISSON) if type(command).__name__ == "ExportPoissonMesh" else ():
        say(line)
    box = [getattr(command, option, None) for option in BOX]
    if None in box and box != [None] * 3:
        say("--obb-center, --obb-rotation and --obb-scale have an effect only together.")


def flag(option: str) -> str:
    """An option as it is typed."""
    return f"--{option.replace('_', '-')}"


def _check_grid(command: Any) -> None:
    """InputError for a grid of cells that has no inside."""
    cells = getattr(command, "resolution", None)
    if cells is None:
        return
    cells = [cells] * 3 if isinstance(cells, int) else cells
    if len(cells) != 3 or min(cells) < 2:
        told = " ".join(map(str, cells)) or "nothing"
        raise InputError(f"--resolution is {told}; give one number of cells, or three, each 2 or more.")
    ends = [tuple(getattr(command, f"bounding_box_{end}")) for end in ("min", "max")]
    is_box = all(low < high for low, high in zip(*ends, strict=True)) and all(map(math.isfinite, sum(ends, ())))
    if command.use_bounding_box and not is_box:
        raise InputError(
            "--bounding-box-min isn't below --bounding-box-max in x, y and z; give the lower corner first."
        )


def check_export_of(command: Any, pipeline: Pipeline) -> None:
    """InputError for a command of ns-export, None for none, that can't be done with what a loaded run shows."""
    for option, kind in (("rgb_output_name", "rgb"), ("depth_output_name", "depth")):
        names = [name for name in pipeline.model.picture_names if name.startswith(kind)]
        if getattr(command, option, names[0]) not in names:
            raise InputError(f"{flag(option)} is {getattr(command, option)}; choose from {', '.join(names)}.")
    if hasattr(command, "resolution"):
        cameras = pipeline.datamanager.train_dataparser_outputs.cameras
        side = min(int(cameras.width.min()), int(cameras.height.min()))
        if side < command.downscale_factor:
            raise InputError(
                f"--downscale-factor is {command.downscale_factor}, and the views have {side} pixels; give less."
            )
    check_box(command, pipeline)


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

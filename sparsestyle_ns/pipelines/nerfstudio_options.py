"""nerfstudio's options, and what a scene may hold: what has no effect in these methods is named, in a line each.

A test demands each of their options in a table, so that one which a new nerfstudio adds is found.
"""

from dataclasses import MISSING, fields
from typing import Any, Dict, List, Mapping

from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from sparsestyle_ns.data.photos import is_transparent

USED = ""
DATA_MANAGER: Mapping[str, str] = {
    **dict.fromkeys(("_target", "data", "dataparser", "train_num_rays_per_batch", "camera_res_scale_factor"), USED),
    **dict.fromkeys(("eval_num_rays_per_batch", "collate_fn", "masks_on_gpu"), USED),
    **dict.fromkeys(("eval_num_images_to_sample_from", "eval_num_times_to_repeat_images"), USED),
    "images_on_gpu": "the photos' pixels are where the model is",
    "train_num_images_to_sample_from": "a batch is drawn from all photos",
    "train_num_times_to_repeat_images": "a batch is drawn from all photos",
    "eval_image_indices": "every held-out photo is looked at",
    "patch_size": "single pixels are drawn",
    "pixel_sampler": "pixels are drawn by the step's number",
    "camera_optimizer": "cameras are learned in another way, or not at all",
}
"""Of nerfstudio's data manager: why an option isn't used, or that it is."""
MODEL: Mapping[str, str] = {
    **dict.fromkeys(("_target", "eval_num_rays_per_chunk", "enable_collider"), USED),  # the last is refused
    "collider_params": "the scene's space ends rays",
    "loss_coefficients": "each loss has a weight of its own",
    "prompt": "no model here reads words",
}
"""Of nerfstudio's model."""
DATAPARSER: Mapping[str, str] = {
    "depth_unit_scale_factor": "depth maps aren't read",
    "depths_path": "depth maps aren't read",
    "load_3D_points": "a scene's points aren't read",
    "max_2D_matches_per_3D_point": "a scene's points aren't read",
    "ply_path": "a scene's points aren't read",
}
"""Of nerfstudio's dataparsers: only what isn't used; all else is theirs to do."""
RENDER: Mapping[str, str] = {
    **dict.fromkeys(("load_config", "output_path", "data", "split", "eval_num_rays_per_chunk"), USED),
    **dict.fromkeys(("image_format", "jpeg_quality", "output_format", "frame_rate", "seconds", "radius"), USED),
    **dict.fromkeys(("downscale_factor", "rendered_output_names", "colormap_options"), USED),
    **dict.fromkeys(("depth_near_plane", "depth_far_plane", "render_nearest_camera", "check_occlusions"), USED),
    **dict.fromkeys(("camera_path_filename", "pose_source", "interpolation_steps", "order_poses"), USED),
    "camera_idx": "no photo's appearance is learned but its exposure, and pictures have the mean one",
}
"""Of ns-render's commands."""


def unused(config: Any, table: Mapping[str, str], prefix: str = "") -> List[str]:
    """A line for each option of a config that differs from its default and isn't used."""
    lines = []
    for each in fields(config):
        why = table.get(each.name, USED)
        usual = each.default_factory() if each.default_factory is not MISSING else each.default
        if why and getattr(config, each.name) != usual:
            lines.append(f"--{prefix}{each.name.replace('_', '-')} has no effect here: {why}.")
    return lines


def unused_in_training(pipeline: Any) -> List[str]:
    """The same of a pipeline's config, with its model, data manager and dataparser."""
    manager, model = pipeline.datamanager, pipeline.model
    found = unused(manager, DATA_MANAGER, "pipeline.datamanager.") + unused(model, MODEL, "pipeline.model.")
    return found + unused(manager.dataparser, DATAPARSER)


def unused_of_scene(outputs: DataparserOutputs) -> List[str]:
    """A line for what the chosen views of a scene have and isn't used, or not as one may think."""
    lines = []
    transparent = [path.name for path in outputs.image_filenames if is_transparent(path)]
    if transparent and outputs.alpha_color is not None:
        color = ", ".join(f"{float(value):g}" for value in outputs.alpha_color)
        lines.append(f"Transparent in places, and laid over RGB {color}: {', '.join(transparent)}.")
    if outputs.mask_filenames:
        lines.append("Masks say what stage 1 trains on; whole views are stylised, and measured.")
    if outputs.metadata.get("depth_filenames"):
        lines.append("The scene's depth maps aren't used; depth is learned from the photos.")
    return lines


def render_options(command: Any) -> List[str]:
    """A line for each option of an ns-render command that isn't used."""
    return unused(command, RENDER)


TABLES: Dict[str, Mapping[str, str]] = {"data manager": DATA_MANAGER, "model": MODEL, "ns-render": RENDER}

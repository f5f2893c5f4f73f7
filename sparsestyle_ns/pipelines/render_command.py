"""nerfstudio's `ns-render`, from whose commands these pipelines are set up: what it would stumble over is said before.

It reads a camera path only after the pipeline is loaded, and believes whatever is in it.
"""

import json
import math
import shutil
import tempfile
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
from nerfstudio.pipelines.base_pipeline import VanillaPipeline

from sparsestyle_ns.data.photos import SMALLEST_SIDE
from sparsestyle_ns.pipelines.command_output import running_command
from sparsestyle_ns.pipelines.nerfstudio_options import render_options
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.interrupts import take_away_at_end
from sparsestyle_ns.utils.progress import say

AROUND = ("equirectangular", "omnidirectional", "vr180")
"""Kinds of cameras, by their names in a camera path, that see what is behind them."""
KINDS = ("perspective", "fisheye", *AROUND)
LONGEST_SIDE = 16384
"""Pixels, that no film has."""
FRAME_RATES = 0.01, 1000.0
"""Frames a second that films can have."""
EXPORT_AGAIN = "export it again from the viewer's Render tab"


def check_numbers(command: Any) -> None:
    """InputError for numbers that nerfstudio stumbles over.

    A scene's pictures are reduced by `prepare_render` where ns-render would have its parser do so, which not all can.
    """
    factor = command.downscale_factor
    if factor is not None and not 0 < factor < math.inf:
        raise InputError(f"--downscale-factor is {factor}; give a number above 0.")
    if command.eval_num_rays_per_chunk is not None and command.eval_num_rays_per_chunk < 1:  # 0 would be the default
        raise InputError(f"--eval-num-rays-per-chunk is {command.eval_num_rays_per_chunk}; give 1 or more.")
    if hasattr(command, "radius"):
        frames = command.frame_rate * command.seconds
        if not (command.frame_rate > 0 and 1 <= frames < math.inf and math.isfinite(command.radius)):
            raise InputError("--frame-rate times --seconds needs to be 1 frame or more, and --radius to be finite.")
    if hasattr(command, "split") and factor is not None:
        command.picture_scale, command.downscale_factor = 1.0 / factor, None


def prepare_render(pipeline: VanillaPipeline) -> None:
    """Checks what ns-render was asked for, if it is what runs, before a checkpoint is loaded; an InputError refuses."""
    command = running_command("render")
    if command is None:
        return
    for line in render_options(command):
        say(line)
    _check_names(pipeline, command)
    reduce_pictures(pipeline, getattr(command, "picture_scale", 1.0))
    if hasattr(command, "camera_path_filename"):
        content = read_camera_path(Path(command.camera_path_filename).expanduser())
        command.camera_path_filename = _saved(content)
        _check_size(command, [content["render_width"], content["render_height"]])
        if str(content.get("camera_type", "")).lower() in AROUND and pipeline.model.ndc is not None:
            say("The scene is forward-facing: what a camera sees beside and behind the photos' views is empty.")
    if hasattr(command, "pose_source"):
        find_ends(pipeline, command)
    if hasattr(command, "radius"):  # nerfstudio multiplies them by poses, which are of single precision
        cameras = pipeline.datamanager.eval_dataloader.cameras
        cameras.fx, cameras.fy = cameras.fx.float(), cameras.fy.float()
    if hasattr(command, "pose_source") or hasattr(command, "radius"):
        is_train = getattr(command, "pose_source", "eval") == "train"
        cameras = (pipeline.datamanager.train_dataset if is_train else pipeline.datamanager.eval_dataset).cameras
        _check_size(command, [*cameras.width.flatten().tolist(), *cameras.height.flatten().tolist()])


def _check_names(pipeline: VanillaPipeline, command: Any) -> None:
    """InputError where a picture is asked for that isn't rendered, or can't be saved."""
    names, known = command.rendered_output_names, list(pipeline.model.picture_names)
    is_dataset = hasattr(command, "split")
    if is_dataset:
        known += ["gt-rgb"] + ["gt-mask"] * (pipeline.datamanager.train_dataparser_outputs.mask_filenames is not None)
        known += [f"raw-{name}" for name in known]
    unknown = [] if names is None else [name for name in names if name not in [*known, "rgba"]]
    if unknown or names == []:
        what = "names nothing" if names == [] else f"names {unknown[0]}, which isn't rendered"
        raise InputError(f"--rendered-output-names {what}; choose from {', '.join([*known, 'rgba'])}.")
    is_png = getattr(command, "output_format", "images") == "images" and command.image_format == "png"
    if "rgba" in (names or []) and not (is_png and (is_dataset or names == ["rgba"])):
        raise InputError(
            "Of --rendered-output-names, rgba can only be a PNG file of its own; render it with --image-format png"
            + ("." if is_dataset else ", --output-format images, and no other name.")
        )


def reduce_pictures(pipeline: VanillaPipeline, scale: float) -> None:
    """Has `ns-render dataset` take a scene's photos, and render its views, at a share of the size of the run's."""
    config, cameras = pipeline.config.datamanager, pipeline.datamanager.train_dataset.cameras
    if scale * min(int(cameras.width.min()), int(cameras.height.min())) < SMALLEST_SIDE:
        raise InputError(
            f"--downscale-factor is {1 / scale:g}, and leaves less than {SMALLEST_SIDE} pixels; give less."
        )
    config.camera_res_scale_factor *= scale
    if config.max_image_side is not None:
        config.max_image_side = math.ceil(config.max_image_side * scale)


def _check_size(command: Any, sides: List[int]) -> None:
    """InputError where a film's frames, which have these sides before they are reduced, would be too small or large."""
    least, most = min(sides) / command.downscale_factor, max(sides) / command.downscale_factor
    if least < 1 or most > LONGEST_SIDE:
        raise InputError(
            f"--downscale-factor is {command.downscale_factor:g}, by which sides are {least:.3g} to {most:.6g} pixels; "
            f"give one that leaves 1 to {LONGEST_SIDE}."
        )


def _saved(content: Dict[str, Any]) -> Path:
    """A file with a camera path, for as long as the process runs."""
    folder = tempfile.mkdtemp(prefix="camera-path-")
    take_away_at_end(lambda: shutil.rmtree(folder, ignore_errors=True))
    path = Path(folder) / "camera_path.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def find_ends(pipeline: VanillaPipeline, command: Any) -> None:
    """Sees to it that `ns-render interpolate` has two cameras to fly between; it flies between held-out views."""
    manager = pipeline.datamanager
    if command.interpolation_steps < 1 or command.frame_rate < 1:
        raise InputError("--interpolation-steps and --frame-rate need 1 or more each.")
    if command.pose_source == "eval" and len(manager.eval_dataset) < 2:
        say(
            "Fewer than two views are held out, so the flight is between the training views, as by --pose-source train."
        )
        manager.eval_dataset = manager.train_dataset
    chosen = manager.eval_dataset if command.pose_source == "eval" else manager.train_dataset
    if len(chosen) < 2:
        raise InputError(
            "There is only one view, and a flight needs two: render a path from the viewer with ns-render camera-path."
        )


def read_camera_path(path: Path) -> Dict[str, Any]:
    """A camera path as nerfstudio's viewer writes it; InputError where ns-render couldn't render what is in it.

    Whole numbers, on which nerfstudio ends with an assertion in some places, become floating-point ones there.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"There is no camera path {path}: name one with --camera-path-filename.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} can't be read as JSON ({error}): {EXPORT_AGAIN}.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} is no camera path: {EXPORT_AGAIN}.")
    keyframes = content.get("camera_path")
    if not isinstance(keyframes, list) or not keyframes:
        raise InputError(f"{path} has no cameras in camera_path: add keyframes in the viewer, and {EXPORT_AGAIN}.")
    if not _number(content.get("seconds")) > 0:
        raise InputError(f"{path} doesn't say in seconds, a number above 0, how long the film is: add it.")
    if not FRAME_RATES[0] <= len(keyframes) / content["seconds"] <= FRAME_RATES[1]:
        raise InputError(
            f"{path} shows {len(keyframes)} frames in {content['seconds']:g} seconds, and a film has from "
            f"{FRAME_RATES[0]:g} to {FRAME_RATES[1]:g} a second: correct seconds."
        )
    for side in ("render_height", "render_width"):
        value = content.get(side)
        # nerfstudio's viewer may write 1080.0, which is whole.
        if isinstance(value, bool) or not 1 <= _number(value) <= LONGEST_SIDE or int(value) != value:
            raise InputError(f"{path} has no {side} from 1 to {LONGEST_SIDE}, in whole pixels: correct it.")
        content[side] = int(value)
    kind = content.get("camera_type", KINDS[0])
    if not isinstance(kind, str) or kind.lower() not in KINDS or (kind != kind.lower() and kind.lower() in KINDS[:3]):
        raise InputError(f"{path} has the camera_type {json.dumps(kind)[:60]}: name one of {', '.join(KINDS)}.")
    for index, camera in enumerate(keyframes):
        _check_camera(f"Camera {index} (from 0) of {path}", camera, needs_fov=kind.lower() not in AROUND)
    crop = content.get("crop")
    _check_crop(path, crop)
    keyframes = [{**camera, "camera_to_world": _floats(camera["camera_to_world"])} for camera in keyframes]
    if crop is not None:
        crop = {key: _floats(value) if isinstance(value, list) else value for key, value in crop.items()}
    return {**content, "camera_path": keyframes, "crop": crop}


def _check_camera(where: str, camera: Any, needs_fov: bool) -> None:
    if not isinstance(camera, dict) or not _is_pose(camera.get("camera_to_world")):
        raise InputError(f"{where} has no camera_to_world, a pose of 16 numbers: {EXPORT_AGAIN}.")
    if needs_fov and not 0 < _number(camera.get("fov")) < 180:
        raise InputError(f"{where} has no fov, its vertical angle of view in degrees, between 0 and 180: correct it.")
    if "render_time" in camera and math.isnan(_number(camera["render_time"])):
        raise InputError(f"{where} has a render_time that is no number: take it out.")


def _check_crop(path: Path, crop: Any) -> None:
    if crop is None:
        return
    vectors = {"crop_center": None, "crop_scale": None, "crop_rot": [0.0, 0.0, 0.0]}
    given = crop if isinstance(crop, dict) else {}
    for key, usual in vectors.items():
        value = given.get(key, usual)
        if not isinstance(value, list) or len(value) != 3 or any(math.isnan(_number(part)) for part in value):
            raise InputError(f"The crop of {path} has no {key} of three numbers: {EXPORT_AGAIN}, or take crop out.")
    if min(given["crop_scale"]) <= 0:
        raise InputError(f"The crop of {path} has a crop_scale that isn't above 0: correct it, or take crop out.")
    color = given.get("crop_bg_color")
    if not isinstance(color, dict) or not all(0 <= _number(color.get(part)) <= 255 for part in "rgb"):
        raise InputError(f"The crop of {path} has no crop_bg_color with r, g and b from 0 to 255: add it.")


def _is_pose(numbers: Any) -> bool:
    if not isinstance(numbers, list) or len(numbers) != 16 or any(math.isnan(_number(value)) for value in numbers):
        return False
    return bool(abs(np.linalg.det(np.array(numbers, dtype=np.float64).reshape(4, 4)[:3, :3])) > 1e-6)


def _floats(numbers: List[Any]) -> List[Any]:
    return [float(number) if isinstance(number, int) else number for number in numbers]


def _number(value: Any) -> float:
    """The value if it is a number that a camera can have, else NaN."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) < 1e9 else math.nan

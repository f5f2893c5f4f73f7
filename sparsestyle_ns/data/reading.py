"""Reading a scene with any dataparser, with errors that name what is wrong; nerfstudio's own check next to nothing."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict

import numpy as np
import torch
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sparsestyle_ns.data.colmap import read_colmap
from sparsestyle_ns.data.estimated import estimated_cameras
from sparsestyle_ns.data.parser_choice import advice
from sparsestyle_ns.data.photos import has_opacity, open_photo
from sparsestyle_ns.data.scene_info import SCENE_INFO, SceneInfo
from sparsestyle_ns.data.tracks import Tracks
from sparsestyle_ns.data.view_selection import BLENDER_VIEWS
from sparsestyle_ns.utils.errors import InputError

SPLITS = ("train_filenames", "val_filenames", "test_filenames")
"""Entries of a `transforms.json` that list photos by their file_path; nerfstudio wants all three where it has one."""
LENGTHS = ("fl_x", "fl_y", "w", "h")
NUMBERS = ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
ANGLE = "camera_angle_x"
"""Entries, for all cameras or, in a frame, for its own: in pixels and above 0, any number, and in radians."""


def _check_blender_files(config: BlenderDataParserConfig, split: str) -> None:
    frames = read_transforms(config.data / f"transforms_{split}.json", with_angle=True)["frames"]
    first = frames[0]["file_path"].replace("./", "")
    open_photo(config.data / f"{first}.png")  # it gives all cameras their size


def _check_capture(path: Path, is_scaled: bool) -> None:
    """InputError for a `transforms.json` of which nerfstudio's parser would say less; `is_scaled` by its spread."""
    content = read_transforms(path, with_angle=False)
    check_splits(path, content)
    frames: Dict[str, int] = {}
    for index, frame in enumerate(content["frames"]):
        before = frames.setdefault(frame["file_path"], index)
        if before != index:
            raise InputError(
                f"Frames {before} and {index} (from 0) of {path} are both of {frame['file_path']}: drop one of them."
            )
    model = content.get("camera_model", "OPENCV")
    if not isinstance(model, str) or model not in CAMERA_MODEL_TO_TYPE:
        raise InputError(f"{path} has the camera_model {_shown(model)}: name one of {', '.join(CAMERA_MODEL_TO_TYPE)}.")
    places = np.array([np.array(frame["transform_matrix"], float)[:3, 3] for frame in content["frames"]])
    if is_scaled and np.ptp(places, axis=0).max() == 0:
        raise InputError(
            f"All cameras of {path} stand at one place: give it photos from other places, with their poses."
        )


def check_splits(path: Path, content: Dict[str, Any]) -> None:
    """Raises an `InputError` if the lists of photos to train on and to hold out aren't lists of names."""
    for split in SPLITS:
        names = content.get(split, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(
                f"{path} has {split} that is no list of names: list the file_path of each photo there, or take "
                f"{', '.join(SPLITS)} out."
            )
    if content.get(SPLITS[0]) == []:
        raise InputError(f"{path} lists no photo in {SPLITS[0]}: list some there, or take {', '.join(SPLITS)} out.")


def read_scene(parser: DataParser, split: str = "train") -> DataparserOutputs:
    """One split of a scene, checked, with its `SceneInfo` in the metadata.

    Raises:
        InputError: the scene can't be read, or a camera in it can't be used.
    """
    config = parser.config
    if isinstance(config, BlenderDataParserConfig):
        _check_blender_files(config, split)
    if isinstance(config, NerfstudioDataParserConfig):
        is_file = config.data.suffix == ".json"
        _check_capture(config.data if is_file else config.data / "transforms.json", config.auto_scale_poses)
    try:
        is_colmap = isinstance(config, ColmapDataParserConfig)
        outputs = read_colmap(parser, split) if is_colmap else parser.get_dataparser_outputs(split)
    except InputError:
        raise
    except Exception as error:  # a file that isn't as a parser expects it shows itself in any kind of error
        name = type(config).__name__.removesuffix("DataParserConfig").lower()
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{config.data} can't be read as a scene of the kind {name} ({type(error).__name__}: {reason}); correct "
            "its files, or choose the dataparser that they were made for."
        ) from error
    _check_cameras(outputs)
    if outputs.alpha_color is None and any(map(has_opacity, outputs.image_filenames)):
        outputs = replace(outputs, alpha_color=torch.ones(3))  # else the colours that nobody sees would be trained on
    standard_views = BLENDER_VIEWS if isinstance(config, BlenderDataParserConfig) else None
    usual = SceneInfo(tuple(range(len(outputs.image_filenames))), standard_views=standard_views)
    info = outputs.metadata.get(SCENE_INFO, usual)
    folder = config.data if config.data.is_dir() else config.data.parent
    if estimated_cameras(folder) is not None:
        info = replace(info, poses_estimated=True, tracks=Tracks.find(folder))
    return replace(outputs, metadata={**outputs.metadata, SCENE_INFO: info})


def _check_cameras(outputs: DataparserOutputs) -> None:
    cameras = outputs.cameras
    if len(cameras) == 0:  # a split may be empty
        return
    sizes = torch.cat([cameras.fx, cameras.fy, cameras.width, cameras.height], dim=-1)
    numbers = torch.cat([cameras.camera_to_worlds.flatten(1), sizes, cameras.cx, cameras.cy], dim=-1)
    usable = numbers.isfinite().all(dim=-1) & (sizes > 0).all(dim=-1)
    if not usable.all():
        photo = outputs.image_filenames[int((~usable).nonzero()[0])]
        raise InputError(
            f"The camera of {photo} has a pose that is not finite, or a focal length or size that is not above 0: "
            "correct it, or take the photo out of the scene."
        )


def read_transforms(path: Path, with_angle: bool) -> Dict[str, Any]:
    """What a `transforms….json` holds, in which every frame names a photo and has a camera pose.

    Args:
        with_angle: whether it must have `camera_angle_x`, the horizontal angle of view in radians.

    Raises:
        InputError: it isn't there, is no such file, or a frame, counted from 0, lacks something.
    """
    content = _read(path)
    if with_angle:
        _check_angle(str(path), content.get(ANGLE))
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} has no list of frames: export the scene again.")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise InputError(f"Frame {index} (from 0) of {path} names no photo in file_path: correct it or drop it.")
        if not _is_pose(frame.get("transform_matrix")):
            raise InputError(
                f"Frame {index} (from 0) of {path}, {frame['file_path']}, has a transform_matrix that is no camera "
                "pose, which is a 4x4 matrix of finite numbers with three independent directions: correct it or drop "
                "the frame."
            )
    return content


def check_lenses(path: Path, content: Dict[str, Any]) -> None:
    """Raises an `InputError` if what `read_transforms` read of a lens or size is no number that a camera can have."""
    frames = [(f"frame {index} (from 0) of {path}", frame) for index, frame in enumerate(content["frames"])]
    for where, given in [(str(path), content), *frames]:
        for key in LENGTHS:
            if key in given and not _number(given[key]) > 0:
                raise InputError(f"{where} has {key} {_shown(given[key])}: give a number of pixels above 0.")
        for key in NUMBERS:
            if key in given and math.isnan(_number(given[key])):
                raise InputError(f"{where} has {key} {_shown(given[key])}: give a number, or take it out.")
        if ANGLE in given:
            _check_angle(where, given[ANGLE])
        lens = given.get("distortion_params", [0.0] * 6)
        if not isinstance(lens, list) or len(lens) not in (6, 12) or any(math.isnan(_number(value)) for value in lens):
            raise InputError(
                f"{where} has distortion_params {_shown(lens)}: give six numbers, twelve of a FISHEYE624, or take it "
                "out."
            )


def _check_angle(where: str, angle: Any) -> None:
    if not 0 < _number(angle) < math.pi:
        raise InputError(
            f"{where} has {ANGLE} {_shown(angle)}: give the horizontal angle of view in radians, above 0 and below π."
        )


def _read(path: Path) -> Dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        where = f"{path.parent} has no {path.name}" if path.parent.is_dir() else f"There is no folder {path.parent}"
        raise InputError(where, advice(path.parent, path.name) or "name the folder of a scene with --data") from error
    except (OSError, ValueError, RecursionError) as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise InputError(f"{path} can't be read as JSON ({error}): export the scene again.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no JSON object with frames: export the scene again.")
    return content


def _number(value: Any) -> float:
    """The value if it is a number, else NaN."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) < 1e30 else math.nan


def _shown(value: Any) -> str:
    """A value as JSON has it, cut short where it is long."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:59] + "…"


def _is_pose(matrix: Any) -> bool:
    """Whether this is a 4x4 (or, without its last row, 3x4) matrix whose 3x3 part can be turned around."""
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return False
    if pose.shape not in ((4, 4), (3, 4)) or not (np.abs(pose) < 1e15).all():
        return False
    directions = pose[:3, :3] / np.linalg.norm(pose[:3, :3], axis=0, keepdims=True).clip(min=1e-12)
    return bool(abs(np.linalg.det(directions)) > 1e-3)

"""The files of camera poses in Blender and nerfstudio scenes, checked before nerfstudio reads them."""

import json
import math
from pathlib import Path
from typing import Any, Dict, List

import numpy as np

from sparsestyle_ns.dataparsers.choice import advice
from sparsestyle_ns.errors import InputError


def check_transforms(path: Path, with_angle: bool) -> List[str]:
    """Makes sure that every frame of a `transforms….json` names a photo and has a camera pose; returns the names.

    Args:
        path: the file.
        with_angle: whether it must have `camera_angle_x`, the horizontal angle of view in radians.

    Raises:
        InputError: it isn't there, is no such file, or a frame, counted from 0, lacks something.
    """
    content = _read(path)
    if with_angle and not 0 < _number(content.get("camera_angle_x")) < math.pi:
        raise InputError(
            f"{path} has camera_angle_x {json.dumps(content.get('camera_angle_x'))}: give the horizontal angle of "
            "view in radians, above 0 and below π."
        )
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
    return [frame["file_path"] for frame in frames]


def _read(path: Path) -> Dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        where = f"{path.parent} has no {path.name}" if path.parent.is_dir() else f"There is no folder {path.parent}"
        what = advice(path.parent, path.name) or "; name the folder of a scene with --data"
        raise InputError(f"{where}{what}.") from error
    except (OSError, ValueError, RecursionError) as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise InputError(f"{path} can't be read as JSON ({error}): export the scene again.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no JSON object with frames: export the scene again.")
    return content


def _number(value: Any) -> float:
    """The value if it is a number, else NaN."""
    return float(value) if isinstance(value, (int, float)) and abs(value) < 1e30 else math.nan


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

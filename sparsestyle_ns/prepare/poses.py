"""Camera poses that lie beside photos, brought to the photos' new size."""

import json
import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence

import numpy as np

from sparsestyle_ns.dataparsers.llff import read_poses_bounds
from sparsestyle_ns.errors import InputError
from sparsestyle_ns.prepare.photos import MIN_PHOTOS, Framing, Size

POSES_BOUNDS, TRANSFORMS = "poses_bounds.npy", "transforms.json"
ASPECT_TOLERANCE = 0.02
"""Share by which the aspect of a photo may differ from that of its pose: sizes are whole pixels."""
PIXEL_MAPS = ("mask_path", "depth_file_path")
"""Entries of a frame that are pictures of the photo's old size."""


class Poses(ABC):
    """Poses of a photo set. A subclass is one file format."""

    path: Path
    """The file that they are from."""
    parser: str
    """The dataparser that reads what `write` writes."""

    @abstractmethod
    def photos(self, found: Sequence[Path]) -> List[Path]:
        """Those of the photos that have poses, in the poses' order.

        Raises:
            InputError: too few have.
        """

    @abstractmethod
    def size(self, index: int) -> Optional[Size]:
        """Width and height that a pose's focal length is in units of; None where the file doesn't say."""

    @abstractmethod
    def write(self, folder: Path, names: Sequence[str], framings: Sequence[Framing]) -> None:
        """Writes the file for photos with new names and sizes into a folder that has them in `images`."""


def find_poses(photos: Path) -> Optional[Poses]:
    """The poses in the folder of the photos or, for a folder `images`, in the one around it; None if there are none.

    Raises:
        InputError: they can't be used.
    """
    for folder in (photos, photos.parent) if photos.name.startswith("images") else (photos,):
        if (folder / POSES_BOUNDS).is_file():
            return LLFFPoses(folder / POSES_BOUNDS)
        if (folder / TRANSFORMS).is_file():
            return TransformsPoses(folder / TRANSFORMS)
    return None


def fits(photo: Size, pose: Size) -> bool:
    """Whether a photo is a scaled version of what a pose is for."""
    return abs(photo[0] * pose[1] / (photo[1] * pose[0]) - 1.0) < ASPECT_TOLERANCE


class LLFFPoses(Poses):
    """`poses_bounds.npy`: one row a photo, in the order of their names."""

    parser = "llff-data"

    def __init__(self, path: Path) -> None:
        self.path = path
        read_poses_bounds(path.parent)  # says what is wrong with it
        self.rows = np.load(path).astype(np.float64)

    def photos(self, found: Sequence[Path]) -> List[Path]:
        """See `Poses.photos`."""
        if len(found) != len(self.rows):
            raise InputError(
                f"There are {len(found)} photos, but {self.path} has {len(self.rows)} poses; keep exactly one photo "
                "for each, in the order of their names."
            )
        return list(found)

    def size(self, index: int) -> Size:
        """See `Poses.size`."""
        height, width = self.rows[index, [4, 9]]
        return round(width), round(height)

    def write(self, folder: Path, names: Sequence[str], framings: Sequence[Framing]) -> None:
        """See `Poses.write`."""
        rows = self.rows.copy()
        for row, framing in zip(rows, framings, strict=True):
            focal = row[14] * framing.scaled[0] / row[9]
            row[[9, 4, 14]] = *framing.size, focal
        np.save(folder / POSES_BOUNDS, rows)


class TransformsPoses(Poses):
    """nerfstudio's `transforms.json`: a frame a photo, with intrinsics of its own or for all."""

    parser = "nerfstudio-data"

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.content: Dict[str, Any] = json.loads(path.read_text())
            self.frames = {Path(frame["file_path"]).stem: frame for frame in self.content["frames"]}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path} is not nerfstudio's ({type(error).__name__}): it needs a list `frames` with a file_path and a "
                "transform_matrix each; make it again, or move it away to have COLMAP find the poses."
            ) from error
        if "fl_x" not in self.content and "camera_angle_x" not in self.content:
            lacking = [name for name, frame in self.frames.items() if "fl_x" not in frame]
            if lacking:
                raise InputError(f"{path} has no focal length (fl_x) for {lacking[0]}; add it, in pixels.")
        self.used: List[Dict[str, Any]] = []

    def photos(self, found: Sequence[Path]) -> List[Path]:
        """See `Poses.photos`; photos and frames without the other are left out."""
        used = [path for path in found if path.stem in self.frames]
        if len(used) < MIN_PHOTOS:
            raise InputError(
                f"{self.path} has poses for {len(used)} of the {len(found)} photos, and at least {MIN_PHOTOS} are "
                "needed; its file_path entries have to name the photos."
            )
        self.used = [self.frames[path.stem] for path in used]
        return used

    def size(self, index: int) -> Optional[Size]:
        """See `Poses.size`."""
        width, height = (self._value(index, key) for key in ("w", "h"))
        return None if width is None or height is None else (round(width), round(height))

    def _value(self, index: int, key: str) -> Optional[float]:
        return self.used[index].get(key, self.content.get(key))

    def write(self, folder: Path, names: Sequence[str], framings: Sequence[Framing]) -> None:
        """See `Poses.write`. Distortion is in units of the focal length, and stays as it is."""
        frames = []
        for index, (frame, name, framing) in enumerate(zip(self.used, names, framings, strict=True)):
            frame = {key: value for key, value in frame.items() if key not in PIXEL_MAPS}
            frames.append({**frame, "file_path": f"images/{name}", **self._intrinsics(index, framing)})
        shared = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "ply_file_path")
        content = {key: value for key, value in self.content.items() if key not in shared}
        (folder / TRANSFORMS).write_text(json.dumps({**content, "frames": frames}, indent=2) + "\n")

    def _intrinsics(self, index: int, framing: Framing) -> Dict[str, float]:
        width, height = self.size(index) or framing.original
        across, down = framing.scaled[0] / width, framing.scaled[1] / height
        focal_x = self._value(index, "fl_x")
        if focal_x is None:
            focal_x = 0.5 * width / math.tan(0.5 * self._value(index, "camera_angle_x"))
        focal_y = self._value(index, "fl_y") or focal_x
        center_x, center_y = self._value(index, "cx"), self._value(index, "cy")
        center_x = 0.5 * width if center_x is None else center_x
        center_y = 0.5 * height if center_y is None else center_y
        return {
            "fl_x": across * focal_x,
            "fl_y": down * focal_y,
            "cx": across * center_x - framing.corner[0],
            "cy": down * center_y - framing.corner[1],
            "w": framing.size[0],
            "h": framing.size[1],
        }

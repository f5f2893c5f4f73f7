"""Camera poses that lie beside photos, the photos that they are for, and the poses at the photos' new size."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Sequence, Union

import numpy as np
from PIL import Image

from sparsestyle_ns.data.estimated import TRANSFORMS
from sparsestyle_ns.data.llff import read_poses_bounds
from sparsestyle_ns.data.photos import read_mask_of
from sparsestyle_ns.data.reading import SPLITS, check_lenses, check_splits, read_transforms
from sparsestyle_ns.prepare.framing import MIN_PHOTOS, Framing, Photo, Size, mask_name, read_photo
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.pictures import as_upright

POSES_BOUNDS = "poses_bounds.npy"
ASPECT_TOLERANCE = 0.02
"""Share by which the aspect of a photo may differ from that of its pose: sizes are whole pixels."""
MASK, DEPTH = "mask_path", "depth_file_path"
"""Entries of a frame that are pictures of the photo's old size: masks come along, depth maps don't."""
SHARED = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "ply_file_path")
"""Entries of all frames together that hold no longer once each frame has intrinsics of its own."""


def fits(photo: Size, pose: Size) -> bool:
    """Whether a photo is a scaled version of what a pose is for."""
    return abs(photo[0] * pose[1] - photo[1] * pose[0]) < ASPECT_TOLERANCE * photo[1] * pose[0]


class LLFFPoses:
    """Poses of a photo set in `poses_bounds.npy`: one row a photo, in the order of their names."""

    parser = "llff-data"
    """The dataparser that reads what `write` writes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        read_poses_bounds(path.parent)  # says what is wrong with it
        self.rows = np.load(path).astype(np.float64)

    def photos(self, found: Sequence[Path]) -> List[Path]:
        """Those of the photos that have poses; an `InputError` if too few, or if it isn't clear which pose is whose."""
        if len(found) != len(self.rows):
            raise InputError(
                f"There are {len(found)} photos, but {self.path} has {len(self.rows)} poses; keep exactly one photo "
                "for each, in the order of their names."
            )
        return list(found)

    def summary(self) -> str:
        """Where the poses are from, in a line."""
        return f"Poses are those in {self.path}"

    def size(self, index: int) -> Optional[Size]:
        """Width and height of the photo that a pose was made for; None where the file doesn't say."""
        height, width = self.rows[index, [4, 9]]
        return round(width), round(height)

    def mask(self, index: int) -> Optional[Path]:
        """Where a photo's mask is; the file knows of none."""
        return None

    def write(self, folder: Path, names: Sequence[str], framings: Sequence[Framing]) -> None:
        """Writes the file for photos with new names and sizes into a folder that has them in `images`."""
        rows = self.rows.copy()
        for row, framing in zip(rows, framings, strict=True):
            row[[9, 4, 14]] = *framing.size, row[14] * framing.scaled[0] / row[9]
        np.save(folder / POSES_BOUNDS, rows)


class TransformsPoses:
    """The same in nerfstudio's `transforms.json`: a frame a photo, with intrinsics of its own or for all."""

    parser = "nerfstudio-data"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content: Dict[str, Any] = read_transforms(path, with_angle=False)
        check_lenses(path, self.content)
        check_splits(path, self.content)
        for index, frame in enumerate(self.content["frames"]):
            if not isinstance(frame.get(MASK, ""), str):
                raise InputError(
                    f"Frame {index} (from 0) of {path} has a {MASK} that is no name: correct it or drop it."
                )
            if not any(key in part for part in (frame, self.content) for key in ("fl_x", "camera_angle_x")):
                raise InputError(f"{path} has no focal length (fl_x) for {frame['file_path']}; add it, in pixels.")
        self.used: List[Dict[str, Any]] = []

    def photos(self, found: Sequence[Path]) -> List[Path]:
        """See `LLFFPoses.photos`; photos and frames without the other are left out."""
        frames = self._frames_of(found)
        if len(frames) < MIN_PHOTOS:
            raise InputError(
                f"{self.path} has poses for {len(frames)} of the {len(found)} photos, and at least {MIN_PHOTOS} are "
                "needed; its file_path entries have to name the photos."
            )
        placed = [path for path in found if path in frames]
        self.used = [frames[path] for path in placed]
        self._say_what_has_no_match(found, frames)
        if self._splits([frame["file_path"] for frame in self.used]).get(SPLITS[0]) == []:
            raise InputError(
                f"None of the photos with poses is in {SPLITS[0]} of {self.path}: list some there, or take "
                f"{', '.join(SPLITS)} out."
            )
        return placed

    def _say_what_has_no_match(self, found: Sequence[Path], frames: Dict[Path, Dict[str, Any]]) -> None:
        """Prints which photos and which frames are left out."""
        used = {id(frame) for frame in self.used}
        without_photo = [frame["file_path"] for frame in self.content["frames"] if id(frame) not in used]
        without_pose = [path.name for path in found if path not in frames]
        if without_photo:
            print(f"Frames of {self.path} whose photos aren't there, and are left out: {', '.join(without_photo)}")
        without_mask = [path.name for path in found if path in frames and MASK not in frames[path]]
        if any(MASK in frame for frame in self.used) and without_mask:
            print(f"Photos without a mask in {self.path}, of which nothing is left out: {', '.join(without_mask)}")
        if without_pose:
            print(f"Photos without a frame in {self.path}, which are left out: {', '.join(without_pose)}")

    def _frames_of(self, found: Sequence[Path]) -> Dict[Path, Dict[str, Any]]:
        """The frame of each photo that has one: that whose file_path leads there; for names that no file_path leads to,
        that of the same name but for folder and suffix."""
        frames = self._matched(found, os.path.abspath)
        settled = {path.stem for path in frames}
        return {**frames, **self._matched([path for path in found if path.stem not in settled], lambda path: path.stem)}

    def _matched(self, found: Sequence[Path], key: Callable[[Path], str]) -> Dict[Path, Dict[str, Any]]:
        """Photos with their frames, of which keys agree: an `InputError` if with more than one."""
        frames: Dict[str, List[Dict[str, Any]]] = {}
        for frame in self.content["frames"]:
            frames.setdefault(key(self.path.parent / frame["file_path"]), []).append(frame)
        owners: Dict[str, Path] = {}
        for path in found:
            fitting = frames.get(key(path), [])
            if len(fitting) > 1:
                first, second = (frame["file_path"] for frame in fitting[:2])
                raise InputError(
                    f"Two frames of {self.path}, of {first} and {second}, may both be of {path}: correct file_path or "
                    "drop one."
                )
            if fitting and key(path) in owners:
                raise InputError(
                    f"{owners[key(path)]} and {path} may both be the photo of {fitting[0]['file_path']} in "
                    f"{self.path}: take one away."
                )
            if fitting:
                owners[key(path)] = path
        return {path: frames[name][0] for name, path in owners.items()}

    def _splits(self, names: Sequence[str]) -> Dict[str, List[str]]:
        """The file's lists of photos to train on and to hold out, with the new name of each frame in use."""
        if not any(split in self.content for split in SPLITS):
            return {}
        renamed = {Path(frame["file_path"]): name for frame, name in zip(self.used, names, strict=True)}
        listed = {split: map(Path, self.content.get(split, [])) for split in SPLITS}
        return {split: [renamed[path] for path in paths if path in renamed] for split, paths in listed.items()}

    def summary(self) -> str:
        """See `LLFFPoses.summary`."""
        return f"Poses are those in {self.path}"

    def size(self, index: int) -> Optional[Size]:
        """See `LLFFPoses.size`."""
        width, height = (self._value(index, key) for key in ("w", "h"))
        return None if width is None or height is None else (round(width), round(height))

    def mask(self, index: int) -> Optional[Path]:
        """Where a photo's mask is; None where it has none."""
        name = self.used[index].get(MASK)
        return None if name is None else self.path.parent / name

    def _value(self, index: int, key: str, default: Optional[float] = None) -> Optional[float]:
        return self.used[index].get(key, self.content.get(key, default))

    def write(self, folder: Path, names: Sequence[str], framings: Sequence[Framing]) -> None:
        """See `LLFFPoses.write`. Distortion is in units of the focal length, and stays as it is."""
        names = [f"images/{name}" for name in names]
        if any(DEPTH in frame for frame in self.used):
            print(f"Left out of the scene, as they are for photos of the former size: {DEPTH}")
        has_masks, frames = any(MASK in frame for frame in self.used), []
        for index, (frame, name, framing) in enumerate(zip(self.used, names, framings, strict=True)):
            kept = {key: value for key, value in frame.items() if key != DEPTH}
            mask = {MASK: mask_name(name)} if has_masks else {}
            frames.append({**kept, **mask, "file_path": name, **self._intrinsics(index, framing)})
        kept = {key: value for key, value in self.content.items() if key not in SHARED}
        content = {**kept, **self._splits(names), "frames": frames}
        (folder / TRANSFORMS).write_text(json.dumps(content, indent=2) + "\n")

    def _intrinsics(self, index: int, framing: Framing) -> Dict[str, float]:
        width, height = self.size(index) or framing.original
        across, down = framing.scaled[0] / width, framing.scaled[1] / height
        focal_x = self._value(index, "fl_x")
        if focal_x is None:
            focal_x = 0.5 * width / math.tan(0.5 * self._value(index, "camera_angle_x"))
        return {
            "fl_x": across * focal_x,
            "fl_y": down * self._value(index, "fl_y", focal_x),
            "cx": across * self._value(index, "cx", 0.5 * width) - framing.corner[0],
            "cy": down * self._value(index, "cy", 0.5 * height) - framing.corner[1],
            "w": framing.size[0],
            "h": framing.size[1],
        }


Poses = Union[LLFFPoses, TransformsPoses]


def find_poses(photos: Path) -> Optional[Poses]:
    """The poses in the folder of the photos or, for a folder `images`, in the one around it; None if there are none."""
    for folder in (photos, photos.parent) if photos.name.startswith("images") else (photos,):
        if (folder / POSES_BOUNDS).is_file():
            return LLFFPoses(folder / POSES_BOUNDS)
        if (folder / TRANSFORMS).is_file():
            return TransformsPoses(folder / TRANSFORMS)
    return None


def read_for_pose(path: Path, poses: Optional[Poses], index: int) -> Photo:
    """A photo as its pose is for it: upright where it has none yet.

    COLMAP and the readers of poses_bounds.npy and transforms.json take pixels as they are stored, whatever EXIF says,
    so a pose from a file is for these; for the upright photo only where its shape leaves no other choice.
    """
    if poses is None:
        return read_photo(path)
    stored, expected = read_photo(path, upright=False), poses.size(index)
    if expected is None or fits(stored.image.size, expected):
        return _with_mask(stored, poses.mask(index))
    turned = read_photo(path)
    if fits(turned.image.size, expected):
        return _with_mask(turned, poses.mask(index))
    width, height = stored.image.size
    raise InputError(
        f"{path} is {width} × {height} pixels, which is no scaled version of the {expected[0]} × {expected[1]} that "
        f"its pose in {poses.path} is for; use the photo that the pose was found with."
    )


def _with_mask(photo: Photo, mask: Optional[Path]) -> Photo:
    """A photo with its mask, if it has one, which is for the photo as it is stored, or as it is used."""
    if mask is None:
        return photo
    size, as_stored = photo.image.size, photo.image.size[:: -1 if photo.upright and photo.orientation > 4 else 1]
    inside = read_mask_of(photo.path, mask, size, as_stored)
    picture = Image.fromarray(np.where(inside, 255, 0).astype(np.uint8))
    return replace(photo, mask=picture if picture.size == size else as_upright(picture, photo.orientation))


def say_what_masks_are_unused(photos: Path, read: Sequence[Photo]) -> None:
    """Prints that masks in a folder of their own beside photos have no effect where no file says whose they are."""
    around = (photos, photos.parent) if photos.name.startswith("images") else (photos,)
    folders = [folder / "masks" for folder in around if (folder / "masks").is_dir()]
    if folders and all(photo.mask is None for photo in read):
        print(f"Not used: {folders[0]}; a photo's mask is what its frame in a {TRANSFORMS} names as {MASK}")


def say_what_is_turned(photos: Sequence[Photo], poses: Optional[Poses]) -> None:
    """Prints what was done with photos that aren't stored upright, a line for each way."""
    told: Dict[str, List[str]] = {}
    for photo in photos:
        words = "turned upright, as EXIF says"
        if not photo.upright:
            words = f"not turned, though EXIF says so, since poses in {poses.path} are for photos as they are stored"
        elif poses is not None:
            words += f", since only then the shape is that of the pose in {poses.path}"
        if photo.orientation != 1:
            told.setdefault(words, []).append(photo.path.name)
    for words, names in told.items():
        print(f"{', '.join(names)}: {words}")

"""Photographs a sample scene into a folder, in the layouts that the field uses."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Iterator, Literal, Optional, Sequence

import imageio.v2 as imageio
import numpy as np
import tyro
from _command_line import check_ranges
from rich.console import Console
from rich.progress import track

from sample_scene.cameras import circling_cameras, forward_facing_cameras, landscape_cameras, surrounding_cameras
from sample_scene.scene import Scene, objects_on_a_plinth, still_life
from sample_scene.tracer import render_sample

FOCAL_PER_WIDTH = 0.85
BLENDER_CAMERA_ANGLE_X = 0.6911112


def _number(default: str) -> object:
    """An optional number, whose default the help describes in words."""
    return tyro.conf.arg(metavar="INT", help_behavior_hint=f"(default: {default})")


@dataclass(frozen=True)
class Settings:
    """What to photograph and how. The docstrings are the command line's help."""

    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUTPUT")]
    """Folder that will hold llff/, blender/ or nerfstudio/."""
    layout: Literal["llff", "blender", "both", "nerfstudio"] = "both"
    """Which to write; both: llff and blender."""
    num_views: int = 20
    """llff and nerfstudio: number of pictures."""
    width: Annotated[Optional[int], _number("252, blender 100")] = None
    """Columns of the pictures."""
    height: Annotated[Optional[int], _number("3/4 of the columns")] = None
    """llff and nerfstudio: rows of the pictures; blender's are square."""
    num_train: int = 100
    """blender: number of training pictures."""
    num_val: int = 10
    """blender: number of validation pictures."""
    num_test: int = 25
    """blender: number of test pictures."""
    supersample: int = 3
    """Rays along each side of a pixel; odd."""
    exposure: float = 0.0
    """Stops by which training pictures differ, 0 to 3."""
    shiny: float = 0.0
    """Brightness of a lamp's reflection, 0 to 1."""
    haze: float = 0.0
    """llff: extinction per scene unit of a mist, 0 to 10."""
    distortion: float = 0.0
    """nerfstudio: k1 of the lens, -0.2 to 0.5."""
    wander: float = 0.0
    """nerfstudio: how far from the objects' middle a camera may look, 0 to 1."""
    seed: int = 0
    """Which textures and cameras."""
    force: bool = False
    """Replace what OUTPUT holds already."""

    def __post_init__(self) -> None:
        check_ranges(self, **dict.fromkeys(("num_views", "width", "height", "supersample"), (1, math.inf)))
        check_ranges(self, **dict.fromkeys(("num_train", "num_val", "num_test", "seed"), (0, math.inf)))
        check_ranges(self, exposure=(0, 3), shiny=(0, 1), haze=(0, 10), distortion=(-0.2, 0.5), wander=(0, 1))
        if self.supersample % 2 == 0:
            raise ValueError(f"--supersample is {self.supersample}, but has to be odd")
        if self.haze != 0 and self.layout != "llff":
            raise ValueError("--haze needs --layout llff: in a mist the objects of the other layouts have no outline")
        if self.distortion != 0 and self.layout != "nerfstudio":
            raise ValueError("--distortion needs --layout nerfstudio: the other layouts have no place for it")


def write_llff(folder: Path, settings: Settings) -> None:
    """Writes `images/image000.png`, ... and `poses_bounds.npy` of `still_life`."""
    scene = still_life(settings.seed, settings.shiny, settings.haze)
    poses = forward_facing_cameras(settings.num_views, settings.seed)
    depths = [depth[np.isfinite(depth)] for depth in _write_photos(folder, poses, scene, settings)]
    rows = [
        poses_bounds_row(pose, *_photo_size(settings), near=0.9 * depth.min(), far=depth.max())
        for pose, depth in zip(poses, depths, strict=True)
    ]
    np.save(folder / "poses_bounds.npy", np.stack(rows))


def write_blender(folder: Path, settings: Settings) -> None:
    """Writes `train`, `val` and `test` pictures and `transforms_*.json` of `objects_on_a_plinth`.

    Pictures are square, with alpha. A split of 0 pictures is left out. Only training pictures differ in exposure.
    """
    rng = np.random.default_rng(settings.seed)
    splits = {
        "train": surrounding_cameras(settings.num_train, rng),
        "val": surrounding_cameras(settings.num_val, rng),
        "test": circling_cameras(settings.num_test),
    }
    width = settings.width or 100
    focal = 0.5 * width / math.tan(0.5 * BLENDER_CAMERA_ANGLE_X)
    scene = objects_on_a_plinth(settings.seed, settings.shiny)
    gains = photo_gains(settings.num_train, settings.exposure, (), settings.seed)
    for split, poses in splits.items():
        if len(poses) == 0:
            continue
        (folder / split).mkdir()
        frames = []
        for i, pose in _each(poses, f"blender {split}"):
            rgb, alpha, _ = render_sample(pose, focal, width, width, scene, settings.supersample)
            rgb = rgb * gains[i] if split == "train" else rgb
            imageio.imwrite(folder / split / f"r_{i}.png", to_bytes(np.dstack([rgb, alpha])))
            frame = {"file_path": f"./{split}/r_{i}", "rotation": 2 * math.pi / len(poses)}
            frames.append({**frame, "transform_matrix": pose.tolist()})
        transforms = {"camera_angle_x": BLENDER_CAMERA_ANGLE_X, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(transforms, indent=2))


def write_nerfstudio(folder: Path, settings: Settings) -> None:
    """Writes `images` and `transforms.json` of `objects_on_a_plinth` in a landscape.

    The file says which views are held out, for validation and test alike.
    """
    scene = objects_on_a_plinth(settings.seed, settings.shiny, landscape=True)
    poses = landscape_cameras(settings.num_views, settings.wander, settings.seed)
    _write_photos(folder, poses, scene, settings)
    height, width, focal = _photo_size(settings)
    camera = {"camera_model": "OPENCV", "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    lens = {"k1": settings.distortion, "k2": 0.0, "p1": 0.0, "p2": 0.0} if settings.distortion else {}
    names = [_photo_name(i) for i in range(len(poses))]
    held_out = [names[i] for i in held_out_views(len(poses))]
    splits = {"train_filenames": [name for name in names if name not in held_out]}
    splits |= {"val_filenames": held_out or names, "test_filenames": held_out or names}
    frames = [{"file_path": name, "transform_matrix": pose.tolist()} for name, pose in zip(names, poses, strict=True)]
    content = {**camera, "w": width, "h": height, **lens, **splits, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=2))


WRITERS = {"llff": write_llff, "blender": write_blender, "nerfstudio": write_nerfstudio}
"""What writes each layout into an existing folder."""


def poses_bounds_row(pose: np.ndarray, height: int, width: int, focal: float, near: float, far: float) -> np.ndarray:
    """One row of `poses_bounds.npy`.

    Args:
        pose: Camera-to-world matrix, (3, 4) or (4, 4); columns right, up, back, position.
        height, width, focal: In pixels of the stored picture.
        near, far: Depths in scene units.

    Returns:
        (17,): the 3 x 5 matrix with columns down, right, back, position, (height, width, focal), row by row; near; far.
    """
    right, up, back, position = np.asarray(pose)[:3].T
    matrix = np.stack([-up, right, back, position, (height, width, focal)], axis=1)
    return np.concatenate([matrix.ravel(), (near, far)])


def photo_gains(count: int, stops: float, neutral: Sequence[int], seed: int = 0) -> np.ndarray:
    """Gains (count, 3) that photos of different exposure and white balance have.

    Args:
        count: How many photos.
        stops: Largest difference from the mean exposure; a third as much between the channels.
        neutral: Photos whose gain is 1. The geometric mean of the others is 1 in every channel.
        seed: Which gains.
    """
    rng = np.random.default_rng([seed, 1])
    logs = rng.uniform(-1, 1, (count, 1)) + rng.uniform(-1, 1, (count, 3)) / 3
    exposed = np.setdiff1d(np.arange(count), neutral)
    logs[exposed] -= logs[exposed].mean(axis=0)
    logs[exposed] /= max(np.abs(logs[exposed]).max(initial=0.0), 1e-9)
    logs[list(neutral)] = 0
    return np.exp2(stops * logs).astype(np.float32)


def held_out_views(count: int) -> list[int]:
    """Every eighth of `count` photos, which are not trained on; none of up to eight."""
    return list(range(0, count, 8)) if count > 8 else []


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Values in [0, 1], others clipped -> uint8."""
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def _photo_name(view: int) -> str:
    return f"images/image{view:03d}.png"


def _photo_size(settings: Settings) -> tuple[int, int, float]:
    """Height, width and focal length in pixels, of llff's and nerfstudio's photos."""
    width = settings.width or 252
    return settings.height or round(0.75 * width), width, FOCAL_PER_WIDTH * width


def _write_photos(folder: Path, poses: np.ndarray, scene: Scene, settings: Settings) -> list[np.ndarray]:
    """Writes photos of a scene from camera-to-world matrices (N, 4, 4); returns their depths, (height, width) each."""
    height, width, focal = _photo_size(settings)
    gains = photo_gains(len(poses), settings.exposure, held_out_views(len(poses)), settings.seed)
    (folder / "images").mkdir()
    depths = []
    for i, pose in _each(poses, "photos"):
        rgb, _, depth = render_sample(pose, focal, height, width, scene, settings.supersample, settings.distortion)
        imageio.imwrite(folder / _photo_name(i), to_bytes(rgb * gains[i]))
        depths.append(depth)
    return depths


def _each(poses: np.ndarray, what: str) -> Iterator[tuple[int, np.ndarray]]:
    """Numbers and poses, one after another, with a bar on a terminal."""
    console = Console(stderr=True)
    return enumerate(track(poses, what, console=console, disable=not console.is_terminal))

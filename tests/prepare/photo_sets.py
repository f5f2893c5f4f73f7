"""Photos of the sample still life from where a test wants them."""

import json
from functools import cache
from pathlib import Path
from typing import List, Sequence, Tuple

import numpy as np
from PIL import ExifTags, Image
from sample_scene.cameras import look_at
from sample_scene.scene import still_life
from sample_scene.tracer import render_sample
from sample_scene.writers import poses_bounds_row, to_bytes

WIDTH, HEIGHT = 320, 240
FOCAL = 0.85 * WIDTH

Place = Tuple[Tuple[float, float, float], Tuple[float, float, float]]
"""Where the camera stands and what it looks at."""

ASIDE: List[Place] = [((x, 0.0, 1.3), (0.3 * x, 5.0, 0.8)) for x in (-0.5, 0.0, 0.5)]
TURNED: List[Place] = [((0.0, 0.0, 1.3), (x, 5.0, 0.8)) for x in (-0.6, 0.0, 0.6)]
AHEAD: List[Place] = [((0.0, y, 1.3), (0.0, 5.0, 0.8)) for y in (-1.0, -0.4, 0.2)]
AWAY: Place = ((0.0, 0.0, 1.3), (9.0, 1.0, 0.8))


@cache
def photo(place: Place) -> Image.Image:
    """What a camera sees there."""
    scene, pose = still_life(0), look_at(*place)
    rgb, _, _ = render_sample(pose, FOCAL, HEIGHT, WIDTH, scene, 1)
    return Image.fromarray(to_bytes(rgb))


def write_photos(folder: Path, places: Sequence[Place] = tuple(ASIDE), suffix: str = ".png") -> List[str]:
    """Photos a, b, c … in a folder; their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{chr(ord('a') + index)}{suffix}" for index in range(len(places))]
    for name, place in zip(names, places, strict=True):
        photo(place).save(folder / name)
    return names


def save_with_orientation(image: Image.Image, path: Path, orientation: int) -> None:
    """A picture with what EXIF says of how its stored pixels lie."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    image.save(path, exif=exif)


def write_poses_bounds(folder: Path, places: Sequence[Place] = tuple(ASIDE)) -> None:
    """The places as LLFF has them."""
    poses = [look_at(*place) for place in places]
    rows = [poses_bounds_row(pose, HEIGHT, WIDTH, FOCAL, 2.0, 6.0) for pose in poses]
    np.save(folder / "poses_bounds.npy", np.stack(rows))


def write_transforms(folder: Path, names: Sequence[str], places: Sequence[Place] = tuple(ASIDE), **shared) -> None:
    """The places as nerfstudio has them."""
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": look_at(*place).tolist()}
        for name, place in zip(names, places, strict=True)
    ]
    intrinsics = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 150.0, "cy": 130.0, "w": WIDTH, "h": HEIGHT}
    content = {"camera_model": "OPENCV", "k1": 0.01, **intrinsics, **shared, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))

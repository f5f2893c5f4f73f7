"""Photos of the sample still life from where a test wants them."""

import json
from functools import cache
from pathlib import Path
from typing import List, Optional, Sequence, Tuple

import numpy as np
from PIL import ExifTags, Image
from sample_scene.cameras import look_at
from sample_scene.scene import Scene, still_life
from sample_scene.shapes import Box
from sample_scene.textures import Texture, ValueNoise, painted_bricks
from sample_scene.tracer import render_sample
from sample_scene.writers import poses_bounds_row, to_bytes

WIDTH, HEIGHT = 320, 240
FOCAL = 0.85 * WIDTH

Place = Tuple[Tuple[float, float, float], Tuple[float, float, float]]
"""Where the camera stands and what it looks at."""

ASIDE: List[Place] = [((x, 0.0, 1.3), (0.3 * x, 5.0, 0.8)) for x in (-0.5, 0.0, 0.5)]
TURNED: List[Place] = [((0.0, 0.0, 1.3), (x, 5.0, 0.8)) for x in (-0.6, 0.0, 0.6)]
AHEAD: List[Place] = [((0.0, y, 1.3), (0.0, 5.0, 0.8)) for y in (-1.0, -0.4, 0.2)]
WALK: List[Place] = [((x, 0.0, 1.3), (0.3 * x, 5.0, 0.8)) for x in (-0.9, -0.45, 0.0, 0.45, 0.9)]
AWAY: Place = ((0.0, 0.0, 1.3), (9.0, 1.0, 0.8))


@cache
def photo(place: Place, zoom: float = 1.0, wall: Optional[Texture] = None) -> Image.Image:
    """What a camera sees there: of the still life, or of nothing but a wall with a texture."""
    scene, pose = still_life(0), look_at(*place)
    if wall is not None:
        scene = Scene((), ValueNoise(0), sun=scene.sun, backdrop=(Box((0, 6.3, 2), (9, 0.1, 4), wall),))
    rgb, _, _ = render_sample(pose, zoom * FOCAL, HEIGHT, WIDTH, scene, 1)
    return Image.fromarray(to_bytes(rgb))


def bricks(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Bricks, no two of which are quite alike."""
    return painted_bricks(points, noise, 2.0)


def tiles(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """One small picture again and again."""
    across, up = (np.mod(3.0 * points[axis], 1.0) - 0.5 for axis in (0, 2))
    drawn = (np.hypot(across, up) < 0.3) | ((np.abs(across - 0.15) < 0.08) & (up > 0))
    return np.where(drawn, 0.2, 0.8) * np.ones((3, 1), np.float32)


def write_photos(folder: Path, places: Sequence[Place] = tuple(ASIDE), suffix: str = ".png") -> List[str]:
    """Photos a, b, c … in a folder; their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{chr(ord('a') + index)}{suffix}" for index in range(len(places))]
    for name, place in zip(names, places, strict=True):
        photo(place).save(folder / name)
    return names


def save_photos(folder: Path, images: Sequence[Image.Image]) -> Path:
    """Pictures a, b, c … in a folder of their own, which is returned."""
    folder.mkdir(parents=True)
    for index, image in enumerate(images):
        image.save(folder / f"{chr(ord('a') + index)}.png")
    return folder


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

"""The flight of the demo's camera, as nerfstudio reads camera paths.

Poses are camera-to-world matrices; columns right, up, back, position.
"""

import json
import math
from pathlib import Path
from typing import Any, Dict, Tuple

import numpy as np
from PIL import Image
from sample_scene.cameras import look_at

FRAMES_PER_SECOND = 12
NEAR_IN_LLFF_WORLD = 4 / 3
"""Distance of the nearest thing seen in the world that the dataparser llff-data lays out (1 / its bound_scale)."""
LEAST_PARALLAX = 0.03
"""Half axes of the ellipse are at least this share of the focus distance, also where photos hardly differ in place."""


def flight(layout: str, scene: Path, run: Path, frames: int, longer_side: int) -> Dict[str, Any]:
    """The camera path for a run on a sample scene.

    Args:
        layout: `llff` or `blender`.
        scene: the scene's folder, which knows the photos' size and focal length.
        run: the run's folder, whose scene.json knows where its cameras stand in nerfstudio's world.
        frames: how many.
        longer_side: of a frame in pixels; the other one follows from the photos'.
    """
    cameras = np.array(json.loads((run / "scene.json").read_text())["cameras"])
    if layout == "blender":
        transforms = json.loads((scene / "transforms_train.json").read_text())
        with Image.open(sorted((scene / "train").glob("*.png"))[0]) as photo:
            size = photo.size
        focal = 0.5 * size[0] / math.tan(0.5 * transforms["camera_angle_x"])
        poses = orbit_path(cameras, frames)
    else:
        rows = np.load(scene / "poses_bounds.npy")
        *size, focal = rows[0, :15].reshape(3, 5)[[1, 0, 2], 4]
        near, far = rows[:, 15].min(), rows[:, 16].max()
        # As LLFF's own flights: nearer to the front of the scene than to its back, which hardly moves anyway.
        poses = ellipse_path(cameras, NEAR_IN_LLFF_WORLD / near / (0.25 / near + 0.75 / far), frames)
    width, height = (round(side * longer_side / max(size)) for side in size)
    return camera_path(poses, (width, height), focal / size[1])


def ellipse_path(cameras: np.ndarray, focus_distance: float, frames: int) -> np.ndarray:
    """A closed flight before a forward-facing scene: around the mean camera, always looking at one point of the scene.

    The half axes are the standard deviations of the photos' positions along right and up.

    Args:
        cameras: poses of photos, (N, 3 or 4, 4).
        focus_distance: how far before the mean camera the point lies that stays in the middle.
        frames: positions on the ellipse, evenly spaced; the last is just before the first, so that the film loops.

    Returns:
        Poses (frames, 4, 4).
    """
    centre = cameras[:, :3, 3].mean(0)
    mean = look_at(centre, centre - cameras[:, :3, 2].mean(0), up=cameras[:, :3, 1].mean(0))
    right, up, back = mean[:3, :3].T
    spread = np.sqrt(np.mean(((cameras[:, :3, 3] - centre) @ mean[:3, :2]) ** 2, axis=0))
    across, along = np.maximum(spread, LEAST_PARALLAX * focus_distance)
    turns = _full_turn(frames)[:, None]
    positions = centre + np.cos(turns) * across * right + np.sin(turns) * along * up
    return np.stack([look_at(position, centre - focus_distance * back, up) for position in positions])


def orbit_path(cameras: np.ndarray, frames: int) -> np.ndarray:
    """A full turn about the z axis around the origin, at the photos' mean distance and height.

    Args:
        cameras: poses of photos taken from all around, (N, 3 or 4, 4).
        frames: as in `ellipse_path`.

    Returns:
        Poses (frames, 4, 4).
    """
    positions = cameras[:, :3, 3]
    distance = np.linalg.norm(positions, axis=-1).mean()
    height = np.clip(positions[:, 2].mean(), -0.95 * distance, 0.95 * distance)
    radius = math.sqrt(distance**2 - height**2)
    return np.stack(
        [look_at((radius * math.cos(turn), radius * math.sin(turn), height), (0, 0, 0)) for turn in _full_turn(frames)]
    )


def _full_turn(frames: int) -> np.ndarray:
    """Angles in radians, evenly spaced, (frames,)."""
    return 2 * math.pi * np.arange(frames) / frames


def camera_path(poses: np.ndarray, size: Tuple[int, int], focal_over_height: float) -> Dict[str, Any]:
    """nerfstudio's camera path, as `ns-render camera-path` reads it.

    Args:
        poses: (frames, 4, 4), in the world of the run's cameras.
        size: width and height of a frame in pixels; made even, since common video formats need that.
        focal_over_height: focal length as a share of the frame's height.
    """
    width, height = (side - side % 2 for side in size)
    field_of_view = math.degrees(2 * math.atan(0.5 / focal_over_height))
    return {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": FRAMES_PER_SECOND,
        "seconds": len(poses) / FRAMES_PER_SECOND,
        "is_cycle": True,
        "camera_path": [
            {"camera_to_world": pose.ravel().tolist(), "fov": field_of_view, "aspect": width / height} for pose in poses
        ],
    }

"""Where photos are taken from, and the rays through their pixels."""

import math
from typing import Sequence

import numpy as np

BLENDER_CAMERA_RADIUS = 4.03
"""Distance of NeRF's synthetic cameras from the origin."""
FORWARD_FACING_REACH = 0.25 * 2.1
"""Distance of the outermost columns of cameras from the middle: a quarter of the still life's nearest depth."""


def look_at(
    position: Sequence[float], target: Sequence[float], up: Sequence[float] = (0.0, 0.0, 1.0), roll: float = 0.0
) -> np.ndarray:
    """A camera at `position` that looks at `target`, upright but for `roll` radians about its viewing axis.

    `up` is the world's. Returns the camera-to-world matrix (4, 4), float64; columns right, up, back, position.

    Raises:
        ValueError: If the camera would look straight up or down, where upright means nothing.
    """
    back = np.asarray(position, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-6:
        raise ValueError(f"The camera at {tuple(position)} looks straight up or down, so its up is undefined.")
    right /= np.linalg.norm(right)
    upright = np.cross(back, right)
    pose = np.eye(4)
    pose[:3, 0] = math.cos(roll) * right + math.sin(roll) * upright
    pose[:3, 1] = math.cos(roll) * upright - math.sin(roll) * right
    pose[:3, 2] = back
    pose[:3, 3] = position
    return pose


def forward_facing_cameras(count: int, seed: int = 0) -> np.ndarray:
    """Hand-held photos of `still_life` -> (count, 4, 4): a jittered grid, about 5 columns for every 4 rows."""
    rng = np.random.default_rng(seed)
    columns = math.ceil(math.sqrt(count * 1.25))
    rows = math.ceil(count / columns)
    poses = []
    for view in range(count):
        row, column = divmod(view, columns)
        across = 2 * column / max(columns - 1, 1) - 1
        up = 1 - 2 * row / max(rows - 1, 1)
        jitter = rng.uniform(-0.12, 0.12, 3) * FORWARD_FACING_REACH
        position = np.array([across * FORWARD_FACING_REACH, 0.0, 1.3 + 0.6 * up * FORWARD_FACING_REACH]) + jitter
        target = np.array([0.35 * position[0], 5.0, 0.80 + 0.3 * (position[2] - 1.3)]) + rng.normal(0, 0.04, 3)
        poses.append(look_at(position, target, roll=rng.normal(0, 0.012)))
    return np.stack(poses)


def surrounding_cameras(count: int, rng: np.random.Generator) -> np.ndarray:
    """Cameras spread at random over the upper half of a sphere, all looking at the origin -> (count, 4, 4)."""
    return _cameras_on_sphere(rng.uniform(0, 2 * math.pi, count), np.arcsin(rng.uniform(0.05, 0.97, count)))


def circling_cameras(count: int) -> np.ndarray:
    """Cameras evenly around the origin, 30 degrees above its plane, all looking at it -> (count, 4, 4)."""
    return _cameras_on_sphere(2 * math.pi * np.arange(count) / count, np.full(count, math.radians(30)))


def _cameras_on_sphere(azimuths: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """Cameras at angles (N,) in radians, all looking at the origin -> (N, 4, 4)."""
    poses = []
    for azimuth, elevation in zip(azimuths, elevations, strict=True):
        flat = math.cos(elevation)
        direction = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
        poses.append(look_at(BLENDER_CAMERA_RADIUS * direction, (0, 0, 0)))
    return np.reshape(poses, (len(poses), 4, 4))


def landscape_cameras(count: int, wander: float, seed: int) -> np.ndarray:
    """Cameras evenly around the plinth in its landscape, on a ring that goes up and down -> (count, 4, 4).

    Each looks past the objects' middle, by up to `wander` scene units along either axis of the ground; `seed` says how.
    """
    aside = wander * np.random.default_rng([seed, 2]).uniform(-1, 1, (count, 2))
    poses = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        position = (2.6 * math.cos(angle), 2.6 * math.sin(angle), 1.0 + 0.5 * math.sin(3 * angle))
        poses.append(look_at(position, (*aside[i], -0.1)))
    return np.stack(poses)


def rays_of_rows(
    pose: np.ndarray, focal: float, height: int, width: int, rows: np.ndarray, supersample: int, distortion: float
) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (3, N) of the rays of some rows of a picture, and their cosines (N,) with the viewing axis.

    N runs over `rows`, integers (R,), then columns, then the samples within a pixel. See `render_sample` for the rest.
    """
    offsets = (np.arange(supersample, dtype=np.float32) + 0.5) / supersample
    y = (height / 2 - rows[:, None] - offsets) / focal
    x = (np.arange(width)[:, None] + offsets - width / 2) / focal
    grid = np.broadcast_arrays(x[None, :, None, :], y[:, None, :, None])
    x, y = (values.reshape(-1).astype(np.float32) for values in grid)
    if distortion != 0:
        seen = np.hypot(x, y)
        factor = _undistorted_radius(seen, distortion) / np.maximum(seen, np.float32(1e-9))
        x, y = x * factor, y * factor
    cosines = 1 / np.sqrt(x * x + y * y + 1)
    return pose[:3, :3] @ np.stack([x * cosines, y * cosines, -cosines]), cosines


def _undistorted_radius(seen: np.ndarray, distortion: float) -> np.ndarray:
    """r where r + k1 r^3 = `seen`, by Newton's method; finds it where the left side grows with r."""
    radius = seen.copy()
    for _ in range(10):
        radius -= (radius + distortion * radius**3 - seen) / (1 + 3 * distortion * radius**2)
    return radius

"""Renders a scene: what rays hit first, and what light does there."""

import math

import numpy as np

from sample_scene.cameras import rays_of_rows
from sample_scene.scene import Scene
from sample_scene.shapes import Sphere, column, dot
from sample_scene.textures import palette

RAYS_PER_BAND = 60_000
"""Rays that are traced at a time: bounds the memory."""
SHADOW_RAY_OFFSET = 2e-3
"""How far before a surface a ray to the sun starts, so that the surface does not shade itself."""


def render_sample(
    pose: np.ndarray, focal: float, height: int, width: int, scene: Scene, supersample: int = 3, distortion: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Renders one view, with its exact depth and coverage.

    Args:
        pose: Camera-to-world matrix, (3, 4) or (4, 4); columns right, up, back, position.
        focal, height, width: Focal length and size of the picture, in pixels.
        scene: What to look at.
        supersample: Rays along each side of a pixel; odd, so that one of them passes through the pixel's centre.
        distortion: k1 of the lens: a point at distance r from the axis, over the focal length, is seen at r + k1 r^3.

    Returns:
        rgb (height, width, 3) in [0, 1], the mean colour of what a pixel sees of objects, not multiplied by alpha and
        0 where alpha is 0; alpha (height, width) in [0, 1], the share of the pixel that objects cover; and depth
        (height, width) in scene units along the viewing axis (not along the ray) at the pixel's centre, inf where
        the centre sees nothing. All float32.

    Raises:
        ValueError: If `supersample` is not a positive odd number.
    """
    if supersample < 1 or supersample % 2 == 0:
        raise ValueError(f"supersample is {supersample}, but has to be odd, so that a ray passes the pixel's centre.")
    pose = np.asarray(pose, np.float32)
    samples = supersample**2
    rgb = np.zeros((height, width, 3), np.float32)
    alpha = np.zeros((height, width), np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    rows_per_band = max(1, RAYS_PER_BAND // (width * samples))
    for top in range(0, height, rows_per_band):
        rows = np.arange(top, min(top + rows_per_band, height))
        directions, cosines = rays_of_rows(pose, focal, height, width, rows, supersample, distortion)
        colours, distances = trace(scene, pose[:3, 3:], directions, samples)
        shape = (len(rows), width, samples)
        is_hit = np.isfinite(distances).reshape(shape)
        alpha[rows] = is_hit.mean(axis=-1)
        total = colours.reshape(3, *shape).sum(axis=-1)
        rgb[rows] = np.moveaxis(total / np.maximum(is_hit.sum(axis=-1), 1), 0, -1)
        depth[rows] = (distances * cosines).reshape(shape)[..., samples // 2]
    return rgb, alpha, depth


def trace(scene: Scene, origin: np.ndarray, directions: np.ndarray, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours (3, N), 0 where a ray hits nothing, and distances (N,), inf there, of rays from one origin (3, 1).

    The `directions` (3, N) have unit length; each `samples` of them that follow one another belong to a pixel.
    """
    shapes = scene.shapes + scene.backdrop
    nearest = np.full(directions.shape[1], np.inf, np.float32)
    which = np.full(directions.shape[1], -1, np.int8)
    for i, shape in enumerate(shapes):
        distance = shape.distances(origin, directions)
        is_closer = distance < nearest
        nearest[is_closer] = distance[is_closer]
        which[is_closer] = i

    hits = np.flatnonzero(which >= 0)
    points = origin + directions[:, hits] * nearest[hits]
    albedo, normals = np.empty_like(points), np.empty_like(points)
    for i in np.unique(which[hits]):
        mask = which[hits] == i
        local, normals[:, mask] = shapes[i].surface(points[:, mask])
        albedo[:, mask] = shapes[i].texture(local, scene.noise)

    shaded = albedo * diffuse_light(scene, points, normals, hits % samples, samples)
    if scene.shine > 0:
        shaded += gloss(scene, normals, directions[:, hits])
    colours = np.zeros_like(directions)
    colours[:, hits] = np.clip(shaded, 0, 1)
    if scene.haze > 0:
        clear = np.exp(np.float32(-scene.haze) * nearest)
        colours = clear * colours + (1 - clear) * column(scene.haze_color)
    return colours, nearest


# ------------------------------------------------------------------------------------------------------------ light


def diffuse_light(
    scene: Scene, points: np.ndarray, normals: np.ndarray, sample: np.ndarray, samples: int
) -> np.ndarray:
    """Light (3, N) of a soft sky and a sun at surface points (3, N): factors of the surface's colour.

    Each of a pixel's `samples` rays, of which a point belongs to number `sample` (N,), looks at another spot of the
    sun's disc; the pixel's mean is the share of the disc that it sees, so shadows have penumbras.
    """
    to_sun = _spots_on_sun(scene, samples)[:, sample]
    facing = np.maximum(dot(normals, to_sun), 0)
    lit = np.flatnonzero(facing > 0)
    starts, directions = points[:, lit] + normals[:, lit] * np.float32(SHADOW_RAY_OFFSET), to_sun[:, lit]
    is_shaded = np.zeros(len(lit), bool)
    for shape in scene.shapes:
        is_shaded |= np.isfinite(shape.distances(starts, directions))
    facing[lit[is_shaded]] = 0
    sky = scene.sky_light * (0.78 + 0.22 * normals[2]) * _openness(scene, points, normals)
    cool, warm = palette("#e6efff"), palette("#fff6e4")
    return cool * sky + warm * (scene.sun_light * facing)


def gloss(scene: Scene, normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The lamp's reflection (N,) on surfaces with normals (3, N) seen along directions (3, N) (Phong)."""
    mirrored = directions - 2 * dot(normals, directions) * normals
    lamp = column(scene.lamp) / np.float32(np.linalg.norm(scene.lamp))
    return np.float32(scene.shine) * np.maximum(dot(mirrored, lamp), 0) ** np.float32(scene.polish)


def _openness(scene: Scene, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Share of the sky, (N,), that balls do not hide from surface points (3, N).

    A ball of radius r whose centre is d away hides max(0, cosine) r^2 / d^2 of a cosine-weighted sky.
    """
    openness = np.ones(points.shape[1], np.float32)
    for shape in scene.shapes:
        if isinstance(shape, Sphere):
            to_centre = column(shape.centre) - points
            squared = dot(to_centre, to_centre)
            cosine = dot(to_centre, normals) / np.sqrt(squared)
            openness *= 1 - 0.8 * np.clip(cosine, 0, 1) * np.minimum(np.float32(shape.radius**2) / squared, 1)
    return openness


def _spots_on_sun(scene: Scene, count: int) -> np.ndarray:
    """Unit directions (3, count) towards points spread evenly over the sun's disc, like seeds in a sunflower."""
    index = np.arange(count) + 0.5
    angle = index * (math.pi * (3 - math.sqrt(5)))
    across, up = np.sqrt(index / count) * np.stack([np.cos(angle), np.sin(angle)]) * scene.sun_spread
    centre = np.array(scene.sun) / np.linalg.norm(scene.sun)
    side = np.cross(centre, (0, 0, 1.0))
    side /= np.linalg.norm(side)
    spots = centre[:, None] + side[:, None] * across + np.cross(side, centre)[:, None] * up
    return (spots / np.linalg.norm(spots, axis=0)).astype(np.float32)

"""Renders a sample scene, so that everything can be tried without downloading anything.

A small ray tracer draws balls, boxes and columns with painted surfaces, in the layouts the field uses:

    python data_scripts/make_sample_scene.py OUTPUT                      # OUTPUT/llff and OUTPUT/blender
    python data_scripts/make_sample_scene.py OUTPUT --layout llff --width 504
    python data_scripts/make_sample_scene.py OUTPUT --layout blender --num-train 40
    python data_scripts/make_sample_scene.py OUTPUT --layout nerfstudio --distortion 0.1
    python data_scripts/make_sample_scene.py OUTPUT --layout llff --shiny 0.6 --exposure 0.5
    python data_scripts/make_sample_scene.py OUTPUT --layout llff --haze 0.3

`OUTPUT/llff` holds `images/image000.png`, ... and `poses_bounds.npy`: forward-facing photos of a still life in a room.
`OUTPUT/blender` holds `train`, `val` and `test` folders of RGBA pictures and `transforms_*.json`: objects on a plinth
seen from all around. `OUTPUT/nerfstudio` holds `images` and `transforms.json`: the same objects from all around, on a
ground with things far away behind them. The same seed gives the same files.

Conventions: world coordinates are right-handed with z up. A camera looks along its own -z, with x to the right and
y up, and a camera-to-world matrix maps its coordinates to the world's. The centre of the pixel in row i and column j
is at (j + 0.5, i + 0.5), and the principal point is at (width / 2, height / 2). Inside the tracer, points, directions
and colours are float32 arrays with the component first, (3, N). Surfaces are matt, unless they are made shiny: what a
point looks like does not depend on who looks, so a point seen by two cameras has the same colour in both pictures,
unless they are exposed differently.
"""

import argparse
import json
import math
import os
import shlex
import shutil
import sys
import tempfile
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Callable, Optional, Sequence, Union

import imageio.v2 as imageio
import numpy as np

Texture = Callable[[np.ndarray, "ValueNoise"], np.ndarray]
"""Local surface points (3, N) and a source of noise -> colours (3, N) in [0, 1]."""

LLFF_FOCAL_PER_WIDTH = 0.85
LLFF_NEAREST_DEPTH = 2.1
BLENDER_CAMERA_ANGLE_X = 0.6911112
BLENDER_CAMERA_RADIUS = 4.03

SELF_HIT_DISTANCE = 1e-3
RAYS_PER_BAND = 60_000


# ---------------------------------------------------------------------------------------------------------- noise


class ValueNoise:
    """Smooth random values in [0, 1] that fill space: trilinear interpolation between random lattice values.

    Args:
        seed: Which noise; the same seed gives the same values everywhere.
    """

    period = 32

    def __init__(self, seed: int):
        lattice = np.random.default_rng(seed).random(self.period**3)
        self.lattice = lattice.astype(np.float32)

    def at_cells(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """The lattice's random values in [0, 1] at integer cells.

        Args:
            x, y, z: Integer cell numbers (N,) of any size; the lattice repeats every `period` cells.

        Returns:
            (N,) float32.
        """
        mask = self.period - 1
        return self.lattice[((x & mask) * self.period + (y & mask)) * self.period + (z & mask)]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Noise at `points` (3, N), with features about one unit wide -> (N,) in [0, 1]."""
        floor = np.floor(points)
        cell = floor.astype(np.int32)
        fraction = points - floor
        fraction = fraction * fraction * (3 - 2 * fraction)
        x, y, z = cell

        def along_z(dx: int, dy: int) -> np.ndarray:
            low, high = self.at_cells(x + dx, y + dy, z), self.at_cells(x + dx, y + dy, z + 1)
            return low + (high - low) * fraction[2]

        left = along_z(0, 0)
        left = left + (along_z(0, 1) - left) * fraction[1]
        right = along_z(1, 0)
        right = right + (along_z(1, 1) - right) * fraction[1]
        return left + (right - left) * fraction[0]

    def fractal(self, points: np.ndarray, octaves: int = 2) -> np.ndarray:
        """A sum of `octaves` noises, each twice as fine and half as strong as the last: (3, N) -> (N,) in [0, 1]."""
        total = np.zeros(points.shape[1], np.float32)
        for octave in range(octaves):
            total += self(points * np.float32(2**octave) + np.float32(7.3 * octave)) * np.float32(0.5**octave)
        return total / np.float32(2 - 0.5 ** (octaves - 1))


# ------------------------------------------------------------------------------------------------------- textures


@cache
def _colour(hex_code: str) -> np.ndarray:
    """'#rrggbb' -> (3, 1) float32 in [0, 1]."""
    return np.array([int(hex_code[i : i + 2], 16) for i in (1, 3, 5)], np.float32)[:, None] / 255


@cache
def _palette(*hex_codes: str) -> np.ndarray:
    """Several '#rrggbb' -> (3, K) float32 in [0, 1]."""
    return np.concatenate([_colour(code) for code in hex_codes], axis=1)


def _mix(first: np.ndarray, second: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """`first` where `amount` is 0, `second` where it is 1, a blend between."""
    return first + (second - first) * amount


def _ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between."""
    x = np.clip((values - low) / np.float32(high - low), 0, 1)
    return x * x * (3 - 2 * x)


def _angle(points: np.ndarray) -> np.ndarray:
    """Angle about the z axis, in turns, in [-0.5, 0.5]: (3, N) -> (N,)."""
    return np.arctan2(points[1], points[0]) / np.float32(2 * math.pi)


def _integers(values: np.ndarray) -> np.ndarray:
    return np.floor(values).astype(np.int32)


def _face_coordinates(points: np.ndarray, half_size: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where points on a box's surface lie on their own face.

    Args:
        points: (3, N), on the surface, with the box's centre as origin.
        half_size: Half the box's edges.

    Returns:
        Across and up the face, each (N,) in [-1, 1], and the face's number 0..5 (N,).
    """
    relative = points / np.asarray(half_size, np.float32)[:, None]
    axis = np.abs(relative).argmax(axis=0)
    across = np.where(axis == 0, relative[1], relative[0])
    up = np.where(axis == 2, relative[1], relative[2])
    face = axis * 2 + (np.take_along_axis(relative, axis[None], axis=0)[0] > 0)
    return across, up, face


def beach_ball(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Swirling segments of six colours that meet at two cream caps. `points` are in units of the radius."""
    colours = _palette("#e8502f", "#f6c445", "#1f8a8c", "#f4efe2", "#27407f", "#f08a24")
    wobble = noise.fractal(points * 2.5) - 0.5
    segment = (_angle(points) + 0.16 * points[2] + 0.10 * wobble) * 12
    base = colours[:, _integers(segment) % 6]
    seam = np.abs(segment - np.rint(segment))
    base = base * (0.45 + 0.55 * _ramp(seam, 0.03, 0.10))
    cap = _ramp(np.abs(points[2]) + 0.04 * wobble, 0.90, 0.92)
    return _mix(base, _colour("#f7ecd0"), cap) * (0.88 + 0.24 * noise(points * 9))


def globe_checker(points: np.ndarray, noise: ValueNoise, first: str, second: str, squares: int) -> np.ndarray:
    """A checkerboard wrapped around a ball: `squares` pairs of meridian strips. `points` are in units of the radius."""
    longitude = _integers(_angle(points) * 2 * squares)
    latitude = _integers(np.arcsin(np.clip(points[2], -1, 1)) / np.float32(math.pi) * 2 * squares)
    base = np.where((longitude + latitude) % 2 == 0, _colour(first), _colour(second))
    return base * (0.85 + 0.3 * noise(points * 5))


def planet(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Turbulent latitude bands, like a gas giant's. `points` are in units of the radius."""
    colours = _palette("#5b2a86", "#c13c7c", "#f2a0a8", "#fbe3c4", "#e2703a", "#7c3f9e", "#f7c6d0")
    height = points[2] * 4.5 + 2.2 * noise.fractal(points * np.array([[2.0], [2.0], [5.0]], np.float32), 3)
    band = _integers(height)
    return _mix(colours[:, band % 7], colours[:, (band + 1) % 7], _ramp(height - band, 0.55, 1.0))


def crate(points: np.ndarray, noise: ValueNoise, half_size: Sequence[float]) -> np.ndarray:
    """A wooden crate: ringed boards in a darker frame with nails, with a painted diamond on every face."""
    across, up, face = _face_coordinates(points, half_size)
    board = _integers((up + 1) * 2.5)
    shifted = points * np.float32(3) + noise.at_cells(board, face, face) * 5
    rings = np.sqrt(shifted[0] ** 2 + (shifted[1] * 0.6) ** 2 + (shifted[2] * 1.7) ** 2)
    grain = np.sin((rings + 0.8 * noise.fractal(points * 5)) * 9) * 0.5 + 0.5
    wood = _mix(_colour("#b9722f"), _colour("#e9b468"), grain) * (0.8 + 0.35 * noise.at_cells(board, face, board))
    seam = np.abs((up + 1) * 2.5 - np.rint((up + 1) * 2.5))
    wood = wood * (0.35 + 0.65 * _ramp(seam, 0.02, 0.09))
    reach = np.abs(across) + np.abs(up)
    paint = _palette("#2b6cb0", "#d7263d", "#2f9e5b")[:, face // 2]
    wood = _mix(wood, paint * (0.75 + 0.4 * grain), (reach < 0.52) & (reach > 0.28))
    edge = np.maximum(np.abs(across), np.abs(up))
    frame = _mix(_colour("#6d3a17"), _colour("#93552a"), grain)
    nail = (np.abs(np.abs(across) - 0.9) < 0.035) & (np.abs(np.abs(up) - 0.9) < 0.035)
    frame = np.where(nail, _colour("#e3ddd2"), frame)
    return np.where(edge > 0.8, frame * (0.5 + 0.5 * _ramp(np.abs(edge - 0.8), 0.0, 0.04)), wood)


def patchwork(points: np.ndarray, noise: ValueNoise, half_size: Sequence[float], patches: int) -> np.ndarray:
    """Every face sewn from `patches` x `patches` squares of random colours, some of them striped."""
    colours = _palette("#e63946", "#f4a261", "#ffd166", "#2a9d8f", "#118ab2", "#6a4c93", "#f1faee", "#ef7fa8")
    across, up, face = _face_coordinates(points, half_size)
    x, y = (across + 1) * (patches / 2), (up + 1) * (patches / 2)
    column, row = _integers(x), _integers(y)
    base = colours[:, _integers(noise.at_cells(column, row, face) * 8) % 8]
    other = colours[:, _integers(noise.at_cells(column + 11, row, face) * 8) % 8]
    is_striped = noise.at_cells(column, row + 9, face) > 0.55
    stripes = np.sin((x + y) * (2 * math.pi * 1.5)) > 0.2
    base = np.where(is_striped & stripes, other, base)
    seam = np.minimum(np.abs(x - np.rint(x)), np.abs(y - np.rint(y)))
    return base * (0.4 + 0.6 * _ramp(seam, 0.02, 0.08)) * (0.85 + 0.3 * noise(points * 8))


def marble(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Cream stone with blue-grey and rust veins. `points` are in scene units."""
    warp = noise.fractal(points * 2.2, 3) - 0.5
    vein = np.abs(np.sin(points[0] * 3 + points[1] * 2 + points[2] * 2.6 + warp * 11))
    rust = np.abs(np.sin(points[0] * 2 - points[2] * 1.7 + warp * 8 + 1.3))
    stone = _mix(_colour("#efe6d5"), _colour("#d9c8ad"), noise(points * 3.1))
    stone = _mix(_colour("#4a6485"), stone, _ramp(vein, 0.0, 0.38))
    return _mix(_colour("#c06a3f"), stone, _ramp(rust, 0.0, 0.13))


def barber_pole(points: np.ndarray, noise: ValueNoise, turns_per_unit: float) -> np.ndarray:
    """Helical stripes that climb a column. `points` are in scene units."""
    colours = _palette("#d62839", "#fbf3e4", "#f2b632", "#14746f")
    climb = (_angle(points) * 2 + points[2] * turns_per_unit) * 2
    base = colours[:, _integers(climb) % 4]
    seam = np.abs(climb - np.rint(climb))
    return base * (0.55 + 0.45 * _ramp(seam, 0.02, 0.07)) * (0.86 + 0.28 * noise.fractal(points * 6))


def drum(points: np.ndarray, noise: ValueNoise, half_height: float) -> np.ndarray:
    """Zigzag bands around the side, target rings on the lid. `points` have the cylinder's centre as origin."""
    colours = _palette("#0f4c5c", "#fb8b24", "#f6e7cb", "#9a031e", "#5fa8a0")
    turn = _angle(points) * 12
    zigzag = np.abs(turn - np.floor(turn) - 0.5) * 0.16
    side = colours[:, _integers((points[2] + zigzag) / (half_height * 0.32)) % 5]
    lid = colours[:, _integers(np.hypot(points[0], points[1]) * 14) % 5]
    base = np.where(np.abs(points[2]) > half_height * 0.999, lid, side)
    return base * (0.84 + 0.32 * noise.fractal(points * 9))


def floor_boards(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Boards along y, with grain and dark joints: (3, N) in scene units -> colours (3, N)."""
    column = _integers(points[0] / 0.42)
    stagger = noise.at_cells(column, column * 0, column * 0) * 2
    row = _integers(points[1] / 1.7 + stagger)
    tone = noise.at_cells(column, row, row)
    grain_points = np.stack([points[0] * 11, points[1] * 1.1, tone * 40])
    grain = noise.fractal(grain_points)
    base = _palette("#a8602c", "#c98442", "#8f4e2a", "#b5763c", "#d49a57")[:, _integers(tone * 5) % 5]
    base = base * (0.68 + 0.6 * grain)
    x, y = points[0] / 0.42, (points[1] / 1.7 + stagger)
    joint = np.minimum(np.abs(x - np.rint(x)) * 0.42, np.abs(y - np.rint(y)) * 1.7)
    return base * (0.35 + 0.65 * _ramp(joint, 0.006, 0.022))


def rug_on_boards(
    points: np.ndarray, noise: ValueNoise, centre: Sequence[float], half_size: Sequence[float]
) -> np.ndarray:
    """A woven rug lying on floor boards. Sizes are in scene units."""
    u, v = points[0] - np.float32(centre[0]), points[1] - np.float32(centre[1])
    is_rug = (np.abs(u) < half_size[0]) & (np.abs(v) < half_size[1])
    colours = np.empty_like(points)
    colours[:, is_rug] = rug(u[is_rug], v[is_rug], noise, half_size)
    colours[:, ~is_rug] = floor_boards(points[:, ~is_rug], noise)
    return colours


def rug(u: np.ndarray, v: np.ndarray, noise: ValueNoise, half_size: Sequence[float]) -> np.ndarray:
    """A lattice of diamonds within a border of bands: offsets (N,) from the centre -> colours (3, N)."""
    margin = np.minimum(half_size[0] - np.abs(u), half_size[1] - np.abs(v))
    cell_x, cell_y = _integers(u / 0.5), _integers(v / 0.5)
    reach = np.abs(u / 0.5 - cell_x - 0.5) + np.abs(v / 0.5 - cell_y - 0.5)
    diamonds = _palette("#e9b44c", "#2d7f86", "#f3e3c3", "#d1495b", "#1d3557")
    which = (cell_x * 2 + cell_y * 3) % 5
    field = np.where(reach < 0.40, diamonds[:, which], _colour("#8c1c2f"))
    field = np.where(reach < 0.18, diamonds[:, (which + 2) % 5], field)
    band = _integers(margin / 0.085)
    border = _palette("#f3e3c3", "#1d3557", "#e9b44c", "#1d3557", "#f3e3c3")[:, np.clip(band, 0, 4)]
    tooth = (np.sin((u + v) * 26) > 0) & (band == 2)
    border = np.where(tooth, _colour("#b23a48"), border)
    return np.where(margin < 0.425, border, field) * (0.80 + 0.4 * noise(np.stack([u * 30, v * 9, u * 0])))


def painted_bricks(points: np.ndarray, noise: ValueNoise, height_of_centre: float) -> np.ndarray:
    """A wall in the x-z plane: weathered blue and green bricks above a band of tiles and a panelled dado.

    `points` are in scene units from the wall's centre, which is `height_of_centre` above the floor.
    """
    x, z = points[0], points[2] + np.float32(height_of_centre)
    row = _integers(z / 0.24)
    along = x / 0.56 + 0.5 * (row & 1)
    column = _integers(along)
    tone = noise.at_cells(column, row, column * 0 + 3)
    bricks = _palette("#2f5d8a", "#3f7f93", "#5a9a8c", "#27496d", "#86b09a", "#6c86b5")[:, _integers(tone * 6) % 6]
    patina = noise.fractal(np.stack([x * 3.2, x * 0, z * 3.2]), 3)
    bricks = bricks * (0.62 + 0.7 * patina)
    joint = np.minimum(np.abs(along - np.rint(along)) * 0.56, np.abs(z / 0.24 - np.rint(z / 0.24)) * 0.24)
    bricks = _mix(_colour("#d9d2bd"), bricks, _ramp(joint, 0.008, 0.026))

    tile_x, tile_z = x / 0.3, (z - 0.72) / 0.3
    reach = np.hypot(tile_x - np.floor(tile_x) - 0.5, tile_z - 0.5)
    tile = _palette("#f2c14e", "#d1495b")[:, _integers(tile_x) % 2]
    tiles = np.where(reach < 0.34, tile, _colour("#f6ecd6"))
    tiles = np.where(reach < 0.16, _colour("#1d4e6b"), tiles)
    slats = _colour("#9c4a35") * (0.7 + 0.5 * noise.fractal(np.stack([x * 9, x * 0, z * 1.2])))
    slats = slats * (0.5 + 0.5 * _ramp(np.abs(x / 0.24 - np.rint(x / 0.24)), 0.03, 0.1))
    below = np.where(z < 0.72, slats, tiles)
    return np.where(z < 1.02, below, bricks)


def framed_picture(points: np.ndarray, noise: ValueNoise, half_size: Sequence[float]) -> np.ndarray:
    """A gilded frame around a picture of a low sun over layered hills. `points` have the frame's centre as origin."""
    u, v = points[0] / np.float32(half_size[0]), points[2] / np.float32(half_size[2])
    aspect = half_size[0] / half_size[2]
    sky = _mix(_colour("#f9d976"), _colour("#d8456b"), _ramp(v, -0.2, 0.9))
    distance = np.hypot((u - 0.25) * aspect, v - 0.2)
    sky = _mix(sky, _colour("#fff4c9"), 0.6 * (np.sin(distance * 22) > 0.2) * (distance < 0.85))
    sky = np.where(distance < 0.27, _colour("#ffef9f"), sky)
    picture = sky
    hills = ("#8e5aa8", "#4c6fb1", "#2f8f83", "#1f5c4a")
    for i, hill in enumerate(hills):
        ridge = 0.02 - 0.24 * i + 0.13 * np.sin(u * (2.6 + i) + 1.9 * i) + 0.08 * np.sin(u * (7 - i) + i)
        furrows = 0.85 + 0.25 * np.sin((v - ridge) * 30 + u * 6)
        picture = np.where(v < ridge, _colour(hill) * furrows, picture)
    edge = np.maximum(np.abs(u) * half_size[0] - half_size[0], np.abs(v) * half_size[2] - half_size[2])
    gilt = _mix(_colour("#8a5a16"), _colour("#f4cf6a"), 0.5 + 0.5 * np.sin(edge * 70))
    gilt = gilt * (0.85 + 0.3 * noise(points * 14))
    return np.where(edge > -0.13, gilt, picture)


def mosaic(points: np.ndarray, noise: ValueNoise, radius: float) -> np.ndarray:
    """Rings of small coloured tiles about the z axis, up to `radius` in scene units."""
    colours = _palette("#e07a5f", "#3d5a80", "#f2cc8f", "#81b29a", "#f4f1de", "#b56576")
    ring_position = np.hypot(points[0], points[1]) / np.float32(radius * 1.02) * 6
    ring = _integers(ring_position)
    turn = _angle(points) * (6 * (ring + 1)) + 0.5 * (ring & 1)
    wedge = _integers(turn)
    base = colours[:, _integers(noise.at_cells(ring, wedge, ring * 0) * 6) % 6]
    gap = np.minimum(np.abs(ring_position - np.rint(ring_position)), np.abs(turn - np.rint(turn)))
    return base * (0.45 + 0.55 * _ramp(gap, 0.03, 0.09)) * (0.86 + 0.28 * noise(points * 12))


# --------------------------------------------------------------------------------------------------------- shapes


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Inner products of vectors: (3, N) or (3, 1) each -> (N,). Several times faster than summing along the axis."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@dataclass(frozen=True)
class Sphere:
    """A ball: its centre, its radius, and its surface. The texture sees points in units of the radius."""

    centre: tuple[float, float, float]
    radius: float
    texture: Texture

    @property
    def reach(self) -> float:
        """Distance from the centre to the farthest point of the surface."""
        return self.radius * 1.001

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances along rays (origins (3, N) or (3, 1), unit directions (3, N)) to the ball: (N,), inf for a miss."""
        to_origin = origins - np.array(self.centre, np.float32)[:, None]
        half_b = _dot(to_origin, directions)
        under_root = half_b * half_b - (_dot(to_origin, to_origin) - np.float32(self.radius**2))
        root = np.sqrt(np.maximum(under_root, 0))
        near, far = -half_b - root, -half_b + root
        distance = np.where(near > SELF_HIT_DISTANCE, near, far)
        return np.where((under_root > 0) & (distance > SELF_HIT_DISTANCE), distance, np.float32(np.inf))

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Texture coordinates and outward unit normals at points (3, N) on the ball: both (3, N)."""
        local = (points - np.array(self.centre, np.float32)[:, None]) / np.float32(self.radius)
        return local, local


@dataclass(frozen=True)
class Box:
    """A box, turned by `yaw` radians about its vertical axis. The texture sees points relative to the centre."""

    centre: tuple[float, float, float]
    half_size: tuple[float, float, float]
    texture: Texture
    yaw: float = 0.0

    @property
    def reach(self) -> float:
        """Distance from the centre to the farthest point of the surface."""
        return math.hypot(*self.half_size) * 1.001

    def _turn(self) -> np.ndarray:
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]], np.float32)

    def _to_local(self, points: np.ndarray) -> np.ndarray:
        relative = points - np.array(self.centre, np.float32)[:, None]
        return relative if self.yaw == 0 else self._turn() @ relative

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances along rays (origins (3, N) or (3, 1), unit directions (3, N)) to the box: (N,), inf for a miss."""
        local_origins = self._to_local(origins)
        local_directions = directions if self.yaw == 0 else self._turn() @ directions
        near = np.full(directions.shape[1], -np.inf, np.float32)
        far = np.full(directions.shape[1], np.inf, np.float32)
        for axis in range(3):
            direction = local_directions[axis]
            inverse = 1 / np.where(np.abs(direction) < 1e-9, np.float32(1e-9), direction)
            middle = -local_origins[axis] * inverse
            reach = np.abs(inverse) * np.float32(self.half_size[axis])
            near, far = np.maximum(near, middle - reach), np.minimum(far, middle + reach)
        distance = np.where(near > SELF_HIT_DISTANCE, near, far)
        return np.where((near <= far) & (distance > SELF_HIT_DISTANCE), distance, np.float32(np.inf))

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Texture coordinates and outward unit normals at points (3, N) on the box: both (3, N)."""
        local = self._to_local(points)
        relative = local / np.array(self.half_size, np.float32)[:, None]
        axis = np.abs(relative).argmax(axis=0)
        normals = np.where(np.arange(3)[:, None] == axis, np.sign(relative), np.float32(0))
        return local, normals if self.yaw == 0 else self._turn().T @ normals


@dataclass(frozen=True)
class Cylinder:
    """An upright solid cylinder with flat ends. The texture sees points relative to the centre."""

    centre: tuple[float, float, float]
    radius: float
    half_height: float
    texture: Texture

    @property
    def reach(self) -> float:
        """Distance from the centre to the farthest point of the surface."""
        return math.hypot(self.radius, self.half_height) * 1.001

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances along rays (origins (3, N) or (3, 1), unit directions (3, N)) to it: (N,), inf for a miss."""
        x, y, z = origins - np.array(self.centre, np.float32)[:, None]
        a = np.maximum(directions[0] ** 2 + directions[1] ** 2, np.float32(1e-12))
        half_b = x * directions[0] + y * directions[1]
        under_root = half_b * half_b - a * (x * x + y * y - np.float32(self.radius**2))
        root = np.sqrt(np.maximum(under_root, 0))
        inverse = 1 / np.where(np.abs(directions[2]) < 1e-9, np.float32(1e-9), directions[2])
        middle, reach = -z * inverse, np.abs(inverse) * np.float32(self.half_height)
        near = np.maximum((-half_b - root) / a, middle - reach)
        far = np.minimum((-half_b + root) / a, middle + reach)
        distance = np.where(near > SELF_HIT_DISTANCE, near, far)
        is_hit = (under_root > 0) & (near <= far) & (distance > SELF_HIT_DISTANCE)
        return np.where(is_hit, distance, np.float32(np.inf))

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Texture coordinates and outward unit normals at points (3, N) on the cylinder: both (3, N)."""
        local = points - np.array(self.centre, np.float32)[:, None]
        above_side = np.hypot(local[0], local[1]) / np.float32(self.radius)
        is_end = np.abs(local[2]) / np.float32(self.half_height) > above_side
        zeros = np.zeros_like(above_side)
        ends = np.stack([zeros, zeros, np.sign(local[2])])
        side = np.stack([local[0], local[1], zeros]) / np.maximum(np.hypot(local[0], local[1]), np.float32(1e-9))
        return local, np.where(is_end, ends, side)


Shape = Union[Sphere, Box, Cylinder]


@dataclass(frozen=True)
class Scene:
    """Shapes under one sun."""

    shapes: tuple[Shape, ...]
    """What there is to see, and what casts shadows."""
    noise: ValueNoise
    """Where the textures' irregularities come from."""
    sun: tuple[float, float, float]
    """Direction towards the sun's centre; any length."""
    sun_spread: float = 0.10
    """Radius of the sun's disc over its distance: how soft shadows are."""
    sky_light: float = 0.66
    """Share of a surface's colour that it shows in full shadow when it faces the sky."""
    sun_light: float = 0.60
    """Share of a surface's colour that the sun adds where it shines straight on it."""
    backdrop: tuple[Shape, ...] = ()
    """Floors and walls: seen like the shapes, but nothing that is seen lies in their shadow."""
    shine: float = 0.0
    """Brightness of a lamp's reflection where it is seen straight: what makes colour depend on who looks."""
    lamp: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction towards that lamp, which does nothing else; any length."""
    polish: float = 40.0
    """Exponent of that reflection: how narrow it is."""
    haze: float = 0.0
    """Extinction a scene unit of the mist that fills the scene: what is d away shows exp(−haze d) of its colour."""
    haze_color: tuple[float, float, float] = (0.75, 0.78, 0.82)
    """What the mist shows instead."""


def still_life(seed: int = 0, shine: float = 0.0, haze: float = 0.0) -> Scene:
    """The forward-facing scene: toys in front of a wall, z up, to be seen from around (0, 0, 1.25) along +y.

    Args:
        seed: Which noise the textures show; the shapes stay where they are.
        shine, haze: See `Scene`.
    """
    crate_half, cube_half, picture_half = (0.52, 0.52, 0.52), (0.3, 0.3, 0.3), (0.95, 0.05, 0.68)
    backdrop = (
        Box((0, 3.5, -0.05), (9, 6, 0.05), lambda p, n: rug_on_boards(p, n, (0.0, 0.1), (2.35, 1.45))),
        Box((0, 6.3, 2), (9, 0.1, 4), lambda p, n: painted_bricks(p, n, height_of_centre=2)),
    )
    shapes = (
        Box((-1.05, 6.16, 2.12), picture_half, lambda p, n: framed_picture(p, n, picture_half)),
        Sphere((-0.78, 3.75, 0.72), 0.72, beach_ball),
        Box((1.12, 3.7, 0.52), crate_half, lambda p, n: crate(p, n, crate_half), yaw=0.5),
        Sphere((1.05, 3.72, 1.34), 0.30, planet),
        Cylinder((0.38, 5.15, 1.2), 0.36, 1.05, marble),
        Box((0.38, 5.15, 0.075), (0.52, 0.52, 0.075), marble),
        Box((0.38, 5.15, 2.33), (0.48, 0.48, 0.08), marble),
        Cylinder((2.1, 5.3, 1.05), 0.25, 1.05, lambda p, n: barber_pole(p, n, 1.1)),
        Sphere((2.1, 5.3, 2.38), 0.29, lambda p, n: globe_checker(p, n, "#f2b632", "#14746f", 4)),
        Box((-1.28, 2.75, 0.3), cube_half, lambda p, n: patchwork(p, n, cube_half, 3), yaw=-0.35),
        Sphere((0.08, 2.68, 0.25), 0.25, lambda p, n: globe_checker(p, n, "#d7263d", "#fbf3e4", 5)),
        Cylinder((-2.2, 4.9, 0.55), 0.5, 0.55, lambda p, n: drum(p, n, 0.55)),
        Cylinder((1.12, 2.5, 0.17), 0.26, 0.17, lambda p, n: drum(p, n, 0.17)),
    )
    sun, lamp = (-0.62, -0.75, 1.0), (-0.1, -1.0, 0.1)
    return Scene(shapes, ValueNoise(seed), sun=sun, backdrop=backdrop, shine=shine, lamp=lamp, haze=haze)


def objects_on_a_plinth(seed: int = 0, shine: float = 0.0, landscape: bool = False) -> Scene:
    """The all-around scene: toys on a round plinth within [-1, 1]^3, z up.

    Args:
        seed: Which noise the textures show; the shapes stay where they are.
        shine: See `Scene`.
        landscape: Whether they stand on a ground, with walls and balls far behind them; else there is nothing.
    """
    crate_half, cube_half = (0.27, 0.27, 0.27), (0.15, 0.15, 0.15)
    shapes = (
        Cylinder((0, 0, -0.55), 0.92, 0.06, lambda p, n: mosaic(p, n, 0.92)),
        Sphere((-0.36, -0.28, -0.11), 0.38, beach_ball),
        Box((0.42, -0.22, -0.22), crate_half, lambda p, n: crate(p, n, crate_half), yaw=0.5),
        Sphere((0.42, -0.22, 0.22), 0.17, planet),
        Cylinder((0.1, 0.46, -0.02), 0.17, 0.47, lambda p, n: barber_pole(p, n, 2.2)),
        Sphere((0.1, 0.46, 0.62), 0.17, lambda p, n: globe_checker(p, n, "#f2b632", "#14746f", 4)),
        Box((-0.45, 0.42, -0.34), cube_half, lambda p, n: patchwork(p, n, cube_half, 3), yaw=-0.35),
        Cylinder((0.02, -0.68, -0.40), 0.14, 0.09, lambda p, n: drum(p, n, 0.09)),
        Sphere((0.62, 0.34, -0.36), 0.13, lambda p, n: globe_checker(p, n, "#d7263d", "#fbf3e4", 5)),
    )
    backdrop = far_away() if landscape else ()
    sun = (-0.5, -0.7, 1.2)
    return Scene(shapes, ValueNoise(seed), sun=sun, sky_light=0.7, sun_light=0.56, backdrop=backdrop, shine=shine)


def far_away() -> tuple[Shape, ...]:
    """A ground 0.61 below the origin, walls 14 away from it on all sides, and eight balls half way."""
    walls = [
        Box((0, 14, 5), (15, 0.1, 6), lambda p, n: painted_bricks(p * 0.35, n, height_of_centre=2)),
        Box((0, -14, 5), (15, 0.1, 6), lambda p, n: painted_bricks(p * 0.35, n, height_of_centre=2)),
        Box((14, 0, 5), (0.1, 15, 6), lambda p, n: painted_bricks(p[[1, 0, 2]] * 0.35, n, height_of_centre=2)),
        Box((-14, 0, 5), (0.1, 15, 6), lambda p, n: painted_bricks(p[[1, 0, 2]] * 0.35, n, height_of_centre=2)),
    ]
    balls = []
    for i in range(8):
        angle, radius = 2 * math.pi * i / 8, 1.0 + 0.25 * (i % 3)
        centre = (7 * math.cos(angle), 7 * math.sin(angle), radius - 0.61)
        balls.append(Sphere(centre, radius, (beach_ball, planet)[i % 2]))
    return (Box((0, 0, -0.66), (15, 15, 0.05), lambda p, n: floor_boards(p * 0.5, n)), *walls, *balls)


# ------------------------------------------------------------------------------------------------------ rendering


def render_sample(
    camera_to_world: np.ndarray,
    focal: float,
    height: int,
    width: int,
    scene: Optional[Scene] = None,
    supersample: int = 3,
    distortion: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Renders one view, with the depth and coverage that are true of it.

    Args:
        camera_to_world: (3, 4) or (4, 4); columns right, up, back, position.
        focal: Focal length in pixels.
        height: Rows of the picture.
        width: Columns of the picture.
        scene: What to look at; None for `still_life()`.
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
    scene = still_life() if scene is None else scene
    pose = np.asarray(camera_to_world, np.float32)
    samples = supersample**2
    rgb = np.zeros((height, width, 3), np.float32)
    alpha = np.zeros((height, width), np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    rows_per_band = max(1, RAYS_PER_BAND // (width * samples))
    for top in range(0, height, rows_per_band):
        rows = np.arange(top, min(top + rows_per_band, height))
        directions, cosines = _band_of_rays(pose, focal, height, width, rows, supersample, distortion)
        colours, distances = _trace(scene, pose[:, 3][:3, None], directions, samples)
        shape = (len(rows), width, samples)
        is_hit = np.isfinite(distances).reshape(shape)
        alpha[rows] = is_hit.mean(axis=-1)
        total = colours.reshape(3, *shape).sum(axis=-1)
        rgb[rows] = np.moveaxis(total / np.maximum(is_hit.sum(axis=-1), 1), 0, -1)
        depth[rows] = (distances * cosines).reshape(shape)[..., samples // 2]
    return rgb, alpha, depth


def _band_of_rays(
    pose: np.ndarray,
    focal: float,
    height: int,
    width: int,
    rows: np.ndarray,
    supersample: int,
    distortion: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (3, N) of the rays of some rows and their cosines (N,) with the viewing axis.

    N runs over rows, then columns, then the samples within a pixel.
    """
    offsets = (np.arange(supersample, dtype=np.float32) + 0.5) / supersample
    y = (height / 2 - rows[:, None] - offsets[None, :]) / focal
    x = (np.arange(width)[:, None] + offsets[None, :] - width / 2) / focal
    shape = (len(rows), width, supersample, supersample)
    x = np.broadcast_to(x[None, :, None, :], shape).reshape(-1).astype(np.float32)
    y = np.broadcast_to(y[:, None, :, None], shape).reshape(-1).astype(np.float32)
    if distortion != 0:
        seen = np.hypot(x, y)
        factor = _undistorted_radius(seen, distortion) / np.maximum(seen, np.float32(1e-9))
        x, y = x * factor, y * factor
    cosines = 1 / np.sqrt(x * x + y * y + 1)
    directions = pose[:3, :3] @ np.stack([x * cosines, y * cosines, -cosines])
    return directions, cosines


def _undistorted_radius(seen: np.ndarray, distortion: float) -> np.ndarray:
    """r where r + k1 r^3 = `seen`, by Newton's method; finds it where the left side grows with r."""
    radius = seen.copy()
    for _ in range(10):
        radius -= (radius + distortion * radius**3 - seen) / (1 + 3 * distortion * radius**2)
    return radius


def _trace(scene: Scene, origin: np.ndarray, directions: np.ndarray, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours (3, N), 0 where a ray hits nothing, and distances (N,), inf there, of rays from one origin (3, 1)."""
    nearest = np.full(directions.shape[1], np.inf, np.float32)
    which = np.full(directions.shape[1], -1, np.int8)
    shapes = scene.shapes + scene.backdrop
    for i, shape in enumerate(shapes):
        distance = _distances(shape, origin, directions)
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

    colours = np.zeros_like(directions)
    shaded = albedo * _light(scene, points, normals, hits % samples, samples)
    if scene.shine > 0:
        shaded += _gloss(scene, normals, directions[:, hits])
    colours[:, hits] = np.clip(shaded, 0, 1)
    if scene.haze > 0:
        clear = np.exp(np.float32(-scene.haze) * nearest)
        colours = clear * colours + (1 - clear) * np.array(scene.haze_color, np.float32)[:, None]
    return colours, nearest


def _gloss(scene: Scene, normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The lamp's reflection (N,) on surfaces with these normals (3, N), seen along these directions (Phong)."""
    mirrored = directions - 2 * _dot(normals, directions) * normals
    lamp = (np.array(scene.lamp, np.float32) / np.float32(np.linalg.norm(scene.lamp)))[:, None]
    return np.float32(scene.shine) * np.maximum(_dot(mirrored, lamp), 0) ** np.float32(scene.polish)


def _distances(shape: Shape, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """What `shape.intersect` says, worked out only for rays that pass through the ball around the shape."""
    to_centre = np.array(shape.centre, np.float32)[:, None] - origins
    along = _dot(to_centre, directions)
    is_near = np.flatnonzero(_dot(to_centre, to_centre) - along * along < np.float32(shape.reach**2))
    distances = np.full(directions.shape[1], np.inf, np.float32)
    near_origins = origins if origins.shape[1] == 1 else origins[:, is_near]
    distances[is_near] = shape.intersect(near_origins, directions[:, is_near])
    return distances


def _light(scene: Scene, points: np.ndarray, normals: np.ndarray, sample: np.ndarray, samples: int) -> np.ndarray:
    """Light that reaches surface points (3, N): a soft sky, and a sun whose shadows have penumbras -> (3, N).

    Each sample of a pixel looks at another spot of the sun's disc; the pixel's mean is its share of the disc.
    """
    to_sun = _spots_on_sun(scene, samples)[:, sample]
    facing = np.maximum(_dot(normals, to_sun), 0)
    lit = np.flatnonzero(facing > 0)
    starts, towards = points[:, lit] + normals[:, lit] * np.float32(2e-3), to_sun[:, lit]
    is_shaded = np.zeros(len(lit), bool)
    for shape in scene.shapes:
        is_shaded |= np.isfinite(_distances(shape, starts, towards))
    facing[lit[is_shaded]] = 0
    sky = scene.sky_light * (0.78 + 0.22 * normals[2]) * _openness(scene, points, normals)
    warm, cool = _colour("#fff6e4"), _colour("#e6efff")
    return cool * sky + warm * (scene.sun_light * facing)


def _openness(scene: Scene, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Share of the sky, (N,), that balls do not hide from surface points (3, N).

    A ball of radius r whose centre is d away hides max(0, cosine) r^2 / d^2 of a cosine-weighted sky.
    """
    openness = np.ones(points.shape[1], np.float32)
    for shape in scene.shapes:
        if isinstance(shape, Sphere):
            to_centre = np.array(shape.centre, np.float32)[:, None] - points
            squared = _dot(to_centre, to_centre)
            cosine = _dot(to_centre, normals) / np.sqrt(squared)
            openness *= 1 - 0.8 * np.clip(cosine, 0, 1) * np.minimum(np.float32(shape.radius**2) / squared, 1)
    return openness


@lru_cache(maxsize=8)
def _sunflower(count: int) -> np.ndarray:
    """`count` points (2, count) spread evenly over the unit disc."""
    index = np.arange(count) + 0.5
    angle = index * (math.pi * (3 - math.sqrt(5)))
    return np.sqrt(index / count) * np.stack([np.cos(angle), np.sin(angle)])


def _spots_on_sun(scene: Scene, count: int) -> np.ndarray:
    """Unit directions (3, count) towards points spread over the sun's disc."""
    centre = np.array(scene.sun) / np.linalg.norm(scene.sun)
    side = np.cross(centre, (0, 0, 1.0))
    side /= np.linalg.norm(side)
    disc = _sunflower(count) * scene.sun_spread
    spots = centre[:, None] + side[:, None] * disc[0] + np.cross(side, centre)[:, None] * disc[1]
    return (spots / np.linalg.norm(spots, axis=0)).astype(np.float32)


# -------------------------------------------------------------------------------------------------------- cameras


def look_at(position: Sequence[float], target: Sequence[float], roll: float = 0.0) -> np.ndarray:
    """A camera at `position` that looks at `target`, upright but for `roll` radians about its viewing axis.

    Returns:
        Camera-to-world matrix (4, 4), float64; columns right, up, back, position.

    Raises:
        ValueError: If the camera would look straight up or down, where upright means nothing.
    """
    back = np.asarray(position, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross((0.0, 0.0, 1.0), back)
    if np.linalg.norm(right) < 1e-6:
        raise ValueError(f"The camera at {tuple(position)} looks straight up or down, so its up is undefined.")
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    pose = np.eye(4)
    pose[:3, 0] = math.cos(roll) * right + math.sin(roll) * up
    pose[:3, 1] = math.cos(roll) * up - math.sin(roll) * right
    pose[:3, 2] = back
    pose[:3, 3] = position
    return pose


def forward_facing_cameras(num_views: int = 20, baseline: float = 0.25, seed: int = 0) -> np.ndarray:
    """Hand-held photos of `still_life`: a jittered grid of cameras, about 5 columns for every 4 rows, row by row.

    Args:
        num_views: How many cameras, at least 1.
        baseline: How far the outermost columns are from the middle one, as a share of the nearest depth.
        seed: Which jitter.

    Returns:
        Camera-to-world matrices (num_views, 4, 4).
    """
    rng = np.random.default_rng(seed)
    columns = max(1, math.ceil(math.sqrt(num_views * 1.25)))
    rows = math.ceil(num_views / columns)
    reach = baseline * LLFF_NEAREST_DEPTH
    poses = []
    for view in range(num_views):
        row, column = divmod(view, columns)
        across = 2 * column / max(columns - 1, 1) - 1
        up = 1 - 2 * row / max(rows - 1, 1)
        jitter = rng.uniform(-0.12, 0.12, 3) * reach
        position = np.array([across * reach, 0.0, 1.3 + 0.6 * up * reach]) + jitter
        target = np.array([0.35 * position[0], 5.0, 0.80 + 0.3 * (position[2] - 1.3)]) + rng.normal(0, 0.04, 3)
        poses.append(look_at(position, target, roll=rng.normal(0, 0.012)))
    return np.stack(poses)


def surrounding_cameras(count: int, rng: np.random.Generator) -> np.ndarray:
    """Cameras spread at random over the upper half of a sphere, all looking at the origin -> (count, 4, 4)."""
    azimuth = rng.uniform(0, 2 * math.pi, count)
    elevation = np.arcsin(rng.uniform(0.05, 0.97, count))
    return np.stack([_camera_on_sphere(a, e) for a, e in zip(azimuth, elevation, strict=True)])


def circling_cameras(count: int, elevation: float = math.radians(30)) -> np.ndarray:
    """Cameras evenly around the origin at one elevation in radians, all looking at it -> (count, 4, 4)."""
    return np.stack([_camera_on_sphere(2 * math.pi * i / count, elevation) for i in range(count)])


def _camera_on_sphere(azimuth: float, elevation: float) -> np.ndarray:
    flat = math.cos(elevation)
    direction = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    return look_at(BLENDER_CAMERA_RADIUS * direction, (0, 0, 0))


# -------------------------------------------------------------------------------------------------------- layouts


def poses_bounds_row(
    camera_to_world: np.ndarray, height: int, width: int, focal: float, near: float, far: float
) -> np.ndarray:
    """One row of `poses_bounds.npy`.

    Args:
        camera_to_world: (3, 4) or (4, 4); columns right, up, back, position.
        height, width, focal: In pixels of the stored picture.
        near, far: Depths in scene units.

    Returns:
        (17,): the 3 x 5 matrix with columns down, right, back, position, (height, width, focal), row by row; near; far.
    """
    right, up, back, position = np.asarray(camera_to_world)[:3].T
    matrix = np.stack([-up, right, back, position, (height, width, focal)], axis=1)
    return np.concatenate([matrix.ravel(), (near, far)])


def write_llff(
    folder: Path,
    num_views: int = 20,
    width: int = 252,
    height: Optional[int] = None,
    supersample: int = 3,
    seed: int = 0,
    exposure: float = 0.0,
    shine: float = 0.0,
    haze: float = 0.0,
) -> None:
    """Writes `images/image000.png`, ... and `poses_bounds.npy` of `still_life` into `folder`.

    Args:
        folder: An existing folder.
        num_views: How many pictures.
        width: Their columns.
        height: Their rows; None for three quarters of the columns.
        supersample: Rays along each side of a pixel.
        seed: Which noise and which jitter of the cameras.
        exposure: Stops by which photos differ; see `photo_gains`. Every eighth, which is held out, has a gain of 1.
        shine, haze: See `Scene`.
    """
    height = round(width * 0.75) if height is None else height
    focal = LLFF_FOCAL_PER_WIDTH * width
    scene = still_life(seed, shine, haze)
    held_out = [i for i in range(num_views) if i % 8 == 0 and num_views > 8]
    gains = photo_gains(num_views, exposure, held_out, seed)
    (folder / "images").mkdir()
    rows = []
    for i, pose in enumerate(forward_facing_cameras(num_views, seed=seed)):
        rgb, _, depth = render_sample(pose, focal, height, width, scene, supersample)
        imageio.imwrite(folder / "images" / f"image{i:03d}.png", _to_bytes(rgb * gains[i]))
        seen = depth[np.isfinite(depth)]
        rows.append(poses_bounds_row(pose, height, width, focal, 0.9 * seen.min(), seen.max()))
        _report_progress("llff", i + 1, num_views)
    np.save(folder / "poses_bounds.npy", np.stack(rows))


def write_blender(
    folder: Path,
    num_train: int = 100,
    num_val: int = 10,
    num_test: int = 25,
    width: int = 100,
    supersample: int = 3,
    seed: int = 0,
    exposure: float = 0.0,
    shine: float = 0.0,
) -> None:
    """Writes `train`, `val` and `test` pictures and `transforms_*.json` of `objects_on_a_plinth` into `folder`.

    Args:
        folder: An existing folder.
        num_train, num_val, num_test: How many pictures each split has; a split of 0 is left out.
        width: Columns of the square pictures.
        supersample: Rays along each side of a pixel.
        seed: Which noise and which cameras.
        exposure: Stops by which training pictures differ; see `photo_gains`.
        shine: See `Scene`.
    """
    rng = np.random.default_rng(seed)
    splits = {
        "train": surrounding_cameras(num_train, rng) if num_train else (),
        "val": surrounding_cameras(num_val, rng) if num_val else (),
        "test": circling_cameras(num_test) if num_test else (),
    }
    scene = objects_on_a_plinth(seed, shine)
    focal = 0.5 * width / math.tan(0.5 * BLENDER_CAMERA_ANGLE_X)
    gains = photo_gains(num_train, exposure, (), seed)
    for split, poses in splits.items():
        if len(poses) == 0:
            continue
        (folder / split).mkdir()
        frames = []
        for i, pose in enumerate(poses):
            rgb, alpha, _ = render_sample(pose, focal, width, width, scene, supersample)
            rgb = rgb * gains[i] if split == "train" else rgb
            imageio.imwrite(folder / split / f"r_{i}.png", _to_bytes(np.dstack([rgb, alpha])))
            frame = {"file_path": f"./{split}/r_{i}", "rotation": 2 * math.pi / len(poses)}
            frames.append({**frame, "transform_matrix": pose.tolist()})
            _report_progress(f"blender {split}", i + 1, len(poses))
        transforms = {"camera_angle_x": BLENDER_CAMERA_ANGLE_X, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(transforms, indent=2))


def write_nerfstudio(
    folder: Path,
    num_views: int = 20,
    width: int = 252,
    height: Optional[int] = None,
    supersample: int = 3,
    seed: int = 0,
    exposure: float = 0.0,
    shine: float = 0.0,
    distortion: float = 0.0,
    wander: float = 0.0,
) -> None:
    """Writes `images` and `transforms.json` of `objects_on_a_plinth` in a landscape into `folder`.

    Every eighth view is held out, for validation and test alike; the file says so.

    Args:
        folder: An existing folder.
        num_views: How many pictures, on a ring around the objects that goes up and down.
        width: Their columns.
        height: Their rows; None for three quarters of the columns.
        supersample: Rays along each side of a pixel.
        seed: Which noise.
        exposure: Stops by which training pictures differ; see `photo_gains`.
        shine: See `Scene`.
        distortion: k1 of the lens; see `render_sample`.
        wander: How far from the objects' middle, at most along each axis of the ground, a camera may look.
    """
    height = round(width * 0.75) if height is None else height
    focal = LLFF_FOCAL_PER_WIDTH * width
    scene = objects_on_a_plinth(seed, shine, landscape=True)
    names = [f"images/image{i:03d}.png" for i in range(num_views)]
    held_out = [i for i in range(num_views) if i % 8 == 0 and num_views > 8]
    gains = photo_gains(num_views, exposure, held_out, seed)
    aside = wander * np.random.default_rng([seed, 2]).uniform(-1, 1, (num_views, 2))
    (folder / "images").mkdir()
    frames = []
    for i, name in enumerate(names):
        angle = 2 * math.pi * i / num_views
        flat, height_above = 2.6, 1.0 + 0.5 * math.sin(3 * angle)
        pose = look_at((flat * math.cos(angle), flat * math.sin(angle), height_above), (*aside[i], -0.1))
        rgb, _, _ = render_sample(pose, focal, height, width, scene, supersample, distortion)
        imageio.imwrite(folder / name, _to_bytes(rgb * gains[i]))
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        _report_progress("nerfstudio", i + 1, num_views)
    camera = {"camera_model": "OPENCV", "fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2}
    lens = {"k1": distortion, "k2": 0.0, "p1": 0.0, "p2": 0.0} if distortion else {}
    test = [names[i] for i in held_out] or names
    splits = {"train_filenames": [name for i, name in enumerate(names) if i not in held_out]}
    splits |= {"val_filenames": test, "test_filenames": test}
    content = {**camera, "w": width, "h": height, **lens, **splits, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=2))


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


def _to_bytes(image: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def _report_progress(what: str, done: int, total: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{what}: {done}/{total}", end="\n" if done == total else "", file=sys.stderr, flush=True)


# ---------------------------------------------------------------------------------------------------- command line


def _write_layout(target: Path, force: bool, write: Callable[[Path], None]) -> None:
    """Lets `write` fill a temporary folder beside `target`, which then takes its place: never half a scene."""
    if target.exists() and not force:
        raise FileExistsError(f"{target} exists already; add --force to replace it, or choose another folder.")
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".sample-", dir=target.parent) as temporary:
        finished = Path(temporary) / "scene"
        finished.mkdir()
        write(finished)
        if target.exists():
            shutil.move(target, Path(temporary) / "replaced")
        os.replace(finished, target)
    command = ["ns-train", "coarse-fewshot-draft", "--data", str(target), f"{target.name}-data"]
    print(f"Made {target} – next: {shlex.join(command)}")


def _parse(arguments: Optional[Sequence[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Renders a sample scene, so that nothing needs to be downloaded.")
    parser.add_argument("output", type=Path, help="folder that will hold llff/, blender/ or nerfstudio/")
    layouts = ("llff", "blender", "both", "nerfstudio")
    parser.add_argument("--layout", choices=layouts, default="both", help="which to write; both: llff and blender")
    parser.add_argument("--num-views", type=int, default=20, help="llff and nerfstudio: number of pictures")
    parser.add_argument("--width", type=int, help="columns of the pictures (default: 252, blender 100)")
    parser.add_argument("--height", type=int, help="rows of the pictures but blender's (default: 3/4 of the columns)")
    parser.add_argument("--num-train", type=int, default=100, help="blender: number of training pictures")
    parser.add_argument("--num-val", type=int, default=10, help="blender: number of validation pictures")
    parser.add_argument("--num-test", type=int, default=25, help="blender: number of test pictures")
    parser.add_argument("--supersample", type=int, default=3, help="rays along each side of a pixel; odd")
    parser.add_argument("--exposure", type=float, default=0.0, help="stops by which training pictures differ")
    parser.add_argument("--shiny", type=float, default=0.0, help="brightness of a lamp's reflection, 0 to 1")
    parser.add_argument("--haze", type=float, default=0.0, help="llff: extinction of a mist a scene unit, 0 to 10")
    parser.add_argument("--distortion", type=float, default=0.0, help="nerfstudio: k1 of the lens, -0.2 to 0.5")
    parser.add_argument("--wander", type=float, default=0.0, help="nerfstudio: how far aside cameras look, 0 to 1")
    parser.add_argument("--seed", type=int, default=0, help="which textures and cameras")
    parser.add_argument("--force", action="store_true", help="replace what OUTPUT holds already")
    options = parser.parse_args(arguments)
    for name in ("num_views", "width", "height", "num_train", "num_val", "num_test", "supersample"):
        value = getattr(options, name)
        least = 0 if name in ("num_train", "num_val", "num_test") else 1
        if value is not None and value < least:
            parser.error(f"--{name.replace('_', '-')} is {value}, but has to be at least {least}")
    if options.supersample % 2 == 0:
        parser.error(f"--supersample is {options.supersample}, but has to be odd")
    for name, low, high in (
        *(("exposure", 0.0, 3.0), ("shiny", 0.0, 1.0)),
        *(("haze", 0.0, 10.0), ("distortion", -0.2, 0.5), ("wander", 0.0, 1.0)),
    ):
        if not low <= getattr(options, name) <= high:
            parser.error(f"--{name} is {getattr(options, name)}, but has to be between {low} and {high}")
    if options.haze != 0 and options.layout != "llff":
        parser.error("--haze needs --layout llff: in a mist the objects of the other layouts have no outline")
    if options.distortion != 0 and options.layout != "nerfstudio":
        parser.error("--distortion needs --layout nerfstudio: the other layouts have no place for it")
    if options.seed < 0:
        parser.error(f"--seed is {options.seed}, but has to be at least 0")
    return options


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The command line; `arguments` default to the process's own. Returns the exit status."""
    options = _parse(arguments)
    common = {"supersample": options.supersample, "seed": options.seed}
    common |= {"exposure": options.exposure, "shine": options.shiny}
    try:
        if options.layout in ("llff", "both"):
            size = {"width": options.width or 252, "height": options.height}
            _write_layout(
                options.output / "llff",
                options.force,
                lambda folder: write_llff(folder, options.num_views, **size, **common, haze=options.haze),
            )
        if options.layout in ("blender", "both"):
            counts = (options.num_train, options.num_val, options.num_test)
            _write_layout(
                options.output / "blender",
                options.force,
                lambda folder: write_blender(folder, *counts, width=options.width or 100, **common),
            )
        if options.layout == "nerfstudio":
            size = {"width": options.width or 252, "height": options.height}
            _write_layout(
                options.output / "nerfstudio",
                options.force,
                lambda folder: write_nerfstudio(
                    folder,
                    options.num_views,
                    **size,
                    **common,
                    distortion=options.distortion,
                    wander=options.wander,
                ),
            )
    except OSError as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

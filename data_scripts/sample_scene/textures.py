"""What the surfaces of the sample scene are painted with.

A texture maps points on a surface, in the shape's own coordinates (3, N), to colours (3, N) in [0, 1].
"""

import math
from functools import cache
from typing import Callable, Sequence

import numpy as np

# ------------------------------------------------------------------------------------------------------------ noise


def smoothstep(fraction: np.ndarray) -> np.ndarray:
    """Maps [0, 1] to itself with zero slope at both ends."""
    return fraction * fraction * (3 - 2 * fraction)


def blend(first: np.ndarray, second: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """`first` where `amount` is 0, `second` where it is 1, linear between."""
    return first + (second - first) * amount


class ValueNoise:
    """Random values in [0, 1] on a lattice, interpolated between its points.

    Args:
        seed: Which noise; the same seed gives the same values everywhere.
    """

    period = 32

    def __init__(self, seed: int):
        self.lattice = np.random.default_rng(seed).random(self.period**3).astype(np.float32)

    def at_cells(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """The lattice's values at integer cells x, y, z, (N,) each, of any size; it repeats every `period` cells."""
        mask = self.period - 1
        return self.lattice[((x & mask) * self.period + (y & mask)) * self.period + (z & mask)]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Noise at `points` (3, N), with features about one unit wide -> (N,) in [0, 1]."""
        floor = np.floor(points)
        x, y, z = floor.astype(np.int32)
        along_x, along_y, along_z = smoothstep(points - floor)

        def edge(dx: int, dy: int) -> np.ndarray:
            return blend(self.at_cells(x + dx, y + dy, z), self.at_cells(x + dx, y + dy, z + 1), along_z)

        return blend(blend(edge(0, 0), edge(0, 1), along_y), blend(edge(1, 0), edge(1, 1), along_y), along_x)

    def fractal(self, points: np.ndarray, octaves: int = 2) -> np.ndarray:
        """A sum of `octaves` noises, each twice as fine and half as strong as the last: (3, N) -> (N,) in [0, 1]."""
        layers = [self(points * np.float32(2**i) + np.float32(7.3 * i)) * np.float32(0.5**i) for i in range(octaves)]
        return sum(layers) / np.float32(2 - 0.5 ** (octaves - 1))


Texture = Callable[[np.ndarray, ValueNoise], np.ndarray]
"""Points (3, N) and a source of noise -> colours (3, N)."""

# ---------------------------------------------------------------------------------------------------------- helpers


@cache
def palette(*hex_codes: str) -> np.ndarray:
    """K codes '#rrggbb' -> (3, K) float32 in [0, 1]."""
    return np.array([list(bytes.fromhex(code[1:])) for code in hex_codes], np.float32).T / 255


def _pick(colours: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Colours (3, K) in turn, by any integers (N,) -> (3, N)."""
    return colours[:, index % colours.shape[1]]


def _cell(values: np.ndarray) -> np.ndarray:
    """Number of the unit interval that each value lies in."""
    return np.floor(values).astype(np.int32)


def _seam(values: np.ndarray) -> np.ndarray:
    """Distance from the nearest border between unit intervals, in [0, 0.5]."""
    return np.abs(values - np.rint(values))


def _ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between."""
    return smoothstep(np.clip((values - low) / np.float32(high - low), 0, 1))


def _groove(distance: np.ndarray, low: float, high: float, darkest: float) -> np.ndarray:
    """Brightness `darkest` up to a distance `low` from a seam, 1 from `high` on."""
    return darkest + (1 - darkest) * _ramp(distance, low, high)


def _turns(points: np.ndarray) -> np.ndarray:
    """Angle about the z axis, in turns, in [-0.5, 0.5]: (3, N) -> (N,)."""
    return np.arctan2(points[1], points[0]) / np.float32(2 * math.pi)


def _face_coordinates(points: np.ndarray, half_size: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where points (3, N) on a box lie on their face: across and up it in [-1, 1], and its number 0..5, (N,) each."""
    relative = points / np.asarray(half_size, np.float32)[:, None]
    axis = np.abs(relative).argmax(axis=0)
    across = np.where(axis == 0, relative[1], relative[0])
    up = np.where(axis == 2, relative[1], relative[2])
    return across, up, axis * 2 + (np.take_along_axis(relative, axis[None], axis=0)[0] > 0)


# ------------------------------------------------------------------------------ balls: points in units of the radius


def beach_ball(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Swirling segments of six colours that meet at two cream caps."""
    wobble = noise.fractal(points * 2.5) - 0.5
    segment = (_turns(points) + 0.16 * points[2] + 0.10 * wobble) * 12
    base = _pick(palette("#e8502f", "#f6c445", "#1f8a8c", "#f4efe2", "#27407f", "#f08a24"), _cell(segment))
    base = base * _groove(_seam(segment), 0.03, 0.10, darkest=0.45)
    cap = _ramp(np.abs(points[2]) + 0.04 * wobble, 0.90, 0.92)
    return blend(base, palette("#f7ecd0"), cap) * (0.88 + 0.24 * noise(points * 9))


def globe_checker(points: np.ndarray, noise: ValueNoise, colours: tuple[str, str], squares: int) -> np.ndarray:
    """A checkerboard of two colours wrapped around a ball, in `squares` pairs of strips from pole to pole."""
    longitude = _cell(_turns(points) * 2 * squares)
    latitude = _cell(np.arcsin(np.clip(points[2], -1, 1)) / np.float32(math.pi) * 2 * squares)
    return _pick(palette(*colours), longitude + latitude) * (0.85 + 0.3 * noise(points * 5))


def planet(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Turbulent bands along the latitudes, like a gas giant's."""
    colours = palette("#5b2a86", "#c13c7c", "#f2a0a8", "#fbe3c4", "#e2703a", "#7c3f9e", "#f7c6d0")
    height = points[2] * 4.5 + 2.2 * noise.fractal(points * np.array([[2.0], [2.0], [5.0]], np.float32), 3)
    band = _cell(height)
    return blend(_pick(colours, band), _pick(colours, band + 1), _ramp(height - band, 0.55, 1.0))


# ------------------------------------------------- boxes and columns: points in scene units from the shape's centre


def crate(points: np.ndarray, noise: ValueNoise, half_size: Sequence[float]) -> np.ndarray:
    """A wooden crate: ringed boards in a darker frame with nails, with a painted diamond on every face."""
    across, up, face = _face_coordinates(points, half_size)
    boards = (up + 1) * 2.5
    board = _cell(boards)
    shifted = points * np.float32(3) + noise.at_cells(board, face, face) * 5
    rings = np.sqrt(shifted[0] ** 2 + (shifted[1] * 0.6) ** 2 + (shifted[2] * 1.7) ** 2)
    grain = np.sin((rings + 0.8 * noise.fractal(points * 5)) * 9) * 0.5 + 0.5
    wood = blend(palette("#b9722f"), palette("#e9b468"), grain) * (0.8 + 0.35 * noise.at_cells(board, face, board))
    wood = wood * _groove(_seam(boards), 0.02, 0.09, darkest=0.35)
    reach = np.abs(across) + np.abs(up)
    paint = palette("#2b6cb0", "#d7263d", "#2f9e5b")[:, face // 2] * (0.75 + 0.4 * grain)
    wood = blend(wood, paint, (reach < 0.52) & (reach > 0.28))
    edge = np.maximum(np.abs(across), np.abs(up))
    nail = (np.abs(np.abs(across) - 0.9) < 0.035) & (np.abs(np.abs(up) - 0.9) < 0.035)
    frame = np.where(nail, palette("#e3ddd2"), blend(palette("#6d3a17"), palette("#93552a"), grain))
    return np.where(edge > 0.8, frame * _groove(np.abs(edge - 0.8), 0.0, 0.04, darkest=0.5), wood)


def patchwork(points: np.ndarray, noise: ValueNoise, half_size: Sequence[float], patches: int) -> np.ndarray:
    """Every face of a box sewn from `patches` x `patches` squares of random colours, some of them striped."""
    colours = palette("#e63946", "#f4a261", "#ffd166", "#2a9d8f", "#118ab2", "#6a4c93", "#f1faee", "#ef7fa8")
    across, up, face = _face_coordinates(points, half_size)
    x, y = (across + 1) * (patches / 2), (up + 1) * (patches / 2)
    column, row = _cell(x), _cell(y)
    base, other = (_pick(colours, _cell(noise.at_cells(column + shift, row, face) * 8)) for shift in (0, 11))
    stripes = (np.sin((x + y) * (2 * math.pi * 1.5)) > 0.2) & (noise.at_cells(column, row + 9, face) > 0.55)
    base = np.where(stripes, other, base) * _groove(np.minimum(_seam(x), _seam(y)), 0.02, 0.08, darkest=0.4)
    return base * (0.85 + 0.3 * noise(points * 8))


def marble(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Cream stone with blue-grey and rust veins."""
    warp = noise.fractal(points * 2.2, 3) - 0.5
    vein = np.abs(np.sin(points[0] * 3 + points[1] * 2 + points[2] * 2.6 + warp * 11))
    rust = np.abs(np.sin(points[0] * 2 - points[2] * 1.7 + warp * 8 + 1.3))
    stone = blend(palette("#efe6d5"), palette("#d9c8ad"), noise(points * 3.1))
    stone = blend(palette("#4a6485"), stone, _ramp(vein, 0.0, 0.38))
    return blend(palette("#c06a3f"), stone, _ramp(rust, 0.0, 0.13))


def barber_pole(points: np.ndarray, noise: ValueNoise, turns_per_unit: float) -> np.ndarray:
    """Helical stripes that climb a column."""
    climb = (_turns(points) * 2 + points[2] * turns_per_unit) * 2
    base = _pick(palette("#d62839", "#fbf3e4", "#f2b632", "#14746f"), _cell(climb))
    return base * _groove(_seam(climb), 0.02, 0.07, darkest=0.55) * (0.86 + 0.28 * noise.fractal(points * 6))


def drum(points: np.ndarray, noise: ValueNoise, half_height: float) -> np.ndarray:
    """Zigzag bands around the side of a cylinder, target rings on its lid."""
    turn = _turns(points) * 12
    zigzag = np.abs(turn - np.floor(turn) - 0.5) * 0.16
    side = _cell((points[2] + zigzag) / (half_height * 0.32))
    lid = _cell(np.hypot(points[0], points[1]) * 14)
    band = np.where(np.abs(points[2]) > half_height * 0.999, lid, side)
    base = _pick(palette("#0f4c5c", "#fb8b24", "#f6e7cb", "#9a031e", "#5fa8a0"), band)
    return base * (0.84 + 0.32 * noise.fractal(points * 9))


def mosaic(points: np.ndarray, noise: ValueNoise, radius: float) -> np.ndarray:
    """Rings of small coloured tiles about the z axis, up to `radius`."""
    colours = palette("#e07a5f", "#3d5a80", "#f2cc8f", "#81b29a", "#f4f1de", "#b56576")
    rings = np.hypot(points[0], points[1]) / np.float32(radius * 1.02) * 6
    ring = _cell(rings)
    turn = _turns(points) * (6 * (ring + 1)) + 0.5 * (ring & 1)
    base = _pick(colours, _cell(noise.at_cells(ring, _cell(turn), ring * 0) * 6))
    gap = np.minimum(_seam(rings), _seam(turn))
    return base * _groove(gap, 0.03, 0.09, darkest=0.45) * (0.86 + 0.28 * noise(points * 12))


# ------------------------------------------------ floors and walls: points in scene units from the shape's centre


def floor_boards(points: np.ndarray, noise: ValueNoise) -> np.ndarray:
    """Boards along y, with grain and dark joints."""
    x = points[0] / 0.42
    column = _cell(x)
    y = points[1] / 1.7 + noise.at_cells(column, column * 0, column * 0) * 2
    row = _cell(y)
    tone = noise.at_cells(column, row, row)
    grain = noise.fractal(np.stack([points[0] * 11, points[1] * 1.1, tone * 40]))
    base = _pick(palette("#a8602c", "#c98442", "#8f4e2a", "#b5763c", "#d49a57"), _cell(tone * 5))
    joint = np.minimum(_seam(x) * 0.42, _seam(y) * 1.7)
    return base * (0.68 + 0.6 * grain) * _groove(joint, 0.006, 0.022, darkest=0.35)


def rug_on_boards(
    points: np.ndarray, noise: ValueNoise, centre: Sequence[float], half_size: Sequence[float]
) -> np.ndarray:
    """A woven rug lying on floor boards."""
    u, v = points[0] - np.float32(centre[0]), points[1] - np.float32(centre[1])
    is_rug = (np.abs(u) < half_size[0]) & (np.abs(v) < half_size[1])
    colours = np.empty_like(points)
    colours[:, is_rug] = rug(u[is_rug], v[is_rug], noise, half_size)
    colours[:, ~is_rug] = floor_boards(points[:, ~is_rug], noise)
    return colours


def rug(u: np.ndarray, v: np.ndarray, noise: ValueNoise, half_size: Sequence[float]) -> np.ndarray:
    """A lattice of diamonds within a border of bands: offsets (N,) from the centre -> colours (3, N)."""
    margin = np.minimum(half_size[0] - np.abs(u), half_size[1] - np.abs(v))
    cell_x, cell_y = _cell(u / 0.5), _cell(v / 0.5)
    reach = np.abs(u / 0.5 - cell_x - 0.5) + np.abs(v / 0.5 - cell_y - 0.5)
    diamonds = palette("#e9b44c", "#2d7f86", "#f3e3c3", "#d1495b", "#1d3557")
    which = cell_x * 2 + cell_y * 3
    field = np.where(reach < 0.40, _pick(diamonds, which), palette("#8c1c2f"))
    field = np.where(reach < 0.18, _pick(diamonds, which + 2), field)
    band = _cell(margin / 0.085)
    border = palette("#f3e3c3", "#1d3557", "#e9b44c", "#1d3557", "#f3e3c3")[:, np.clip(band, 0, 4)]
    border = np.where((np.sin((u + v) * 26) > 0) & (band == 2), palette("#b23a48"), border)
    return np.where(margin < 0.425, border, field) * (0.80 + 0.4 * noise(np.stack([u * 30, v * 9, u * 0])))


def painted_bricks(points: np.ndarray, noise: ValueNoise, height_of_centre: float) -> np.ndarray:
    """A wall in the x-z plane: weathered blue and green bricks above a band of tiles and panels of slats.

    The wall's centre is `height_of_centre` above the floor.
    """
    x, z = points[0], points[2] + np.float32(height_of_centre)
    row = _cell(z / 0.24)
    along = x / 0.56 + 0.5 * (row & 1)
    column = _cell(along)
    tone = noise.at_cells(column, row, column * 0 + 3)
    bricks = _pick(palette("#2f5d8a", "#3f7f93", "#5a9a8c", "#27496d", "#86b09a", "#6c86b5"), _cell(tone * 6))
    bricks = bricks * (0.62 + 0.7 * noise.fractal(np.stack([x * 3.2, x * 0, z * 3.2]), 3))
    joint = np.minimum(_seam(along) * 0.56, _seam(z / 0.24) * 0.24)
    bricks = blend(palette("#d9d2bd"), bricks, _ramp(joint, 0.008, 0.026))

    tile_x, tile_z = x / 0.3, (z - 0.72) / 0.3
    reach = np.hypot(tile_x - np.floor(tile_x) - 0.5, tile_z - 0.5)
    tiles = np.where(reach < 0.34, _pick(palette("#f2c14e", "#d1495b"), _cell(tile_x)), palette("#f6ecd6"))
    tiles = np.where(reach < 0.16, palette("#1d4e6b"), tiles)
    slats = palette("#9c4a35") * (0.7 + 0.5 * noise.fractal(np.stack([x * 9, x * 0, z * 1.2])))
    slats = slats * _groove(_seam(x / 0.24), 0.03, 0.1, darkest=0.5)
    return np.where(z < 0.72, slats, np.where(z < 1.02, tiles, bricks))


def framed_picture(points: np.ndarray, noise: ValueNoise, half_size: Sequence[float]) -> np.ndarray:
    """A gilded frame around a picture of a low sun over layered hills, in the x-z plane."""
    u, v = points[0] / np.float32(half_size[0]), points[2] / np.float32(half_size[2])
    picture = blend(palette("#f9d976"), palette("#d8456b"), _ramp(v, -0.2, 0.9))
    distance = np.hypot((u - 0.25) * (half_size[0] / half_size[2]), v - 0.2)
    picture = blend(picture, palette("#fff4c9"), 0.6 * (np.sin(distance * 22) > 0.2) * (distance < 0.85))
    picture = np.where(distance < 0.27, palette("#ffef9f"), picture)
    for i, hill in enumerate(("#8e5aa8", "#4c6fb1", "#2f8f83", "#1f5c4a")):
        ridge = 0.02 - 0.24 * i + 0.13 * np.sin(u * (2.6 + i) + 1.9 * i) + 0.08 * np.sin(u * (7 - i) + i)
        furrows = 0.85 + 0.25 * np.sin((v - ridge) * 30 + u * 6)
        picture = np.where(v < ridge, palette(hill) * furrows, picture)
    edge = np.maximum(np.abs(u) * half_size[0] - half_size[0], np.abs(v) * half_size[2] - half_size[2])
    gilt = blend(palette("#8a5a16"), palette("#f4cf6a"), 0.5 + 0.5 * np.sin(edge * 70))
    return np.where(edge > -0.13, gilt * (0.85 + 0.3 * noise(points * 14)), picture)

"""Paints a style image, so that a scene can be stylised without looking for a painting first.

An expressionist landscape, in thick strokes that follow a swirling flow: a sky with whirls and a haloed sun, hills,
furrowed fields and a dark tree. The same size, seed and palette give the same picture.

    python data_scripts/make_style_image.py OUTPUT.png
    python data_scripts/make_style_image.py OUTPUT.png --size 768 --palette harvest --seed 3
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Optional, Sequence

import cv2
import numpy as np
import tyro
from _command_line import ScriptError, check_ranges, exit_status, parse, print_made

SUBPIXEL_BITS = 4
"""OpenCV draws lines with end points in units of 1 / 2^SUBPIXEL_BITS pixel."""
THICKEST_PAINT = 150
"""A thickness of 1 in the relief, which holds bytes because OpenCV draws smooth lines into nothing else."""


@dataclass(frozen=True)
class Palette:
    """Paints for every part of the picture, as '#rrggbb'."""

    sky: tuple[str, ...]
    """From the horizon up."""
    light: tuple[str, ...]
    """The sun, from its centre outwards."""
    hills: tuple[str, ...]
    """From the farthest to the nearest."""
    field: tuple[str, ...]
    """The furrows, in turn."""
    tree: tuple[str, ...]
    """Its flames, in turn."""
    ground: str
    """The canvas's first coat, which shows between strokes."""


PALETTES = {
    "night": Palette(
        sky=("#7fb5c8", "#3f7fc1", "#2456a6", "#1b3a86", "#12265c"),
        light=("#fff3b0", "#ffd23f", "#f9a825", "#bcd4a0", "#6ea8c9"),
        hills=("#3b6ea5", "#27558c", "#1d3f72"),
        field=("#d9a521", "#3f7d4e", "#e8c547", "#235f54", "#9bb04a"),
        tree=("#0b1f2a", "#16423c", "#2c2a1e", "#215247"),
        ground="#10204a",
    ),
    "harvest": Palette(
        sky=("#ffd98e", "#f7a23b", "#e8642c", "#c4342b", "#8e1f3b"),
        light=("#fffbe0", "#ffe66d", "#ffc233", "#ff8c2e", "#e3502a"),
        hills=("#8a4f7d", "#5f3b73", "#34416f"),
        field=("#f2b632", "#b8541a", "#f6d76b", "#7a3b1d", "#e07b28"),
        tree=("#14342f", "#1f5a4c", "#27303f", "#3b7a57"),
        ground="#5a1f1f",
    ),
    "garden": Palette(
        sky=("#f9c6d3", "#e78fb3", "#b06ab3", "#7b4fa3", "#4b3a8c"),
        light=("#fffdf0", "#fff07c", "#ffd166", "#ff9eb5", "#d97fc0"),
        hills=("#3fa7a0", "#1f8a84", "#126a72"),
        field=("#8ccf4d", "#e64980", "#2f9e44", "#ffd43b", "#1b7f5c"),
        tree=("#123d3a", "#0f5c4a", "#3a1f5d", "#2d7d46"),
        ground="#3c2a63",
    ),
    "sea": Palette(
        sky=("#fdf0d5", "#9ad1d4", "#4fb3bf", "#1f8a9e", "#0f5c78"),
        light=("#ffffff", "#ffe8c2", "#ffb997", "#f67e7d", "#c7a0a8"),
        hills=("#2b7a9b", "#1c5f82", "#123f63"),
        field=("#2fc4b2", "#0b3c5d", "#7fe0cf", "#176087", "#f5f1e3"),
        tree=("#3d1f2b", "#7a2e3a", "#1f2a44", "#a63d40"),
        ground="#0b3048",
    ),
}


@dataclass(frozen=True)
class Layer:
    """One pass over the canvas. Lengths are shares of the picture's height."""

    spacing: float
    """Distance between strokes."""
    width: float
    """Of a stroke."""
    length: float
    """Of a stroke."""
    bristles: int
    """Lines in a stroke."""
    contrast: float
    """How far tones stray from the paint's colour, in [0, 1]."""


LAYERS = (
    Layer(spacing=0.030, width=0.048, length=0.15, bristles=12, contrast=0.12),
    Layer(spacing=0.021, width=0.024, length=0.11, bristles=7, contrast=0.22),
    Layer(spacing=0.018, width=0.013, length=0.08, bristles=4, contrast=0.30),
)


def paint(size: int = 512, seed: int = 0, palette: str = "night") -> np.ndarray:
    """Paints the picture, in layers of ever finer strokes.

    A stroke is a short curve along the flow, and consists of bristles: thin parallel lines of slightly different tone
    that also leave a relief of paint. Light from the upper left on that relief makes the strokes stand out.

    Args:
        size: Rows; there are 5 columns for every 4 rows.
        seed: Which arrangement of whirls, hills and strokes.
        palette: A key of `PALETTES`.

    Returns:
        (size, round(1.25 * size), 3) uint8, red first.

    Raises:
        ValueError: If `size` is under 64 or the palette is unknown.
    """
    if size < 64:
        raise ValueError(f"size is {size}, but strokes need a canvas of at least 64 rows.")
    if palette not in PALETTES:
        raise ValueError(f"There is no palette {palette!r}; choose one of {', '.join(PALETTES)}.")
    rng = np.random.default_rng(seed)
    height, width = size, round(1.25 * size)
    colours, flow = compose(height, width, rng, PALETTES[palette])
    canvas = np.full((height, width, 3), _paints([PALETTES[palette].ground])[0], np.uint8)
    relief = np.zeros((height, width), np.uint8)
    for layer in LAYERS:
        _paint_layer(canvas, relief, colours, flow, layer, rng)
    lit = canvas * _light_on_relief(relief, size)[..., None]
    return np.rint(np.clip(lit, 0, 255)).astype(np.uint8)


# ---------------------------------------------------------------------------------------------------- composition


def compose(height: int, width: int, rng: np.random.Generator, palette: Palette) -> tuple[np.ndarray, np.ndarray]:
    """What to paint where, and which way the brush goes.

    Args:
        height, width: Of the canvas, in pixels.
        rng: Decides on the arrangement; used up.
        palette: The colours.

    Returns:
        Colours (height, width, 3) float32 in [0, 255], and unit vectors (height, width, 2), x first, y down.
    """
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) / height
    sun = (rng.uniform(0.85, 1.05), rng.uniform(0.17, 0.25))
    whirls = [
        (rng.uniform(0.42, 0.58), rng.uniform(0.28, 0.36), 0.17, 1.0),
        (rng.uniform(0.72, 0.84), rng.uniform(0.46, 0.52), 0.10, -1.0),
        (rng.uniform(0.12, 0.22), rng.uniform(0.12, 0.2), 0.12, -1.0),
    ]
    colours, flow = _sky(x, y, whirls, palette, rng)
    _add_sun(colours, flow, x, y, sun, palette)
    _add_land(colours, flow, x, y, palette, rng)
    _add_tree(colours, flow, x, y, rng.uniform(0.16, 0.24), palette)
    flow /= np.maximum(np.linalg.norm(flow, axis=-1, keepdims=True), 1e-6)
    return colours, flow


def _sky(
    x: np.ndarray, y: np.ndarray, whirls: Sequence[tuple[float, ...]], palette: Palette, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Colours and flow of a banded sky, dragged around whirls (x, y, radius, 1 clockwise or -1 against it)."""
    phase = rng.uniform(0, 2 * math.pi, 2)
    flow = np.stack([np.ones_like(x), 0.45 * np.cos(5 * x + phase[0]) + 0.2 * np.sin(9 * y + phase[1])], axis=-1)
    tone = (0.62 - y) / 0.62 + 0.12 * np.sin(4.2 * x + phase[0]) + 0.07 * np.sin(13 * y + 3 * x)
    for centre_x, centre_y, radius, sense in whirls:
        dx, dy = x - centre_x, y - centre_y
        distance = np.hypot(dx, dy)
        pull = np.exp(-((distance / radius) ** 2))
        _turn_flow(flow, dx, dy, pull, 2.2, sense)
        spiral = np.sin(np.arctan2(dy, dx) * 2 * sense + distance / radius * 8)
        tone = tone * (1 - 0.55 * pull) + pull * (0.15 + 0.45 * spiral)
    steps = np.clip(tone * len(palette.sky), 0, len(palette.sky) - 1).astype(int)
    return _paints(palette.sky)[steps], flow


def _add_sun(
    colours: np.ndarray, flow: np.ndarray, x: np.ndarray, y: np.ndarray, sun: tuple[float, float], palette: Palette
) -> None:
    """A sun with halos, which the flow goes around; in place."""
    dx, dy = x - sun[0], y - sun[1]
    distance = np.hypot(dx, dy)
    rings = np.clip(distance / 0.045, 0, len(palette.light) - 1).astype(int)
    is_halo = (distance < 0.14) | ((distance < 0.27) & (np.sin(distance * 90) > 0.1))
    colours[is_halo] = _paints(palette.light)[rings[is_halo]]
    _turn_flow(flow, dx, dy, np.clip(1.6 - distance / 0.19, 0, 1), 2.0)


def _turn_flow(
    flow: np.ndarray, dx: np.ndarray, dy: np.ndarray, pull: np.ndarray, speed: float, sense: float = 1.0
) -> None:
    """Bends the flow around the point from which pixels are (dx, dy) away, by a share `pull` in [0, 1]; in place."""
    around = np.stack([-dy, dx], axis=-1) * sense / np.maximum(np.hypot(dx, dy), 1e-4)[..., None]
    flow[:] = flow * (1 - pull[..., None]) + speed * pull[..., None] * around


def _add_land(
    colours: np.ndarray, flow: np.ndarray, x: np.ndarray, y: np.ndarray, palette: Palette, rng: np.random.Generator
) -> None:
    """Hills one before the other, then fields whose furrows run to a vanishing point; in place."""
    hills = _paints(palette.hills)
    for i, hill in enumerate(hills):
        phase = rng.uniform(0, 2 * math.pi, 2)
        ridge = 0.58 + 0.055 * i
        ridge = ridge + (0.05 - 0.01 * i) * np.sin(3.1 * x + phase[0]) + 0.02 * np.sin(7 * x + phase[1])
        mask = y > ridge
        shade = 1 + 0.28 * np.sin((y - ridge) * 75 + 4 * x)
        colours[mask] = (hill * shade[..., None])[mask]
        slope = np.gradient(ridge, axis=1) * y.shape[0]
        flow[mask] = np.stack([np.ones_like(x), slope], axis=-1)[mask]

    phase = rng.uniform(0, 2 * math.pi)
    edge = 0.745 + 0.02 * np.sin(4 * x + phase)
    dx, dy = x - 0.8, y - 0.55
    furrow = np.arctan2(dx, dy) * 11 + 0.5 * np.sin(9 * y + phase)
    paints = _paints(palette.field)
    mask = y > edge
    colours[mask] = paints[np.floor(furrow).astype(int) % len(paints)][mask]
    flow[mask] = np.stack([dx + 0.06 * np.sin(20 * y), dy], axis=-1)[mask]


def _add_tree(
    colours: np.ndarray, flow: np.ndarray, x: np.ndarray, y: np.ndarray, root: float, palette: Palette
) -> None:
    """A flame-shaped tree, from the lower edge up into the sky; in place."""
    up = np.clip((1.02 - y) / 0.92, 0, 1)
    lean = root + 0.03 * np.sin(6.5 * up) * up
    half_width = 0.15 * np.sqrt(np.clip(1 - up, 0, 1)) * (0.75 + 0.35 * np.sin(4.5 * up + 0.6))
    half_width = half_width * (1 + 0.16 * np.sin(34 * up + 16 * x))
    mask = np.abs(x - lean) < half_width
    paints = _paints(palette.tree)
    tongue = np.floor((x - lean) * 34 + 1.3 * np.sin(16 * up)).astype(int) % len(paints)
    colours[mask] = paints[tongue][mask]
    flow[mask] = np.stack([0.42 * np.sin(16 * up + 9 * x), -np.ones_like(x)], axis=-1)[mask]


# -------------------------------------------------------------------------------------------------------- brushes


def _paint_layer(
    canvas: np.ndarray,
    relief: np.ndarray,
    colours: np.ndarray,
    flow: np.ndarray,
    layer: Layer,
    rng: np.random.Generator,
) -> None:
    """Covers the canvas and its relief with one layer of strokes, in random order; in place."""
    height, width = relief.shape
    spacing = layer.spacing * height
    rows, columns = np.mgrid[0 : height + spacing : spacing, 0 : width + spacing : spacing]
    starts = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    starts = rng.permutation(starts + rng.uniform(-0.6, 0.6, starts.shape) * spacing)
    lengths = layer.length * height * rng.uniform(0.6, 1.25, len(starts))
    paths = follow_flow(flow, starts, lengths)

    middle = _nearest_pixels(paths[:, paths.shape[1] // 2], height, width)
    tones = layer.contrast * np.clip(rng.normal(0, 1, (len(starts), 1)), -1.6, 1.6)
    tints = 0.35 * layer.contrast * np.clip(rng.normal(0, 1, (len(starts), 3)), -1.6, 1.6)
    stroke_colours = colours[middle] * (1 + tones + tints)
    _draw_strokes(canvas, relief, paths, stroke_colours, layer, rng)


def follow_flow(flow: np.ndarray, starts: np.ndarray, lengths: np.ndarray, steps: int = 9) -> np.ndarray:
    """Curves along a flow, half of each before its start and half after.

    Args:
        flow: Unit vectors (height, width, 2), x first.
        starts: Pixel positions (N, 2), x first; those outside use the flow at the nearest edge.
        lengths: Of the curves in pixels, (N,).
        steps: Straight pieces on each side.

    Returns:
        Pixel positions (N, 2 * steps + 1, 2).
    """
    step = (lengths / (2 * steps))[:, None]
    halves = []
    for sense in (-1, 1):
        position, half = starts, []
        for _ in range(steps):
            position = position + sense * step * flow[_nearest_pixels(position, *flow.shape[:2])]
            half.append(position)
        halves.append(half)
    return np.stack([*halves[0][::-1], starts, *halves[1]], axis=1)


def _nearest_pixels(positions: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column numbers of the pixels at positions (N, 2), x first, held within the picture."""
    columns = np.clip(np.rint(positions[:, 0]), 0, width - 1).astype(int)
    rows = np.clip(np.rint(positions[:, 1]), 0, height - 1).astype(int)
    return rows, columns


def _draw_strokes(
    canvas: np.ndarray,
    relief: np.ndarray,
    paths: np.ndarray,
    colours: np.ndarray,
    layer: Layer,
    rng: np.random.Generator,
) -> None:
    """Draws strokes along paths (N, P, 2) in colours (N, 3), one after the other, each bristle by bristle; in place.

    The paint is thick at a stroke's edges, where the brush pushes it, and each bristle lifts off at its own point.
    """
    count, bristles = len(paths), layer.bristles
    tangents = np.gradient(paths, axis=1)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=-1, keepdims=True), 1e-6)
    normals = np.stack([-tangents[..., 1], tangents[..., 0]], axis=-1)
    widths = layer.width * canvas.shape[0] * rng.uniform(0.75, 1.2, count)
    offsets = (np.arange(bristles) + 0.5) / bristles - 0.5
    shifts = (widths[:, None] * offsets)[:, :, None, None] * normals[:, None]
    lines = np.rint((paths[:, None] + shifts) * 2**SUBPIXEL_BITS).astype(np.int32)

    tones = rng.normal(0, 1, (count, bristles))
    shades = np.clip(colours[:, None] * (1 + 0.07 * tones[..., None]), 0, 255).tolist()
    thickness = rng.uniform(0.3, 0.7, (count, 1)) + 0.9 * np.abs(offsets) + 0.12 * tones
    heights = np.clip(THICKEST_PAINT * thickness, 0, 255).tolist()
    line_widths = np.maximum(np.rint(1.5 * widths / bristles), 1).astype(int).tolist()
    skipped = rng.integers(0, 3, (count, bristles, 2)).tolist()
    order = rng.permuted(np.tile(np.arange(bristles), (count, 1)), axis=1).tolist()
    for stroke in range(count):
        for i in order[stroke]:
            first, last = skipped[stroke][i]
            line = [lines[stroke, i, first : lines.shape[2] - last]]
            style = (line_widths[stroke], cv2.LINE_AA, SUBPIXEL_BITS)
            cv2.polylines(canvas, line, False, shades[stroke][i], *style)
            cv2.polylines(relief, line, False, heights[stroke][i], *style)


def _light_on_relief(relief: np.ndarray, size: int) -> np.ndarray:
    """How bright paint of some thickness is under light from the upper left: (height, width), about 1."""
    thickness = relief.astype(np.float32) / THICKEST_PAINT
    smooth = cv2.GaussianBlur(thickness, (0, 0), max(0.6, size / 700))
    slope = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) + cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    return 1 + 0.30 * np.tanh(slope * 0.9)


def _paints(hex_codes: Sequence[str]) -> np.ndarray:
    """K codes '#rrggbb' -> (K, 3) float32 in [0, 255]."""
    return np.array([list(bytes.fromhex(code[1:])) for code in hex_codes], np.float32)


# ---------------------------------------------------------------------------------------------------- command line


@dataclass(frozen=True)
class Options:
    """The command line; the docstrings are its help."""

    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUTPUT")]
    """Picture to write, .png or .jpg."""
    size: int = 512
    """Rows of the picture, at least 64; there are 5 columns for every 4 rows."""
    seed: int = 0
    """Which arrangement of whirls, hills and strokes."""
    palette: tyro.extras.literal_type_from_choices(PALETTES) = "night"
    """Which paints."""

    force: bool = False
    """Replace OUTPUT if it is there already."""

    def __post_init__(self) -> None:
        check_ranges(self, seed=(0, math.inf))
        if self.output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise ValueError(f"OUTPUT is {self.output}, but has to end in .png or .jpg")


def write_picture(options: Options) -> None:
    """Paints a picture and writes it.

    Raises:
        ScriptError: It is too small to be painted, or cannot be written.
    """
    if options.output.exists() and not options.force:
        raise ScriptError(f"{options.output} exists already; add --force to replace it, or choose another OUTPUT.")
    try:
        picture = paint(options.size, options.seed, options.palette)
        options.output.parent.mkdir(parents=True, exist_ok=True)
        _, encoded = cv2.imencode(options.output.suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        options.output.write_bytes(encoded.tobytes())
    except ValueError as error:
        raise ScriptError(str(error)) from error
    except OSError as error:
        raise ScriptError(
            f"Cannot write {options.output}: {error.strerror or error}; choose another OUTPUT."
        ) from error
    command = ["ns-train", "hier-style", "--style-image", options.output, "--data", "SCENE", "llff-data"]
    print_made(options.output, command)


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The command line; `arguments` default to the process's own. Returns the exit status."""
    options = parse(Options, __doc__, arguments)
    return exit_status(lambda: write_picture(options))


if __name__ == "__main__":
    sys.exit(main())

"""The sample scenes: a still life to be seen from the front, and objects to be seen from all around."""

import math
from dataclasses import dataclass
from functools import partial

from sample_scene import textures
from sample_scene.shapes import Box, Cylinder, Shape, Sphere, Vector


@dataclass(frozen=True)
class Scene:
    """Shapes under one sun. Distances are in scene units."""

    shapes: tuple[Shape, ...]
    """What there is to see, and what casts shadows."""
    noise: textures.ValueNoise
    """Where the textures' irregularities come from."""
    sun: Vector
    """Direction towards the sun's centre; any length."""
    sun_spread: float = 0.10
    """Radius of the sun's disc over its distance: how soft shadows are."""
    sky_light: float = 0.66
    """Share of a surface's colour that it shows in full shadow when it faces the sky."""
    sun_light: float = 0.60
    """Share of a surface's colour that the sun adds where it shines straight on it."""
    backdrop: tuple[Shape, ...] = ()
    """Floors and walls: seen like the shapes, but they cast no shadow."""
    shine: float = 0.0
    """Brightness of a lamp's reflection where it is seen straight: what makes colour depend on the viewpoint."""
    lamp: Vector = (0.0, 0.0, 1.0)
    """Direction towards that lamp, which does nothing else; any length."""
    polish: float = 40.0
    """Exponent of that reflection: how narrow it is."""
    haze: float = 0.0
    """Extinction per scene unit of a mist that fills the scene: at distance d, exp(-haze d) of a colour remains."""
    haze_color: Vector = (0.75, 0.78, 0.82)
    """What the mist shows instead."""


YELLOW_GREEN, RED_CREAM = ("#f2b632", "#14746f"), ("#d7263d", "#fbf3e4")


def still_life(seed: int = 0, shine: float = 0.0, haze: float = 0.0) -> Scene:
    """The forward-facing scene: toys in front of a wall, to be seen from around (0, 0, 1.25) along +y.

    Args:
        seed: Which noise the textures show; the shapes stay where they are.
        shine, haze: See `Scene`.
    """
    crate_half, cube_half, picture_half = (0.52, 0.52, 0.52), (0.3, 0.3, 0.3), (0.95, 0.05, 0.68)
    backdrop = (
        Box((0, 3.5, -0.05), (9, 6, 0.05), partial(textures.rug_on_boards, centre=(0.0, 0.1), half_size=(2.35, 1.45))),
        Box((0, 6.3, 2), (9, 0.1, 4), partial(textures.painted_bricks, height_of_centre=2)),
    )
    shapes = (
        Box((-1.05, 6.16, 2.12), picture_half, partial(textures.framed_picture, half_size=picture_half)),
        Sphere((-0.78, 3.75, 0.72), 0.72, textures.beach_ball),
        Box((1.12, 3.7, 0.52), crate_half, partial(textures.crate, half_size=crate_half), yaw=0.5),
        Sphere((1.05, 3.72, 1.34), 0.30, textures.planet),
        Cylinder((0.38, 5.15, 1.2), 0.36, 1.05, textures.marble),
        Box((0.38, 5.15, 0.075), (0.52, 0.52, 0.075), textures.marble),
        Box((0.38, 5.15, 2.33), (0.48, 0.48, 0.08), textures.marble),
        Cylinder((2.1, 5.3, 1.05), 0.25, 1.05, partial(textures.barber_pole, turns_per_unit=1.1)),
        Sphere((2.1, 5.3, 2.38), 0.29, partial(textures.globe_checker, colours=YELLOW_GREEN, squares=4)),
        Box((-1.28, 2.75, 0.3), cube_half, partial(textures.patchwork, half_size=cube_half, patches=3), yaw=-0.35),
        Sphere((0.08, 2.68, 0.25), 0.25, partial(textures.globe_checker, colours=RED_CREAM, squares=5)),
        Cylinder((-2.2, 4.9, 0.55), 0.5, 0.55, partial(textures.drum, half_height=0.55)),
        Cylinder((1.12, 2.5, 0.17), 0.26, 0.17, partial(textures.drum, half_height=0.17)),
    )
    sun, lamp = (-0.62, -0.75, 1.0), (-0.1, -1.0, 0.1)
    return Scene(shapes, textures.ValueNoise(seed), sun=sun, backdrop=backdrop, shine=shine, lamp=lamp, haze=haze)


def objects_on_a_plinth(seed: int = 0, shine: float = 0.0, landscape: bool = False) -> Scene:
    """The all-around scene: toys on a round plinth within [-1, 1]^3.

    Args:
        seed: Which noise the textures show; the shapes stay where they are.
        shine: See `Scene`.
        landscape: Whether they stand on a ground, with walls and balls far behind them; else there is nothing.
    """
    crate_half, cube_half = (0.27, 0.27, 0.27), (0.15, 0.15, 0.15)
    shapes = (
        Cylinder((0, 0, -0.55), 0.92, 0.06, partial(textures.mosaic, radius=0.92)),
        Sphere((-0.36, -0.28, -0.11), 0.38, textures.beach_ball),
        Box((0.42, -0.22, -0.22), crate_half, partial(textures.crate, half_size=crate_half), yaw=0.5),
        Sphere((0.42, -0.22, 0.22), 0.17, textures.planet),
        Cylinder((0.1, 0.46, -0.02), 0.17, 0.47, partial(textures.barber_pole, turns_per_unit=2.2)),
        Sphere((0.1, 0.46, 0.62), 0.17, partial(textures.globe_checker, colours=YELLOW_GREEN, squares=4)),
        Box((-0.45, 0.42, -0.34), cube_half, partial(textures.patchwork, half_size=cube_half, patches=3), yaw=-0.35),
        Cylinder((0.02, -0.68, -0.40), 0.14, 0.09, partial(textures.drum, half_height=0.09)),
        Sphere((0.62, 0.34, -0.36), 0.13, partial(textures.globe_checker, colours=RED_CREAM, squares=5)),
    )
    backdrop = far_away() if landscape else ()
    sun = (-0.5, -0.7, 1.2)
    return Scene(
        shapes, textures.ValueNoise(seed), sun=sun, sky_light=0.7, sun_light=0.56, backdrop=backdrop, shine=shine
    )


def far_away() -> tuple[Shape, ...]:
    """A ground 0.61 below the origin, walls 14 away from it on all sides, and eight balls half way."""
    walls = []
    for side in (14, -14):
        walls.append(Box((0, side, 5), (15, 0.1, 6), lambda p, n: textures.painted_bricks(p * 0.35, n, 2)))
        walls.append(Box((side, 0, 5), (0.1, 15, 6), lambda p, n: textures.painted_bricks(p[[1, 0, 2]] * 0.35, n, 2)))
    balls = []
    for i in range(8):
        angle, radius = 2 * math.pi * i / 8, 1.0 + 0.25 * (i % 3)
        centre = (7 * math.cos(angle), 7 * math.sin(angle), radius - 0.61)
        balls.append(Sphere(centre, radius, (textures.beach_ball, textures.planet)[i % 2]))
    return (Box((0, 0, -0.66), (15, 15, 0.05), lambda p, n: textures.floor_boards(p * 0.5, n)), *walls, *balls)

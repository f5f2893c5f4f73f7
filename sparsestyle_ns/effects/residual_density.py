"""The density that stage 2 adds to the coarse one (Eq. 3): on as in the paper; off, stage 2 learns colours only."""

from sparsestyle_ns.effects.base import Effect, Measurement
from sparsestyle_ns.effects.empty_space import opacities
from sparsestyle_ns.effects.scene import Scene

MAX_ALPHA = 0.5
"""Opacity over a cell's side from which on a point is a surface or inside of something."""
MIN_HAZE = 0.1
"""Share of haze, in what isn't empty, from which on the coarse geometry isn't trusted."""


def measure_residual_density(scene: Scene) -> Measurement:
    """The share, in the space that isn't empty, of haze: neither surface nor solid."""
    if scene.coarse_density is None:
        return Measurement(True, "assumed until there is a coarse field to measure", None, MIN_HAZE)
    alpha, empty = opacities(scene)
    haze = 0.0 if empty.all() else float((alpha[~empty] < MAX_ALPHA).float().mean())
    return Measurement(haze >= MIN_HAZE, "of the space that isn't empty is haze", haze, MIN_HAZE)


RESIDUAL_DENSITY = Effect("residual_density", measure_residual_density, source="coarse field")

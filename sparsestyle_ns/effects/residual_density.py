"""The density that stage 2 adds to the coarse one (Eq. 3)."""

from sparsestyle_ns.effects.base import Effect, Measurement
from sparsestyle_ns.effects.empty_space import opacities
from sparsestyle_ns.effects.scene import Scene

MAX_ALPHA = 0.5
"""Opacity over a cell's side from which on a point is a surface or inside of something."""
MIN_HAZE = 0.1
"""Share of what is seen as haze from which on the coarse geometry isn't trusted."""


class ResidualDensity(Effect):
    """Whether stage 2 changes the geometry, as in the paper; off, it learns colours only."""

    name = "residual_density"
    help = "Residual density in stage 2, as in the paper; off where the coarse geometry can be trusted."
    source = "coarse field"

    def measure(self, scene: Scene) -> Measurement:
        """See `Effect.measure`; the share of the space that isn't empty in which there is haze, not a surface."""
        if scene.coarse_density is None:
            return Measurement(True, "assumed until there is a coarse field to measure", None, MIN_HAZE)
        alpha, empty = opacities(scene)
        haze = 0.0 if empty.all() else float((alpha[~empty] < MAX_ALPHA).float().mean())
        return Measurement(haze >= MIN_HAZE, "of what isn't empty is haze, neither surface nor solid", haze, MIN_HAZE)

"""What the coarse field's density tells: whether space can be skipped, and whether stage 2 adds to it.

Empty-space skipping: stage 1 puts its samples where something is, stage 2 skips the rest. Residual density (Eq. 3): on
as in the paper; off, stage 2 learns colours only.
"""

from typing import Tuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestyle_ns.effects.decisions import Measurement
from sparsestyle_ns.effects.scene import Scene

MIN_EMPTY = 0.1
"""Share of space that must be empty for looking it up to pay."""
CELLS = 64
"""Cells along a side of the cube, over one of which a point's opacity is taken."""
MIN_ALPHA, MAX_ALPHA = 0.03, 0.5
"""Opacities over a cell's side below which a point is empty, and from which on it is on or inside of something."""
MAX_MIST = 0.2
"""Optical depth that such points may have all along the cube's side. Many cells that are nearly empty can together hide
what is behind them; drafts of fern and lego have 0.05 and 0.01."""
MIN_HAZE = 0.5
"""Share of haze, in what isn't empty, from which on the coarse geometry isn't trusted. Surfaces have hazy
edges: fern has 0.12 and lego 0.42, and both are stylised as well without residual density."""
NUM_POINTS = 1 << 14
"""Points, always the same, at which the density is looked up."""


@torch.no_grad()
def opacities(scene: Scene) -> Tuple[Float[Tensor, "points"], Bool[Tensor, "points"]]:
    """1 − exp(−σ · cell side) of the coarse field at `NUM_POINTS` points of the cube, and which of them are empty.

    None count as empty in a mist: where skipping all of them would be visible.
    """
    points = 2.0 * torch.rand(NUM_POINTS, 3, generator=torch.Generator().manual_seed(0)) - 1.0
    depths = scene.coarse_density(points).float().cpu() * (2.0 / CELLS)
    alpha = -torch.expm1(-depths)
    empty = alpha < MIN_ALPHA
    mist = float(depths[empty].mean()) * CELLS if empty.any() else 0.0
    return alpha, empty & (mist <= MAX_MIST)


def measure_empty_space(scene: Scene) -> Measurement:
    """The share of space in which the coarse field is all but transparent."""
    if scene.coarse_density is None:
        return Measurement(True, "assumed until there is a coarse field to measure", None, MIN_EMPTY)
    empty = float(opacities(scene)[1].float().mean())
    return Measurement(empty >= MIN_EMPTY, "of space is empty", empty, MIN_EMPTY)


def measure_residual_density(scene: Scene) -> Measurement:
    """The share, in the space that isn't empty, of haze: neither surface nor solid."""
    if scene.coarse_density is None:
        return Measurement(True, "assumed until there is a coarse field to measure", None, MIN_HAZE)
    alpha, empty = opacities(scene)
    haze = 0.0 if empty.all() else float((alpha[~empty] < MAX_ALPHA).float().mean())
    return Measurement(haze >= MIN_HAZE, "of the space that isn't empty is haze", haze, MIN_HAZE)

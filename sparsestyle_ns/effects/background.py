"""The colour of rays that meet nothing: that behind transparent photos, or that of a border of one colour."""

from typing import Optional

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.effects.decisions import Decisions, Measurement
from sparsestyle_ns.effects.layouts import MIN_EMPTY_BORDER
from sparsestyle_ns.effects.scene import Scene


def measure_background(scene: Scene) -> Measurement:
    """The share of the photos' border that shows nothing, and the colour there."""
    color, on = scene.background_color, scene.empty_border >= MIN_EMPTY_BORDER
    reason = "of the photos' border is empty, too little to tell a background colour"
    if on:
        kind = "is transparent" if scene.transparent else "has one colour"
        reason = f"of the photos' border {kind}: RGB {', '.join(f'{value:.2f}' for value in color)}"
    return Measurement(on, reason, scene.empty_border, MIN_EMPTY_BORDER, {"color": color})


def background_color(effects: Decisions) -> Optional[Float[Tensor, "3"]]:
    """The RGB colour behind the scene, in [0, 1]; None where nothing is behind it."""
    decision = effects["background"]
    return torch.tensor(decision.parameters["color"]) if decision.on else None

"""A colour behind the scene."""

from typing import Any, Dict, List

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.effects.base import Effect, Measurement
from sparsestyle_ns.effects.layouts import MIN_EMPTY_BORDER
from sparsestyle_ns.effects.scene import Scene


class Background(Effect):
    """What rays that meet nothing show: the colour behind transparent photos, or that of a constant border."""

    name = "background"
    help = "Background colour: photos have transparency or a border of one colour."

    def measure(self, scene: Scene) -> Measurement:
        """See `Effect.measure`; the share of the photos' border that shows nothing."""
        found = {"value": scene.empty_border, "threshold": MIN_EMPTY_BORDER}
        color = scene.background_color
        words = f"RGB {', '.join(f'{value:.2f}' for value in color)}"
        found["parameters"] = {"color": color}
        if scene.empty_border < MIN_EMPTY_BORDER:
            return Measurement(False, "of the border is empty: photos show no background colour", **found)
        kind = "is transparent" if scene.transparent else "has one colour"
        return Measurement(True, f"of the border {kind}; {words}", **found)

    def build(self, parameters: Dict[str, List[float]], **needs: Any) -> Float[Tensor, "3"]:
        """See `Effect.build`; the colour."""
        return torch.tensor(parameters["color"])

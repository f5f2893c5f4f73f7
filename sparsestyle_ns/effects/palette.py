"""The painting's palette, given to the photos before stylising."""

from typing import Any, Dict, List, Tuple

from torch import Tensor

from sparsestyle_ns.effects.base import Effect, Measurement
from sparsestyle_ns.effects.scene import Scene, foreground_colors
from sparsestyle_ns.style.color import color_moments, gaussian_distance, palette_transform

MIN_DISTANCE = 8.0
"""2-Wasserstein distance between both palettes, in units of 1/255, from which on they differ."""


class Palette(Effect):
    """ARF's transfer of mean colour and covariance."""

    name = "palette"
    help = "Palette transfer: the painting's colours are not the photos'."
    source = "style image"

    def measure(self, scene: Scene) -> Measurement:
        """See `Effect.measure`; the distance between Gaussians with the moments of both palettes, in 1/255."""
        if scene.style_image is None:
            return Measurement(True, "assumed until there is a style image to measure", None, MIN_DISTANCE)
        photos = color_moments(foreground_colors(scene))
        style = color_moments(scene.style_image.flatten(1).T)
        distance = 255.0 * float(gaussian_distance(*photos, *style))
        return Measurement(distance >= MIN_DISTANCE, "of 255 between the palettes", distance, MIN_DISTANCE)

    def build(self, parameters: Dict[str, List[float]], **needs: Any) -> Tuple[Tensor, Tensor]:
        """See `Effect.build`; the map from the moments of `content` to those of `style`."""
        return palette_transform(*needs["content"], *needs["style"])

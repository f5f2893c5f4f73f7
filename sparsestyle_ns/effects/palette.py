"""The painting's palette, given to the photos before stylising and to the finished field: whether there is a need."""

import numpy as np
import torch

from sparsestyle_ns.effects.decisions import Measurement
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.style.color import color_moments, gaussian_distance

MIN_DISTANCE = 8.0
"""2-Wasserstein distance between both palettes, in units of 1/255, from which on they differ."""


def measure_palette(scene: Scene) -> Measurement:
    """The distance between Gaussians with the moments of both palettes, in 1/255."""
    if scene.style_image is None:
        return Measurement(True, "assumed until there is a style image to measure", None, MIN_DISTANCE)
    opaque = np.concatenate([photo[photo[..., 3] > 0.5][:, :3] for photo in scene.photos])
    photos, style = color_moments(torch.from_numpy(opaque)), color_moments(scene.style_image.flatten(1).T)
    distance = 255.0 * float(gaussian_distance(*photos, *style))
    return Measurement(distance >= MIN_DISTANCE, "of 255 between the two palettes", distance, MIN_DISTANCE)

"""How wide the strokes of a picture are."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torchvision.transforms.functional import gaussian_blur, rgb_to_grayscale

SHAPES = 24
"""What varies more slowly than over this part of the longer side is no stroke but a shape."""


@torch.no_grad()
def stroke_width(picture: Float[Tensor, "H W 3"]) -> float:
    """Half the wavelength, in pixels, of a picture's fine brightness: the mean by energy; 0 where there is none.

    A wave sin(2πx/w) has the variance (w/2π)² of its slope's, and waves add up: w/2 = π √(var L / var ∇L), with L what
    a Gaussian blur of `SHAPES` takes away. Stripes of w/2 bright and w/2 dark pixels have strokes of w/2.

    Example:
        >>> stripes = torch.sin(torch.arange(240) * math.pi / 6).expand(96, 240)
        >>> round(stroke_width(0.5 + 0.4 * stripes[..., None].expand(-1, -1, 3)))
        6
    """
    brightness = rgb_to_grayscale(picture.permute(2, 0, 1))[None]
    sigma = max(brightness.shape) / SHAPES
    reach = min(round(3 * sigma), min(brightness.shape[-2:]) - 1)
    fine = brightness - gaussian_blur(brightness, [2 * reach + 1] * 2, [sigma] * 2)
    slopes = fine.diff(dim=-1).square().mean() + fine.diff(dim=-2).square().mean()
    return math.pi * math.sqrt(float(fine.var(correction=0) / slopes)) if slopes > 0 else 0.0

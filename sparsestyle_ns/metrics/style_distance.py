"""How far pictures are from a painting, by distances that no iteration makes small, and how much of it they use."""

from typing import Dict, List, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.feature_maps import covered_rows, feature_rows
from sparsestyle_ns.core.sliced import random_directions, sliced_distance
from sparsestyle_ns.metrics.image import st_lpips_metric

NUM_DIRECTIONS = 64
"""Lines along which clouds are compared."""
BINS = 8
"""Of the cube of colours, along each side."""
LEAST_SPREAD = 1e-4
"""Variance of a painting's unit feature vectors that textures are measured by at least: one colour alone has none."""
LEAST_SHARE = 0.1
"""A bin's colours are used where the picture has at least this share of what the painting has there."""


class StyleDistance:
    """A painting, in [0, 1], that pictures are held against, on the CPU wherever they are.

    `color_distance` is the 2-Wasserstein distance of colours, sliced, in units of the colour range; `texture_distance`
    the same of AlexNet's unit feature vectors (ST-LPIPS' trunk), relative to the painting's own spread, the root of the
    mean square over five layers; it is left out without weights, or where a picture is tiny. `colors_used` is the share
    of the painting's pixels whose colours, in `BINS`³ bins, the picture has too.

    Args:
        painting: of the size that strokes have in pictures.
    """

    def __init__(self, painting: Float[Tensor, "3 H W"]) -> None:
        generator, painting = torch.Generator().manual_seed(0), painting.cpu()
        self.colors = feature_rows(painting[None])
        self.color_directions = random_directions(3, NUM_DIRECTIONS, generator)
        self.histogram = _histogram(self.colors)
        network = st_lpips_metric(tuple(painting.shape[-2:]))
        self.layers: List[Tensor] = [] if network is None else list(map(feature_rows, network.features(painting[None])))
        self.directions = [random_directions(each.shape[-1], NUM_DIRECTIONS, generator) for each in self.layers]

    @torch.no_grad()
    def figures(
        self, picture: Float[Tensor, "H W 3"], accumulation: Optional[Float[Tensor, "H W"]] = None
    ) -> Dict[str, float]:
        """The figures of a picture, in [0, 1], where its accumulation is above half; everywhere without any."""
        image = picture.cpu().clamp(0.0, 1.0).permute(2, 0, 1)[None]
        accumulation = None if accumulation is None else accumulation.cpu()
        colors = covered_rows(image, accumulation)
        color = sliced_distance(colors, self.colors, self.color_directions).sqrt()
        used = self.histogram[_histogram(colors) >= LEAST_SHARE * self.histogram].sum()
        figures = {"color_distance": float(color), "colors_used": float(used)}
        network = st_lpips_metric(tuple(picture.shape[:2]))
        if network is None or not self.layers:
            return figures
        squares = [
            sliced_distance(covered_rows(maps, accumulation), target, lines) / _spread(target)
            for maps, target, lines in zip(network.features(image), self.layers, self.directions, strict=True)
        ]
        return {**figures, "texture_distance": float(torch.stack(squares).mean().sqrt())}


def _spread(rows: Float[Tensor, "rows C"]) -> Float[Tensor, ""]:
    return rows.var(dim=0, correction=0).sum().clamp(min=LEAST_SPREAD)


def _histogram(colors: Float[Tensor, "pixels 3"]) -> Float[Tensor, "bins"]:
    places = (colors * BINS).long().clamp(0, BINS - 1) @ torch.tensor([BINS**2, BINS, 1])
    return torch.bincount(places, minlength=BINS**3) / len(colors)

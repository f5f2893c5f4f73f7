"""Gaussians where the rays of some cameras have their weight.

The scene's cube is cut into cells. One that rays have weight in gets a Gaussian: its mean and covariance are those of
the weight in it, in field coordinates, and the space's map carries them into the world, by its Jacobian: a cell of
normalised device coordinates is long far away. Its opacity is that of a ray that crosses the cell, 1 − exp(−Σ τ).
"""

import itertools
from dataclasses import dataclass
from typing import List, Sequence, Tuple

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.core.precision import autocast
from sparsestyle_ns.core.spaces import ForwardFacingSpace, Space
from sparsestyle_ns.core.volrend import optical_depth, packed_sum, packed_weights
from sparsestyle_ns.export.gaussians import Gaussians
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.mixing import STYLISED, Appearance, mixed
from sparsestyle_ns.rendering.render import over_background
from sparsestyle_ns.utils.progress import track

LEAST_WEIGHT = 1e-3
"""Samples with less weight don't count."""
HELD_WEIGHT = 0.995
"""Share of all weight that lies in cells with Gaussians; the rest is strewn over many cells."""
MOST_CELLS = 320
"""Cells along a side, at most; bounds the memory."""
FILLED = 0.9
"""Cells are made smaller until there are at least so many Gaussians, as a share of those that there may be."""
DEPTH_CELLS = 2.0
"""In forward-facing scenes cells are so many times as deep as they are wide: cameras hardly see their depth."""
CELL_SPREAD = 0.3
"""Standard deviation that a Gaussian has besides that of the weight in its cell, in cells; an even cell has 0.29."""
OPACITIES = (0.02, 0.98)
"""The least and the largest opacity of a Gaussian: from others a gradient hardly leads away."""


@dataclass
class SeenView:
    """What one camera sees, on the CPU: the exact picture, and the samples that it is made of.

    Attributes:
        depth: τ of each sample; infinite stretches are capped.
        rays: the sample's pixel, row by row.
    """

    camera: Cameras
    picture: Float[Tensor, "H W 3"]
    positions: Float[Tensor, "samples 3"]
    depth: Float[Tensor, "samples"]
    weights: Float[Tensor, "samples"]
    colors: Float[Tensor, "samples 3"]
    rays: Int[Tensor, "samples"]


@torch.no_grad()
def look_at(model: HierStyleModel, cameras: Sequence[Cameras], description: str) -> List[SeenView]:
    """The exact pictures of pinhole cameras, with their samples."""
    return [seen_view(model, camera) for camera in track(cameras, description)]


def seen_view(model: HierStyleModel, camera: Cameras) -> SeenView:
    """One camera's exact picture, with its samples."""
    bundle = camera.to(model.device).generate_rays(camera_indices=0, keep_shape=False).flatten()
    frozen = model.freeze(bundle.origins, bundle.directions, model.marching)
    samples, mix = frozen.samples, model.display.own.mix
    with autocast(model.device, model.config.precision):
        density, color = found = Appearance(*model.residual(frozen.location, frozen.feature, frozen.density))
        if mix != STYLISED:
            coarse = model.field.color(frozen.feature, bundle.directions[samples.ray_indices])
            density, color = mixed(Appearance(frozen.density, coarse), [found], mix)
    color = color.float()
    depth = optical_depth(density, samples.lengths)
    weights = packed_weights(depth, samples.ray_indices, frozen.num_rays)
    values = weights[:, None] * torch.cat([color, torch.ones_like(color[:, :1])], dim=-1)
    rgb, accumulation = packed_sum(values, samples.ray_indices, frozen.num_rays).split([3, 1], dim=-1)
    picture = over_background(rgb, accumulation, model.background)
    seen = weights > LEAST_WEIGHT
    parts = (samples.positions, depth, weights, color, samples.ray_indices)
    size = int(camera.height), int(camera.width), 3
    return SeenView(camera, picture.view(size).cpu(), *(part[seen].cpu() for part in parts))


@torch.no_grad()
def place_gaussians(space: Space, views: Sequence[SeenView], most: int) -> Gaussians:
    """At most `most` Gaussians for a scene as some views see it, in cells as small as that allows."""
    weights = torch.cat([view.weights for view in views])
    positions = torch.cat([view.positions for view in views]).clamp(-1.0, 1.0)
    cells, sides = _choose_cells(space, positions, weights, most)
    number, cells, kept = _heaviest(cells, weights, most)

    def mean(values: Float[Tensor, "samples channels"]) -> Float[Tensor, "gaussians channels"]:
        summed = torch.zeros(number, values.shape[1]).index_add_(0, cells, weights[kept, None] * values)
        return summed / total

    weight = weights[kept]
    total = torch.zeros(number).index_add_(0, cells, weight)[:, None]
    positions = positions[kept]
    centers = mean(positions)
    offsets = positions - centers[cells]
    spread = mean((offsets[:, :, None] * offsets[:, None]).flatten(1)).view(-1, 3, 3)
    spread = spread + torch.diag((CELL_SPREAD * sides) ** 2)
    jacobian = jacobians(space, centers)
    spread = (jacobian @ spread @ jacobian.mT).double()
    variances, axes = torch.linalg.eigh(spread)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # eigenvectors may be a mirror image
    log_scales = 0.5 * variances.clamp(min=1e-6 * variances[:, 2:]).clamp(min=1e-24).log()
    colors = mean(torch.cat([view.colors for view in views])[kept]).clamp(0.0, 1.0)
    alpha = -torch.expm1(-_crossed(views, cells, kept, number))
    return Gaussians.of(space.to_world(centers), log_scales, quaternions(axes), alpha.clamp(*OPACITIES).logit(), colors)


def _choose_cells(
    space: Space, positions: Float[Tensor, "samples 3"], weights: Float[Tensor, "samples"], most: int
) -> Tuple[Int[Tensor, "samples"], Float[Tensor, "3"]]:
    """The cell of each sample and the cells' sides, where `HELD_WEIGHT` lies in nearly `most` cells or fewer."""
    shape = torch.tensor([1.0, 1.0, DEPTH_CELLS if isinstance(space, ForwardFacingSpace) else 1.0])
    low, high, resolution = 1.0, float(MOST_CELLS), 150.0
    while True:
        counts = (resolution / shape).long().clamp(min=1)
        index = torch.minimum(((0.5 * positions + 0.5) * counts).long(), counts - 1)
        cells = (index[:, 0] * counts[1] + index[:, 1]) * counts[2] + index[:, 2]
        held = torch.bincount(cells, weights, minlength=1).sort(descending=True).values.cumsum(0)
        found = int((held < HELD_WEIGHT * held[-1]).sum()) + 1
        low, high = (low, resolution) if found > most else (resolution, high)
        if FILLED * most <= found <= most or high - low < 2.0:
            return cells, 2.0 / counts
        guess = resolution * (0.97 * most / found) ** 0.5  # surfaces: cells grow with the square of their number a side
        resolution = guess if low < guess < high else 0.5 * (low + high)


def _heaviest(
    cells: Int[Tensor, "samples"], weights: Float[Tensor, "samples"], most: int
) -> Tuple[int, Int[Tensor, "kept"], Int[Tensor, "kept"]]:
    """How many of the heaviest cells hold `HELD_WEIGHT`, at most `most`; and of samples in them the cell, from 0 on,
    and the number."""
    total = torch.bincount(cells, weights)
    heaviest = total.argsort(descending=True)
    held = total[heaviest].cumsum(0)
    number = min(int((held < HELD_WEIGHT * held[-1]).sum()) + 1, most)
    place = torch.full_like(heaviest, -1)
    place[heaviest[:number]] = torch.arange(number)
    kept = (place[cells] >= 0).nonzero()[:, 0]
    return number, place[cells[kept]], kept


def _crossed(
    views: Sequence[SeenView], cells: Int[Tensor, "kept"], kept: Int[Tensor, "kept"], number: int
) -> Float[Tensor, "cells"]:
    """The optical depth of each cell for the rays that cross it: the mean over them, by their weight in it."""
    firsts = itertools.accumulate((view.picture[..., 0].numel() for view in views[:-1]), initial=0)
    rays = torch.cat([view.rays.long() + first for view, first in zip(views, firsts, strict=True)])[kept]
    depth, weights = (torch.cat([getattr(view, name) for view in views])[kept] for name in ("depth", "weights"))
    crossings, crossing = (rays * number + cells).unique(return_inverse=True)
    through = torch.zeros(len(crossings)).index_add_(0, crossing, depth)
    weighed = torch.zeros(number).index_add_(0, cells, weights * through[crossing])
    return weighed / torch.zeros(number).index_add_(0, cells, weights)


def jacobians(space: Space, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3 3"]:
    """What a space's map to the world does to small steps; columns are the images of the axes."""
    ways = torch.eye(3).to(positions)
    columns = [torch.func.jvp(space.to_world, (positions,), (way.expand_as(positions),))[1] for way in ways]
    return torch.stack(columns, dim=-1)


def quaternions(rotations: Float[Tensor, "batch 3 3"]) -> Float[Tensor, "batch 4"]:
    """Unit quaternions (w, x, y, z) of rotations, from whichever of the four is largest (Shepperd 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotations.unbind(-2))
    candidates = torch.stack(
        [
            torch.stack([1.0 + a + e + i, h - f, c - g, d - b], dim=-1),
            torch.stack([h - f, 1.0 + a - e - i, b + d, c + g], dim=-1),
            torch.stack([c - g, b + d, 1.0 - a + e - i, f + h], dim=-1),
            torch.stack([d - b, c + g, f + h, 1.0 - a - e + i], dim=-1),
        ],
        dim=-2,
    )
    largest = candidates.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    return torch.nn.functional.normalize(candidates[torch.arange(len(rotations)), largest], dim=-1)

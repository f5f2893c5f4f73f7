"""Gaussians made to look as exact pictures do: a short refit of all that they are, by Adam.

Each step takes one view, and draws it as one of several viewers does (`DRAWINGS`), so that Gaussians look right in all.
"""

import math
from typing import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.export.gaussians import DRAWINGS, Gaussians, picture_of_gaussians
from sparsestyle_ns.export.place_gaussians import SeenView
from sparsestyle_ns.rendering.render import Background
from sparsestyle_ns.utils.progress import bar

RATES = (0.1, 0.05, 0.03, 0.1, 0.03)
"""First steps of means (in a Gaussian's own size), logarithms of scales, quaternions, logits and colours."""
LEAST_SIZE = 0.5
"""Standard deviation of a Gaussian, in pixels of the view that sees it best, at least: viewers blur and drop smaller
ones, each in its own way."""
LAST_RATE = 0.1
"""The last steps are this share of the first, the ones between falling exponentially."""


def fit_gaussians(gaussians: Gaussians, views: Sequence[SeenView], background: Background, steps: int) -> Gaussians:
    """Gaussians that differ less from views' pictures, by mean squared error."""
    least = least_log_scales(gaussians, views)
    start, sizes = gaussians.rows.clone(), first_steps(gaussians)
    start[:, 3:6] = torch.maximum(start[:, 3:6], least)
    moved = torch.zeros_like(start, requires_grad=True)  # in first steps, so that all have one rate
    optimizer = torch.optim.Adam([moved], lr=1.0, betas=(0.9, 0.99), eps=1e-12, fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, LAST_RATE ** (1.0 / max(1, steps)))
    dark, light = -start[:, 11:] / sizes[:, 11:], (1.0 - start[:, 11:]) / sizes[:, 11:]
    small = (least - start[:, 3:6]) / sizes[:, 3:6]
    generator = torch.Generator().manual_seed(0)
    drawings = list(DRAWINGS.values())
    order, note = [], ""
    with bar("Fitting splats", steps, unit="steps") as fitting:
        for step in range(steps):
            order = order or torch.randperm(len(views), generator=generator).tolist()
            view = views[order.pop()]
            drawing = drawings[int(torch.randint(len(drawings), (), generator=generator))]
            shown = picture_of_gaussians(Gaussians(start + sizes * moved), view.camera, background, drawing)
            error = (shown - view.picture).square()
            optimizer.zero_grad()
            error.sum().backward()
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                moved[:, 3:6] = torch.maximum(moved[:, 3:6], small)
                moved[:, 11:] = torch.minimum(torch.maximum(moved[:, 11:], dark), light)
            if step % 10 == 0:
                note = f"{-10.0 * math.log10(max(float(error.detach().mean()), 1e-10)):.1f} dB"
            fitting.advance(note=note)
    return Gaussians((start + sizes * moved).detach())


def first_steps(gaussians: Gaussians) -> Float[Tensor, "gaussians 14"]:
    """How far a first step goes in each of Gaussians' numbers."""
    rates = [torch.full((1, count), rate) for count, rate in zip((3, 3, 4, 1, 3), RATES, strict=True)]
    steps = torch.cat(rates, dim=-1).repeat(len(gaussians), 1)
    steps[:, :3] *= gaussians.log_scales.mean(dim=-1, keepdim=True).exp()
    return steps


def least_log_scales(gaussians: Gaussians, views: Sequence[SeenView]) -> Float[Tensor, "gaussians 1"]:
    """Logarithms of `LEAST_SIZE` in world units, by the view that sees a Gaussian largest; −inf where none does."""
    pixel = torch.full((len(gaussians),), torch.inf)
    for view in views:
        camera, pose = view.camera, view.camera.camera_to_worlds[0]
        x, y, z = ((gaussians.means - pose[:, 3]) @ pose[:, :3]).unbind(-1)
        column = float(camera.cx) - float(camera.fx) * x / z
        row = float(camera.cy) + float(camera.fy) * y / z
        seen = (z < 0) & (column >= 0) & (column < int(camera.width)) & (row >= 0) & (row < int(camera.height))
        pixel = torch.where(seen, torch.minimum(pixel, -z / float(camera.fx)), pixel)
    return torch.where(pixel.isfinite(), LEAST_SIZE * pixel, 0.0).log()[:, None]

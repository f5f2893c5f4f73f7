"""The painting's palette for a scene's photos: a smooth map of all colours.

`palette_transform` gives photos the painting's mean colour and covariance. That stretches and turns the cloud of their
colours, and keeps its shape: what has three colours in the photos has three in the painting's place, too, whether the
painting has two or ten. Transport carries the cloud into the painting's, whatever the shape of either (Pitié et al.
2007), so that each of the painting's colours is there as often as in the painting. Alone it would turn the noise of a
flat wall into patches. So only the smooth part of what it adds to the affine map is kept.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.sliced import quantiles
from sparsestyle_ns.field_components.color_map import TABLE_SIDE, ColorMap
from sparsestyle_ns.style.color import color_moments, palette_transform

PaletteTransfer = Literal["transport", "moments"]

MOST_COLORS = 1 << 14
"""Colours that stand for all, drawn at random where there are more."""
ROUNDS = 20
"""Rotations of the colour space along whose axes colours are carried."""
SMOOTHNESS = 4e-5
"""Weight of the table's squared second differences, all added up, beside all colours' pulls, which add up to 1."""
_LEAST = 1e-9  # for entries that neither colours nor neighbours say anything of


def palette_of(
    colors: Float[Tensor, "colors 3"],
    weights: Float[Tensor, "colors"],
    style_colors: Float[Tensor, "style 3"],
    transfer: PaletteTransfer,
) -> ColorMap:
    """The map of a scene's colours, each with a weight ≥ 0, to a painting's; all in [0, 1].

    *moments* is `palette_transform`; *transport* adds the smooth part of `transport` to it.
    An `InputError` where no weight is positive.
    """
    moments = palette_transform(*color_moments(colors, weights), *color_moments(style_colors))
    affine = [each.cpu() for each in moments]  # so that every device gets the same
    if transfer == "moments":
        return ColorMap(*affine).to(colors.device)
    generator = torch.Generator().manual_seed(0)
    drawn = ColorMap(*affine)(_drawn(colors.cpu(), weights.cpu(), generator))
    target = _drawn(style_colors.cpu(), torch.ones(len(style_colors)), generator)
    return ColorMap(*affine, smooth_table(drawn, transport(drawn, target) - drawn)).to(colors.device)


def transport(points: Float[Tensor, "N 3"], target: Float[Tensor, "M 3"]) -> Float[Tensor, "N 3"]:
    """Points carried into another cloud, by order along the axes of one rotation after the other.

    Iterative distribution transfer (Pitié et al. 2007, "Automated colour grading using colour distribution transfer").
    """
    generator = torch.Generator().manual_seed(0)
    moved = points.double()
    for _ in range(ROUNDS):
        rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
        along, wanted = moved @ rotation, (target.double() @ rotation).sort(dim=0).values
        places = along.argsort(dim=0, stable=True)
        carried = torch.empty_like(along).scatter(0, places, quantiles(wanted, len(along)))
        moved = carried @ rotation.T
    return moved.to(points)


def smooth_table(colors: Float[Tensor, "N 3"], offsets: Float[Tensor, "N 3"]) -> Float[Tensor, "3 b g r"]:
    """A smooth table of offsets at colours in [0, 1], to be read between its entries.

    Each entry is pulled to the offsets of the colours in the cells around it, in its share of them, and by `SMOOTHNESS`
    times the squared second differences to its neighbours: where there are no colours, the table goes on as it is
    nearby. Colours that are close together, as those of a noisy wall, so have nearly the same offset.
    """
    side, cells = TABLE_SIDE, TABLE_SIDE - 1
    scaled = colors.double().clamp(0.0, 1.0) * cells
    lower = scaled.long().clamp(max=cells - 1)
    fraction = scaled - lower
    corners = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    entries = ((lower[:, None] + corners) * torch.tensor([1, side, side**2])).sum(dim=-1).flatten()
    shares = torch.where(corners.bool(), fraction[:, None], 1.0 - fraction[:, None]).prod(dim=-1) / len(colors)

    pulls = torch.full((side**3,), _LEAST, dtype=torch.float64).index_add(0, entries, shares.flatten())
    pulled = (shares[..., None] * offsets.double()[:, None]).flatten(0, 1)
    wanted = torch.zeros(side**3, 3, dtype=torch.float64).index_add(0, entries, pulled)
    table = torch.linalg.solve(SMOOTHNESS * _second_differences(side) + torch.diag(pulls), wanted)
    return table.T.reshape(3, side, side, side).to(colors)


def _second_differences(side: int) -> Float[Tensor, "entries entries"]:
    """The quadratic form of the squared second differences along all three axes of a cube of numbers."""
    unit = torch.eye(side, dtype=torch.float64)
    differences = unit[:-2] - 2.0 * unit[1:-1] + unit[2:]
    bent = differences.T @ differences
    forms = ((bent, unit, unit), (unit, bent, unit), (unit, unit, bent))
    return sum(torch.kron(torch.kron(first, second), third) for first, second, third in forms)


def _drawn(
    colors: Float[Tensor, "colors 3"], weights: Float[Tensor, "colors"], generator: torch.Generator
) -> Float[Tensor, "drawn 3"]:
    """`MOST_COLORS` of the colours, as often as their weights say."""
    until = weights.double().cumsum(dim=0)
    places = torch.rand(MOST_COLORS, generator=generator, dtype=torch.float64) * until[-1]
    return colors[torch.searchsorted(until, places, right=True).clamp(max=len(colors) - 1)]

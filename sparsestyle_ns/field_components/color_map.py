"""A smooth map of colours, as part of a field."""

from typing import Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

TABLE_SIDE = 9
"""Entries of the table along each axis of the colour cube."""


def affine(
    colors: Float[Tensor, "*batch 3"], matrix: Float[Tensor, "3 3"], offset: Float[Tensor, "3"]
) -> Float[Tensor, "*batch 3"]:
    """A c + b for every colour, in the colours' own dtype and on their device."""
    return colors @ matrix.to(colors).T + offset.to(colors)


class ColorMap(nn.Module):
    """c ↦ A c + b, cut to [0, 1], and what a table over the colour cube adds to that, cut again.

    A new one leaves colours as they are; so does one that has been `reset`.

    Args:
        matrix: A.
        offset: b.
        table: offsets at even steps from 0 to 1 along blue, green and red, by the affine map's colours; read linearly
            in between.
    """

    matrix: Float[Tensor, "3 3"]
    offset: Float[Tensor, "3"]
    table: Float[Tensor, "3 b g r"]

    def __init__(
        self,
        matrix: Optional[Float[Tensor, "3 3"]] = None,
        offset: Optional[Float[Tensor, "3"]] = None,
        table: Optional[Float[Tensor, "3 b g r"]] = None,
    ) -> None:
        super().__init__()
        parts = {"matrix": torch.eye(3), "offset": torch.zeros(3), "table": torch.zeros(3, *3 * (TABLE_SIDE,))}
        for (name, neutral), given in zip(parts.items(), (matrix, offset, table), strict=True):
            self.register_buffer(name, neutral if given is None else given.to(neutral))
        self._look()
        self.register_load_state_dict_post_hook(lambda module, keys: module._look())

    def _look(self) -> None:
        """Whether it does anything, once and for all colours: asking a GPU makes it wait."""
        self.is_neutral = bool((self.matrix == torch.eye(3).to(self.matrix)).all())
        self.is_neutral &= not bool(self.offset.any()) and not bool(self.table.any())

    def adopt(self, other: "ColorMap") -> None:
        """Becomes what another is."""
        self.load_state_dict(other.state_dict())

    def reset(self) -> None:
        """Leaves colours as they are from now on."""
        if not self.is_neutral:
            self.adopt(ColorMap())

    def forward(self, colors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Each colour in [0, 1] as the map has it, in [0, 1], of the colours' own dtype; differentiable."""
        if self.is_neutral:
            return colors
        mapped = affine(colors, self.matrix, self.offset).clamp(0.0, 1.0)
        places = (2.0 * mapped - 1.0).reshape(1, 1, 1, -1, 3)
        values = F.grid_sample(self.table.to(colors)[None], places, mode="bilinear", align_corners=True)
        return (mapped + values.reshape(3, -1).T.reshape(colors.shape)).clamp(0.0, 1.0)

"""A coarse field that is stylised itself, as ARF fine-tunes a radiance field, in the residual field's place."""

from typing import Tuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestyle_ns.field_components.hash_grid import GridLocation
from sparsestyle_ns.fields.coarse import CoarseField


class FineTunedField(nn.Module):
    """(σ, c) of a copy of the coarse field, which learns while the coarse field stays as it is.

    Colour is that of a view straight ahead from everywhere: ARF, too, stylises without view dependence.

    Args:
        field: the copy.
    """

    def __init__(self, field: CoarseField) -> None:
        super().__init__()
        self.field = field

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """Field coordinates in [−1, 1]³, as they are."""
        return GridLocation(positions, None)

    def forward(
        self,
        location: GridLocation,
        feature: Float[Tensor, "points feature"],
        coarse_density: Float[Tensor, "points"],
    ) -> Tuple[Float[Tensor, "points"], Float[Tensor, "points 3"]]:
        """σ and c in [0, 1] at located points; what the frozen field has there isn't looked at."""
        density, own_feature = self.field.density_and_feature(location.positions)
        ahead = torch.tensor([0.0, 0.0, -1.0], device=location.positions.device)
        return density, self.field.color(own_feature, ahead.expand_as(location.positions)).float()

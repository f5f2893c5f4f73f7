"""The field that is stylised, as the settings have it: the residual field, or a copy of the coarse one."""

import copy
from dataclasses import dataclass
from typing import Literal, Optional, Tuple, Union

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestyle_ns.field_components.color_map import ColorMap
from sparsestyle_ns.field_components.hash_grid import GridLocation, HashGrid
from sparsestyle_ns.field_components.positional_encoding import FrequencyEncoding, NoEncoding, PointEncoding
from sparsestyle_ns.field_components.tiny_cuda_grid import TinyCudaGrid, has_tiny_cuda_nn
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField


class FineTunedField(nn.Module):
    """(σ, c) of a copy of the coarse field, which learns while the coarse field stays as it is.

    Colour is that of a view straight ahead from everywhere: ARF, too, stylises without view dependence. `recoloring`
    is as in the residual field.
    """

    def __init__(self, field: CoarseField) -> None:
        super().__init__()
        self.field = field
        self.recoloring = ColorMap()

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """Field coordinates in [−1, 1]³, as they are."""
        return GridLocation(positions, None)

    def forward(
        self, location: GridLocation, feature: Float[Tensor, "points feature"], coarse_density: Float[Tensor, "points"]
    ) -> Tuple[Float[Tensor, "points"], Float[Tensor, "points 3"]]:
        """σ and c in [0, 1] at located points; what the frozen field has there isn't looked at."""
        density, own_feature = self.field.density_and_feature(location.positions)
        ahead = -torch.eye(3, device=location.positions.device)[2]
        color = self.field.color(own_feature, ahead.expand_as(location.positions)).float()
        return density, self.recoloring(color)


StylisedField = Union[ResidualField, FineTunedField]
"""Gives σ_f and c_f at located points, from σ_c and e_c there."""


@dataclass
class FineFieldConfig:
    """Settings of the stylised field."""

    stylised_field: Literal["residual", "coarse"] = "residual"
    """What learns the style: the residual field on top of the frozen coarse field (Eq. 2 and 3), or a copy of the
    coarse field, fine-tuned as ARF does. With the copy, the settings of the residual field are not used."""
    fine_encoding: Literal["auto", "hash", "tiny-cuda-nn", "frequency", "none"] = "auto"
    """What the residual field gets of a position beside e_c: our hash grid, tiny-cuda-nn's hash grid, sines and
    cosines of `frequency_levels` octaves, or nothing. auto is tiny-cuda-nn's on a GPU where that library is installed,
    else ours."""
    frequency_levels: int = 10
    """Octaves of the sines and cosines, where they take the hash grid's place."""
    hash_levels: int = 8
    """Levels of the hash grid (M)."""
    min_resolution: int = 16
    """Cells along the cube's side on the first level (N_min). The paper's is 128; coarser ones make wider strokes."""
    max_resolution: Optional[int] = None
    """Cells along the cube's side on the last level (N_max). None: about as many as the largest views that are stylised
    have pixels along their longer side, since cells finer than that learn noise; as many times fewer as strokes are
    wider than 1."""
    depth_cells: float = 1 / 16
    """Cells along depth as a share of those across, from 0 to 1, where all cameras look one way (NDC). Photos hardly
    say at which depth a surface is: where colour may change along depth as fast as across, strokes become the surfaces'
    contour lines."""
    features_per_level: int = 4
    """Features of a cell's corner."""
    log2_table_size: int = 19
    """log2 of a level's table length."""
    hidden_layers: int = 2
    """Hidden layers of the residual field's MLP."""
    layer_width: int = 256
    """Units in a hidden layer."""
    residual_density_scale: float = 10.0
    """Unit of the residual density, per half side of the scene's cube."""

    def settle_encoding(self, device: torch.device) -> None:
        """Replaces auto by what it stands for on a device, so that a run is opened as what it was trained as."""
        if self.fine_encoding == "auto":
            is_there = has_tiny_cuda_nn(device, self.features_per_level)
            self.fine_encoding = "tiny-cuda-nn" if is_there else "hash"

    def new_field(
        self, coarse: CoarseField, with_density: bool, looks_ahead: bool, device: torch.device
    ) -> StylisedField:
        """A field as it is before training, to be used on `device`; a copy of `coarse` starts from its weights.

        Args:
            with_density: whether it has a residual density.
            looks_ahead: whether all cameras look one way, and the third of the field coordinates is depth.
        """
        if self.stylised_field == "coarse":
            return FineTunedField(copy.deepcopy(coarse).requires_grad_(True))
        sizes = coarse.feature_dim, self.hidden_layers, self.layer_width
        stretch = (1.0, 1.0, self.depth_cells if looks_ahead else 1.0)
        encoding = self._encoding(device)
        return ResidualField(encoding, *sizes, self.residual_density_scale, with_density, stretch)

    def _encoding(self, device: torch.device) -> PointEncoding:
        if self.fine_encoding == "none":
            return NoEncoding()
        if self.fine_encoding == "frequency":
            return FrequencyEncoding(self.frequency_levels)
        assert self.max_resolution is not None
        resolutions = self.min_resolution, self.max_resolution
        shape = (self.hash_levels, *resolutions, self.features_per_level, self.log2_table_size)
        return TinyCudaGrid(*shape, device=device) if self.fine_encoding == "tiny-cuda-nn" else HashGrid(*shape)

"""ψ(x) as tiny-cuda-nn lays it out: by its kernels on GPUs where that library is installed, and in torch elsewhere.

It differs from ours in that levels whose corners all fit into the table aren't hashed, that cells are shifted by half
of one, and that features are in half precision. A field that was trained with the library opens without it: a
checkpoint holds the encoding of a few points too, and what torch makes of the table has to be that.
"""

import math
from typing import Dict, NamedTuple, Tuple

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.field_components import encodings
from nerfstudio.field_components.encodings import FieldComponent, HashEncoding
from torch import Tensor, nn

from sparsestyle_ns.field_components.hash_grid import Corners, GridLocation, hash_corners, interpolate
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.machine import numbers_on

POSSIBLE_FEATURES = (1, 2, 4, 8)
"""Of a row, in the library."""
NUM_PROBES = 256
TOLERANCE = 0.02
"""Of a level's probes, in the Euclidean norm; half precision makes some 0.001 of it."""


class Level(NamedTuple):
    """A grid of tiny-cuda-nn's, whose rows in the joined table are one after another."""

    scale: float
    """Cells along the cube's side, less one; not an integer in general."""
    resolution: int
    """Corners along the cube's side."""
    first_row: int
    num_rows: int

    @property
    def is_hashed(self) -> bool:
        """Whether corners share rows."""
        return self.resolution**3 > self.num_rows


def has_tiny_cuda_nn(device: torch.device, features_per_level: int) -> bool:
    """Whether tiny-cuda-nn is installed, works, and serves that device and so many features."""
    return device.type == "cuda" and encodings.TCNN_EXISTS and features_per_level in POSSIBLE_FEATURES


def growth_factor(num_levels: int, min_resolution: int, max_resolution: int) -> float:
    """b, by which a level is finer than the one before (Sec. 3.1)."""
    return 1.0 if num_levels == 1 else math.exp(math.log(max_resolution / min_resolution) / (num_levels - 1))


def tiny_cuda_levels(
    num_levels: int, min_resolution: int, max_resolution: int, log2_table_size: int
) -> Tuple[Level, ...]:
    """The levels of tiny-cuda-nn's GridEncoding of type Hash, in the single precision that it reckons them in."""
    log2_growth = np.log2(np.float32(growth_factor(num_levels, min_resolution, max_resolution)))
    levels, first_row = [], 0
    for level in range(num_levels):
        scale = np.exp2(np.float32(level) * log2_growth) * np.float32(min_resolution) - np.float32(1.0)
        resolution = math.ceil(scale) + 1
        num_rows = min(math.ceil(resolution**3 / 8) * 8, 2**log2_table_size)
        levels.append(Level(float(scale), resolution, first_row, num_rows))
        first_row += num_rows
    return tuple(levels)


def locate_tiny_cuda_corners(positions: Float[Tensor, "points 3"], levels: Tuple[Level, ...]) -> Corners:
    """Table rows and trilinear weights of points in [0, 1]³; corners beyond a level's last begin again at its first."""
    offsets = numbers_on([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], positions.device)
    rows, weights = [], []
    for level in levels:
        scaled = positions * level.scale + 0.5
        lower = scaled.floor()
        fraction = (scaled - lower)[:, None]
        corners = lower.long()[:, None] + offsets
        if level.is_hashed:
            row = hash_corners(corners, level.num_rows)
        else:
            x, y, z = corners.unbind(dim=-1)
            row = (x + level.resolution * (y + level.resolution * z)) % level.num_rows
        rows.append(level.first_row + row)
        weights.append(torch.where(offsets.bool(), fraction, 1.0 - fraction).prod(dim=-1))
    return Corners(torch.stack(rows, dim=1).int(), torch.stack(weights, dim=1))


class TinyCudaGrid(FieldComponent):
    """The hash grid with the arguments of `HashGrid`, and its two steps; the library's kernels need a GPU."""

    def __init__(
        self,
        num_levels: int,
        min_resolution: int,
        max_resolution: int,
        features_per_level: int,
        log2_table_size: int,
        device: torch.device,
    ) -> None:
        super().__init__(in_dim=3, out_dim=num_levels * features_per_level)
        self.features_per_level = features_per_level
        self.levels = tiny_cuda_levels(num_levels, min_resolution, max_resolution, log2_table_size)
        self.with_library = has_tiny_cuda_nn(device, features_per_level)
        if self.with_library:
            settings = HashEncoding.get_tcnn_encoding_config(
                num_levels=num_levels,
                features_per_level=features_per_level,
                log2_hashmap_size=log2_table_size,
                min_res=min_resolution,
                growth_factor=growth_factor(num_levels, min_resolution, max_resolution),
            )
            self.grid = encodings.tcnn.Encoding(n_input_dims=3, encoding_config=settings)
        else:
            num_rows = self.levels[-1].first_row + self.levels[-1].num_rows
            table = torch.empty(num_rows * features_per_level).uniform_(-1e-4, 1e-4)
            self.grid = nn.ParameterDict({"params": nn.Parameter(table)})
        self.register_buffer("probed", torch.zeros(NUM_PROBES, self.get_out_dim()))
        self.register_state_dict_post_hook(TinyCudaGrid._probe)
        self.register_load_state_dict_post_hook(TinyCudaGrid._compare)

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """See `HashGrid.locate`."""
        positions = positions.float().clamp(0.0, 1.0)
        return GridLocation(positions, None if self.with_library else locate_tiny_cuda_corners(positions, self.levels))

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points encoded"]:
        """See `HashGrid.interpolate`; float32."""
        if location.corners is None:
            return self.grid(location.positions).to(torch.float32)
        return interpolate(self.grid.params.view(-1, self.features_per_level), location.corners)

    @torch.no_grad()
    def _at_probes(self) -> Float[Tensor, "probes encoded"]:
        positions = torch.rand(NUM_PROBES, 3, generator=torch.Generator().manual_seed(0))
        return self.interpolate(self.locate(positions.to(self.grid.params.device)))

    def _probe(self, state: Dict[str, Tensor], prefix: str, _: object) -> None:
        state[f"{prefix}probed"] = self._at_probes()  # the buffer stays: its changes would count as changed weights

    def _compare(self, _: object) -> None:
        shape = (NUM_PROBES, len(self.levels), self.features_per_level)
        saved, found = self.probed.view(shape), self._at_probes().to(self.probed).view(shape)
        if ((found - saved).norm(dim=(0, 2)) > TOLERANCE * saved.norm(dim=(0, 2)) + 1e-7).any():
            raise InputError(
                "The hash grid of this run was trained with tiny-cuda-nn, and gives other numbers here than it gave "
                "there; open the run on a machine with the version of tiny-cuda-nn that it was trained with."
            )

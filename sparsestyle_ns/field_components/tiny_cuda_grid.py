"""ψ(x) by tiny-cuda-nn's kernels, through nerfstudio, on GPUs where that library is installed.

Its tables are laid out otherwise than ours: coarse levels aren't hashed, points are shifted by half a cell, features
are in half precision. A field that was trained with them opens only where tiny-cuda-nn is, so this is nobody's default.
"""

import torch
from jaxtyping import Float
from nerfstudio.field_components import encodings
from nerfstudio.field_components.encodings import FieldComponent, HashEncoding
from torch import Tensor

from sparsestyle_ns.errors import InputError
from sparsestyle_ns.field_components.hash_grid import GridLocation


class TinyCudaGrid(FieldComponent):
    """The hash grid with the arguments of `HashGrid`, and its two steps.

    Raises:
        InputError: tiny-cuda-nn isn't installed, or finds no GPU.
    """

    def __init__(
        self,
        num_levels: int,
        min_resolution: int,
        max_resolution: int,
        features_per_level: int,
        log2_table_size: int,
    ) -> None:
        super().__init__(in_dim=3, out_dim=num_levels * features_per_level)
        if not encodings.TCNN_EXISTS:
            raise InputError(
                "--pipeline.model.fine-encoding is tiny-cuda-nn, which isn't installed here or finds no GPU; install "
                "it on a machine with one, or leave the setting out: the hash grid has kernels of its own. A run that "
                "was trained with it opens only where it is."
            )
        # nerfstudio falls back to torch in silence where the library is missing; that was ruled out above.
        self.encoding = HashEncoding(
            num_levels=num_levels,
            min_res=min_resolution,
            max_res=max_resolution,
            log2_hashmap_size=log2_table_size,
            features_per_level=features_per_level,
            implementation="tcnn",
        )

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """See `HashGrid.locate`."""
        return GridLocation(positions.float().clamp(0.0, 1.0), None)

    def interpolate(self, location: GridLocation) -> Float[Tensor, "points encoded"]:
        """See `HashGrid.interpolate`; float32."""
        return self.encoding(location.positions).to(torch.float32)

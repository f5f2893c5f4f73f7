"""The coarse field F_c (Eq. 1): what a scene looks like from afar, learned from three to eight photos."""

import math
from dataclasses import dataclass
from typing import Callable, Dict, List, Literal, Optional, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.mlp import MLP
from nerfstudio.fields.base_field import Field
from torch import Tensor, nn

from sparsestyle_ns.field_components.positional_encoding import PositionalEncoding
from sparsestyle_ns.field_components.thinned_mlp import Thinning, thinned_mlp
from sparsestyle_ns.utils.device_sizes import sizes_for

DensityActivation = Literal["softplus", "exp"]
MAX_LOG_DENSITY = 15.0
"""ln of the largest density, 3e6 per half side of the cube: opaque within a thousandth of a hash cell, and far from
float32's largest number, which products with intervals and sums must not reach."""


def in_chunks(function: Callable[..., Tuple[Tensor, ...]], *inputs: Tensor) -> Tuple[Tensor, ...]:
    """`function(*inputs)`, a piece of the points at a time where no gradient is asked for.

    With gradients all points are evaluated at once: their hidden layers are kept for the backward pass anyhow. Inputs
    and outputs have a row for each point.
    """
    size = sizes_for(inputs[0].device).mlp_points
    if torch.is_grad_enabled() or len(inputs[0]) <= size:
        return function(*inputs)
    pieces = [function(*piece) for piece in zip(*(each.split(size) for each in inputs), strict=True)]
    return tuple(torch.cat(parts) for parts in zip(*pieces, strict=True))


def activate_density(raw: Float[Tensor, "*batch"], activation: DensityActivation) -> Float[Tensor, "*batch"]:
    """σ, from 0 to e^`MAX_LOG_DENSITY`, from any number, infinite ones included."""
    if activation == "exp":
        return torch.exp(raw.clamp(max=MAX_LOG_DENSITY))
    return F.softplus(raw.clamp(max=math.exp(MAX_LOG_DENSITY)))


class CoarseField(Field):
    """(σ_c, e_c, c_c) = F_c(γ(x), d): an MLP on a low-frequency positional encoding (Eq. 1).

    The arguments are those of `CoarseFieldConfig`; with `direction_levels` None colour doesn't depend on direction.
    """

    def __init__(
        self,
        num_levels: int = 7,
        num_layers: int = 6,
        layer_width: int = 256,
        feature_dim: int = 64,
        direction_levels: Optional[int] = 4,
        density_activation: DensityActivation = "softplus",
        density_bias: float = 0.0,
    ) -> None:
        super().__init__()
        self.density_activation: DensityActivation = density_activation
        self.density_bias = density_bias
        self.feature_dim = feature_dim
        self.position_encoding = PositionalEncoding(in_dim=3, num_levels=num_levels)
        self.trunk = MLP(
            in_dim=self.position_encoding.get_out_dim(),
            num_layers=num_layers,
            layer_width=layer_width,
            out_dim=layer_width,
            out_activation=nn.ReLU(),
        )
        self.density_head = nn.Linear(layer_width, 1)
        self.feature_head = nn.Linear(layer_width, feature_dim)
        self.direction_encoding: Optional[PositionalEncoding] = None
        direction_dim = 0
        if direction_levels is not None:
            self.direction_encoding = PositionalEncoding(in_dim=3, num_levels=direction_levels)
            direction_dim = self.direction_encoding.get_out_dim()
        self.color_head = MLP(feature_dim + direction_dim, num_layers=2, layer_width=layer_width // 2, out_dim=3)

    def hidden_matrices(self) -> List[nn.Parameter]:
        """The weights of hidden layers, which an optimiser for matrices may take (`engine.training.MuonConfig`)."""
        layers = [layer for layer in self.trunk.modules() if isinstance(layer, nn.Linear)]
        *hidden, _ = [layer for layer in self.color_head.modules() if isinstance(layer, nn.Linear)]
        return [layer.weight for layer in (*layers, *hidden)]

    def density_and_feature(
        self, positions: Float[Tensor, "*batch 3"], thinning: Optional[Thinning] = None
    ) -> Tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch feature"]]:
        """σ_c and e_c at field coordinates in [−1, 1]; `thinning` spares the backward pass points (`thinned_mlp`)."""
        points = positions.reshape(-1, 3)
        if thinning is None:
            density, feature = in_chunks(self._evaluate, points)
        else:
            hidden = [layer for layer in self.trunk.modules() if isinstance(layer, nn.Linear)]
            heads = self.density_head, self.feature_head
            raw, feature = thinned_mlp(self.position_encoding(points), hidden, heads, thinning)
            density = self._activate(raw)
        batch = positions.shape[:-1]
        return density.view(batch), feature.view(*batch, self.feature_dim)

    def _evaluate(self, points: Float[Tensor, "points 3"]) -> Tuple[Tensor, Tensor]:
        hidden = self.trunk(self.position_encoding(points))
        return self._activate(self.density_head(hidden)), self.feature_head(hidden)

    def _activate(self, raw: Float[Tensor, "points 1"]) -> Float[Tensor, "points"]:
        return activate_density(raw.squeeze(-1).float() + self.density_bias, self.density_activation)

    def color(
        self, feature: Float[Tensor, "*batch feature"], directions: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch 3"]:
        """c_c in [0, 1], from e_c and unit view directions."""
        batch = feature.shape[:-1]
        rays = directions.expand(*batch, 3).reshape(-1, 3)
        (color,) = in_chunks(self._evaluate_color, feature.reshape(-1, self.feature_dim), rays)
        return color.view(*batch, 3)

    def _evaluate_color(self, feature: Tensor, directions: Tensor) -> Tuple[Tensor]:
        if self.direction_encoding is not None:
            feature = torch.cat([feature, self.direction_encoding(directions).to(feature)], dim=-1)
        # In half precision a sigmoid reaches 1 at a logit of 6, and has no gradient from there on.
        return (torch.sigmoid(self.color_head(feature).float()),)

    def get_density(self, ray_samples: RaySamples) -> Tuple[Tensor, Tensor]:
        """nerfstudio's form of `density_and_feature`; the samples' positions are field coordinates."""
        density, feature = self.density_and_feature(ray_samples.frustums.get_positions())
        return density[..., None], feature

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Optional[Tensor] = None
    ) -> Dict[FieldHeadNames, Tensor]:
        """nerfstudio's form of `color`."""
        return {FieldHeadNames.RGB: self.color(density_embedding, ray_samples.frustums.directions)}


@dataclass
class CoarseFieldConfig:
    """The shape of the coarse field."""

    num_levels: int = 7
    """Octaves of the positional encoding of x."""
    num_layers: int = 6
    """Hidden layers."""
    layer_width: int = 256
    """Units in a hidden layer."""
    feature_dim: int = 64
    """Length of the geometric feature e_c."""
    direction_levels: int = 4
    """Octaves of the view direction's encoding, where colour depends on it (`--pipeline.effects.view-color`)."""
    density_activation: DensityActivation = "exp"
    """What keeps the density positive. exp finds surfaces sooner than softplus (docs/method.md)."""
    density_bias: float = 1.0
    """Added to the density's logit: a field that starts as dense fog is less drawn to the far end of its rays."""

    def setup(self, view_dependent: bool) -> CoarseField:
        """The field; `view_dependent` says whether its colour depends on the view direction."""
        return CoarseField(**(vars(self) | ({} if view_dependent else {"direction_levels": None})))

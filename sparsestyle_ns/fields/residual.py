"""The residual field F_f (Eq. 2) and the density it makes together with the coarse field (Eq. 3)."""

from typing import Tuple

import torch
from jaxtyping import Float
from nerfstudio.field_components.mlp import MLP
from torch import Tensor, nn

from sparsestyle_ns.field_components.blocked_mlp import blocked_mlp
from sparsestyle_ns.field_components.color_map import ColorMap
from sparsestyle_ns.field_components.hash_grid import GridLocation
from sparsestyle_ns.field_components.positional_encoding import PointEncoding
from sparsestyle_ns.field_components.thinned_mlp import Thinning
from sparsestyle_ns.utils.machine import numbers_on


class _NonNegative(torch.autograd.Function):
    """max(x, 0) whose gradient also passes at x < 0 where it asks for a larger x."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(min=0.0)

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return grad * ((x >= 0) | (grad < 0))


def fine_density(residual: Float[Tensor, "*batch"], coarse: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """σ_f = σ' + σ_c, and 0 where that sum is negative (Eq. 3).

    A density can't be negative, and a plain clamp would leave a sample at 0 for good, its gradient gone. Here a
    negative sum still receives the gradient that would raise it (the projected gradient, as in Ballé's lower bound for
    learned compression), so that what was removed can come back.
    """
    return _NonNegative.apply(residual + coarse)


class ResidualField(nn.Module):
    """(σ', c_f) = F_f(ψ(x), e_c): an encoding ψ, `grid`, and an MLP, no view direction (Eq. 2).

    At the start σ' is 0 everywhere, so that stylising begins from the coarse geometry, and c_f is grey. `recoloring`
    maps the colours c_f of a finished field to the painting's, and does nothing while it learns.

    Args:
        density_scale: the MLP's density output is multiplied by this, so that one optimiser step moves σ' by an amount
            that matters beside σ_c (densities are per cube half-side: a surface has some hundreds).
        with_density: whether σ' exists; without it the geometry is the coarse field's.
        stretch: what each axis of the field coordinates is multiplied by before it is encoded, from 0 to 1: ψ has as
            much fewer cells along it, and none along an axis of 0.
    """

    def __init__(
        self,
        grid: PointEncoding,
        feature_dim: int,
        hidden_layers: int = 2,
        layer_width: int = 256,
        density_scale: float = 1.0,
        with_density: bool = True,
        stretch: Tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> None:
        super().__init__()
        self.grid, self.stretch = grid, stretch
        self.density_scale = density_scale
        self.mlp = MLP(
            in_dim=grid.get_out_dim() + feature_dim,
            num_layers=hidden_layers,
            layer_width=layer_width,
            out_dim=layer_width,
            out_activation=nn.ReLU(),
        )
        self.color_head = nn.Linear(layer_width, 3)
        self.density_head = nn.Linear(layer_width, 1) if with_density else None
        self.thinning = Thinning(0.0)
        self.recoloring = ColorMap()
        if self.density_head is not None:
            nn.init.zeros_(self.density_head.weight)
            nn.init.zeros_(self.density_head.bias)

    def locate(self, positions: Float[Tensor, "points 3"]) -> GridLocation:
        """Where field coordinates in [−1, 1]³ lie in the encoding's cube."""
        stretch = numbers_on(self.stretch, positions.device, positions.dtype)
        return self.grid.locate(0.5 * (positions * stretch + 1.0))

    def forward(
        self, location: GridLocation, feature: Float[Tensor, "points feature"], coarse_density: Float[Tensor, "points"]
    ) -> Tuple[Float[Tensor, "points"], Float[Tensor, "points 3"]]:
        """σ_f ≥ 0 (Eq. 3) and c_f in [0, 1] at located points, from e_c and σ_c there.

        Gradients reach the parameters alone, from the points that `thinning` keeps.
        """
        hidden = [layer for layer in self.mlp.modules() if isinstance(layer, nn.Linear)]
        heads = [self.color_head] if self.density_head is None else [self.color_head, self.density_head]
        encoded = self.grid.interpolate(location)
        if torch.is_autocast_enabled(kind := encoded.device.type):  # half of what is kept for the backward pass
            encoded = encoded.to(torch.get_autocast_dtype(kind))
        logits = blocked_mlp((encoded, feature), hidden, heads, self.thinning).float()
        # In half precision a sigmoid reaches 1 at a logit of 6, and has no gradient from there on.
        if self.density_head is None:
            return coarse_density, self.recoloring(torch.sigmoid(logits))
        density = fine_density(self.density_scale * logits[:, 3], coarse_density)
        return density, self.recoloring(torch.sigmoid(logits[:, :3]))

"""Optimisers that leave everything as it is where a gradient isn't finite."""

from typing import Any, Dict, Iterable, List, Tuple

import torch
from jaxtyping import Float
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor, nn
from torch.amp import GradScaler
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

from sparsestyle_ns.utils.distributed import average_gradients


def broken(parameters: Iterable[nn.Parameter]) -> Float[Tensor, ""]:
    """1 where the squares of all gradients don't add up to a finite number, else 0; stays on the device."""
    # Adam keeps a running mean of squares: one that overflows would stop its parameter for good.
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    return 1.0 - torch.isfinite(get_total_norm(gradients)).float()


def step_if_finite(optimizer: Optimizer, is_broken: Float[Tensor, ""]) -> bool:
    """Whether to call an optimiser's step; fused ones look at the flag where they run, and nothing waits for a GPU."""
    if getattr(optimizer, "_step_supports_amp_scaling", False):
        optimizer.found_inf = is_broken
        return True
    return not is_broken.item()


class FiniteOptimizers(Optimizers):
    """nerfstudio's optimisers, with averaged gradients; a step whose gradient isn't finite is skipped and counted.

    The iteration still counts as one: learning rate, λ, view and batch go by its number.
    """

    def __init__(self, config: Dict[str, Any], param_groups: Dict[str, List[nn.Parameter]]) -> None:
        super().__init__(config, param_groups)
        device = next(iter(param_groups.values()))[0].device
        self._skipped = torch.zeros(2, device=device)

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: List[str]) -> None:
        """Steps these groups, or none of them, alike in all processes."""
        parameters = [parameter for name in param_groups for parameter in self.parameters[name]]
        if not parameters:
            return
        average_gradients(parameters)
        is_broken = broken(parameters)
        self._skipped[0] += is_broken
        self._skipped[1] = (self._skipped[1] + 1.0) * is_broken
        if not grad_scaler.is_enabled():  # an enabled one skips such steps itself
            param_groups = [name for name in param_groups if step_if_finite(self.optimizers[name], is_broken)]
        super().optimizer_scaler_step_some(grad_scaler, param_groups)

    def skipped(self) -> Tuple[int, int]:
        """How many steps weren't taken in all, and since the last one that was taken; waits for a GPU."""
        total, in_a_row = map(int, self._skipped.tolist())
        return total, in_a_row

"""Optimisers that leave everything as it is where a gradient isn't finite."""

from typing import Any, Callable, Dict, Iterable, List, Optional, Tuple

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


class FiniteMuon(torch.optim.Muon):
    """torch's Muon, which leaves everything as it is where `found_inf` is 1, and for which nothing waits.

    The two attributes are those by which fused optimisers are told; `grad_scale` is a scaler's.
    """

    _step_supports_amp_scaling = True
    found_inf: Optional[Float[Tensor, ""]] = None
    grad_scale: Optional[Float[Tensor, ""]] = None

    @torch.no_grad()
    def step(self, closure: Optional[Callable[[], float]] = None) -> Optional[float]:
        """A step; on a GPU, what it changes is kept beside it and put back there if need be."""
        parameters = [each for group in self.param_groups for each in group["params"] if each.grad is not None]
        if self.grad_scale is not None:
            for parameter in parameters:
                parameter.grad /= self.grad_scale
        if self.found_inf is None:
            return super().step(closure)
        if self.found_inf.device.type == "cpu":  # a look costs nothing there, and copies would cost time
            return None if self.found_inf.item() else super().step(closure)
        for parameter in parameters:
            self.state[parameter].setdefault("momentum_buffer", torch.zeros_like(parameter.grad))
        changed = [*parameters, *(self.state[parameter]["momentum_buffer"] for parameter in parameters)]
        before = [tensor.clone() for tensor in changed]
        loss = super().step(closure)
        for tensor, value in zip(changed, before, strict=True):
            tensor.copy_(torch.where(self.found_inf > 0, value, tensor))
        return loss


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

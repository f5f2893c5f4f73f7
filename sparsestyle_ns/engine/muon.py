"""Muon, the optimiser of hidden layers' matrices, in the number format that the device multiplies fast.

torch's own Muon multiplies in bfloat16 on every device. A CPU without instructions for that takes sixty times as long
for such a product as for one in float32, and stage 1 more than an hour instead of minutes.
"""

import math
from itertools import groupby
from typing import Any, Callable, Dict, Iterable, List, Optional

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import Optimizer

from sparsestyle_ns.core.precision import at_least_float32, multiplies_bfloat16

POLYNOMIAL = (3.4445, -4.775, 2.0315)
"""Coefficients of x, x³ and x⁵ (Jordan 2024): applied `ROUNDS` times, they bring all of (0, 1] but what is tiny to
between 0.7 and 1.2."""
ROUNDS = 5


def nearly_orthogonal(matrices: Float[Tensor, "B m n"], eps: float = 1e-7) -> Float[Tensor, "B m n"]:
    """Matrices with the singular vectors of those that are given, and singular values of about 1 (0.7 to 1.2).

    Newton-Schulz iteration with `POLYNOMIAL` (Jordan 2024), in bfloat16 where the device multiplies that, else in
    float32. Singular values under about a thousandth of a matrix's norm come out smaller, and 0 stays 0.

    Args:
        matrices: finite, of any size.
        eps: Frobenius norms count as at least so much.
    """
    if matrices.shape[-2] > matrices.shape[-1]:
        return nearly_orthogonal(matrices.mT, eps).mT
    a, b, c = POLYNOMIAL
    found = at_least_float32(matrices)
    found = found / torch.linalg.matrix_norm(found, keepdim=True).clamp(min=eps)
    if multiplies_bfloat16(found.device):
        found = found.bfloat16()
    for _ in range(ROUNDS):
        squares = found @ found.mT
        factor = torch.baddbmm(squares, squares, squares, beta=b, alpha=c)
        found = torch.baddbmm(found, factor, found, beta=a)
    return found.to(matrices.dtype)


class Muon(Optimizer):
    """Muon (Jordan 2024): each step of a matrix is the running mean of its gradients, made nearly orthogonal.

    It leaves everything as it is where `found_inf` is 1, and nothing waits for a GPU. The two attributes are those by
    which torch's fused optimisers are told; `grad_scale` is a scaler's.

    Args:
        lr: of square and wide matrices; tall ones, m × n, move by √(m/n) times as much.
        momentum: decay of the running mean, which looks one step ahead (Nesterov).
        weight_decay: the share of `lr` by which weights shrink in each step.
        eps: see `nearly_orthogonal`.
    """

    _step_supports_amp_scaling = True
    found_inf: Optional[Float[Tensor, ""]] = None
    grad_scale: Optional[Float[Tensor, ""]] = None

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        lr: float = 0.02,
        momentum: float = 0.95,
        weight_decay: float = 0.0,
        eps: float = 1e-7,
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Optional[Callable[[], float]] = None) -> Optional[float]:
        """A step of every matrix that has a gradient; those of one shape take it together."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if self.found_inf is not None and self.found_inf.device.type == "cpu" and self.found_inf.item():
            return loss
        for group in self.param_groups:
            moving = sorted((each for each in group["params"] if each.grad is not None), key=_shape)
            for _, alike in groupby(moving, key=_shape):
                self._move(list(alike), group)
        return loss

    def _move(self, parameters: List[nn.Parameter], group: Dict[str, Any]) -> None:
        buffers = [self.state[each].setdefault("momentum_buffer", torch.zeros_like(each)) for each in parameters]
        gradients = torch.stack([each.grad for each in parameters])
        if self.grad_scale is not None:
            gradients /= self.grad_scale
        before = torch.stack(buffers), torch.stack(parameters)
        mean = before[0].lerp(gradients, 1.0 - group["momentum"])
        direction = nearly_orthogonal(gradients.lerp(mean, group["momentum"]), group["eps"])
        rows, columns = direction.shape[-2:]
        rate = group["lr"] * math.sqrt(max(1.0, rows / columns))
        after = mean, before[1] * (1.0 - group["lr"] * group["weight_decay"]) - rate * direction
        if self.found_inf is not None:
            after = [torch.where(self.found_inf > 0, *pair) for pair in zip(before, after, strict=True)]
        for kept, values in zip((buffers, parameters), after, strict=True):
            torch._foreach_copy_(kept, values.unbind())


def _shape(parameter: nn.Parameter) -> Any:
    return tuple(parameter.shape)

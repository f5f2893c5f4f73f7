"""A multilayer perceptron for millions of points, in little memory: hidden layers stay in the processor's cache.

Points are evaluated a block at a time, and no layer is kept: the backward pass works out again what it needs. That is
quicker than to write layers to memory and to read them back, and 256 units in two layers would take a kilobyte a point.
The backward pass may be spared points that hardly matter (`thinned_mlp.thin`).
"""

from typing import Any, List, Optional, Sequence, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sparsestyle_ns.core.precision import at_least_float32
from sparsestyle_ns.field_components.thinned_mlp import Thinning, thin
from sparsestyle_ns.utils.device_sizes import sizes_for


def blocked_mlp(
    inputs: Sequence[Float[Tensor, "points _"]],
    hidden: Sequence[nn.Linear],
    heads: Sequence[nn.Linear],
    thinning: Thinning,
) -> Float[Tensor, "points out"]:
    """What `heads` make, side by side, of the last of the hidden layers, which have ReLUs between and after them.

    The values are those of the layers themselves on the inputs side by side, in the format that autocast asks for.
    Gradients reach the layers' parameters and the first of the inputs, from the points that `thin` keeps.

    Raises:
        ValueError: another input asks for a gradient.
    """
    if any(each.requires_grad for each in inputs[1:]):
        raise ValueError("blocked_mlp gives only its first input a gradient; detach the others.")
    weight, bias = (torch.cat(parts) for parts in zip(*((head.weight, head.bias) for head in heads), strict=True))
    parameters = [part for layer in hidden for part in (layer.weight, layer.bias)]
    return _BlockedMLP.apply(thinning, len(inputs), *inputs, *parameters, weight, bias)


class _BlockedMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, thinning: Thinning, num_inputs: int, *tensors: Tensor) -> Tensor:
        inputs, parameters = tensors[:num_inputs], tensors[num_inputs:]
        kind = inputs[0].device.type
        dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else inputs[0].dtype
        ctx.thinning, ctx.dtype, ctx.num_inputs = thinning, dtype, num_inputs
        ctx.save_for_backward(*tensors)
        layers = _Layers(inputs, parameters, dtype)
        return torch.cat([layers.output(layers.hidden(block)[-1]) for block in _blocks(inputs)])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradients: Tensor) -> Tuple[Optional[Tensor], ...]:
        saved = ctx.saved_tensors  # once: a checkpointed view gives them no second time
        inputs, parameters = saved[: ctx.num_inputs], saved[ctx.num_inputs :]
        kept, gradients = None, at_least_float32(gradients)
        if ctx.thinning.threshold > 0:
            kept, gradients = thin(gradients, ctx.thinning)
            inputs = tuple(each[kept] for each in inputs)
        layers, exact = _Layers(inputs, parameters, ctx.dtype), torch.promote_types(ctx.dtype, torch.float32)
        found = [torch.zeros_like(part, dtype=exact) for part in parameters]
        first: List[Tensor] = []
        with torch.autocast(gradients.device.type, enabled=False):
            for block, gradient in zip(
                _blocks(inputs), gradients.split(sizes_for(gradients.device).mlp_points), strict=True
            ):
                hidden, gradient = layers.hidden(block), gradient.to(ctx.dtype)
                for number in reversed(range(len(hidden))):
                    found[2 * number + 3] += gradient.sum(dim=0, dtype=exact)
                    found[2 * number + 2] += gradient.t() @ hidden[number]
                    gradient = gradient @ layers.weights[number + 1]
                    gradient = torch.ops.aten.threshold_backward(gradient, hidden[number], 0.0)
                found[1] += gradient.sum(dim=0, dtype=exact)
                found[0] += torch.cat([gradient.t() @ each.to(ctx.dtype) for each in block], dim=-1)
                if ctx.needs_input_grad[2]:
                    first.append((gradient @ layers.first[0]).to(inputs[0].dtype))
        own = None
        if ctx.needs_input_grad[2]:
            own = torch.cat(first)
            if kept is not None:
                own = own.new_zeros(saved[0].shape).index_add_(0, kept, own)
        rest = [None] * (ctx.num_inputs - 1)
        return None, None, own, *rest, *(part.to(like.dtype) for part, like in zip(found, parameters, strict=True))


class _Layers:
    """The layers in a number format, the first of them cut into the columns of each input."""

    def __init__(self, inputs: Sequence[Tensor], parameters: Sequence[Tensor], dtype: torch.dtype) -> None:
        self.dtype = dtype
        self.weights, self.biases = ([part.to(dtype) for part in parameters[start::2]] for start in (0, 1))
        self.first = self.weights[0].split([each.shape[-1] for each in inputs], dim=-1)

    def hidden(self, block: Sequence[Tensor]) -> List[Tensor]:
        """What each hidden layer gives for some points, after its ReLU."""
        layer = F.linear(block[0].to(self.dtype), self.first[0], self.biases[0])
        for each, weight in zip(block[1:], self.first[1:], strict=True):
            layer.addmm_(each.to(self.dtype), weight.t())
        layers = [layer.relu_()]
        for weight, bias in zip(self.weights[1:-1], self.biases[1:-1], strict=True):
            layers.append(F.linear(layers[-1], weight, bias).relu_())
        return layers

    def output(self, hidden: Tensor) -> Tensor:
        """What the head makes of the last hidden layer."""
        return F.linear(hidden, self.weights[-1], self.biases[-1])


def _blocks(inputs: Sequence[Tensor]) -> List[Tuple[Tensor, ...]]:
    return list(zip(*(each.split(sizes_for(each.device).mlp_points) for each in inputs), strict=True))

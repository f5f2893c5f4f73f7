"""A multilayer perceptron whose backward pass is spared points that hardly matter.

Samples in empty space and behind surfaces have next to no gradient. Each point stays in the backward pass with a
probability p in proportion to the size of its gradient (1 where that is large), and its gradient is divided by p. The
parameters' gradients are then right on average ("Russian roulette", as in Monte Carlo rendering), at a share of the
work: of a step's matrix products two thirds belong to the backward pass.
"""

from typing import Any, NamedTuple, Optional, Sequence, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from sparsestyle_ns.core.precision import at_least_float32

MULTIPLE = 1024
"""The backward pass gets a multiple of so many points: a library may compile a matrix product anew for each shape, and
oneDNN keeps a thousand of these, half a gigabyte."""


class Thinning(NamedTuple):
    """How many points the backward pass is spared."""

    threshold: float
    """Gradients of at least this many times the points' mean always count; 0 spares none."""
    generator: Optional[torch.Generator] = None
    """On the points' device."""


def thin(
    gradients: Float[Tensor, "points channels"], thinning: Thinning
) -> Tuple[Int[Tensor, " kept"], Float[Tensor, "kept channels"]]:
    """The points that stay, ascending, and their gradients over the probabilities with which they do.

    More than `MULTIPLE` are filled up to a multiple of it, by the last point with a gradient of 0.
    """
    # In units of the largest number no square overflows, and none underflows that matters.
    largest = torch.linalg.vector_norm(gradients, ord=torch.inf) if gradients.numel() else gradients.new_ones(())
    sizes = torch.linalg.vector_norm(gradients / torch.where(largest > 0, largest, 1.0), dim=-1)
    limit = thinning.threshold * sizes.mean()
    # Gradients that are all 0, or not numbers, stay as they are.
    chance = torch.where(sizes < limit, sizes / limit, 1.0)
    drawn = torch.rand(len(sizes), device=sizes.device, dtype=sizes.dtype, generator=thinning.generator)
    # The one place of a backward pass that waits for a GPU: how many points are left is the size of all that follows.
    (kept,) = (drawn < chance).nonzero(as_tuple=True)
    gradients = gradients[kept] / chance[kept, None]
    missing = -len(kept) % MULTIPLE if len(kept) > MULTIPLE else 0
    return torch.cat([kept, kept[-1:].expand(missing)]), F.pad(gradients, (0, 0, 0, missing))


def thinned_mlp(
    inputs: Float[Tensor, "points in"], hidden: Sequence[nn.Linear], heads: Sequence[nn.Linear], thinning: Thinning
) -> Tuple[Tensor, ...]:
    """What each of `heads` makes of the last of the hidden layers, which have ReLUs between and after them.

    The values are those of the layers themselves, in the format that autocast asks for. Gradients reach the layers'
    parameters, from the points that `thin` keeps, and not the inputs.

    Raises:
        ValueError: the inputs ask for a gradient.
    """
    if inputs.requires_grad:
        raise ValueError("thinned_mlp gives its inputs no gradient, but they ask for one; detach them.")
    # Heads share one product.
    weight, bias = (torch.cat(parts) for parts in zip(*((head.weight, head.bias) for head in heads), strict=True))
    parameters = [part for layer in hidden for part in (layer.weight, layer.bias)]
    outputs = _ThinnedMLP.apply(thinning, inputs, *parameters, weight, bias)
    return outputs.split([head.out_features for head in heads], dim=-1)


class _ThinnedMLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, thinning: Thinning, inputs: Tensor, *parameters: Tensor) -> Tensor:
        kind = inputs.device.type
        dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else inputs.dtype
        weights, biases = ([part.to(dtype) for part in parameters[first::2]] for first in (0, 1))
        layers = [inputs.to(dtype)]
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            layers.append(F.linear(layers[-1], weight, bias).relu_())
        ctx.thinning = thinning
        ctx.save_for_backward(*layers, *weights)
        return F.linear(layers[-1], weights[-1], biases[-1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradients: Tensor) -> Tuple[Optional[Tensor], ...]:
        saved = ctx.saved_tensors
        num_layers = len(saved) // 2
        layers, weights = saved[:num_layers], saved[num_layers:]
        dtype = weights[0].dtype
        kept: Any = slice(None)
        if ctx.thinning.threshold > 0:
            kept, gradients = thin(at_least_float32(gradients), ctx.thinning)
        gradients = gradients.to(dtype)
        found = []
        for number in reversed(range(num_layers)):
            layer = layers[number][kept]
            found += [gradients.sum(dim=0, dtype=torch.promote_types(dtype, torch.float32)), gradients.t() @ layer]
            if number > 0:
                gradients = torch.ops.aten.threshold_backward(gradients @ weights[number], layer, 0.0)
        return None, None, *reversed(found)

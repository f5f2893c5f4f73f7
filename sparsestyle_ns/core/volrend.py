"""Volume rendering's quadrature: from densities along a ray to weights and pixels.

Letters, as in NeRF (Sec. 4) and the paper: σ_i density of sample i, δ_i length of its interval, τ_i = σ_i δ_i its
optical depth, T_i = exp(−Σ_{j<i} τ_j) the transmittance in front of it, w_i = T_i (1 − exp(−τ_i)) its weight.

Samples come in two layouts. *Dense*: [rays, samples]. *Packed*: the samples of all rays one after another, front to
back, sample i belonging to ray `ray_indices[i]` (ascending); rays may have none, and empty space costs nothing.
Depths, transmittances and weights have at least float32's digits: sums of thousands of samples need them.
"""

from typing import Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestyle_ns.core.precision import at_least_float32

MAX_OPTICAL_DEPTH = 80.0
"""Beyond it exp(−τ) is below 2e-35, so an interval is opaque in every dtype; the cap keeps sums of τ exact when an
interval is infinite."""


def optical_depth(density: Float[Tensor, "*batch"], interval: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """τ = σ δ, capped at `MAX_OPTICAL_DEPTH`.

    An infinite interval gives the cap, or 0 where σ = 0, and the gradient of an interval of length 1: the true one,
    infinite at σ = 0, would drown all others once a last sample has been emptied.
    """
    density, interval = at_least_float32(density), at_least_float32(interval)
    infinite = interval.isinf()
    # A density that overflowed would make no number in an interval of length 0.
    finite = density.clamp(max=torch.finfo(density.dtype).max)
    depth = (finite * torch.where(infinite, 1.0, interval)).clamp(max=MAX_OPTICAL_DEPTH)
    opaque = torch.where(density > 0, MAX_OPTICAL_DEPTH, 0.0).to(depth)
    return torch.where(infinite, depth + (opaque - depth).detach(), depth)


def dense_weights(depth: Float[Tensor, "*rays samples"]) -> Float[Tensor, "*rays samples"]:
    """w_i = T_i (1 − exp(−τ_i)) from optical depths τ ≥ 0, dense layout (NeRF, Eq. 3)."""
    return _DenseWeights.apply(at_least_float32(depth))


class _DenseWeights(torch.autograd.Function):
    """∂L/∂τ_j = T_{j+1} ∂L/∂w_j − Σ_{i>j} w_i ∂L/∂w_i, with T_{j+1} itself.

    torch would take 1 + expm1(−τ) for exp(−τ), which has no correct digit left at τ = 16.
    """

    @staticmethod
    def forward(ctx, depth: Tensor) -> Tensor:
        behind = torch.exp(-torch.cumsum(depth, dim=-1))
        weights = F.pad(behind[..., :-1], (1, 0), value=1.0) * -torch.expm1(-depth)
        ctx.save_for_backward(behind, weights)
        return weights

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> Tensor:
        behind, weights = ctx.saved_tensors
        hidden = (weights * grad)[..., 1:].flip(-1).cumsum(dim=-1).flip(-1)
        return behind * grad - F.pad(hidden, (0, 1))


def ray_borders(ray_indices: Int[Tensor, "samples"], num_rays: int) -> Int[Tensor, "rays_plus_1"]:
    """The place of each ray's first sample, and last the number of all; a ray without samples begins where it ends.

    Example:
        >>> ray_borders(torch.tensor([0, 0, 2]), num_rays=3)
        tensor([0, 2, 2, 3])
    """
    # Counting by `bincount` would make a GPU look at its input first, and the CPU wait for that.
    rays = torch.arange(num_rays + 1, device=ray_indices.device)
    return torch.searchsorted(ray_indices.contiguous(), rays)


def packed_transmittance(
    depth: Float[Tensor, "samples"], ray_indices: Int[Tensor, "samples"], num_rays: int
) -> Float[Tensor, "samples"]:
    """T_i = exp(−Σ τ_j over the samples in front of i on the same ray), packed layout."""
    depth = at_least_float32(depth)
    # In float64, with τ capped, the error of a difference of two sums over all rays stays below 1e-6.
    before = F.pad(torch.cumsum(depth.double(), dim=0), (1, 0))
    in_front = before[:-1] - before[ray_borders(ray_indices, num_rays)[:-1]][ray_indices]
    return torch.exp(-in_front).to(depth.dtype)


def packed_weights(
    depth: Float[Tensor, "samples"], ray_indices: Int[Tensor, "samples"], num_rays: int
) -> Float[Tensor, "samples"]:
    """w_i = T_i (1 − exp(−τ_i)), packed layout; the twin of `dense_weights`."""
    return _PackedWeights.apply(at_least_float32(depth), ray_indices, num_rays)


class _PackedWeights(torch.autograd.Function):
    """The twin of `_DenseWeights`, with sums as in `packed_transmittance`."""

    @staticmethod
    def forward(ctx, depth: Tensor, ray_indices: Tensor, num_rays: int) -> Tensor:
        transmittance = packed_transmittance(depth, ray_indices, num_rays)
        weights = transmittance * -torch.expm1(-depth)
        ctx.save_for_backward(transmittance * torch.exp(-depth), weights, ray_indices)
        ctx.num_rays = num_rays
        return weights

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> Tuple[Tensor, None, None]:
        behind, weights, ray_indices = ctx.saved_tensors
        up_to = F.pad(torch.cumsum((weights * grad).double(), dim=0), (1, 0))
        hidden = up_to[ray_borders(ray_indices, ctx.num_rays)[1:]][ray_indices] - up_to[1:]
        return behind * grad - hidden.to(grad.dtype), None, None


def packed_sum(
    values: Float[Tensor, "samples channels"], ray_indices: Int[Tensor, "samples"], num_rays: int
) -> Float[Tensor, "rays channels"]:
    """Sum of the samples' values for each ray; 0 for a ray without samples."""
    return values.new_zeros(num_rays, values.shape[-1]).index_add(0, ray_indices, values)


def effective_samples(weights: Float[Tensor, "*rays samples"]) -> Float[Tensor, "*rays"]:
    """(Σw)² / Σw²: on how many samples a ray's weight lies, 1 for a surface, many for a fog, 0 without any weight."""
    tiny = torch.finfo(weights.dtype).tiny
    # Squares of shares, unlike those of weights, don't underflow where all weights are small.
    shares = weights / weights.sum(dim=-1, keepdim=True).clamp(min=tiny)
    return shares.sum(dim=-1).square() / shares.square().sum(dim=-1).clamp(min=tiny)


def distortion(weights: Float[Tensor, "*rays samples"], edges: Float[Tensor, "*rays edges"]) -> Float[Tensor, "*rays"]:
    """Distortion of a ray's weights: Σ_ij w_i w_j |m_i − m_j| + ⅓ Σ w_i² (s_{i+1} − s_i) (mip-NeRF 360, Eq. 15).

    In linear time, without terms that cancel: the first sum is 2 Σ_k (m_{k+1} − m_k) (Σ_{i≤k} w_i) (Σ_{i>k} w_i). Edges
    are the samples' ascending borders s in [0, 1], m their middles.
    """
    mass = torch.cumsum(weights, dim=-1)
    before, behind = mass[..., :-1], mass[..., -1:] - mass[..., :-1]
    between = ((edges[..., 2:] - edges[..., :-2]) * before * behind).sum(dim=-1)
    within = (weights.square() * (edges[..., 1:] - edges[..., :-1])).sum(dim=-1) / 3.0
    return between + within

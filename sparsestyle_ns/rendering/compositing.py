"""Volume rendering's quadrature: from densities along a ray to weights and pixels.

Letters, as in NeRF (Sec. 4) and the paper: σ_i density of sample i, δ_i length of its interval, τ_i = σ_i δ_i its
optical depth, T_i = exp(−Σ_{j<i} τ_j) the transmittance in front of it, w_i = T_i (1 − exp(−τ_i)) its weight.

Samples come in two layouts. *Dense*: [rays, samples], every ray has as many samples. *Packed*: the samples of all rays
one after another, front to back, sample i belonging to ray `ray_indices[i]` (ascending); rays may have none. Packed is
the layout in which empty space costs nothing.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

MAX_OPTICAL_DEPTH = 80.0
"""Beyond it exp(−τ) is below 2e-35, so an interval is opaque in every dtype; the cap keeps sums of τ exact when an
interval is infinite."""


def optical_depth(density: Float[Tensor, "*batch"], interval: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """τ = σ δ, capped at `MAX_OPTICAL_DEPTH`.

    An infinite interval gives the cap, and 0 where the density is 0. Its gradient is that of an interval of length 1:
    the true one, infinite at σ = 0, would drown all others once a last sample has been emptied.
    """
    infinite = interval.isinf()
    depth = (density * torch.where(infinite, 1.0, interval)).clamp(max=MAX_OPTICAL_DEPTH)
    opaque = torch.where(density > 0, MAX_OPTICAL_DEPTH, 0.0).to(depth)
    return torch.where(infinite, depth + (opaque - depth).detach(), depth)


def dense_weights(depth: Float[Tensor, "*rays samples"]) -> Float[Tensor, "*rays samples"]:
    """w_i = T_i (1 − exp(−τ_i)) from optical depths τ ≥ 0, dense layout (NeRF, Eq. 3)."""
    in_front = torch.cumsum(torch.cat([torch.zeros_like(depth[..., :1]), depth[..., :-1]], dim=-1), dim=-1)
    transmittance = torch.exp(-in_front)
    return transmittance * -torch.expm1(-depth)


def packed_transmittance(
    depth: Float[Tensor, "samples"], ray_indices: Int[Tensor, "samples"], num_rays: int
) -> Float[Tensor, "samples"]:
    """T_i = exp(−Σ τ_j over the samples in front of i on the same ray), packed layout.

    The running sum goes over all rays in float64, and each ray's start is taken off: with τ capped, the error of that
    difference stays below 1e-6 for ten million samples.
    """
    running = torch.cumsum(depth.double(), dim=0)
    counts = torch.bincount(ray_indices, minlength=num_rays)
    before = torch.cat([running.new_zeros(1), running])
    in_front = before[:-1] - before[torch.cumsum(counts, dim=0) - counts][ray_indices]
    return torch.exp(-in_front).to(depth.dtype)


def packed_weights(
    depth: Float[Tensor, "samples"], ray_indices: Int[Tensor, "samples"], num_rays: int
) -> Float[Tensor, "samples"]:
    """w_i = T_i (1 − exp(−τ_i)), packed layout; the twin of `dense_weights`."""
    return packed_transmittance(depth, ray_indices, num_rays) * -torch.expm1(-depth)


def packed_sum(
    values: Float[Tensor, "samples channels"], ray_indices: Int[Tensor, "samples"], num_rays: int
) -> Float[Tensor, "rays channels"]:
    """Sum of the samples' values for each ray; 0 for a ray without samples."""
    return values.new_zeros(num_rays, values.shape[-1]).index_add(0, ray_indices, values)


def effective_samples(weights: Float[Tensor, "*rays samples"]) -> Float[Tensor, "*rays"]:
    """(Σw)² / Σw²: on how many samples a ray's weight lies. 1 is a surface, the number of samples is a fog.

    A ray without any weight counts as 0.
    """
    return weights.sum(dim=-1).square() / weights.square().sum(dim=-1).clamp(min=torch.finfo(weights.dtype).tiny)


def distortion(weights: Float[Tensor, "*rays samples"], edges: Float[Tensor, "*rays edges"]) -> Float[Tensor, "*rays"]:
    """Distortion of a ray's weights: Σ_ij w_i w_j |m_i − m_j| + ⅓ Σ w_i² (s_{i+1} − s_i) (mip-NeRF 360, Eq. 15).

    Computed in linear time from running sums. It is small when the weight lies in one place.

    Args:
        weights: w ≥ 0.
        edges: s, the samples' ascending borders, one more than samples; normalised to [0, 1] by the caller.
    """
    middle = 0.5 * (edges[..., 1:] + edges[..., :-1])
    mass_before = torch.cumsum(weights, dim=-1) - weights
    moment_before = torch.cumsum(weights * middle, dim=-1) - weights * middle
    between = 2.0 * (weights * (middle * mass_before - moment_before)).sum(dim=-1)
    within = (weights.square() * (edges[..., 1:] - edges[..., :-1])).sum(dim=-1) / 3.0
    return between + within

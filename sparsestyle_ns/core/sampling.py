"""Where along a ray samples go; s is 0 at the start of its part that lies in the scene, and 1 at the end."""

from typing import Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def even_edges(
    num_rays: int, num_samples: int, device: torch.device, generator: Optional[torch.Generator] = None
) -> Float[Tensor, "rays edges"]:
    """`num_samples` + 1 ascending borders in [0, 1]; a generator moves inner ones by up to half a step (stratified)."""
    if generator is None:
        return torch.linspace(0.0, 1.0, num_samples + 1, device=device).expand(num_rays, -1)
    jitter = torch.rand(num_rays, num_samples - 1, device=device, generator=generator) - 0.5
    # Whole steps and jitter are added first: neighbours that touch can then not change places by rounding.
    inner = (torch.arange(1, num_samples, device=device) + jitter) / num_samples
    return F.pad(F.pad(inner, (1, 0), value=0.0), (0, 1), value=1.0)


def sample_pdf(
    edges: Float[Tensor, "rays bins_plus_1"],
    weights: Float[Tensor, "rays bins"],
    num_samples: int,
    generator: Optional[torch.Generator] = None,
) -> Float[Tensor, "rays edges"]:
    """`num_samples` + 1 borders that cut a histogram into parts of equal mass (NeRF, Sec. 5.2, by inverse CDF).

    The first border is the histogram's start and the last its end. Weights, the mass of each bin between its ascending
    `edges`, are ≥ 0, with a positive sum on every ray; a `generator` moves inner borders by up to half a part of mass.
    """
    mass = torch.cumsum(weights, dim=-1)
    cdf = torch.cat([torch.zeros_like(mass[:, :1]), mass / mass[:, -1:]], dim=-1)
    quantiles = even_edges(len(weights), num_samples, weights.device, generator)[:, 1:-1].contiguous()
    right = torch.searchsorted(cdf, quantiles, right=True).clamp(1, weights.shape[-1])
    left = right - 1
    cdf_left, cdf_right = cdf.gather(-1, left), cdf.gather(-1, right)
    fraction = (quantiles - cdf_left) / (cdf_right - cdf_left).clamp(min=torch.finfo(cdf.dtype).eps)
    # Unlike left + fraction · (right − left), it never passes the right border by rounding.
    inner = torch.lerp(edges.gather(-1, left), edges.gather(-1, right), fraction.clamp(0.0, 1.0))
    return torch.cat([edges[:, :1], inner, edges[:, -1:]], dim=-1)

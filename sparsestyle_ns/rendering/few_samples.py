"""A few samples a ray where its weight is, in place of all its steps; each stands for a stretch of its ray.

The geometry of a frozen field never changes, so its density is measured once, in a volume (`DensityVolume`). A ray is
cut into stretches of equal weight, by what the volume shows on even steps, and each is sampled where half of its weight
lies. There the field itself is evaluated, and corrects the volume: a stretch of optical depth τ̂ by the volume has
τ = τ̂ σ_c/σ̂, with both densities at its sample (a control variate: σ̂ is wrong by a factor that hardly changes along a
stretch). With residual density (Eq. 3) it has τ + σ' L, where L is its length. All of this is exact as stretches become
short, for which a share of them is spread evenly.
"""

from dataclasses import dataclass
from typing import NamedTuple, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.occupancy import DensityVolume, Occupancy, PackedSamples, interval_lengths
from sparsestyle_ns.core.sampling import even_edges, sample_pdf
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.core.volrend import dense_weights, optical_depth

LEAST_WEIGHT = 1e-4
"""Stretches, and rays, with less weight than this have no sample where nothing can be added to them."""
MOST_CORRECTION = 10.0
"""A volume's density counts as at most so many times too small or too large."""
LEAST_EVEN_SHARE = 0.05
"""Of the stretches, so that what the volume has missed is found."""


@dataclass(frozen=True)
class FewSamples:
    """Where a ray's samples are, and how many."""

    volume: DensityVolume
    count: int
    """At least 1; an unbounded space's last step, which is infinite, is one more wherever light gets there."""
    even_share: float = 0.0
    """Share of the stretches, in [0, 1), that is spread evenly; above 0 where residual density may add weight."""


class Stretches(NamedTuple):
    """Samples that stand for stretches of rays, and what the volume says of these."""

    samples: PackedSamples
    """`lengths` are the stretches'."""
    depth: Float[Tensor, "samples"]
    """Optical depth τ̂ by the volume; 0 of an endless step."""

    def density(self, volume: DensityVolume, density: Float[Tensor, "samples"]) -> Float[Tensor, "samples"]:
        """The stretches' mean σ_c, from σ_c at their samples."""
        lengths = self.samples.lengths
        factor = density / volume.density(self.samples.positions)
        factor = factor.clamp(1.0 / MOST_CORRECTION, MOST_CORRECTION)
        return torch.where(lengths.isinf(), density, factor * self.depth / lengths.clamp(min=1e-12)).to(density)


@torch.no_grad()
def cut_into_stretches(
    segments: Segments, few: FewSamples, num_steps: int, unbounded: bool, occupancy: Optional[Occupancy] = None
) -> Stretches:
    """The stretches of a batch of rays, by what the volume shows on `num_steps` even steps in occupied cells."""
    rays = segments.hit.nonzero().squeeze(-1)
    edges = even_edges(len(segments.hit), num_steps, rays.device)
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    lengths = interval_lengths(segments, edges, unbounded)
    positions = segments.positions(middle)
    density, lengths = few.volume.density(positions)[rays], lengths[rays]
    is_passed = lengths.isinf()
    if occupancy is not None:
        is_passed = is_passed | ~occupancy.contains(positions)[rays]
    lengths = torch.where(is_passed, 0.0, lengths)
    depth = optical_depth(density, lengths)
    weights = dense_weights(depth)
    share = max(few.even_share, LEAST_EVEN_SHARE)
    mass = torch.lerp(_shares(weights), _shares(lengths), share)
    if not unbounded:  # rays that meet nothing but empty cells have no samples; here they still have an endless step
        (seen,) = (mass.sum(dim=-1) > 0.0).nonzero(as_tuple=True)
        rays, depth, lengths, mass = rays[seen], depth[seen], lengths[seen], mass[seen]

    cuts = sample_pdf(edges[rays], mass + 1e-9, 2 * few.count)
    borders, s = cuts[:, ::2].contiguous(), cuts[:, 1::2]
    step = (borders * num_steps).long().clamp(max=num_steps - 1)
    part = borders * num_steps - step
    depth, lengths = (_between(values, step, part) for values in (depth, lengths))
    is_kept = dense_weights(depth) > LEAST_WEIGHT if few.even_share == 0.0 else lengths > 0.0
    if unbounded:
        s, depth = torch.cat([s, middle[rays, -1:]], dim=-1), F.pad(depth, (0, 1))
        lengths = F.pad(lengths, (0, 1), value=torch.inf)
        reached = torch.exp(-depth.sum(dim=-1, keepdim=True)) > LEAST_WEIGHT
        is_kept = torch.cat([is_kept, reached], dim=-1)
    row, _ = is_kept.nonzero(as_tuple=True)
    on_ray, s = rays[row], s[is_kept]
    return Stretches(PackedSamples(on_ray, s, lengths[is_kept], segments.positions(s, on_ray)), depth[is_kept])


def _shares(values: Float[Tensor, "rays steps"]) -> Float[Tensor, "rays steps"]:
    """Each row over its sum; 0 where that is 0."""
    return values / values.sum(dim=-1, keepdim=True).clamp(min=1e-12)


def _between(
    values: Float[Tensor, "rays steps"], step: Tensor, part: Float[Tensor, "rays borders"]
) -> Float[Tensor, "rays stretches"]:
    """Sums between neighbouring borders, each a part in [0, 1] into a step."""
    before = F.pad(torch.cumsum(values, dim=-1), (1, 0))
    return (before.gather(-1, step) + part * values.gather(-1, step)).diff(dim=-1).clamp(min=0.0)

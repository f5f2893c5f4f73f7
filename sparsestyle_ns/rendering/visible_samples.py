"""The samples of rays that can show, found by marching through a frozen coarse field."""

from dataclasses import dataclass
from typing import Callable, List, Optional, Tuple

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.occupancy import Occupancy, PackedSamples, march
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.core.volrend import optical_depth, ray_borders
from sparsestyle_ns.rendering.few_samples import FewSamples

SAMPLES_PER_PASS = 6
"""Samples of a ray that are evaluated before looking whether it goes on."""


@dataclass(frozen=True)
class Marching:
    """Where samples lie on a ray, and where it ends."""

    occupancy: Optional[Occupancy]
    """Which cells of the cube are empty and skipped; None: none."""
    num_steps: int
    unbounded: bool
    """Whether the last step goes on to infinity."""
    min_transmittance: float
    """Share of light left, in [0, 1), at which a ray ends."""
    few: Optional[FewSamples] = None
    """How few samples a frozen ray keeps; None: one for each step."""

    @property
    def most_samples(self) -> int:
        """Samples that a ray has at most."""
        return self.num_steps if self.few is None else self.few.count + self.unbounded


DensityAndFeature = Callable[[Float[Tensor, "points 3"]], Tuple[Tensor, Tensor]]
"""Gives σ_c and e_c at field coordinates."""


def visible_samples(
    evaluate: DensityAndFeature, segments: Segments, marching: Marching
) -> Tuple[PackedSamples, Float[Tensor, "samples"], Float[Tensor, "samples feature"]]:
    """The samples of a batch of rays that can show, and σ_c and e_c there.

    They lie in occupied cells, and more than `min_transmittance` of the light is left in front of them. The result is
    the same each time, on a GPU too: a view that is frozen again in the backward pass must have the same samples. So no
    depths are summed by atomic additions, as `index_add_` and long running sums do there.
    """
    samples = march(segments, marching.occupancy, marching.num_steps, marching.unbounded)
    on_ray, num_rays = samples.ray_indices, len(segments.hit)
    borders = ray_borders(on_ray, num_rays)
    rank = torch.arange(len(on_ray), device=on_ray.device) - borders[on_ray]
    depth = samples.s.new_zeros(num_rays)
    found: List[Tuple[Tensor, Tensor, Tensor]] = []
    # A GPU is waited for here, and three times in each pass: how much is left decides how much is evaluated.
    for first in range(0, max(1, int(borders.diff().max())), SAMPLES_PER_PASS):
        goes_on = torch.exp(-depth) > marching.min_transmittance
        in_pass = (rank >= first) & (rank < first + SAMPLES_PER_PASS) & goes_on[on_ray]
        index = in_pass.nonzero().squeeze(-1)
        density, feature = evaluate(samples.positions[index])
        place = on_ray[index], rank[index] - first
        depths = depth.new_zeros(num_rays, SAMPLES_PER_PASS)
        depths[place] = optical_depth(density, samples.lengths[index])
        behind = depth[:, None] + depths.cumsum(dim=1)
        in_front = torch.cat([depth[:, None], behind[:, :-1]], dim=1)
        seen = (torch.exp(-in_front)[place] > marching.min_transmittance).nonzero().squeeze(-1)
        depth = behind[:, -1]
        found.append((index[seen], density[seen], feature[seen]))
    index, density, feature = (torch.cat(parts) for parts in zip(*found, strict=True))
    order = torch.argsort(index)
    return samples.select(index[order]), density[order], feature[order]

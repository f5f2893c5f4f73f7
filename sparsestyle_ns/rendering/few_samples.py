"""A few samples a ray where its weight is, in place of all its steps; each stands for a stretch of its ray.

The geometry of a frozen field never changes, so its density is measured once, in a volume (`DensityVolume`). A ray is
cut into stretches of about equal weight, by what the volume shows on even steps. Their borders move to where there is
little weight, so that two surfaces seldom share a stretch, and each is sampled where half of its own weight lies. There
the field itself is evaluated, and corrects the volume: a stretch of optical depth τ̂ by the volume has τ = τ̂ σ_c/σ̂,
with both densities at its sample (a control variate: σ̂ is wrong by a factor that hardly changes along a stretch). With
residual density (Eq. 3) it has τ + σ' L, where L is its length. All of this is exact as stretches become short, for
which a share of them is spread evenly.
"""

from dataclasses import dataclass
from typing import NamedTuple, Optional, Tuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestyle_ns.core.occupancy import DensityVolume, Occupancy, PackedSamples
from sparsestyle_ns.core.sampling import even_edges, sample_pdf
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.core.volrend import dense_weights, optical_depth
from sparsestyle_ns.rendering import few_samples_kernels
from sparsestyle_ns.rendering.lines import RAYS_PER_PART, Lines, lines_of
from sparsestyle_ns.utils.numba_kernels import even_parts, run_on_threads

LEAST_WEIGHT = 1e-4
"""Stretches, and rays, with less weight than this have no sample where nothing can be added to them."""
MOST_CORRECTION = 10.0
"""A volume's density counts as at most so many times too small."""
LEAST_EVEN_SHARE = 0.05
"""Of the stretches, so that what the volume has missed is found."""

FINE_STEPS, FINE_EVEN_SHARE = 64, 0.3
"""Steps of the second look at the volume, and which share of them is spread evenly over what is occupied."""
ROUNDS = 3
"""In which borders of stretches move to where there is little weight."""
SHARE_WITHIN = 1e-4
"""What lies evenly counts so much where a stretch is sampled: one without weight has its sample in the middle. With
more, samples of stretches that hold two surfaces fall between these, where no view has taught the field a colour."""
TINY = 1e-9


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
        factor = factor.clamp(max=MOST_CORRECTION)
        return torch.where(lengths.isinf(), density, factor * self.depth / lengths.clamp(min=1e-12)).to(density)


@torch.no_grad()
def cut_into_stretches(
    segments: Segments, few: FewSamples, num_steps: int, unbounded: bool, occupancy: Optional[Occupancy] = None
) -> Stretches:
    """The stretches of a batch of rays, by what the volume shows in occupied cells.

    It is looked at on `num_steps` even steps, and then on `FINE_STEPS` that lie where the weight is: on even steps
    alone, neighbouring pixels see a surface in different steps, which shows as ripples like the grain of wood.
    """
    lines = lines_of(segments, num_steps, unbounded)
    if lines is None:
        is_kept, *values = _cut_in_torch(segments, few, num_steps, unbounded, occupancy)
    else:
        is_kept, *values = _cut_compiled(lines, few, occupancy)
    # Where they are is asked for once: a GPU is waited for with every mask.
    kept = is_kept.nonzero(as_tuple=True)
    s, lengths, depth = (each[kept] for each in values)
    return Stretches(PackedSamples(kept[0], s, lengths, segments.positions(s, kept[0])), depth)


class _Cut(NamedTuple):
    """All stretches of rays."""

    is_kept: Bool[Tensor, "rays samples"]
    """Whether they have a sample; what else is said of one without may be anything."""
    s: Float[Tensor, "rays samples"]
    lengths: Float[Tensor, "rays samples"]
    depth: Float[Tensor, "rays samples"]
    """By the volume."""


def _cut_compiled(lines: Lines, few: FewSamples, occupancy: Optional[Occupancy]) -> _Cut:
    num_rays, count = len(lines.hit), few.count + lines.unbounded
    is_kept = torch.zeros(num_rays, count, dtype=torch.bool)
    results = [torch.zeros(num_rays, count) for _ in range(3)]
    settings = few_samples_kernels.Settings(
        few.volume.log_density.numpy(),
        np.ones((1, 1, 1), dtype=bool) if occupancy is None else occupancy.occupied.numpy(),
        FINE_STEPS,
        np.float32(FINE_EVEN_SHARE),
        ROUNDS,
        np.float32(max(few.even_share, LEAST_EVEN_SHARE)),
        np.float32(SHARE_WITHIN),
        np.float32(LEAST_WEIGHT if few.even_share == 0.0 else -1.0),
        np.float32(TINY),
    )
    arrays = lines, settings, np.float32(LEAST_WEIGHT), is_kept.numpy(), *(each.numpy() for each in results)
    parts = even_parts(num_rays, -(-num_rays // RAYS_PER_PART))
    run_on_threads(few_samples_kernels.cut_rays, [(*part, *arrays) for part in parts])
    return _Cut(is_kept, *results)


def _cut_in_torch(
    segments: Segments, few: FewSamples, num_steps: int, unbounded: bool, occupancy: Optional[Occupancy]
) -> _Cut:
    """The same on any device."""
    edges = even_edges(len(segments.hit), num_steps, segments.hit.device)
    end = 0.5 * (edges[:, -2:-1] + edges[:, -1:])
    if unbounded:  # the last step is endless, and has a sample of its own
        edges = edges[:, :-1]
    depth, lengths = _looked_at(segments, edges, few.volume, occupancy)
    near = F.max_pool1d(dense_weights(depth)[:, None], kernel_size=3, stride=1, padding=1)[:, 0]
    edges = sample_pdf(edges, torch.lerp(_shares(near), _shares(lengths), FINE_EVEN_SHARE) + TINY, FINE_STEPS)
    depth, lengths = _looked_at(segments, edges, few.volume, occupancy)
    share = max(few.even_share, LEAST_EVEN_SHARE)
    weights, evenly = _shares(dense_weights(depth)), _shares(lengths)
    mass = torch.lerp(weights, evenly, share) + TINY
    place = _place(edges, _gathered(edges, mass, sample_pdf(edges, mass, few.count)))
    s = _middles(edges, torch.lerp(weights, evenly, SHARE_WITHIN) + TINY, place)
    depth, lengths = (_at(values, place).diff(dim=-1).clamp(min=0.0) for values in (depth, lengths))
    is_kept = lengths > 0.0
    if few.even_share == 0.0:
        is_kept &= dense_weights(depth) > LEAST_WEIGHT
    if unbounded:
        reached = segments.hit[:, None] & (torch.exp(-depth.sum(dim=-1, keepdim=True)) > LEAST_WEIGHT)
        is_kept, s = torch.cat([is_kept, reached], dim=-1), torch.cat([s, end], dim=-1)
        depth, lengths = F.pad(depth, (0, 1)), F.pad(lengths, (0, 1), value=torch.inf)
    return _Cut(is_kept, s, lengths, depth)


def _looked_at(
    segments: Segments, edges: Float[Tensor, "rays edges"], volume: DensityVolume, occupancy: Optional[Occupancy]
) -> Tuple[Float[Tensor, "rays steps"], Float[Tensor, "rays steps"]]:
    """Optical depths by the volume, and lengths, of steps; 0 in empty cells."""
    positions = segments.positions(0.5 * (edges[:, 1:] + edges[:, :-1]))
    lengths = torch.where(segments.hit[:, None], segments.lengths(edges), 0.0)
    if occupancy is not None:
        lengths = torch.where(occupancy.contains(positions), lengths, 0.0)
    return optical_depth(volume.density(positions), lengths), lengths


def _shares(values: Float[Tensor, "rays steps"]) -> Float[Tensor, "rays steps"]:
    """Each row over its sum; 0 where that is 0."""
    return values / values.sum(dim=-1, keepdim=True).clamp(min=1e-12)


class _Place(NamedTuple):
    """Where points of rays lie among steps."""

    step: Int[Tensor, "rays points"]
    part: Float[Tensor, "rays points"]
    """Of the step, in [0, 1]."""


def _place(edges: Float[Tensor, "rays edges"], s: Float[Tensor, "rays points"]) -> _Place:
    step = torch.searchsorted(edges, s, right=True).clamp(1, edges.shape[-1] - 1) - 1
    start = edges.gather(-1, step)
    return _Place(step, ((s - start) / (edges.gather(-1, step + 1) - start).clamp(min=TINY)).clamp(0.0, 1.0))


def _at(values: Float[Tensor, "rays steps"], place: _Place) -> Float[Tensor, "rays points"]:
    """Sums of steps' values up to points."""
    before = F.pad(torch.cumsum(values, dim=-1), (1, 0))
    return before.gather(-1, place.step) + place.part * values.gather(-1, place.step)


def _gathered(
    edges: Float[Tensor, "rays edges"], mass: Float[Tensor, "rays steps"], borders: Float[Tensor, "rays borders"]
) -> Float[Tensor, "rays borders"]:
    """Borders moved to where there is little mass, between two surfaces that would share a stretch (Lloyd 1982)."""
    moment = mass * 0.5 * (edges[:, 1:] + edges[:, :-1])
    for _ in range(ROUNDS):
        place = _place(edges, borders)
        within, sums = (_at(values, place).diff(dim=-1) for values in (mass, moment))
        centers = (sums / within.clamp(min=TINY)).clamp(borders[:, :-1], borders[:, 1:])
        inner = 0.5 * (centers[:, 1:] + centers[:, :-1])
        borders = torch.cat([borders[:, :1], inner, borders[:, -1:]], dim=-1)
    return borders


def _middles(
    edges: Float[Tensor, "rays edges"], mass: Float[Tensor, "rays steps"], borders: _Place
) -> Float[Tensor, "rays stretches"]:
    """Where half of the mass between neighbouring borders lies."""
    until = _at(mass, borders)
    middle = _place(F.pad(torch.cumsum(mass, dim=-1), (1, 0)), 0.5 * (until[:, 1:] + until[:, :-1]))
    return torch.lerp(edges.gather(-1, middle.step), edges.gather(-1, middle.step + 1), middle.part)

"""Grids that remember what each part of the cube holds, so that samples go where something is."""

from typing import Callable, NamedTuple, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from sparsestyle_ns.core.sampling import even_edges, sample_pdf
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.core.volrend import dense_weights, optical_depth

LEAST_DENSITY = 1e-4
"""Per half side of the cube; less shows nowhere."""


def interval_lengths(
    segments: Segments, edges: Float[Tensor, "rays edges"], unbounded: bool
) -> Float[Tensor, "rays samples"]:
    """δ of each sample; the last is infinite in an unbounded space, as in NeRF, for rays that hit it."""
    lengths = segments.lengths(edges)
    if not unbounded:
        return lengths
    last = torch.where(segments.hit, torch.inf, 0.0)[:, None].to(lengths)
    return torch.cat([lengths[:, :-1], last], dim=-1)


def grid_cells(positions: Float[Tensor, "*batch 3"], resolution: int) -> Int[Tensor, "*batch 3"]:
    """Indices of the cells of the cube [−1, 1]³ that positions lie in; outside of it the nearest cell's."""
    # Cut off before they become integers, which have no numbers for the farthest points. What is no number gets the
    # first cell: an index out of bounds would end the process on a GPU before anyone could say where it came from.
    return ((0.5 * positions + 0.5) * resolution).clamp(0, resolution - 1).long().clamp_(min=0)


class DensityGrid(nn.Module):
    """σ per cell of the cube, `resolution` a side, of a field that learns; `initial` before anything is known."""

    density: Float[Tensor, "cells"]

    def __init__(self, resolution: int, initial: float = 1.0) -> None:
        super().__init__()
        self.resolution = resolution
        self.register_buffer("density", torch.full((resolution**3,), initial))

    def cells(self, positions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """The cell each position lies in."""
        index = grid_cells(positions, self.resolution)
        return (index[..., 0] * self.resolution + index[..., 1]) * self.resolution + index[..., 2]

    @torch.no_grad()
    def remember(
        self, positions: Float[Tensor, "*batch 3"], density: Float[Tensor, "*batch"], decay: float = 0.8
    ) -> None:
        """Takes note of densities seen at positions: the larger of them and `decay` times what the cell had."""
        cells = self.cells(positions).reshape(-1)
        seen = density.detach().reshape(-1).to(self.density)
        self.density[cells] *= decay
        # The step that a density which isn't finite comes from is skipped, but what the grid holds would stay.
        self.density.scatter_reduce_(0, cells, seen.where(seen.isfinite(), 0.0), reduce="amax")

    @torch.no_grad()
    def place_samples(
        self,
        segments: Segments,
        num_samples: int,
        num_bins: int,
        unbounded: bool,
        even_share: float,
        generator: Optional[torch.Generator] = None,
    ) -> Float[Tensor, "rays edges"]:
        """Borders of samples on each ray, dense where the remembered density is seen from the camera.

        They follow its weights on even bins, of which a share in (0, 1] is spread evenly; a `generator` moves them.
        """
        rays = len(segments.hit)
        edges = even_edges(rays, num_bins, self.density.device, generator)
        middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
        density = self.density[self.cells(segments.positions(middle))]
        weights = dense_weights(optical_depth(density, interval_lengths(segments, edges, unbounded)))
        weights = F.max_pool1d(weights[:, None], kernel_size=3, stride=1, padding=1)[:, 0]
        share = weights / weights.sum(dim=-1, keepdim=True).clamp(min=1e-6)
        return sample_pdf(edges, (1.0 - even_share) * share + even_share / num_bins, num_samples, generator)


class DensityVolume(nn.Module):
    """σ of a frozen field at the centres of the cube's cells, `resolution` a side, interpolated in its logarithm."""

    log_density: Float[Tensor, "x y z"]

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.resolution = resolution
        self.register_buffer("log_density", torch.zeros(resolution, resolution, resolution))

    @torch.no_grad()
    def measure(self, density: Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points"]], chunk: int) -> None:
        """Takes the densities of a field, `chunk` points at a time."""
        axis = (torch.arange(self.resolution, device=self.log_density.device) + 0.5) * (2.0 / self.resolution) - 1.0
        found = []
        for xs in axis.split(max(1, chunk // self.resolution**2)):
            points = torch.stack(torch.meshgrid(xs, axis, axis, indexing="ij"), dim=-1)
            found.append(density(points.reshape(-1, 3)).float().view(points.shape[:-1]))
        self.log_density.copy_(torch.cat(found).clamp(min=LEAST_DENSITY).log())

    def density(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """σ at positions, at least `LEAST_DENSITY`; outside of the cube that of its border."""
        places = positions.reshape(1, 1, 1, -1, 3).flip(-1).to(self.log_density)
        found = F.grid_sample(self.log_density[None, None], places, padding_mode="border", align_corners=False)
        return found.view(positions.shape[:-1]).exp()


class Occupancy(nn.Module):
    """Which cells of the cube, `resolution` a side, hold anything of a frozen field."""

    occupied: Bool[Tensor, "x y z"]

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.resolution = resolution
        self.register_buffer("occupied", torch.ones(resolution, resolution, resolution, dtype=torch.bool))

    @property
    def share(self) -> float:
        """Share of the cells that are occupied, in [0, 1]."""
        return self.occupied.float().mean().item()

    @torch.no_grad()
    def measure(self, volume: DensityVolume, min_alpha: float) -> None:
        """Marks the cells with 1 − exp(−σ · cell side) above `min_alpha` at their centre, and their neighbours.

        The volume has the same resolution.
        """
        alpha = -torch.expm1(-volume.log_density.exp() * (2.0 / self.resolution))
        occupied = (alpha > min_alpha).float()
        self.occupied.copy_(F.max_pool3d(occupied[None], kernel_size=3, stride=1, padding=1)[0] > 0)

    def contains(self, positions: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether positions lie in occupied cells."""
        index = grid_cells(positions, self.resolution)
        return self.occupied[index[..., 0], index[..., 1], index[..., 2]]


class PackedSamples(NamedTuple):
    """Samples in the packed layout (see `volrend`): middles of intervals, s in [0, 1] and positions, and lengths δ."""

    ray_indices: Int[Tensor, "samples"]
    s: Float[Tensor, "samples"]
    lengths: Float[Tensor, "samples"]
    positions: Float[Tensor, "samples 3"]

    def select(self, keep: Tensor) -> "PackedSamples":
        """Some of the samples, in order, by mask or ascending indices."""
        return PackedSamples(*(part[keep] for part in self))


@torch.no_grad()
def march(segments: Segments, occupancy: Optional[Occupancy], num_steps: int, unbounded: bool) -> PackedSamples:
    """The samples of even steps along each ray that lie in occupied cells, and an unbounded space's last one."""
    edges = even_edges(len(segments.hit), num_steps, segments.hit.device)
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    positions = segments.positions(middle)
    keep = segments.hit[:, None].expand(-1, num_steps)
    if occupancy is not None:
        filled = occupancy.contains(positions)
        if unbounded:
            filled[:, -1] = True
        keep = keep & filled
    kept = keep.nonzero(as_tuple=True)
    lengths = interval_lengths(segments, edges, unbounded)
    return PackedSamples(kept[0], middle[kept], lengths[kept], positions[kept])

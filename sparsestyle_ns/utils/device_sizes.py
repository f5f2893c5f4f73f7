"""What is chosen by device: how much is worked on at once, and what may be kept. Results differ by rounding alone.

Number formats are chosen in `core.precision`, and the hash grid's kernels in `hash_grid.fused_kernels`.

The sizes for a CPU are measured. Those for a GPU haven't been on one yet: they are reckoned from memory, at most half a
gigabyte for what is worked on at once, and from how few and how large launches should be.
"""

from typing import NamedTuple

import psutil
import torch

KEPT_SHARE = 0.25
"""Of the memory that is free when views are prepared; the rest is for an iteration's own tensors, and for others."""


class Sizes(NamedTuple):
    """How much is worked on at once."""

    mlp_points: int
    """Points of the MLPs where no layer is kept. On a CPU, hidden layers of 4,096 points stay in its cache, which makes
    a frozen coarse field 1.5 times as fast as with 2^17 (2.8 against 4.2 µs a point on two cores). On a GPU the bound
    is memory: 256 half-precision numbers for 2^17 points are 64 MiB a layer."""
    marched_rays: int
    """Rays whose steps through empty space are looked at, a hundred bytes for each of 128 steps. A GPU wants fewer and
    larger launches."""
    style_block: int
    """Most of the painting's feature vectors in a block of the search. A CPU rules more of them out with small blocks;
    a GPU wants fewer and larger products."""
    bounded_vectors: int
    """Feature vectors of either kind whose similarities are bounded at once. Bounds should stay in a CPU's cache."""


SIZES = {
    "cpu": Sizes(mlp_points=1 << 12, marched_rays=1 << 13, style_block=128, bounded_vectors=1 << 10),
    "cuda": Sizes(mlp_points=1 << 17, marched_rays=1 << 15, style_block=1 << 10, bounded_vectors=1 << 12),
}


def sizes_for(device: torch.device) -> Sizes:
    """The sizes for a device; one that is neither a CPU nor CUDA gets those for CUDA."""
    return SIZES["cpu" if device.type == "cpu" else "cuda"]


def bytes_to_keep(device: torch.device) -> float:
    """Memory for what stays the same from iteration to iteration: of the GPU where the work is on one, else main."""
    on_gpu = device.type == "cuda"
    free = torch.cuda.mem_get_info(device)[0] if on_gpu else psutil.virtual_memory().available
    return KEPT_SHARE * free

"""A whole view rendered as one differentiable image, in bounded memory.

The view's rays are cut into chunks of a limited number of samples. Each chunk but a lone one is rendered under gradient
checkpointing: its activations are computed again in the backward pass, so that the gradient equals that of rendering
all at once while only one chunk's activations exist at a time.
"""

from functools import partial
from itertools import pairwise
from typing import Callable, List, Optional

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from sparsestyle_ns.rendering.render import FrozenSamples


def equal_runs(num_rays: int, most: int) -> List[slice]:
    """Cuts rays into as few consecutive runs of about the same length as have at most so many each."""
    count = max(1, -(-num_rays // max(1, most)))
    borders = [num_rays * part // count for part in range(count + 1)]
    return [slice(*pair) for pair in pairwise(borders)]


class FrozenView:
    """The rays of one view, cut into chunks, with the frozen part of each chunk's work kept or done again each time.

    Kept chunks take at most `keep_bytes` of memory; those past it are frozen again whenever they are rendered.
    """

    def __init__(self, runs: List[slice], freeze: Callable[[slice], FrozenSamples], keep_bytes: float) -> None:
        self.runs = runs
        self.freeze = freeze
        self.kept: List[Optional[FrozenSamples]] = []
        self.kept_bytes = 0
        for run in runs:
            frozen = freeze(run) if self.kept_bytes < keep_bytes else None
            if frozen is None or self.kept_bytes + frozen.num_bytes > keep_bytes:
                frozen, keep_bytes = None, 0
            else:
                self.kept_bytes += frozen.num_bytes
            self.kept.append(frozen)

    @property
    def num_chunks(self) -> int:
        """Chunks the view is cut into."""
        return len(self.runs)

    @property
    def is_kept(self) -> bool:
        """Whether all of the view's frozen samples are kept."""
        return all(chunk is not None for chunk in self.kept)

    def chunk(self, index: int) -> FrozenSamples:
        """The frozen samples of a chunk."""
        kept = self.kept[index]
        return self.freeze(self.runs[index]) if kept is None else kept

    def render(self, render_chunk: Callable[[FrozenSamples], Float[Tensor, "rays channels"]]) -> Tensor:
        """Pixels of the view, [rays, channels], differentiable in whatever `render_chunk` learns."""

        def run(index: int) -> Tensor:
            return render_chunk(self.chunk(index))

        once = run
        if self.num_chunks > 1 and torch.is_grad_enabled():
            once = partial(checkpoint, run, use_reentrant=False, preserve_rng_state=False)
        return torch.cat([once(index) for index in range(self.num_chunks)])

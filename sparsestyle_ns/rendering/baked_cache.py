"""The baked volumes of the styles that were shown last."""

import threading
from typing import Callable, Dict, Iterable, List, Optional, Sequence, Tuple

import torch
from torch import Tensor, nn

from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.rendering.baked import BakedVolume, render_baked
from sparsestyle_ns.rendering.mixing import STYLISED, Mix
from sparsestyle_ns.rendering.render import Background, PackedRender
from sparsestyle_ns.rendering.visible_samples import Marching

MOST_BAKED = 4
"""Styles whose volumes are kept."""


class BakedCache:
    """Keeps a baked volume for each of the styles that were shown last, for as long as no weight in it changes.

    Any number of threads may render: they take turns.

    Args:
        bake: makes a style's volume, with nothing in it yet.
        shared: gives the modules that the pictures of all styles depend on.
    """

    def __init__(self, bake: Callable[[StylisedField], BakedVolume], shared: Callable[[], Iterable[nn.Module]]) -> None:
        self._bake, self._shared = bake, shared
        self.volumes: Dict[StylisedField, Tuple[BakedVolume, List[Tensor]]] = {}
        """By style, the volume and the weights that it was made of; the style that was shown last comes last."""
        self._lock = threading.Lock()  # volumes grow while they are rendered, and a viewer has several threads

    def render(
        self,
        styles: Sequence[StylisedField],
        segments: Segments,
        marching: Marching,
        background: Background,
        mix: Mix = STYLISED,
    ) -> Tuple[PackedRender, PackedRender]:
        """`render_baked` of one or two styles; what these rays need and the volumes don't have yet is filled in."""
        with self._lock:
            first, second = (*map(self._current, styles), None)[:2]
            return render_baked(first, segments, marching, background, mix, second)

    def kept(self, style: StylisedField) -> Optional[BakedVolume]:
        """The volume of a style's next picture.

        None where that picture would start a new one: it is the style's first, the weights have changed, or
        `MOST_BAKED` other styles were shown since the last one.
        """
        volume, known = self.volumes.get(style, (None, []))
        return volume if volume is not None and all(map(torch.equal, known, self._weights(style))) else None

    def _current(self, style: StylisedField) -> BakedVolume:
        """A style's volume, a new one if what it shows has changed since the last picture."""
        weights, volume = self._weights(style), self.kept(style) or self._bake(style)
        # The viewer may break a picture off between any two lines; here that loses nothing.
        others = {each: kept for each, kept in self.volumes.items() if each is not style}
        self.volumes = dict([*others.items(), (style, (volume, weights))][-MOST_BAKED:])
        return volume

    def _weights(self, style: StylisedField) -> List[Tensor]:
        """What changes with every change of the weights that a style's pictures show, and is quick to compare.

        torch counts the changes of each tensor, but not those that fused optimisers make; these change every parameter
        of the residual MLP.
        """
        tensors = [tensor for part in (*self._shared(), style) for tensor in (*part.parameters(), *part.buffers())]
        versions = torch.tensor([(tensor.data_ptr(), tensor._version) for tensor in tensors])
        values = [parameter for name, parameter in style.named_parameters() if not name.startswith("grid")]
        return [versions, torch.cat([value.detach().flatten() for value in values])]

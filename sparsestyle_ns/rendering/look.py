"""What pictures made outside of training show: how they are rendered, and of which fields."""

from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Callable, Iterator, Literal, Optional, Tuple

from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.rendering.mixing import Mix

RenderMode = Literal["exact", "baked"]


@dataclass(frozen=True)
class Look:
    """How pictures are made, and of what."""

    mode: RenderMode
    mix: Mix
    styles: Optional[Tuple[StylisedField, ...]] = None
    """One or two, on the model's device; None: the model's own."""


class Display:
    """The look of a model's pictures, at first the one of the run's config; the viewer's threads may see another."""

    def __init__(self, own: Look) -> None:
        self.own = own
        self.viewer: Callable[[], Optional[Look]] = lambda: None
        """Gives the look of the viewer's pictures in the viewer's own threads, and None in all others."""

    @property
    def look(self) -> Look:
        """The look of a picture that is made in this thread."""
        return self.viewer() or self.own

    @contextmanager
    def rendering(self, mode: RenderMode) -> Iterator[None]:
        """Within it, pictures are made in this mode, except those for the viewer."""
        before, self.own = self.own, replace(self.own, mode=mode)
        try:
            yield
        finally:
            self.own = before

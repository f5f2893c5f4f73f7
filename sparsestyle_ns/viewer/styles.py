"""The styles of a scene that a viewer can show: fields, their paintings, and what made them."""

import base64
from dataclasses import dataclass, field
from pathlib import Path
from typing import List, Optional, Tuple

from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.runs.checkpoints import CheckpointNotes, load_checkpoint, newest_checkpoint
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.viewer.texts import plain

Facts = List[Tuple[str, str]]
"""What made a style: pairs of what it is called and what it is."""


@dataclass(eq=False)
class Style:
    """One style of the scene.

    Attributes:
        name: what the panel calls it.
        field: gives σ_f and c_f.
        facts: what made it.
        thumbnail: a small JPEG of its painting.
    """

    name: str
    field: StylisedField
    facts: Facts = field(default_factory=list)
    thumbnail: Optional[bytes] = None

    def markdown(self) -> str:
        """The thumbnail, and what made the style."""
        picture = []
        if self.thumbnail is not None:
            picture = [f"![painting](data:image/jpeg;base64,{base64.b64encode(self.thumbnail).decode()})"]
        return "\n\n".join([*picture, *(f"**{name}** {plain(value)}" for name, value in self.facts)])


def style_facts(painting: Optional[str], run: str, notes: CheckpointNotes, iterations: Optional[int] = None) -> Facts:
    """What made a style.

    Args:
        painting: its file's name.
        run: the run's folder, or why there is none.
        notes: of its checkpoint, or of its trainer.
        iterations: how many it has behind it; None: not known yet.
    """
    facts = [("Painting", painting or "not known"), ("Run", run)]
    if iterations is not None:
        facts.append(("Iterations", str(iterations)))
    if notes.backbone is not None:
        facts.append(("Features", "{name}, {source}".format(**notes.backbone)))
    if notes.coarse_run is not None:
        facts.append(("Coarse run", notes.coarse_run))
    return facts


def saved_notes(folder: Path) -> Tuple[CheckpointNotes, Optional[int]]:
    """What the newest checkpoint in a folder says, and its iterations; nothing where none can be read."""
    newest = newest_checkpoint(folder)
    try:
        state = {} if newest is None else load_checkpoint(newest)
    except InputError:
        state = {}
    return CheckpointNotes.of(state), state["step"] + 1 if state else None

"""The styles of a scene that a viewer can show: fields, their paintings, and what made them."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import List, Optional, Tuple

from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.runs.checkpoints import CheckpointNotes, load_checkpoint, newest_checkpoint
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.page import bytes_uri

Facts = List[Tuple[str, str]]
"""What made a style: pairs of what it is called and what it is."""


def plain(text: str) -> str:
    """Text that Markdown shows as it is, and that may be broken behind slashes and underscores.

    viser's Markdown takes JSX; a panel with a path in it that doesn't fit would have to be scrolled sideways.
    """
    escaped = re.sub(r"([\\`*_{}\[\]<>()#+!|~$&])", r"\\\1", " ".join(text.split()))
    return re.sub(r"(/|\\_)", r"\1<wbr />", escaped)


@dataclass(eq=False)
class Style:
    """One style of the scene."""

    name: str
    field: StylisedField
    facts: Facts = field(default_factory=list)
    thumbnail: Optional[bytes] = None
    """A small JPEG of its painting."""

    def markdown(self) -> str:
        """The thumbnail, and what made the style."""
        lines = [f"**{name}** {plain(value)}" for name, value in self.facts]
        if self.thumbnail is not None:
            lines.insert(0, f"![painting]({bytes_uri(self.thumbnail, 'image/jpeg')})")
        return "\n\n".join(lines)


def style_facts(painting: Optional[str], run: str, notes: CheckpointNotes, iterations: Optional[int] = None) -> Facts:
    """What made a style: its painting's file name, the run's folder, and notes of its checkpoint or of its trainer."""
    facts = [("Painting", painting or "not known"), ("Run", run)]
    if iterations is not None:
        facts.append(("Iterations", str(iterations)))
    if "backbone" in notes:
        facts.append(("Features", "{name}, {source}".format(**notes["backbone"])))
    if "coarse_run" in notes:
        facts.append(("Coarse run", notes["coarse_run"]))
    return facts


def saved_notes(folder: Path) -> Tuple[CheckpointNotes, Optional[int]]:
    """What the newest checkpoint in a folder says, and its iterations; nothing where none can be read."""
    newest = newest_checkpoint(folder)
    try:
        state = {} if newest is None else load_checkpoint(newest)
    except InputError:
        state = {}
    notes = {name: state[name] for name in CheckpointNotes.__annotations__ if name in state}
    return notes, state["step"] + 1 if state else None

"""The styles of a scene that a viewer can show: fields, their paintings, and what made them."""

import base64
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Dict, List, Optional, Tuple

from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.runs.checkpoints import load_checkpoint, newest_checkpoint
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


def style_facts(painting: Optional[str], run: str, notes: Dict[str, Any]) -> Facts:
    """What made a style.

    Args:
        painting: its file's name.
        run: the run's folder, or why there is none.
        notes: of its checkpoint, or of its trainer.
    """
    facts = [("Painting", painting or "not known"), ("Run", run)]
    if "step" in notes:
        facts.append(("Iterations", str(notes["step"] + 1)))
    if "backbone" in notes:
        facts.append(("Features", "{name}, {source}".format(**notes["backbone"])))
    if "coarse_run" in notes:
        facts.append(("Coarse run", notes["coarse_run"]))
    return facts


def checkpoint_notes(folder: Path) -> Dict[str, Any]:
    """What the newest checkpoint in a folder says beside the state; nothing where there is none or it can't be read."""
    newest = newest_checkpoint(folder)
    try:
        state = {} if newest is None else load_checkpoint(newest)
    except InputError:
        return {}
    return {name: state[name] for name in ("step", "backbone", "coarse_run") if name in state}

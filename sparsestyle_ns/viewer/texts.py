"""What the panels say, as the viewer's Markdown."""

import re
from typing import Dict

from sparsestyle_ns.utils.errors import InputError


def plain(text: str) -> str:
    """Text that Markdown shows as it is, and that may be broken behind slashes and underscores.

    viser's Markdown takes JSX; a panel with a path in it that doesn't fit would have to be scrolled sideways.
    """
    escaped = re.sub(r"([\\`*_{}\[\]<>()#+!|~$&])", r"\\\1", " ".join(text.split()))
    return re.sub(r"(/|\\_)", r"\1<wbr />", escaped)


def losses_text(losses: Dict[str, float]) -> str:
    """Losses and weights by name, in a line."""
    return ", ".join(f"{name} {value:.3g}" for name, value in losses.items())


def error_text(error: Exception) -> str:
    """An error in one sentence; one that isn't about the user's input keeps its kind."""
    text = in_one_line(error)
    if isinstance(error, InputError):
        return text
    return f"Something went wrong in restyling, and the style on the screen stays ({type(error).__name__}: {text})."


def in_one_line(error: Exception) -> str:
    """An error's message without line breaks, or its kind where it has none."""
    return " ".join(str(error).split()) or type(error).__name__

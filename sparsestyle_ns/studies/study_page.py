"""The page of a study: paragraphs, tables, plots and grids of pictures in one file that opens offline."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Dict, List, Sequence, Tuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from sparsestyle_ns.evaluation.tables import Table
from sparsestyle_ns.utils.page import render_page

Plot = Tuple[str, str]
"""A picture as SVG, and its caption."""
Captioned = List[Tuple[str, Path]]
"""Pictures' captions and files."""


@dataclass
class Section:
    """A part of the page; all texts are plain."""

    heading: str
    text: str = ""
    lines: Sequence[str] = ()
    """A list below the text."""
    tables: Sequence[Table] = ()
    plots: Sequence[Plot] = ()
    grid: Sequence[Tuple[str, Captioned]] = ()
    """Rows of pictures, each with a name."""
    note: str = ""
    """A paragraph below all, in small type."""
    facts: Dict[str, str] = field(default_factory=dict)
    """What it depends on, by name."""
    parts: Sequence["Section"] = ()


def study_page(title: str, sections: Sequence[Section]) -> str:
    """The page as HTML."""
    return render_page("study.html", "sparsestyle_ns.studies", title=title, sections=sections, pixels=_pixels)


def _pixels(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    with Image.open(path) as image:
        return np.array(image.convert("RGB"))

"""The gallery page: photos, painting, the scene before and after, a film of it, and how it was made.

The page is one HTML file that needs nothing else: pictures and films lie inside it as data URIs, so that it opens
without a network and can be sent as it is. This module knows nothing of nerfstudio, only of pictures.
"""

from dataclasses import dataclass, field, replace
from typing import Dict, List, Optional, Sequence, Tuple

import numpy as np
from PIL import Image

from sparsestyle_ns.evaluation.tables import Table
from sparsestyle_ns.utils.files import free_name
from sparsestyle_ns.utils.page import Pixels, render_page

THUMBNAIL_SIDE = 224
"""Pixels that a picture of the grid has at most along its longer side."""


@dataclass
class Picture:
    """A picture with its caption."""

    pixels: Pixels
    caption: str


@dataclass
class View:
    """One viewpoint of a run: both renders, the photo taken there, and the stylised depth as a picture, of one size."""

    name: str
    stylised: Pixels
    coarse: Pixels
    photo: Pixels
    depth: Pixels


@dataclass
class Film:
    """An MP4 file's bytes, and what they show."""

    content: bytes
    caption: str


@dataclass
class RunPictures:
    """All that the page shows of one run.

    Attributes:
        name: of the scene.
        subtitle: a line on how it was made.
        photos: those it was trained on.
        views: at least one; the first is shown large.
        style_name: the painting's; on the page, another painting of that name gets a number behind it.
        style: the painting; None where its file is gone.
        style_note: said in its place.
        settings: (label, value) of how the run was made.
        effects: lines of the table of effects, the first of them its heading.
    """

    name: str
    subtitle: str
    photos: List[Picture]
    views: List[View]
    style_name: str = ""
    style: Optional[Picture] = None
    style_note: str = "The style image is no longer where it was."
    film: Optional[Film] = None
    tables: List[Table] = field(default_factory=list)
    settings: List[Tuple[str, str]] = field(default_factory=list)
    effects: List[Tuple[str, ...]] = field(default_factory=list)

    @property
    def heading(self) -> str:
        """Scene and painting."""
        return f"{self.name} · {self.style_name}" if self.style_name else self.name


def gallery_page(runs: Sequence[RunPictures], title: str) -> str:
    """The whole page as HTML: a section for each run, and a grid of scenes and paintings where there are several."""
    runs = with_distinct_paintings(runs)
    scenes: Dict[str, Pixels] = {}
    paintings: Dict[str, Optional[Pixels]] = {}
    for run in runs:
        scenes.setdefault(run.name, run.views[0].coarse)
        paintings.setdefault(run.style_name, None if run.style is None else run.style.pixels)
    numbered = list(enumerate(runs, start=1))
    return render_page(
        "gallery.html", __package__, title=title, runs=numbered, scenes=scenes, paintings=paintings, thumbnail=thumbnail
    )


def with_distinct_paintings(runs: Sequence[RunPictures]) -> List[RunPictures]:
    """The runs, with a number behind a painting's name where another painting is called the same.

    Paintings are the same if their names and pixels are; a painting whose file is gone is another one.
    """
    names: Dict[Tuple[str, object], str] = {}
    distinct = []
    for run in runs:
        pixels = None if run.style is None else (run.style.pixels.shape, run.style.pixels.tobytes())
        name = names.setdefault((run.style_name, pixels), free_name(run.style_name, names.values()))
        distinct.append(replace(run, style_name=name))
    return distinct


def thumbnail(pixels: Pixels, longest: int = THUMBNAIL_SIDE) -> Pixels:
    """A picture with at most `longest` pixels along its longer side; a smaller one stays as it is."""
    image = Image.fromarray(pixels)
    image.thumbnail((longest, longest), Image.Resampling.LANCZOS)
    return np.array(image)

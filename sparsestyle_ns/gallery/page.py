"""The gallery page: photos, painting, the scene before and after, a film of it, and how it was made.

The page is one HTML file that needs nothing else: pictures and films lie inside it as data URIs, so that it opens
without a network and can be sent as it is. This knows nothing of nerfstudio, only of pictures.
"""

import base64
from dataclasses import dataclass, field, replace
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Dict, List, Optional, Sequence, Tuple

from sparsestyle_ns.evaluation.tables import Table
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.names import free_name
from sparsestyle_ns.utils.page import Pixels, figure, image, picture_page, table

THUMBNAIL_SIDE = 224
"""Pixels that a picture of the grid has at most along its longer side."""


@dataclass
class Picture:
    """A picture with its caption."""

    pixels: Pixels
    caption: str


@dataclass
class View:
    """One viewpoint of a run, all pictures of the same size.

    Attributes:
        name: what kind of view it is and which.
        stylised: the stylised render.
        coarse: the render before stylising.
        photo: the photo taken there, where there is one.
        depth: the stylised scene's depth, as a picture.
    """

    name: str
    stylised: Pixels
    coarse: Pixels
    photo: Optional[Pixels] = None
    depth: Optional[Pixels] = None


@dataclass
class Film:
    """A flight through the scene or a turn about it.

    Attributes:
        content: an MP4 file's bytes.
        caption: what it shows, and how it was made.
    """

    content: bytes
    caption: str


def read_film(path: Path) -> Film:
    """A film from an MP4 file.

    Raises:
        InputError: it can't be read or is no MP4.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"The video {path} can't be read ({error.strerror}).") from error
    if content[4:8] != b"ftyp":
        raise InputError(f"{path} is no MP4 video; give one that ns-render wrote.")
    return Film(content, "A flight through the stylised scene.")


@dataclass
class RunPictures:
    """All that the page shows of one run.

    Attributes:
        name: the scene's name, the section's heading.
        subtitle: a line on how it was made.
        photos: the photos it was trained on.
        views: viewpoints, the first of them shown large; at least one.
        style_name: the painting's name; on the page, another painting of that name gets a number behind it.
        style: the style image; None where its file is gone.
        style_note: said in its place.
        film: of the stylised scene.
        figures: (label, value) of measurements of the views that are shown.
        tables: what was measured of all held-out views; shown instead of `figures`.
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
    figures: List[Tuple[str, str]] = field(default_factory=list)
    tables: List[Table] = field(default_factory=list)
    settings: List[Tuple[str, str]] = field(default_factory=list)
    effects: List[Tuple[str, ...]] = field(default_factory=list)


def gallery_page(runs: Sequence[RunPictures], title: str) -> str:
    """The whole page as HTML.

    Args:
        runs: what to show, in this order.
        title: the page's heading, plain text.
    """
    runs, several = _paintings_told_apart(runs), len(runs) > 1
    contents = _contents(runs) if several else ""
    sections = (_grid(runs) if several else "") + "".join(
        _section(run, _anchor(number)) for number, run in enumerate(runs, start=1)
    )
    return picture_page(title, contents, sections, _file("page.css"), _file("page.js"))


def _paintings_told_apart(runs: Sequence[RunPictures]) -> List[RunPictures]:
    """The runs, with one name for a painting and another for each other painting that is called the same."""
    names: Dict[Tuple, str] = {}
    for run in runs:
        if _painting(run) not in names:
            names[_painting(run)] = free_name(run.style_name, names.values())
    return [replace(run, style_name=names[_painting(run)]) for run in runs]


def _painting(run: RunPictures) -> Tuple:
    """What makes a painting another one: its name or its pixels, as far as these are known."""
    pixels = None if run.style is None else run.style.pixels
    return run.style_name, None if pixels is None else (pixels.shape, pixels.tobytes())


def _file(name: str) -> str:
    return (files("sparsestyle_ns.gallery") / name).read_text(encoding="utf-8")


def _anchor(number: int) -> str:
    return f"run-{number}"


def _contents(runs: Sequence[RunPictures]) -> str:
    links = "".join(
        f'<a href="#{_anchor(number)}">{escape(_full_name(run))}</a>' for number, run in enumerate(runs, start=1)
    )
    return f'<nav aria-label="Runs">{links}</nav>'


def _full_name(run: RunPictures) -> str:
    return f"{run.name} · {run.style_name}" if run.style_name else run.name


def _grid(runs: Sequence[RunPictures]) -> str:
    """Scenes down, paintings across; each picture leads to its run. Runs of the same two stand below each other."""
    scenes, styles = dict.fromkeys(run.name for run in runs), dict.fromkeys(run.style_name for run in runs)
    cells: Dict[Tuple[str, str], str] = {}
    for number, run in enumerate(runs, start=1):
        picture = image(_thumbnail(run.views[0].stylised), f"{_full_name(run)}, stylised")
        at = run.name, run.style_name
        cells[at] = cells.get(at, "") + f'<a href="#{_anchor(number)}">{picture}</a>'
    head = "".join(_grid_head("col", style, _painting_of(style, runs)) for style in styles)
    rows = "".join(
        f"<tr>{_grid_head('row', scene, next(run.views[0].coarse for run in runs if run.name == scene))}"
        + "".join(f"<td>{cells.get((scene, style), '')}</td>" for style in styles)
        + "</tr>"
        for scene in scenes
    )
    return (
        '<section class="grid" aria-label="Scenes and paintings"><div class="scroll"><table>'
        f"<thead><tr><td></td>{head}</tr></thead><tbody>{rows}</tbody></table></div></section>\n"
    )


def _painting_of(style: str, runs: Sequence[RunPictures]) -> Optional[Pixels]:
    return next((run.style.pixels for run in runs if run.style_name == style and run.style is not None), None)


def _grid_head(scope: str, name: str, pixels: Optional[Pixels]) -> str:
    picture = "" if pixels is None else image(_thumbnail(pixels), name)
    return f'<th scope="{scope}">{picture}<span>{escape(name)}</span></th>'


def _thumbnail(pixels: Pixels) -> Pixels:
    """Every n-th pixel of n × n means, so that the longer side has at most `THUMBNAIL_SIDE` pixels."""
    step = -(-max(pixels.shape[:2]) // THUMBNAIL_SIDE)
    height, width = (side // step for side in pixels.shape[:2])
    blocks = pixels[: height * step, : width * step].reshape(height, step, width, step, 3)
    return blocks.mean(axis=(1, 3)).round().astype("uint8")


def _section(run: RunPictures, anchor: str) -> str:
    name = escape(_full_name(run))
    return (
        f'<section class="run" id="{anchor}" aria-labelledby="{anchor}-name">\n'
        f'<div class="heading"><h2 id="{anchor}-name">{name}</h2><p>{escape(run.subtitle)}</p></div>\n'
        f'<div class="stage">{_comparison(run.views[0])}{_film(run.film)}</div>\n'
        f"{_sources(run)}{_views(run.views)}{_facts(run)}</section>\n"
    )


def _comparison(view: View) -> str:
    """The slider between the coarse and the stylised render; without scripts, half of each."""
    return (
        '<figure><div class="compare">'
        f"{image(view.stylised, f'{view.name}, stylised')}{image(view.coarse, f'{view.name}, coarse', 'before')}"
        '<span class="tag left">Before</span><span class="tag right">After</span>'
        '<span class="handle" aria-hidden="true"></span>'
        '<input type="range" min="0" max="100" step="1" value="50" aria-label="Share of the coarse render in percent">'
        f"</div><figcaption>{escape(view.name)}, coarse and stylised. Drag to compare.</figcaption></figure>"
    )


def _film(film: Optional[Film]) -> str:
    if film is None:
        return ""
    return (
        f'<figure><video autoplay loop muted playsinline controls aria-label="{escape(film.caption)}" '
        f'src="data:video/mp4;base64,{base64.b64encode(film.content).decode()}"></video>'
        f"<figcaption>{escape(film.caption)}</figcaption></figure>"
    )


def _sources(run: RunPictures) -> str:
    photos = "".join(figure(photo.pixels, photo.caption) for photo in run.photos)
    if run.style is None:
        style = f'<p class="note">{escape(run.style_note)}</p>'
    else:
        style = figure(run.style.pixels, run.style.caption)
    columns = 4 if len(run.photos) in (4, 7, 8) else 3
    count = "One photo" if len(run.photos) == 1 else f"{len(run.photos)} photos"
    return (
        '<div class="sources">'
        f'<div class="photos"><h3>{count}</h3><div class="strip" style="--columns: {columns}">{photos}</div></div>'
        '<span class="plus" aria-hidden="true">+</span>'
        f'<div class="painting"><h3>One painting</h3><div class="strip">{style}</div></div></div>\n'
    )


def _views(views: Sequence[View]) -> str:
    """A contact sheet: a row a view, the columns photo, coarse, stylised, depth."""
    rows, columns = [], set()
    for view in views:
        cells = {"Photo": view.photo, "Coarse": view.coarse, "Stylised": view.stylised, "Depth": view.depth}
        there = {caption: pixels for caption, pixels in cells.items() if pixels is not None}
        columns.add(tuple(there))
        figures = "".join(figure(pixels, caption, f"{caption}, {view.name}") for caption, pixels in there.items())
        rows.append(f'<div class="view"><h4>{escape(view.name)}</h4><div class="cells">{figures}</div></div>')
    names = "views aligned" if len(columns) == 1 else "views"
    return f'<div class="{names}"><h3>From other viewpoints</h3>{"".join(rows)}</div>\n'


def _facts(run: RunPictures) -> str:
    measured = "".join(each.html() for each in run.tables) or _definitions("Measured", "figures", run.figures)
    effects = ""
    if run.effects:
        effects = f'<div class="effects"><h3>Effects</h3>{table(run.effects[0], run.effects[1:])}</div>\n'
    settings = _definitions("Settings", "settings", run.settings)
    return f'<div class="facts">{measured}{settings}{effects}</div>'


def _definitions(heading: str, name: str, entries: Sequence[Tuple[str, str]]) -> str:
    if not entries:
        return ""
    pairs = "".join(f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>" for label, value in entries)
    return f'<div class="{name}"><h3>{heading}</h3><dl>{pairs}</dl></div>\n'

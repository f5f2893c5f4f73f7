"""The page of a comparison or of ablations: tables, plots and grids of pictures in one file that opens offline."""

import base64
import io
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Dict, List, Sequence, Tuple

import numpy as np
from PIL import Image

from sparsestyle_ns.evaluation.tables import Table
from sparsestyle_ns.utils.page import figure, picture_page, write_page


@dataclass
class Section:
    """A part of the page.

    Attributes:
        heading: above it.
        text: a paragraph on what is shown, plain text.
        tables: figures.
        plots: SVG pictures with their captions.
        grid: rows of pictures, each with a name; captions and files.
    """

    heading: str
    text: str = ""
    tables: List[Table] = field(default_factory=list)
    plots: List[Tuple[str, str]] = field(default_factory=list)
    grid: List[Tuple[str, List[Tuple[str, Path]]]] = field(default_factory=list)


def write_study(sections: Sequence[Section], output_path: Path, title: str) -> Path:
    """Writes the page.

    Raises:
        InputError: it can't be written there.
    """
    return write_page(picture_page(title, "", "".join(map(_section, sections))), output_path)


def _section(section: Section) -> str:
    parts = [f"<h2>{escape(section.heading)}</h2>"]
    if section.text:
        parts.append(f"<p>{escape(section.text)}</p>")
    parts += [each.html() for each in section.tables]
    for svg, caption in section.plots:
        source = base64.b64encode(svg.encode()).decode()
        parts.append(
            f'<figure class="plot"><img src="data:image/svg+xml;base64,{source}" alt="{escape(caption)}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )
    if section.grid:
        parts.append(f'<div class="views">{"".join(_row(name, pictures) for name, pictures in section.grid)}</div>')
    return f'<section class="run">{"".join(parts)}</section>\n'


def _row(name: str, pictures: Sequence[Tuple[str, Path]]) -> str:
    figures = []
    for caption, path in pictures:
        with Image.open(path) as image:
            figures.append(figure(np.array(image.convert("RGB")), caption, f"{caption}, {name}"))
    return f'<div class="view"><h4>{escape(name)}</h4><div class="cells">{"".join(figures)}</div></div>'


Series = Dict[str, Tuple[Sequence[float], Sequence[float]]]


def line_plot(series: Series, x_label: str, y_label: str, marks: bool = False) -> str:
    """Lines with a legend as SVG.

    Args:
        series: x and y values of each line, by name.
        x_label: below the axis.
        y_label: beside it.
        marks: whether the end of each line is marked with a dot.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    plot = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = plot.subplots()
    for name, (x, y) in series.items():
        (line,) = axes.plot(x, y, label=name, linewidth=1.5)
        if marks:
            axes.plot(x[-1:], y[-1:], "o", color=line.get_color())
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.legend()
    axes.grid(alpha=0.3)
    buffer = io.BytesIO()
    FigureCanvasSVG(plot).print_svg(buffer, metadata={"Date": None})
    return buffer.getvalue().decode()

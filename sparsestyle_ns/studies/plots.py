"""Plots as SVG: lines with a legend, and what the plots of all studies look like."""

import io
from typing import Mapping, Sequence, Tuple

import matplotlib
from matplotlib.figure import Figure

COLORS = ("#33617f", "#b4492b", "#6a8f3c", "#8a5a9e", "#b58a2a", "#3f8f8a")
GRID = {"color": "#e4e1da", "lw": 0.6}
STYLE = {
    "svg.fonttype": "none",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": matplotlib.cycler(color=COLORS),
}
SIZE = (5.4, 3.5)
"""Inches."""


def as_svg(figure: Figure) -> str:
    """A figure as SVG, the same each time."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def line_plot(
    series: Mapping[str, Tuple[Sequence[float], Sequence[float]]], x_label: str, y_label: str, marks: bool = False
) -> str:
    """Lines with a legend as SVG.

    Args:
        series: x and y values of each line, by name.
        x_label: below the axis.
        y_label: beside it.
        marks: whether the end of each line is marked with a dot.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        cell = figure.subplots()
        for name, (x, y) in series.items():
            (line,) = cell.plot(x, y, label=name, linewidth=1.5)
            if marks:
                cell.plot(x[-1:], y[-1:], "o", color=line.get_color())
        cell.set(xlabel=x_label, ylabel=y_label)
        cell.legend(frameon=False)
        cell.grid(True, **GRID)
        return as_svg(figure)

"""Plots of losses in training, and of curves of error against time."""

import contextlib
import io
import math
from typing import Iterator, List, Literal, Mapping, Sequence, Tuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from sparsestyle_ns.studies.curves import METRICS, ON_LINEAR_SCALES, Curve, Point

COLORS = ("#33617f", "#b4492b", "#6a8f3c", "#8a5a9e", "#b58a2a", "#3f8f8a")
CHOSEN, FRONT, GRID = "#b4492b", "#9aa5ab", {"color": "#e4e1da", "lw": 0.6}
STYLE = {
    "svg.fonttype": "none",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": matplotlib.cycler(color=COLORS),
    "legend.frameon": False,
    "legend.fontsize": 8,
}
SIZE = (5.4, 3.5)
"""Inches."""
COLUMNS = 3
"""Of the overview."""


def line_plot(
    series: Mapping[str, Tuple[Sequence[float], Sequence[float]]],
    x_label: str,
    y_label: str,
    marks: Literal["", "end", "all"] = "",
) -> str:
    """Lines with a legend as SVG: x and y values of each by its name; with dots at their ends or everywhere."""
    with _svg() as (cell, svg):
        for name, (x, y) in series.items():
            cell.plot(
                x, y, label=name, linewidth=1.5, marker="o" if marks else "", markevery=[-1] if marks == "end" else None
            )
        cell.set(xlabel=x_label, ylabel=y_label)
        cell.legend()
        cell.grid(True, **GRID)
    return svg.getvalue()


def curve_plot(curve: Curve, x: str, y: str) -> str:
    """Two metrics of a curve as SVG."""
    with _svg() as (cell, svg):
        _draw(cell, curve, x, y)
    return svg.getvalue()


def overview(curves: Sequence[Curve]) -> bytes:
    """The main plots of all curves in one PNG picture."""
    rows = math.ceil(len(curves) / COLUMNS)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(COLUMNS * 4.2, rows * 3.0), layout="constrained", dpi=90)
        cells = figure.subplots(rows, COLUMNS, squeeze=False).flatten()
        for cell, curve in zip(cells, curves, strict=False):
            _draw(cell, curve, *curve.plots[0])
            cell.set_title(curve.title, fontsize=10, loc="left")
        for cell in cells[len(curves) :]:
            cell.set_axis_off()
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


@contextlib.contextmanager
def _svg() -> Iterator[Tuple[Axes, io.StringIO]]:
    """A plot to draw into, and what it is written to in the end."""
    with matplotlib.rc_context(STYLE):
        figure, svg = Figure(figsize=SIZE, layout="constrained"), io.StringIO()
        yield figure.subplots(), svg
        figure.savefig(svg, format="svg", metadata={"Date": None})


def _draw(cell: Axes, curve: Curve, x: str, y: str) -> None:
    """Points with the spread of their repetitions (hollow: busy machine), the front, a ring around the recommended one.

    A triangle at the top stands for an infinite number.
    """
    points = [point for point in curve.points if x in point.values and y in point.values]
    finite = [point.median(y) for point in points if math.isfinite(point.median(y))] or [0.0, 1.0]
    top = max(finite) + 0.12 * ((max(finite) - min(finite)) or 1.0)

    def places(some: Sequence[Point]) -> Tuple[List[float], List[float]]:
        return [point.median(x) for point in some], [min(point.median(y), top) for point in some]

    settings = dict.fromkeys(point.setting for point in points)
    for number, setting in enumerate(settings):
        run = sorted((point for point in points if point.setting == setting), key=lambda point: point.median(x))
        color = COLORS[number % len(COLORS) if curve.has_runs else 0]
        cell.plot(*places(run), color=color, lw=1.5, label=setting)
        for point in run:
            (across,), (up,) = places([point])
            spreads = [
                [[middle - spread.low], [spread.high - middle]] if math.isfinite(spread.high) else None
                for middle, spread in ((across, point.spread(x)), (up, point.spread(y)))
            ]
            mark, face = "o" if spreads[1] else "^", "white" if point.busy else color
            cell.errorbar(across, up, *reversed(spreads), fmt=mark, color=color, mfc=face, ms=5, lw=1, zorder=3)
            if not curve.has_runs:
                cell.annotate(setting, (across, up), (5, 5), textcoords="offset points", fontsize=8)
    if curve.has_runs:
        cell.legend()
    if (x, y) == curve.plots[0]:
        front = [point for point in curve.front if point in points]
        cell.plot(*places(front), "--", color=FRONT, lw=1, zorder=1)
    if curve.recommended in points:
        cell.plot(*places([curve.recommended]), "o", ms=13, mfc="none", mec=CHOSEN, mew=1.8, zorder=4)
    cell.set(xlabel=METRICS[x], ylabel=METRICS[y])
    for metric, scale in ((x, cell.xaxis), (y, cell.yaxis)):
        if metric not in ON_LINEAR_SCALES and all(point.median(metric) > 0 for point in points):
            _make_logarithmic(scale)
    cell.grid(True, which="major", **GRID)
    cell.margins(0.12)


def _make_logarithmic(scale: Axis) -> None:
    """Labels 1, 2, 5, 10, …: with a label at each minor tick those of less than a decade run into each other."""
    scale.axes.set(**{f"{scale.axis_name}scale": "log"})
    scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    scale.set_major_formatter(StrMethodFormatter("{x:g}"))
    scale.set_minor_formatter(NullFormatter())

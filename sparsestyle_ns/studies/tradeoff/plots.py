"""Plots of axes."""

import io
import math
from typing import List, Sequence

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis as Scale
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from sparsestyle_ns.studies.tradeoff.axis import METRICS, Axis, Point

POINT, FRONT, CHOSEN = "#33617f", "#9aa5ab", "#b4492b"
CURVES = ("#33617f", "#b4492b", "#6a8f3c", "#8a5a9e", "#b58a2a", "#3f8f8a")
SIZE = (5.4, 3.5)
"""Inches."""
COLUMNS = 3
STYLE = {"svg.fonttype": "none", "font.size": 9, "axes.spines.top": False, "axes.spines.right": False}


def plot_svg(axis: Axis, x: str, y: str) -> str:
    """One plot of an axis as SVG."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        draw(figure.subplots(), axis, x, y)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def overview_png(axes: Sequence[Axis]) -> bytes:
    """The main plots of all axes in one picture."""
    rows = math.ceil(len(axes) / COLUMNS)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(COLUMNS * 4.2, rows * 3.0), layout="constrained", dpi=90)
        cells = figure.subplots(rows, COLUMNS, squeeze=False).flatten()
        for cell, axis in zip(cells, axes, strict=False):
            draw(cell, axis, *axis.plots[0])
            cell.set_title(axis.title, fontsize=10, loc="left")
        for cell in cells[len(axes) :]:
            cell.set_axis_off()
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def draw(cell: Axes, axis: Axis, x: str, y: str) -> None:
    """Points with the spread of their repetitions, the front, and a ring around the recommended one.

    Hollow points were measured while the machine was busy. Where a number is infinite, a triangle at the top stands for
    it.
    """
    points = [point for point in axis.points if x in point.values and y in point.values]
    finite = [point.median(y) for point in points if math.isfinite(point.median(y))]
    top = max(finite, default=1.0) + 0.12 * ((max(finite, default=1.0) - min(finite, default=0.0)) or 1.0)

    def height(point: Point) -> float:
        return point.median(y) if math.isfinite(point.median(y)) else top

    if axis.has_runs:
        _draw_runs(cell, points, x, y)
    else:
        _draw_points(cell, points, x, height, y)
    if (x, y) == axis.plots[0]:
        front = [point for point in axis.front if point in points]
        cell.plot([point.median(x) for point in front], list(map(height, front)), "--", color=FRONT, lw=1, zorder=1)
    chosen = axis.recommended
    if chosen in points:
        cell.plot(chosen.median(x), height(chosen), "o", ms=13, mfc="none", mec=CHOSEN, mew=1.8, zorder=4)
    cell.set_xlabel(METRICS[x].label)
    cell.set_ylabel(METRICS[y].label)
    for metric, scale in ((x, cell.xaxis), (y, cell.yaxis)):
        if METRICS[metric].log and all(point.median(metric) > 0 for point in points):
            _make_logarithmic(scale)
    cell.grid(True, which="major", color="#e4e1da", lw=0.6)
    cell.margins(0.12)


def _make_logarithmic(scale: Scale) -> None:
    """Labels 1, 2, 5, 10, …: with a label at each minor tick those of less than a decade run into each other."""
    scale.axes.set(**{f"{scale.axis_name}scale": "log"})
    scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    scale.set_major_formatter(StrMethodFormatter("{x:g}"))
    scale.set_minor_formatter(NullFormatter())


def _draw_points(cell: Axes, points: Sequence[Point], x: str, height: object, y: str) -> None:
    for point in points:
        across, up = point.spread(x), point.spread(y)
        heights = [[up.median - up.low], [up.high - up.median]] if math.isfinite(up.median) else None
        cell.errorbar(
            *(across.median, height(point)),
            xerr=[[across.median - across.low], [across.high - across.median]],
            yerr=heights,
            fmt="o" if math.isfinite(up.median) else "^",
            color=POINT,
            mfc="white" if point.busy else POINT,
            ms=5,
            lw=1,
            zorder=3,
        )
        cell.annotate(point.setting, (across.median, height(point)), (5, 5), textcoords="offset points", fontsize=8)


def _draw_runs(cell: Axes, points: Sequence[Point], x: str, y: str) -> None:
    settings: List[str] = list(dict.fromkeys(point.setting for point in points))
    for setting, color in zip(settings, CURVES * len(settings), strict=False):
        run = sorted((point for point in points if point.setting == setting), key=lambda point: point.median(x))
        cell.plot([point.median(x) for point in run], [point.median(y) for point in run], color=color, lw=1.5)
        for number, point in enumerate(run):
            cell.errorbar(
                *(point.median(x), point.median(y)),
                yerr=[[point.median(y) - point.spread(y).low], [point.spread(y).high - point.median(y)]],
                fmt="o",
                color=color,
                mfc="white" if point.busy else color,
                ms=5,
                zorder=3,
                label=setting if number == 0 else None,
            )
    cell.legend(fontsize=8, frameon=False)

"""Plots of curves of error against time."""

import io
import math
from typing import Callable, Sequence

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from sparsestyle_ns.studies.plots import COLORS, GRID, SIZE, STYLE, as_svg
from sparsestyle_ns.studies.tradeoff.curves import METRICS, Curve, Point

POINT, CHOSEN, FRONT = *COLORS[:2], "#9aa5ab"
COLUMNS = 3


def curve_svg(curve: Curve, x: str, y: str) -> str:
    """One plot of a curve as SVG."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        draw(figure.subplots(), curve, x, y)
        return as_svg(figure)


def overview_png(curves: Sequence[Curve]) -> bytes:
    """The main plots of all curves in one picture."""
    rows = math.ceil(len(curves) / COLUMNS)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(COLUMNS * 4.2, rows * 3.0), layout="constrained", dpi=90)
        cells = figure.subplots(rows, COLUMNS, squeeze=False).flatten()
        for cell, curve in zip(cells, curves, strict=False):
            draw(cell, curve, *curve.plots[0])
            cell.set_title(curve.title, fontsize=10, loc="left")
        for cell in cells[len(curves) :]:
            cell.set_axis_off()
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    return buffer.getvalue()


def draw(cell: Axes, curve: Curve, x: str, y: str) -> None:
    """Points with the spread of their repetitions, the front, and a ring around the recommended one.

    Hollow points were measured while the machine was busy. Where a number is infinite, a triangle at the top stands for
    it.
    """
    points = [point for point in curve.points if x in point.values and y in point.values]
    finite = [point.median(y) for point in points if math.isfinite(point.median(y))] or [0.0, 1.0]
    top = max(finite) + 0.12 * ((max(finite) - min(finite)) or 1.0)

    def height(point: Point) -> float:
        return min(point.median(y), top)

    if curve.has_runs:
        settings = list(dict.fromkeys(point.setting for point in points))
        for setting, color in zip(settings, COLORS * len(settings), strict=False):
            run = sorted((point for point in points if point.setting == setting), key=lambda point: point.median(x))
            cell.plot([p.median(x) for p in run], list(map(height, run)), color=color, lw=1.5, label=setting)
            _draw_points(cell, run, x, y, height, color)
        cell.legend(fontsize=8, frameon=False)
    else:
        _draw_points(cell, points, x, y, height, POINT)
        for point in points:
            place = (point.median(x), height(point))
            cell.annotate(point.setting, place, (5, 5), textcoords="offset points", fontsize=8)
    if (x, y) == curve.plots[0]:
        front = [point for point in curve.front if point in points]
        cell.plot([p.median(x) for p in front], list(map(height, front)), "--", color=FRONT, lw=1, zorder=1)
    chosen = curve.recommended
    if chosen in points:
        cell.plot(chosen.median(x), height(chosen), "o", ms=13, mfc="none", mec=CHOSEN, mew=1.8, zorder=4)
    cell.set(xlabel=METRICS[x].label, ylabel=METRICS[y].label)
    for metric, scale in ((x, cell.xaxis), (y, cell.yaxis)):
        if METRICS[metric].log and all(point.median(metric) > 0 for point in points):
            _make_logarithmic(scale)
    cell.grid(True, which="major", **GRID)
    cell.margins(0.12)


def _make_logarithmic(scale: Axis) -> None:
    """Labels 1, 2, 5, 10, …: with a label at each minor tick those of less than a decade run into each other."""
    scale.axes.set(**{f"{scale.axis_name}scale": "log"})
    scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    scale.set_major_formatter(StrMethodFormatter("{x:g}"))
    scale.set_minor_formatter(NullFormatter())


def _draw_points(
    cell: Axes, points: Sequence[Point], x: str, y: str, height: Callable[[Point], float], color: str
) -> None:
    for point in points:
        across, up = point.spread(x), point.spread(y)
        is_finite = math.isfinite(up.median)
        cell.errorbar(
            *(across.median, height(point)),
            xerr=[[across.median - across.low], [across.high - across.median]],
            yerr=[[up.median - up.low], [up.high - up.median]] if is_finite else None,
            fmt="o" if is_finite else "^",
            color=color,
            mfc="white" if point.busy else color,
            ms=5,
            lw=1,
            zorder=3,
        )

"""The report: JSON, CSV, a page that opens offline, and a picture of all plots."""

import base64
import csv
import io
import json
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, Dict, List, Sequence

from sparsestyle_ns.studies.tradeoff.axis import METRICS, Axis, Point
from sparsestyle_ns.studies.tradeoff.plots import overview_png, plot_svg
from sparsestyle_ns.studies.tradeoff.words import recommendation
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.page import html_page

JSON_FILE, CSV_FILE, PAGE_FILE, PICTURE_FILE = "tradeoff.json", "tradeoff.csv", "index.html", "tradeoff.png"
GROUPS = {
    "training": "Training (stage 1)",
    "quadrature": "Quadrature",
    "fine-field": "Fine field (stage 2)",
    "style": "Style (stage 2)",
    "rendering": "Rendering",
    "precision": "Precision",
}
"""In the order of the page."""
COLUMNS = (
    "axis",
    "flag",
    "setting",
    "moment",
    "metric",
    "median",
    "low",
    "high",
    "count",
    "front",
    "recommended",
    "busy",
)


@dataclass
class Report:
    """All that was found.

    Attributes:
        scene: what was measured, in words.
        facts: of scene, machine and run, by their names.
        axes: that have points or have left something out.
        left_out: whole groups that weren't measured, and why.
    """

    scene: str
    facts: Dict[str, Any]
    axes: List[Axis]
    left_out: List[str] = field(default_factory=list)

    @property
    def sorted_axes(self) -> List[Axis]:
        """By group."""
        return sorted(self.axes, key=lambda axis: list(GROUPS).index(axis.group))

    @property
    def measured(self) -> List[Axis]:
        """Those with points."""
        return [axis for axis in self.sorted_axes if axis.points]

    @property
    def recommendation(self) -> List[str]:
        """In plain words."""
        return recommendation(self.measured)

    def everything_left_out(self) -> List[str]:
        """Groups and single values, each with its reason."""
        return [*self.left_out, *(f"{axis.title}, {what}" for axis in self.sorted_axes for what in axis.left_out)]

    def write(self, folder: Path) -> Path:
        """Writes all files into a folder; returns the page.

        Raises:
            InputError: it can't be written to.
        """
        content = {
            "scene": self.scene,
            **self.facts,
            "recommendation": self.recommendation,
            "left_out": self.everything_left_out(),
            "axes": [axis.content() for axis in self.sorted_axes],
        }
        try:
            write_whole(folder / JSON_FILE, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
            write_whole(folder / CSV_FILE, table(self.sorted_axes))
            if self.measured:
                write_whole(folder / PICTURE_FILE, overview_png(self.measured))
            return write_whole(folder / PAGE_FILE, page(self))
        except OSError as error:
            raise cant_write(folder, error) from error


def cant_write(folder: Path, error: OSError) -> InputError:
    """What to say where a report can't be written."""
    return InputError(f"The report can't be written to {folder} ({error.strerror}); name another --output-dir.")


def table(axes: Sequence[Axis]) -> str:
    """All figures as CSV, one a row."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for axis in axes:
        front, recommended = axis.front, axis.recommended
        for point in axis.points:
            marks = [int(point in front), int(point is recommended), int(point.busy)]
            for metric in point.values:
                spread = point.spread(metric)
                numbers = [f"{value:.6g}" for value in (spread.median, spread.low, spread.high)]
                rows.writerow(
                    [axis.name, axis.flag, point.setting, point.moment, metric, *numbers, spread.count, *marks]
                )
    return text.getvalue()


# --------------------------------------------------------------------------------------------------------------- page


def page(report: Report) -> str:
    """The whole page as HTML."""
    title = f"What accuracy costs in time: {report.scene}"
    lines = "".join(f"<li>{escape(line)}</li>" for line in report.recommendation)
    facts = "".join(
        f"<div><dt>{escape(name.replace('_', ' '))}</dt><dd>{escape(words_of(value))}</dd></div>"
        for name, value in report.facts.items()
    )
    left_out = "".join(f"<li>{escape(line)}</li>" for line in report.everything_left_out())
    sections = "".join(_group(name, title, report.measured) for name, title in GROUPS.items())
    body = (
        f'<header class="top"><h1>{escape(title)}</h1></header>\n<main>\n'
        f'<section class="advice"><h2>In short</h2><ul>{lines}</ul></section>\n{sections}'
        + (f'<section><h2>Left out</h2><ul class="soft">{left_out}</ul></section>\n' if left_out else "")
        + f"<section><h2>How it was measured</h2><p>{escape(LEGEND)}</p><dl>{facts}</dl></section>\n</main>"
    )
    return html_page(title, STYLE_SHEET, body)


def words_of(value: Any) -> str:
    """A fact in a line."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {words_of(item)}" for name, item in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(words_of, value))
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _group(name: str, title: str, axes: Sequence[Axis]) -> str:
    members = "".join(map(_axis, (axis for axis in axes if axis.group == name)))
    return f'<section id="{name}"><h2>{escape(title)}</h2>\n{members}</section>\n' if members else ""


def _axis(axis: Axis) -> str:
    plots = "".join(
        f'<figure><img src="data:image/svg+xml;base64,{base64.b64encode(plot_svg(axis, x, y).encode()).decode()}" '
        f'alt="{escape(axis.title)}: {escape(METRICS[y].label)} against {escape(METRICS[x].label)}"></figure>'
        for x, y in axis.plots
        if any(x in point.values and y in point.values for point in axis.points)
    )
    order = "" if axis.order is None else f"<p>Observed order of convergence: {axis.order:.2f}.</p>"
    return (
        f'<article><h3>{escape(axis.title)}</h3><p><code>{escape(axis.flag)}</code>, preset: {escape(axis.preset)}</p>'
        f'{order}<div class="plots">{plots}</div>{_figures(axis)}'
        f'<p class="soft">{escape(axis.rule)} {escape(axis.note)}</p></article>\n'
    )  # fmt: skip


def _figures(axis: Axis) -> str:
    metrics = list(dict.fromkeys(metric for point in axis.points for metric in point.values))
    head = "".join(f"<th>{escape(METRICS[metric].label)}</th>" for metric in metrics)
    front, recommended = axis.front, axis.recommended
    rows = []
    for point in axis.points:
        cells = "".join(f"<td>{_cell(point, metric)}</td>" for metric in metrics)
        marks = ["recommended"] * (point is recommended) + ["on the front"] * (point in front)
        marks += ["busy"] * point.busy
        name = " ".join(filter(None, (point.setting, point.moment)))
        row = f"<th>{escape(name)}</th>{cells}<td>{', '.join(marks)}</td>"
        rows.append(f'<tr class="chosen">{row}</tr>' if point is recommended else f"<tr>{row}</tr>")
    return (
        f'<div class="scroll"><table><thead><tr><th>setting</th>{head}<th></th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _cell(point: Point, metric: str) -> str:
    if metric not in point.values:
        return ""
    spread = point.spread(metric)
    if spread.count == 1:
        return f"{spread.median:.4g}"
    return f"{spread.median:.4g} <small>{spread.low:.3g} – {spread.high:.3g}, {spread.count}×</small>"


LEGEND = (
    "Figures are medians, with the smallest and largest of as many repetitions as are named. A ring marks the "
    "recommended point, the dashed line is the Pareto front: no other point is as fast and as accurate. Hollow points, "
    "and rows with the word busy, were measured while other processes used more than a tenth of the cores; take their "
    "times as upper ends."
)
STYLE_SHEET = """
section { border-top: 1px solid var(--line); padding-top: 1.5rem; margin-top: 2.5rem; }
h2 { margin-bottom: 1rem; }
article { margin-bottom: 3rem; }
ul { padding-left: 1.2rem; display: grid; gap: 0.4rem; }
.advice { border-top: none; padding-top: 0; margin-top: 0; }
.advice li { font-size: 1.0625rem; }
.soft { color: var(--soft); font-size: 0.875rem; margin-top: 0.75rem; }
.plots { display: grid; gap: 1rem; margin: 1rem 0; }
.plots { grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); }
figure { background: #fff; border: 1px solid var(--line); border-radius: 0.375rem; padding: 0.5rem; max-width: 38rem; }
img { display: block; width: 100%; height: auto; }
code { font-size: 0.875rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.8125rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 0.25rem 1rem 0.25rem 0; border-bottom: 1px solid var(--line); font-weight: 400; }
thead th, small { color: var(--soft); }
.chosen th, .chosen td { color: var(--accent); }
dl { display: grid; gap: 0.75rem 2rem; grid-template-columns: repeat(auto-fill, minmax(16rem, 1fr)); margin-top: 1rem; }
dt { font-size: 0.8125rem; color: var(--soft); }
dd { overflow-wrap: anywhere; }
"""

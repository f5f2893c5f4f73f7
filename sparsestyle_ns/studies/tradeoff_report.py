"""The report: JSON, CSV, a page that opens offline, and a picture of all plots."""

import contextlib
import csv
import io
import itertools
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Dict, Iterator, List, Mapping, Optional, Sequence, Union

from sparsestyle_ns.evaluation.tables import Table
from sparsestyle_ns.studies.advice import recommendation
from sparsestyle_ns.studies.curves import METRICS, Curve, Point, Spread
from sparsestyle_ns.studies.plots import curve_plot, overview
from sparsestyle_ns.studies.study_options import Group
from sparsestyle_ns.studies.study_page import Section, study_page
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import free_path, write_whole

Fact = Union[str, float, Sequence[str], Mapping[str, str]]
GROUPS: Dict[Group, str] = {
    "training": "Training (stage 1)",
    "quadrature": "Quadrature",
    "fine-field": "Fine field (stage 2)",
    "style": "Style (stage 2)",
    "rendering": "Rendering",
    "precision": "Precision",
}
"""In the order of the page."""
FILES = ("index.html", "tradeoff.json", "tradeoff.csv", "tradeoff.png")
"""What a report's folder has."""
COLUMNS = ("axis", "flag", "setting", "moment", "metric", *Spread._fields, "front", "recommended", "busy")
LEGEND = (
    "Figures are medians, with the smallest and largest of as many repetitions as are named. A ring marks the "
    "recommended point, the dashed line is the Pareto front: no other point is as fast and as accurate. Hollow points, "
    "and rows with the word busy, were measured while other processes used more than a tenth of the cores; take their "
    "times as upper ends."
)


@dataclass
class Report:
    """All that was found."""

    scene: str
    facts: Dict[str, Fact]
    """What figures depend on, by name."""
    curves: List[Curve]
    left_out: List[str] = field(default_factory=list)
    """Whole groups that weren't measured, and why."""

    def __post_init__(self) -> None:
        self.curves = sorted(self.curves, key=lambda curve: list(GROUPS).index(curve.group))

    @property
    def measured(self) -> List[Curve]:
        """Those with points."""
        return [curve for curve in self.curves if curve.points]

    @property
    def recommendation(self) -> List[str]:
        """In plain words."""
        return recommendation(self.measured)

    def everything_left_out(self) -> List[str]:
        """Groups and single values, each with its reason."""
        return [*self.left_out, *(f"{curve.title}, {what}" for curve in self.curves for what in curve.left_out)]

    def write(self, folder: Path) -> Path:
        """Writes all files into a folder and returns the page, or raises an `InputError` if it can't be written to."""
        found = {"recommendation": self.recommendation, "left_out": self.everything_left_out()}
        content = {"scene": self.scene, **self.facts, **found, "axes": list(map(curve_content, self.curves))}
        with writing_to(folder):
            write_whole(folder / "tradeoff.json", json.dumps(content, indent=2, ensure_ascii=False) + "\n")
            write_whole(folder / "tradeoff.csv", as_csv(self.curves))
            if self.measured:
                write_whole(folder / "tradeoff.png", overview(self.measured))
            title = f"What accuracy costs in time: {self.scene}"
            return write_whole(folder / "index.html", study_page(title, self.sections()))

    def sections(self) -> List[Section]:
        """What the page shows."""
        groups = itertools.groupby(self.measured, key=lambda curve: GROUPS[curve.group])
        sections = [Section(title, parts=list(map(curve_section, curves))) for title, curves in groups]
        left_out = [Section("Left out", lines=self.everything_left_out())] if self.everything_left_out() else []
        facts = {name.replace("_", " "): in_a_line(value) for name, value in self.facts.items()}
        how = Section("How it was measured", LEGEND, facts=facts)
        return [Section("In short", lines=self.recommendation), *sections, *left_out, how]


def report_folder(asked: Optional[Path], force: bool) -> Path:
    """Where a new report goes; an `InputError` where one is there already that may not be lost."""
    if asked is None:
        return free_path(Path("tradeoff"))
    there = [asked / name for name in FILES if (asked / name).exists()]
    if there and not force:
        raise InputError(
            f"There is a report in --output-dir {asked} already ({there[0].name}); name another folder, such as "
            f"{free_path(asked)}, or write over it with --force."
        )
    return asked


@contextlib.contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Turns an `OSError` on the way into an `InputError` that names the report's folder."""
    try:
        yield
    except OSError as error:
        sentence = f"The report can't be written to {folder} ({error.strerror}); name another --output-dir."
        raise InputError(sentence) from error


def as_csv(curves: Sequence[Curve]) -> str:
    """All figures as CSV, one a row."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for curve in curves:
        for point, marks in curve.marked_points():
            for metric in point.values:
                *numbers, count = point.spread(metric)
                place = [curve.name, curve.flag, point.setting, point.moment, metric]
                rows.writerow([*place, *(f"{number:.6g}" for number in numbers), count, *map(int, marks.values())])
    return text.getvalue()


def curve_content(curve: Curve) -> Dict[str, object]:
    """What the JSON report says of a curve. JSON has no infinity (the PSNR of equal pictures): null stands for it."""

    def spread(point: Point, metric: str) -> Dict[str, Optional[float]]:
        values = point.spread(metric)._asdict()
        return {name: value if math.isfinite(value) else None for name, value in values.items()}

    named = ("group", "name", "title", "flag", "preset", "time", "error", "plots", "rule", "note", "left_out")
    return {
        **{name: getattr(curve, name) for name in named},
        "metrics": {metric: METRICS[metric] for metric in curve.metrics},
        "observed_order": curve.order,
        "points": [
            {"setting": point.setting, "moment": point.moment, **marks}
            | {"values": {metric: spread(point, metric) for metric in point.values}}
            for point, marks in curve.marked_points()
        ],
    }


def in_a_line(fact: Fact) -> str:
    """A fact in a line."""
    if isinstance(fact, Mapping):
        return ", ".join(f"{name} {item}" for name, item in fact.items())
    if isinstance(fact, float):
        return f"{fact:.3g}"
    return fact if isinstance(fact, str) else ", ".join(fact)


def curve_section(curve: Curve) -> Section:
    """What the page shows of a curve that has points."""
    order = "" if curve.order is None else f" Observed order of convergence: {curve.order:.2f}."
    plots = [
        (curve_plot(curve, x, y), f"{METRICS[y]} against {METRICS[x]}")
        for x, y in curve.plots
        if any(x in point.values and y in point.values for point in curve.points)
    ]
    rows = []
    for point, marks in curve.marked_points():
        said = ", ".join(mark.replace("_", " ") for mark, holds in marks.items() if holds)
        rows.append((point.name, [*(_cell(point, metric) for metric in curve.metrics), said]))
    columns = [*(METRICS[metric] for metric in curve.metrics), ""]
    table = Table(f"{curve.flag}, preset: {curve.preset}", columns, rows)
    return Section(curve.title, tables=[table], plots=plots, note=f"{curve.rule}{order} {curve.note}")


def _cell(point: Point, metric: str) -> str:
    if metric not in point.values:
        return ""
    spread = point.spread(metric)
    more = f" ({spread.low:.3g} – {spread.high:.3g}, {spread.count}×)" if spread.count > 1 else ""
    return f"{spread.median:.4g}{more}"

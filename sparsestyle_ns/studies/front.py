"""`sparsestyle compare --front`: how much style each way of stylising gives for how much content, in equal time."""

import bisect
import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple

from sparsestyle_ns.evaluation.tables import LABELS, PERCEPTUAL, STYLE, Table, table_of
from sparsestyle_ns.studies.baselines import can_transfer, transfer_frames
from sparsestyle_ns.studies.paper_runs import PaperRuns
from sparsestyle_ns.studies.plots import line_plot
from sparsestyle_ns.studies.run_figures import PaintingMeasure, RunFigures, iteration_times, measure_run
from sparsestyle_ns.studies.run_queue import Run, RunQueue
from sparsestyle_ns.studies.study_page import Section

OURS, ARF = "ours", "ARF kind, on our coarse field"
KINDS: Dict[str, Tuple[str, str]] = {
    OURS: ("ours", "ours"),
    ARF: ("arf", "ours"),
    "FreeNeRF-style field + ARF kind": ("arf", "freenerf"),
}
"""By name, the kinds of stage 2 and stage 1."""


class Sweep(NamedTuple):
    """The setting by which a kind of stage 2 keeps more or less content."""

    setting: str
    label: str
    """In tables and plots."""
    values: Tuple[float, ...]
    """From the strongest style to the most content."""
    strengths: Tuple[float, ...] = ()
    """With which pictures of the run with the last value are measured besides, each below 1."""


SWEEPS = {
    "ours": Sweep("pipeline.kept_structure", "structure", (0.0, 0.65, 0.8), strengths=(0.7, 0.4)),
    "arf": Sweep("pipeline.loss_weights.content", "λ", (0.03, 0.3, 3.0)),
}
"""Of each kind of stage 2."""
FRAME_BY_FRAME = "frame by frame (AdaIN's kind)"
DISTANCES = ("style_loss", "texture_distance", "color_distance")
"""What all train on, a distance of another network that none trains on, and one of colours."""
KEPT = "unstylised_ssim"
KEPT_LEVELS = tuple(level / 10 for level in range(3, 9))
"""Kept content at which kinds are held against each other, where both reach it."""
PROBE_ITERATIONS = 20
"""Of a run that says how long an iteration of a kind takes."""


@dataclass(frozen=True)
class FrontPoint:
    """A run's kept content, and its figures."""

    kind: str
    value: Optional[float]
    """Of the setting that keeps content; None for a kind that has none."""
    measured: RunFigures
    strength: float = 1.0
    """How much of the style its pictures show."""

    @property
    def kept(self) -> float:
        """SSIM to the unstylised frames."""
        return self.measured.figures[KEPT]


class Fronts:
    """The runs of a front on one scene with one painting, and what is measured of them."""

    def __init__(self, runs: PaperRuns, painting: Path, queue: RunQueue) -> None:
        self.runs, self.painting, self.queue = runs, painting, queue

    def _run(self, kind: str, value: float, iterations: Optional[int] = None) -> Run:
        style, coarse = KINDS[kind]
        return self.runs.stylised(self.painting, style, coarse, (SWEEPS[style].setting, value), iterations)

    def train(self) -> Dict[str, List[Run]]:
        """Brings all runs to their end, those of each kind with as many iterations as ours takes the time for."""
        values = {kind: SWEEPS[style].values for kind, (style, _) in KINDS.items()}
        found = {OURS: [self._run(OURS, value) for value in values[OURS]]}
        self.queue.train(found[OURS])
        seconds = median(self._seconds_of(run, run.iterations) for run in found[OURS])
        for kind in (kind for kind in KINDS if kind != OURS):
            probe = self._run(kind, values[kind][0], PROBE_ITERATIONS)
            self.queue.train([probe])
            count = max(1, round(PROBE_ITERATIONS * seconds / self._seconds_of(probe, PROBE_ITERATIONS)))
            found[kind] = [self._run(kind, value, count) for value in values[kind]]
            self.queue.train(found[kind])
        return found

    def _seconds_of(self, run: Run, iterations: int) -> float:
        """What so many iterations take, by the median at each size of the views."""
        times = iteration_times(run.folder)
        levels = self.runs.study.config("hier-style").pipeline.levels(iterations)
        return sum(
            level.length * median(times[step] for step in times if level.first <= step < level.first + level.length)
            for level in levels
        )

    def measure(self, found: Mapping[str, Sequence[Run]]) -> List[FrontPoint]:
        """The points of all runs, and where the package is there, of frame-by-frame transfer."""
        measure = PaintingMeasure(self.painting)
        points = []
        for kind, runs in found.items():
            sweep = SWEEPS[KINDS[kind][0]]
            for value, run in zip(sweep.values, runs, strict=True):
                points.append(FrontPoint(kind, value, measure_run(run.folder, measure)))
            for strength in sweep.strengths:
                measured = measure_run(runs[-1].folder, measure, strength=strength)
                points.append(FrontPoint(kind, sweep.values[-1], measured, strength))
        if can_transfer():
            ours = found[OURS][0].folder
            by_frame = measure_run(
                ours, measure, "frame-by-frame", lambda frames: transfer_frames(frames.coarse, self.painting)
            )
            points.append(FrontPoint(FRAME_BY_FRAME, None, by_frame))
        return points


def front_section(runs: PaperRuns, painting: Path, queue: RunQueue) -> Section:
    """Trains and measures what a painting's fronts need, and sets them out."""
    fronts = Fronts(runs, painting, queue)
    found = fronts.train()
    points = fronts.measure(found)
    iterations = ", ".join(f"{kind}: {runs_of[0].iterations}" for kind, runs_of in found.items())
    text = (
        f"Each kind has the time that ours takes for its iterations, on views of the same sizes ({iterations}). "
        "Ours keeps ever more structure, and then shows ever less of its style (strength); the others have ever larger "
        "content weights. Measured on frames of the path between the training cameras, each kind by its own unstylised "
        "geometry."
    )
    section = Section(f"Style against content: {runs.study.name} in the style of {painting.stem}", text)
    section.tables = [points_table(points), ratios_table(points)]
    section.plots = [(front_plot(points, distance), LABELS[distance][0]) for distance in DISTANCES]
    section.grid = [
        (point_name(point), [("middle of the path", point.measured.pictures[len(point.measured.pictures) // 2])])
        for point in points
    ]
    return section


def point_name(point: FrontPoint) -> str:
    """A point in words."""
    if point.value is None:
        return point.kind
    shown = "" if point.strength == 1.0 else f", strength = {point.strength:g}"
    return f"{point.kind}, {SWEEPS[KINDS[point.kind][0]].label} = {point.value:g}{shown}"


def points_table(points: Sequence[FrontPoint]) -> Table:
    """All points with their figures."""
    keys = [(key, key, "") for key in (KEPT, *STYLE)]
    keys += [(f"{part}_{kind}", kind, f"{part} ") for part in ("short", "long") for kind in PERCEPTUAL]
    return table_of("All points", keys, [(point_name(point), point.measured.figures) for point in points])


def ratios_table(points: Sequence[FrontPoint]) -> Table:
    """What ours has of ARF's kind's distances where it keeps as much content, or more; below 1 is better."""
    keys = (*DISTANCES, "short_rmse", "long_rmse")
    labels = [LABELS[key][0] if key in LABELS else f"{key[:-5]} {LABELS['rmse'][0]}" for key in keys]
    table = Table("Ours over ARF's kind at equal content kept, or where ours keeps more with every setting", labels)
    for level in KEPT_LEVELS:
        pairs = [[at_kept(points, OURS, key, level, or_more=True), at_kept(points, ARF, key, level)] for key in keys]
        cells = [None if None in pair else f"{pair[0] / pair[1]:.2f}" for pair in pairs]
        if any(cells):
            table.rows.append((f"SSIM {level:.1f}", cells))
    table.note = "" if table.rows else "There is no content kept that both reach."
    return table


def at_kept(points: Sequence[FrontPoint], kind: str, key: str, kept: float, or_more: bool = False) -> Optional[float]:
    """A figure of a kind at some content kept, on lines between its points; None beyond them, or where none has it.

    With `or_more`, where all of its points keep more, that of the point which keeps least.
    """
    having = [point for point in points if point.kind == kind and key in point.measured.figures]
    own = sorted((point.kept, point.measured.figures[key]) for point in having)
    if own and or_more:
        kept = max(kept, own[0][0])
    if not own or not own[0][0] <= kept <= own[-1][0]:
        return None
    place = max(1, bisect.bisect_left([each for each, _ in own], kept))
    if len(own) == 1:
        return own[0][1]
    (left, low), (right, high) = own[place - 1], own[place]
    return low if right == left else low + (high - low) * (kept - left) / (right - left)


def front_plot(points: Sequence[FrontPoint], distance: str) -> str:
    """A distance from the painting against content kept, a line for each kind."""
    series = {}
    for kind, own in itertools.groupby(points, key=lambda point: point.kind):
        pairs = sorted((point.kept, point.measured.figures.get(distance, math.nan)) for point in own)
        series[kind] = tuple(zip(*pairs, strict=True))
    return line_plot(series, LABELS[KEPT][0], LABELS[distance][0], marks="all")

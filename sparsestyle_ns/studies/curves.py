"""A curve of error against time: what was measured at each value of one setting."""

import statistics
from dataclasses import dataclass, field
from typing import Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple, Union

from sparsestyle_ns.studies.pareto import (
    TIME_EXPONENT,
    decibels,
    decibels_lost,
    error_that_costs,
    fastest_within,
    knee,
    pareto_front,
    root_mean_square,
)
from sparsestyle_ns.studies.study_options import Group

Values = Mapping[str, Union[float, Sequence[float]]]
"""What one measurement found: a number, or several repetitions of it, for each metric."""
FREE_LOSS = 0.1
"""dB against the photos that nobody misses: what an error may cost that is there only to save time."""


class Metric(NamedTuple):
    """What a number is: in words, with its unit, and whether its scale is logarithmic."""

    label: str
    log: bool = False


METRICS = {
    "iterations": Metric("iterations", log=True),
    "train_seconds": Metric("seconds of training", log=True),
    "step_seconds": Metric("seconds an iteration", log=True),
    "view_seconds": Metric("seconds a view", log=True),
    "fps": Metric("frames a second", log=True),
    "first_seconds": Metric("seconds of the first picture", log=True),
    "rmse": Metric("root mean square error of colours", log=True),
    "psnr": Metric("PSNR (dB)"),
    "ssim": Metric("SSIM"),
    "style_loss": Metric("style loss, held-out views"),
    "content_loss": Metric("content loss, held-out views"),
    "memory_mb": Metric("peak memory (MB)", log=True),
}
"""Every number that is measured. Those of PSNR and SSIM are better the larger, as frames a second are."""


class Spread(NamedTuple):
    """Median, smallest and largest of some repetitions."""

    median: float
    low: float
    high: float
    count: int


@dataclass
class Point:
    """What was measured at one value of the setting, or at one moment of a run with it."""

    setting: str
    """The value, as typed after the flag."""
    moment: str = ""
    """When in a run it was measured, in words; empty where there is no run."""
    values: Dict[str, List[float]] = field(default_factory=dict)
    """Every repetition of every metric."""
    busy: bool = False
    """Whether other processes kept the machine busy during any of them."""

    @property
    def name(self) -> str:
        """The setting, and the moment where there is one."""
        return f"{self.setting} {self.moment}".rstrip()

    def spread(self, metric: str) -> Spread:
        """Of the repetitions of a metric."""
        values = self.values[metric]
        return Spread(statistics.median(values), min(values), max(values), len(values))

    def median(self, metric: str) -> float:
        """Of the repetitions of a metric."""
        return statistics.median(self.values[metric])


@dataclass(eq=False)
class Curve:
    """A curve of error against time for one setting.

    Attributes:
        preset: the setting's value in the preset, as typed after its flag.
        time, error: the metrics between which there is to choose; smaller is better. An error of `psnr` stands for
            the root mean square error with that PSNR.
        plots: (x, y) metrics of each plot; the first is the main one.
        note: how it was measured.
        own_error: root mean square error of the field against held-out photos. Given, the error is one that only
            saves time and may cost `FREE_LOSS` dB more than need be; None: the knee is recommended.
        left_out: values that weren't measured, and why.
        order: the observed order of convergence.
    """

    group: Group
    name: str
    title: str
    flag: str
    preset: str
    time: str
    error: str
    plots: Sequence[Tuple[str, str]]
    note: str = ""
    own_error: Optional[float] = None
    points: List[Point] = field(default_factory=list)
    left_out: List[str] = field(default_factory=list)
    order: Optional[float] = None

    def add(self, setting: object, values: Values, busy: bool, moment: str = "") -> None:
        """Adds a repetition of a point, or several where a metric has several values."""
        point = self.find(setting, moment)
        if point is None:
            point = Point(str(setting), moment)
            self.points.append(point)
        for metric, value in values.items():
            point.values.setdefault(metric, []).extend([value] if isinstance(value, (int, float)) else value)
        point.busy |= busy

    def find(self, setting: object, moment: str = "") -> Optional[Point]:
        """The point at a value of the setting; None where it wasn't measured."""
        return next((p for p in self.points if (p.setting, p.moment) == (str(setting), moment)), None)

    def last(self, setting: object) -> Optional[Point]:
        """The latest moment of the run with a value of the setting."""
        return next((point for point in reversed(self.points) if point.setting == str(setting)), None)

    @property
    def metrics(self) -> List[str]:
        """All that was measured, in order."""
        return list(dict.fromkeys(metric for point in self.points for metric in point.values))

    @property
    def has_runs(self) -> bool:
        """Whether the points of one setting are moments of a run."""
        return any(point.moment for point in self.points)

    def error_of(self, point: Point) -> float:
        """The error between which and time there is to choose; 0 or more."""
        value = point.median(self.error)
        return root_mean_square(value) if self.error == "psnr" else value

    def _times_and_errors(self) -> Tuple[List[float], List[float]]:
        return [point.median(self.time) for point in self.points], [self.error_of(point) for point in self.points]

    @property
    def front(self) -> List[Point]:
        """The Pareto front, from the fastest point on."""
        return [self.points[index] for index in pareto_front(*self._times_and_errors())]

    @property
    def recommended(self) -> Optional[Point]:
        """The point to choose, by `rule`."""
        times, errors = self._times_and_errors()
        index = knee(times, errors) if self.own_error is None else fastest_within(times, errors, self.free_error)
        return None if index is None else self.points[index]

    @property
    def free_error(self) -> float:
        """The error that costs `FREE_LOSS` dB more than that of the most accurate point; `own_error` must be known."""
        least = min(map(self.error_of, self.points), default=0.0)
        return error_that_costs(FREE_LOSS + decibels_lost(least, self.own_error), self.own_error)

    @property
    def rule(self) -> str:
        """How the recommended point is chosen, in words."""
        if self.own_error is None:
            return (
                f"Recommended: the smallest error × time^{TIME_EXPONENT:g}. Beyond it, twice the time takes less than "
                f"{1 - 2**-TIME_EXPONENT:.0%} off the error."
            )
        return (
            f"Recommended: the fastest setting that loses at most {FREE_LOSS:g} dB against photos to the most accurate "
            f"one. The field itself has {decibels(self.own_error):.1f} dB against photos; with it, "
            f"{decibels(self.free_error):.1f} dB here are enough."
        )

    def marked_points(self) -> List[Tuple[Point, Dict[str, bool]]]:
        """The points, in order of measuring, and what is to be said of each."""
        front, chosen = self.front, self.recommended
        return [
            (point, {"on_front": point in front, "recommended": point is chosen, "busy": point.busy})
            for point in self.points
        ]

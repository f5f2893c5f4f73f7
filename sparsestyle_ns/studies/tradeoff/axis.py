"""One axis: what was measured at each value of one setting."""

import copy
import math
import statistics
from dataclasses import dataclass, field
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple, Union

from sparsestyle_ns.studies.tradeoff.budget import Budget, Costs, OutOfTimeError
from sparsestyle_ns.studies.tradeoff.pareto import (
    TIME_EXPONENT,
    decibels,
    decibels_lost,
    error_that_costs,
    fastest_within,
    knee,
    pareto_front,
)
from sparsestyle_ns.utils.machine import LoadWatch

Values = Dict[str, Union[float, Sequence[float]]]
"""What one measurement found: a number, or several repetitions of it, for each metric."""
FREE_LOSS = 0.1
"""dB against the photos that nobody misses: what an error may cost that is there only to save time."""


@dataclass(frozen=True)
class Metric:
    """What a number is.

    Attributes:
        label: in words, with its unit.
        log: whether its axis is logarithmic.
    """

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


@dataclass(frozen=True)
class Spread:
    """Median, smallest and largest of some repetitions."""

    median: float
    low: float
    high: float
    count: int


@dataclass
class Point:
    """What was measured at one value of the setting, or at one moment of a run with it.

    Attributes:
        setting: the value, as typed after the flag.
        moment: when in a run it was measured, in words; empty where there is no run.
        values: every repetition of every metric.
        busy: whether other processes kept the machine busy during any of them.
    """

    setting: str
    moment: str = ""
    values: Dict[str, List[float]] = field(default_factory=dict)
    busy: bool = False

    def spread(self, metric: str) -> Spread:
        """Of the repetitions of a metric."""
        values = self.values[metric]
        return Spread(statistics.median(values), min(values), max(values), len(values))

    def median(self, metric: str) -> float:
        """Of the repetitions of a metric."""
        return statistics.median(self.values[metric])


@dataclass
class Axis:
    """A curve of error against time for one setting.

    Attributes:
        group: quadrature, training, fine-field, style, rendering or precision.
        name: unique.
        title: in words.
        flag: the setting's flag on the command line.
        preset: its value in the preset, as typed after the flag.
        time, error: the metrics between which there is to choose; smaller is better. An error of `psnr` stands for
            the root mean square error with that PSNR.
        plots: (x, y) metrics of each plot; the first is the main one.
        note: how it was measured.
        own_error: root mean square error of the field against held-out photos. Given, the error is one that only
            saves time and may cost `FREE_LOSS` dB more than need be; None: the knee is recommended.
        points: in order of measuring.
        left_out: values that weren't measured, and why.
        order: the observed order of convergence.
    """

    group: str
    name: str
    title: str
    flag: str
    preset: str
    time: str
    error: str
    plots: List[Tuple[str, str]]
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
        matches = (point for point in self.points if (point.setting, point.moment) == (str(setting), moment))
        return next(matches, None)

    def last(self, setting: object) -> Optional[Point]:
        """The latest moment of the run with a value of the setting."""
        points = [point for point in self.points if point.setting == str(setting)]
        return points[-1] if points else None

    @property
    def has_runs(self) -> bool:
        """Whether the points of one setting are moments of a run."""
        return any(point.moment for point in self.points)

    def error_of(self, point: Point) -> float:
        """The error between which and time there is to choose; 0 or more."""
        value = point.median(self.error)
        return 10.0 ** (-value / 20.0) if self.error == "psnr" else value

    def _times_and_errors(self) -> Tuple[List[float], List[float]]:
        return [point.median(self.time) for point in self.points], [self.error_of(point) for point in self.points]

    @property
    def front(self) -> List[Point]:
        """Points that no other beats, from the fastest on."""
        return [self.points[index] for index in pareto_front(*self._times_and_errors())]

    @property
    def recommended(self) -> Optional[Point]:
        """The point to choose, by `rule`."""
        times, errors = self._times_and_errors()
        index = knee(times, errors) if self.own_error is None else fastest_within(times, errors, self.free_error)
        return None if index is None else self.points[index]

    @property
    def free_error(self) -> float:
        """The error that costs `FREE_LOSS` dB more than that of the most accurate point; `own_error` must be known.

        Not than none at all: what other settings cost is in all points, and can't be saved here.
        """
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
            f"Recommended: the fastest that costs at most {FREE_LOSS:g} dB more against photos than the most accurate: "
            f"the field itself has {decibels(self.own_error):.1f} dB there, so {decibels(self.free_error):.1f} dB here."
        )

    def content(self) -> Dict[str, Any]:
        """What the JSON report says of the axis."""
        front, recommended = self.front, self.recommended
        metrics = dict.fromkeys(metric for point in self.points for metric in point.values)
        return {
            "group": self.group,
            "name": self.name,
            "title": self.title,
            "flag": self.flag,
            "preset": self.preset,
            "time": self.time,
            "error": self.error,
            "plots": [list(plot) for plot in self.plots],
            "metrics": {metric: METRICS[metric].label for metric in metrics},
            "rule": self.rule,
            "note": self.note,
            "observed_order": self.order,
            "left_out": self.left_out,
            "points": [
                {
                    "setting": point.setting,
                    "moment": point.moment,
                    "on_front": point in front,
                    "recommended": point is recommended,
                    "busy": point.busy,
                    "values": {
                        metric: {name: finite(value) for name, value in vars(point.spread(metric)).items()}
                        for metric in point.values
                    },
                }
                for point in self.points
            ],
        }


def finite(value: float) -> Optional[float]:
    """JSON has no infinity: None for it (the PSNR of equal pictures)."""
    return value if math.isfinite(value) else None


@dataclass(frozen=True)
class Knob:
    """A setting and the values to measure beside the preset's, those that matter most first.

    Attributes:
        name: short and unique.
        title: in words.
        path: its place in a method's config.
        values: to measure.
    """

    name: str
    title: str
    path: str
    values: Tuple[Any, ...]

    @property
    def flag(self) -> str:
        """As ns-train has it."""
        return "--" + self.path.replace("_", "-")

    def read(self, config: Any) -> Any:
        """Its value in a config."""
        for name in self.path.split("."):
            config = getattr(config, name)
        return config


def with_setting(config: Any, path: str, value: Any) -> Any:
    """A copy of a config with the value of one setting, given by its place, changed."""
    config = copy.deepcopy(config)
    *parents, name = path.split(".")
    part = config
    for parent in parents:
        part = getattr(part, parent)
    if not hasattr(part, name):
        raise AttributeError(f"{type(config).__name__} has no {path}")
    setattr(part, name, value)
    return config


def in_turns(
    axis: Axis,
    cases: Dict[Any, Callable[[], Values]],
    budget: Budget,
    rounds: int,
    watch: LoadWatch,
) -> None:
    """Measures cases in turn, A B C A B C …, until each has all its rounds or time is over.

    So a slow spell of the machine meets all of them. A case that took longer than what is left isn't begun again; one
    that never was is left out, and the axis says so.

    Args:
        cases: by the value of the setting, what measures it once.
        rounds: repetitions of each at most.
    """
    costs = Costs()
    try:
        for _ in range(rounds):
            for setting, measure in cases.items():
                if budget.left <= costs.expected(str(setting)):
                    continue
                start = budget.clock()
                with watch:
                    values = measure()
                costs.note(str(setting), budget.clock() - start)
                axis.add(setting, values, watch.busy)
    except OutOfTimeError:
        pass
    finally:
        missing = [str(setting) for setting in cases if axis.find(setting) is None]
        axis.left_out += [f"{setting}: no time was left" for setting in missing]

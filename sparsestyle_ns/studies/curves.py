"""A curve of error against time: what was measured at each value of one setting, and which point to choose."""

import math
import statistics
from dataclasses import dataclass, field
from typing import Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple, Union

from sparsestyle_ns.studies.study_options import Group

TIME_EXPONENT = 1 / 8
"""a of `knee`: twice the time is worth it where it takes off 1 − 2^−a = 8.3% of the error (0.75 dB of PSNR) or more."""
Values = Mapping[str, Union[float, Sequence[float]]]
"""What one measurement found: a number, or several repetitions of it, for each metric."""
METRICS = {
    "iterations": "iterations",
    "train_seconds": "seconds of training",
    "step_seconds": "seconds an iteration",
    "view_seconds": "seconds a view",
    "fps": "frames a second",
    "first_seconds": "seconds of the first picture",
    "rmse": "root mean square error of colours",
    "memory_mb": "peak memory (MB)",
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "style_loss": "style loss, held-out views",
    "content_loss": "content loss, held-out views",
}
"""Every number that is measured, in words. Those of PSNR and SSIM are better the larger, as frames a second are."""
ON_LINEAR_SCALES = ("psnr", "ssim", "style_loss", "content_loss")
"""All other metrics have logarithmic scales."""
FREE_LOSS = 0.1
"""dB against the photos that nobody misses: what an error may cost that is there only to save time."""


def pareto_front(times: Sequence[float], errors: Sequence[float]) -> List[int]:
    """The points that no other beats in both, from the fastest on; of points that are equal in both, the first."""
    front: List[int] = []
    for index in sorted(range(len(times)), key=lambda point: (times[point], errors[point])):
        if not front or errors[index] < errors[front[-1]]:
            front.append(index)
    return front


def knee(times: Sequence[float], errors: Sequence[float], exponent: float = TIME_EXPONENT) -> Optional[int]:
    """The point with the smallest error · time^a, of equals the fastest; None where there are no points.

    It doesn't depend on the units of either, and lies on the front. Times and the exponent a are above 0.
    """
    front = pareto_front(times, errors)
    return min(front, key=lambda point: errors[point] * times[point] ** exponent, default=None)


def fastest_within(times: Sequence[float], errors: Sequence[float], limit: float) -> Optional[int]:
    """The fastest point with an error of at most `limit`, else the most accurate; None where there are no points."""
    front = pareto_front(times, errors)
    within = [point for point in front if errors[point] <= limit]
    return (within[:1] or front[-1:] or [None])[0]


def observed_order(samples: Sequence[float], errors: Sequence[float]) -> Optional[float]:
    """p of error ∝ samples^−p, by least squares of the logarithms; None without two points with an error."""
    points = [(math.log(n), math.log(error)) for n, error in zip(samples, errors, strict=True) if error > 0]
    if len({x for x, _ in points}) < 2:
        return None
    return -statistics.linear_regression(*zip(*points, strict=True)).slope


def decibels(error: float) -> float:
    """PSNR in dB of a root mean square error of colours in [0, 1]; infinite for 0."""
    return -20.0 * math.log10(error) if error > 0 else math.inf


def root_mean_square(psnr: float) -> float:
    """The error that has this PSNR in dB."""
    return 10.0 ** (-psnr / 20.0)


def decibels_lost(error: float, own_error: float) -> float:
    """dB of PSNR that an error costs which adds, independently, to another (both root mean squares)."""
    return 10.0 * math.log10(1.0 + (error / own_error) ** 2)


def error_that_costs(loss: float, own_error: float) -> float:
    """The inverse of `decibels_lost`: the error that costs `loss` dB."""
    return own_error * math.sqrt(10.0 ** (loss / 10.0) - 1.0)


def time_factor_of_a_decibel(time: float, psnr: float, later_time: float, later_psnr: float) -> Optional[float]:
    """How many times as long 1 dB more takes, at the rate between two points; None where nothing was gained."""
    if later_psnr <= psnr or later_time <= time:
        return None
    return (later_time / time) ** (1.0 / (later_psnr - psnr))


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
        time, error: the metrics between which there is to choose; smaller is better. An error of `psnr` stands for
            the root mean square error with that PSNR.
        plots: (x, y) metrics of each plot; the first is the main one.
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
        """The error, 0 or more, between which and time there is to choose."""
        value = point.median(self.error)
        return root_mean_square(value) if self.error == "psnr" else value

    @property
    def _times_and_errors(self) -> Tuple[List[float], List[float]]:
        return [point.median(self.time) for point in self.points], [self.error_of(point) for point in self.points]

    @property
    def front(self) -> List[Point]:
        """The Pareto front, from the fastest point on."""
        return [self.points[index] for index in pareto_front(*self._times_and_errors)]

    @property
    def recommended(self) -> Optional[Point]:
        """The point to choose, by `rule`."""
        both = self._times_and_errors
        index = knee(*both) if self.own_error is None else fastest_within(*both, self.free_error)
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

"""Time that may be spent, what fits into it, and in which order curves are measured."""

import contextlib
import itertools
import re
import time
from dataclasses import dataclass
from typing import Callable, Dict, Mapping, Sequence, Tuple

from sparsestyle_ns.studies.curves import Curve, Values
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.machine import LoadWatch

Clock = Callable[[], float]


class OutOfTimeError(Exception):
    """The time that a measurement may take is over; what has been measured stays."""


class Budget:
    """Seconds that may be spent from now on, by a clock."""

    def __init__(self, seconds: float, clock: Clock = time.perf_counter) -> None:
        self.clock, self.start = clock, clock()
        self.end = self.start + seconds

    @property
    def left(self) -> float:
        """Seconds left; negative when it was overdrawn."""
        return self.end - self.clock()

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return self.clock() - self.start

    def part(self, seconds: float) -> "Budget":
        """A part of what is left, from now on."""
        part = Budget(seconds, self.clock)
        part.end = min(part.end, self.end)
        return part

    def check(self, needed: float = 0.0) -> None:
        """Raises an `OutOfTimeError` unless more than `needed` seconds are left."""
        if self.left <= needed:
            raise OutOfTimeError


def parse_duration(text: str) -> float:
    """Seconds of a duration such as 90s, 10m, 1h30m or 600.

    Raises:
        InputError: it isn't one, or is 0.
    """
    number = r"(\d+(?:\.\d+)?)"
    parts = re.fullmatch(rf"(?:{number}h)?(?:{number}m)?(?:{number}s?)?", text.strip())
    hours, minutes, seconds = (float(part or 0) for part in parts.groups()) if parts else (0.0, 0.0, 0.0)
    total = 3600 * hours + 60 * minutes + seconds
    if total <= 0:
        raise InputError(f"--budget {text} is no duration; give one such as 90s, 10m or 1h30m.")
    return total


@dataclass
class Plan:
    """How to measure some curves together."""

    curves: Sequence[Curve]
    weight: float
    """Their part of the time, beside those of the plans that follow."""
    measure: Callable[[Budget], None]
    """Measures them within a budget; what it has added to them when it stops counts."""


def run_plans(plans: Sequence[Plan], budget: Budget, begin: Callable[[Plan], None] = lambda plan: None) -> None:
    """Measures one plan after another, each told to `begin`; time that one leaves over goes to those that follow."""
    for index, plan in enumerate(plans):
        share = budget.left * plan.weight / sum(later.weight for later in plans[index:])
        begin(plan)
        if share > 0:
            with contextlib.suppress(OutOfTimeError):
                plan.measure(budget.part(share))
        for curve in plan.curves:
            if not curve.points and not curve.left_out:
                curve.left_out.append("all: no time was left")


@dataclass
class Case:
    """Settings that are measured together, once in each round."""

    points: Sequence[Tuple[Curve, object]]
    """The curves that what is found belongs to, and the value of the setting there."""
    measure: Callable[[int], Mapping[str, Values]]
    """Given the round's number, what was found by the moment in a run. A curve takes what has its metric of time."""


def in_turns(cases: Sequence[Case], budget: Budget, rounds: int, watch: LoadWatch) -> None:
    """Measures cases in turn, A B C A B C …, until each has all its rounds or time is over; slow spells meet all alike.

    A case that took longer than what is left isn't begun again, nor a new one where the latest other took longer; one
    that never was is left out, and its curves say so.
    """
    costs: Dict[int, float] = {}
    latest = 0.0
    try:
        for round_, (number, case) in itertools.product(range(rounds), enumerate(cases)):
            if budget.left <= costs.get(number, latest):
                continue
            start = budget.clock()
            with watch:
                found = case.measure(round_)
            costs[number] = latest = budget.clock() - start
            for (curve, setting), (moment, values) in itertools.product(case.points, found.items()):
                if curve.time in values:
                    curve.add(setting, values, watch.busy, moment)
    except OutOfTimeError:
        pass
    finally:
        for curve, setting in (point for case in cases for point in case.points):
            if curve.last(setting) is None:
                curve.left_out.append(f"{setting}: no time was left")

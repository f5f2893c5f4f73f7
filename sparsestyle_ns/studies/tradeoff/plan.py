"""What is measured in which order, and how long each may take."""

import contextlib
from dataclasses import dataclass
from typing import Callable, List, Sequence

from sparsestyle_ns.studies.tradeoff.axis import Axis
from sparsestyle_ns.studies.tradeoff.budget import Budget, OutOfTimeError

Measure = Callable[[Axis, Budget], None]


@dataclass
class Plan:
    """How to measure an axis.

    Attributes:
        axis: takes the points.
        weight: its part of the time, beside those of the plans that follow.
        measure: measures it within a budget; what it has added to the axis when it stops counts.
    """

    axis: Axis
    weight: float
    measure: Measure


def run_plans(plans: Sequence[Plan], budget: Budget, begin: Callable[[Axis], None] = lambda axis: None) -> None:
    """Measures axes one after another. Time that one leaves over is shared among those that follow.

    Args:
        plans: in order.
        budget: for all of them.
        begin: is told of each axis before it is measured.
    """
    for index, plan in enumerate(plans):
        share = budget.left * plan.weight / sum(later.weight for later in plans[index:])
        begin(plan.axis)
        if share > 0:
            with contextlib.suppress(OutOfTimeError):
                plan.measure(plan.axis, budget.part(share))
        if not plan.axis.points and not plan.axis.left_out:
            plan.axis.left_out.append("all: no time was left")


def measured(plans: Sequence[Plan]) -> List[Axis]:
    """The axes that have points."""
    return [plan.axis for plan in plans if plan.axis.points]

"""How strongly a loss counts at an iteration."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Sequence, Tuple

from sparsestyle_ns.utils.errors import InputError


def content_weight(step: int, initial: float, decay: float, duration: int) -> float:
    """The weight λ(t) of the content loss, λ0 · α^(t/T) while t ≤ T, and λ0 · α from then on (Eq. 6).

    `step` is t ≥ 0. λ0, α and T are 0 or more, or an `InputError` says so; the paper's are 10, 0.01 and 100.

    Example:
        >>> content_weight(step=50, initial=10.0, decay=0.01, duration=100)
        1.0
    """
    arguments = {"iteration": step, "initial value": initial, "decay factor": decay, "duration in iterations": duration}
    for name, value in arguments.items():
        if not 0 <= value < math.inf:
            raise InputError(f"The content weight's {name} is {value}: give a finite number that is 0 or more.")
    return initial * decay ** (step / duration if step < duration else 1)


def ramp(progress: float, start: float, length: float) -> float:
    """Rises evenly from 0 at `start` to 1 at `start + length`, shares of the iterations; a step where `length` is 0."""
    since = progress - start
    if since >= length:
        return 1.0
    return since / length if since > 0 else 0.0


@dataclass(frozen=True)
class Level:
    """Iterations at one size of the pictures, of several that follow each other from small to large."""

    scale: float
    """The pictures' size, as a share of the largest's."""
    first: int
    """The first iteration."""
    length: int
    """How many there are."""


def coarse_to_fine(scales: Sequence[float], shares: Sequence[float], total: int) -> Tuple[Level, ...]:
    """Divides `total` iterations among sizes, ascending scales in (0, 1], by shares above 0 whose sum needn't be 1.

    The last gets one at least, where there is any; others that would get none are left out. InputError where scales or
    shares aren't such.
    """
    ascending = all(scale < larger for scale, larger in pairwise(scales))
    if not (scales and len(scales) == len(shares) and ascending and all(0.0 < scale <= 1.0 for scale in scales)):
        raise InputError(
            f"Views' scales are {_listed(scales)} and their shares of the iterations {_listed(shares)}: give as many "
            "shares as scales, and scales above 0 and up to 1, each larger than the one before."
        )
    if not all(0.0 < share < math.inf for share in shares):
        raise InputError(f"The scales' shares of the iterations are {_listed(shares)}: give numbers above 0.")
    borders = [0]
    for place in range(len(scales)):
        borders.append(round(total * sum(shares[: place + 1]) / sum(shares)))
    borders[:-1] = [min(border, max(0, total - 1)) for border in borders[:-1]]
    levels = [
        Level(scale, first, after - first) for scale, first, after in zip(scales, borders, borders[1:], strict=False)
    ]
    return (*(level for level in levels[:-1] if level.length > 0), levels[-1])


def _listed(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers) or "none"

"""How strongly a loss counts at an iteration."""

import math

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

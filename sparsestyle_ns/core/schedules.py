"""How strongly a loss counts at an iteration: content while a scene is stylised, regularisers that set in later."""

import math

from sparsestyle_ns.utils.errors import InputError


def content_weight(step: int, initial: float, decay: float, duration: int) -> float:
    """The weight λ of the content loss at one iteration (Eq. 6).

    λ(t) = λ0 · α^(t/T) while t ≤ T, and λ0 · α from then on; with T = 0 from the first iteration on.

    Args:
        step: the iteration t, counted from 0.
        initial: λ0 ≥ 0; the paper's is 10.
        decay: α ≥ 0; the paper's is 0.01, 1 keeps the weight constant.
        duration: T ≥ 0 iterations; the paper's is 100.

    Raises:
        InputError: an argument is negative, infinite or not a number.

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
    """A share that rises evenly from 0 at `start` to 1 at `start + length`; a step where `length` is 0.

    All three are shares of the iterations, 0 or more: `ramp(0.5, start=0.25, length=0.5)` is 0.5.
    """
    since = progress - start
    if since >= length:
        return 1.0
    return since / length if since > 0 else 0.0

"""How strongly the content holds on while a scene is stylised."""

from sparsestyle_ns.errors import InputError


def content_weight(step: int, initial: float, decay: float, duration: int) -> float:
    """The weight λ of the content loss at one iteration (Eq. 6).

    λ(t) = λ0 · α^(t/T) while t ≤ T, and λ0 · α from then on: an exponential fall from λ0 to λ0 · α. With T = 0
    the fall is already over, so λ is λ0 · α from the first iteration on, t = 0 included.

    Args:
        step: the iteration t, counted from 0.
        initial: λ0 ≥ 0, the weight at t = 0; the paper's is 10.
        decay: α ≥ 0, what is left of the weight at the end; the paper's is 0.01, 1 keeps the weight constant.
        duration: T ≥ 0, the iterations the fall takes; the paper's is 100.

    Raises:
        InputError: an argument is negative or not a number.

    Example:
        >>> content_weight(step=50, initial=10.0, decay=0.01, duration=100)
        1.0
    """
    arguments = {"iteration": step, "initial value": initial, "decay factor": decay, "duration in iterations": duration}
    for name, value in arguments.items():
        if not value >= 0:
            raise InputError(f"The content weight's {name} is {value}: give a number that is 0 or more.")
    if step >= duration:
        return initial * decay
    return initial * decay ** (step / duration)

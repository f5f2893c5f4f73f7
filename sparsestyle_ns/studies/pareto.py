"""What a set of (time, error) points says: the front, the point to choose, how fast an error falls."""

import math
from typing import List, Optional, Sequence

TIME_EXPONENT = 1 / 8
"""a of `knee`: twice the time is worth it where it takes off 1 − 2^−a = 8.3% of the error (0.75 dB of PSNR) or more."""


def pareto_front(times: Sequence[float], errors: Sequence[float]) -> List[int]:
    """The points that no other beats in both, from the fastest on.

    Of points that are equal in both, the first.
    """
    front: List[int] = []
    least = math.inf
    for index in sorted(range(len(times)), key=lambda point: (times[point], errors[point])):
        if errors[index] < least:
            front.append(index)
            least = errors[index]
    return front


def knee(times: Sequence[float], errors: Sequence[float], exponent: float = TIME_EXPONENT) -> Optional[int]:
    """The point with the smallest error · time^a; None where there are no points.

    It doesn't depend on the units of either, and lies on the front. Of equals, the fastest.

    Args:
        times: above 0.
        errors: 0 or more.
        exponent: a, above 0; what time counts for beside error.
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
    mean_x, mean_y = (sum(values) / len(points) for values in zip(*points, strict=True))
    covariance = sum((x - mean_x) * (y - mean_y) for x, y in points)
    return -covariance / sum((x - mean_x) ** 2 for x, _ in points)


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

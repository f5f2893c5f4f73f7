"""Time that may be spent, and what fits into it."""

import re
import time
from typing import Callable, Dict, Optional

from sparsestyle_ns.utils.errors import InputError

Clock = Callable[[], float]


class OutOfTimeError(Exception):
    """The time that a measurement may take is over; what has been measured stays."""


class Budget:
    """Seconds that may be spent from now on.

    Args:
        seconds: how many.
        clock: what time it is.
    """

    def __init__(self, seconds: float, clock: Clock = time.perf_counter) -> None:
        self.clock = clock
        self.start = clock()
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
        """Goes on only if more than this is left.

        Raises:
            OutOfTimeError: it isn't.
        """
        if self.left <= needed:
            raise OutOfTimeError


def parse_duration(text: str) -> float:
    """Seconds of a duration such as 90s, 10m, 1h30m or 600.

    Raises:
        InputError: it isn't one, or is 0.
    """
    parts = re.fullmatch(r"(?:([\d.]+)h)?(?:([\d.]+)m)?(?:([\d.]+)s?)?", text.strip())
    try:
        hours, minutes, seconds = (float(part or 0) for part in parts.groups()) if parts else (0.0, 0.0, 0.0)
    except ValueError:
        hours = minutes = seconds = 0.0
    total = 3600 * hours + 60 * minutes + seconds
    if total <= 0:
        raise InputError(f"--budget {text} is no duration; give one such as 90s, 10m or 1h30m.")
    return total


class Costs:
    """What measurements took, to tell whether one more fits."""

    def __init__(self) -> None:
        self._seconds: Dict[str, float] = {}
        self._latest: Optional[float] = None

    def note(self, name: str, seconds: float) -> None:
        """Remembers what one took."""
        self._seconds[name] = self._latest = seconds

    def expected(self, name: str) -> float:
        """What it took before; what the latest other took if it is new; 0 for the very first."""
        return self._seconds.get(name, self._latest or 0.0)

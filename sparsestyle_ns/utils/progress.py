"""How far long work is, and how long it still takes: bars on a terminal, a line now and then in a log.

All bars of a process are on one display, also those of several threads and bars within bars, so that none overwrites
another and what is printed meanwhile appears above them. Of several processes that train together, the first shows
them; where CONSOLE is quiet, nothing is shown. A process that was started by another one tells it how far it is in a
file (see `progress_file`).
"""

import math
import threading
import time
from contextlib import contextmanager
from typing import Iterator, Optional, Sequence, TypeVar

from nerfstudio.utils import comms
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from sparsestyle_ns.utils.progress_file import ProgressReport, Work, report

T = TypeVar("T")

SECONDS_BETWEEN_LINES = (10.0, 60.0)
"""In a log, the least and the most time from one line to the next."""
SHARE_BETWEEN_LINES = 0.05
"""Share of the work after which a line comes before the most time has passed."""
WORTH_A_LINE = 10.0
"""Seconds from which on finished work leaves a line that says how long it took."""
SPEED_PERIOD = 120.0
"""Seconds of the past by which the time left is estimated."""
REFRESHES = 4
"""Of the bars in a second; drawing them takes time from the work."""
SECONDS_BETWEEN_REPORTS = 1.0
"""Least time from one report to the process that started this one to the next."""


class Bar:
    """One piece of work that is under way; made by `bar`."""

    def __init__(
        self, display: Progress, description: str, total: float, done: float, unit: str, visible: bool
    ) -> None:
        self._display, self._unit = display, f" {unit}" if unit else ""
        visible = visible and total > 1
        number = display.add_task(
            description, total=total, completed=done, visible=visible, first=done, note="", unit=unit
        )
        self.task = next(task for task in display.tasks if task.id == number)
        self._said, self._said_at = done, time.monotonic()

    def advance(self, steps: float = 1, note: Optional[str] = None) -> None:
        """Some more of it is done; `note`, where given, is shown behind the time left from now on."""
        self.reach(self.task.completed + steps, note)

    def reach(self, done: float, note: Optional[str] = None) -> None:
        """So much of it is done in all."""
        fields = {} if note is None else {"note": note}
        task = self.task
        self._display.update(task.id, completed=done, **fields)
        _report(self._display)
        if not self._display.disable or not task.visible or task.finished:
            return
        least, most = SECONDS_BETWEEN_LINES
        waited, share = time.monotonic() - self._said_at, (done - self._said) / task.total
        if waited >= most or (waited >= least and share >= SHARE_BETWEEN_LINES):
            self._said, self._said_at = done, time.monotonic()
            left, note = seconds_left(task), task.fields["note"]
            say(
                f"{task.description}: {done:.0f} of {task.total:.0f}{self._unit} ({task.percentage:.0f}%)"
                + ("" if left is None else f", {duration(left)} left")
                + (f"; {note}" if note else "")
            )

    def end(self) -> None:
        """Takes the bar away; work that took long and is finished leaves a line."""
        task = self.task
        if task.visible and task.finished and (task.finished_time or 0.0) >= WORTH_A_LINE:
            done = task.completed - task.fields["first"]
            say(f"{task.description}: {done:.0f}{self._unit} in {duration(task.finished_time)}")
        self._display.remove_task(task.id)


@contextmanager
def bar(description: str, total: float, done: float = 0, unit: str = "", visible: bool = True) -> Iterator[Bar]:
    """Shows how far some work is, within a `with`.

    Args:
        description: what is being done, a word or two.
        total: how much there is to do; of one thing alone nothing is shown.
        done: how much of it was done before.
        unit: what is counted, for lines in a log.
        visible: whether to show anything.
    """
    with _shared_display() as display:
        one = Bar(display, description, total, done, unit, visible)
        try:
            yield one
        finally:
            one.end()


def track(items: Sequence[T], description: str) -> Iterator[T]:
    """The items one after another, with a bar that counts them."""
    with bar(description, len(items)) as one:
        for item in items:
            yield item
            one.advance()


def say(line: str) -> None:
    """A line of plain text, above the bars if there are any."""
    if comms.is_main_process():
        CONSOLE.print(line, markup=False, highlight=False, soft_wrap=True)


def seconds_left(task: Task) -> Optional[float]:
    """By the speed of the last minutes; while they say nothing, by the mean speed; None before anything is done."""
    if task.time_remaining is not None:
        return task.time_remaining
    done = task.completed - task.fields["first"]
    return None if done <= 0 or task.elapsed is None else task.elapsed / done * task.remaining


def duration(seconds: float) -> str:
    """Seconds as minutes and seconds, or hours and minutes."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 60}:{whole % 60:02d} min"


class _TimeLeftColumn(ProgressColumn):
    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        """The time left, once it is known."""
        left = seconds_left(task)
        return Text("" if left is None else f"{duration(left)} left", style="progress.remaining")


def _can_draw() -> bool:
    return CONSOLE.is_terminal and not (CONSOLE.is_dumb_terminal or CONSOLE.quiet) and comms.is_main_process()


_lock = threading.Lock()
_display: Optional[Progress] = None
_users = 0
_reported_at = -math.inf


def _report(display: Progress) -> None:
    """Tells the process that started this one how far all work is, not too often."""
    global _reported_at
    with _lock:
        if time.monotonic() - _reported_at < SECONDS_BETWEEN_REPORTS or not comms.is_main_process():
            return
        _reported_at = time.monotonic()
        works = (Work(task.description, task.completed, task.total, task.fields["unit"]) for task in display.tasks)
        report(ProgressReport(tuple(works)))


@contextmanager
def _shared_display() -> Iterator[Progress]:
    """The display of all bars: there while at least one is."""
    global _display, _users
    with _lock:
        if _display is None:
            _display = Progress(
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=30),
                MofNCompleteColumn(),
                _TimeLeftColumn(),
                TextColumn("{task.fields[note]}", markup=False, style="dim"),
                console=CONSOLE,
                transient=True,
                refresh_per_second=REFRESHES,
                speed_estimate_period=SPEED_PERIOD,
                disable=not _can_draw(),
            )
            _display.start()
        _users += 1
        display = _display
    try:
        yield display
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                display.stop()
                _display = None

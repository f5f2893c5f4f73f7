"""How far long work is, and how long it still takes: bars on a terminal, a line now and then in a log.

All bars of a process are on one display, also those of several threads and bars within bars, and what is printed
meanwhile appears above them. Of several processes that train together, the first shows them; where CONSOLE is quiet,
nothing is shown. A process that was started by another one tells it how far it is in a file (see `progress_file`).
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
    """One piece of work that is under way, a task of the display; made by `bar`."""

    def __init__(self, display: Progress, task: Task) -> None:
        self._display, self.task = display, task
        self._unit = f" {task.fields['unit']}" if task.fields["unit"] else ""
        self._said, self._said_at = task.completed, time.monotonic()

    def advance(self, steps: float = 1, note: Optional[str] = None) -> None:
        """Some more of it is done; `note`, where given, is shown behind the time left from now on."""
        self.reach(self.task.completed + steps, note)

    def reach(self, done: float, note: Optional[str] = None) -> None:
        """So much of it is done in all."""
        task = self.task
        self._display.update(task.id, completed=done, note=task.fields["note"] if note is None else note)
        _report(self._display)
        if not self._display.disable or not task.visible or task.finished:
            return
        least, most = SECONDS_BETWEEN_LINES
        waited, share = time.monotonic() - self._said_at, (done - self._said) / task.total
        if waited >= most or (waited >= least and share >= SHARE_BETWEEN_LINES):
            self._said, self._said_at = done, time.monotonic()
            line = f"{task.description}: {done:.0f} of {task.total:.0f}{self._unit} ({task.percentage:.0f}%)"
            left, note = time_left(task), task.fields["note"]
            say(line + (f", {left}" if left else "") + (f"; {note}" if note else ""))

    def end(self) -> None:
        """Takes the bar away; work that took long and is finished leaves a line."""
        task = self.task
        if task.visible and task.finished and (task.finished_time or 0.0) >= WORTH_A_LINE:
            done = task.completed - task.fields["first"]
            say(f"{task.description}: {done:.0f}{self._unit} in {duration(task.finished_time)}")
        self._display.remove_task(task.id)


@contextmanager
def bar(description: str, total: float, done: float = 0, unit: str = "", visible: bool = True) -> Iterator[Bar]:
    """Shows how far some work is, within a `with`; nothing is shown where there is one thing to do in all.

    The description is a word or two, `done` what was done before, and `unit` what is counted, for lines in a log.
    """
    with _shared_display() as display:
        number = display.add_task(
            description, total=total, completed=done, visible=visible and total > 1, first=done, note="", unit=unit
        )
        one = Bar(display, next(task for task in display.tasks if task.id == number))
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


def time_left(task: Task) -> str:
    """By the speed of the last minutes; while they say nothing, by the mean speed; empty before anything is done."""
    seconds, done = task.time_remaining, task.completed - task.fields["first"]
    if seconds is None and done > 0 and task.elapsed is not None:
        seconds = task.elapsed / done * task.remaining
    return "" if seconds is None else f"{duration(seconds)} left"


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
        return Text(time_left(task), style="progress.remaining")


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
            can_draw = CONSOLE.is_terminal and not (CONSOLE.is_dumb_terminal or CONSOLE.quiet)
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
                disable=not (can_draw and comms.is_main_process()),
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

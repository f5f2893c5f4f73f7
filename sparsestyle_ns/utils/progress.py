"""How far long work is, and how long it still takes: bars on a terminal, a line now and then in a log.

All bars of a process are on one display, above which what is printed meanwhile appears. Of several processes that train
together, the first shows them. A process that was started by another one tells it how far it is in a small JSON file.
"""

import json
import math
import os
import re
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Iterator, Optional, Sequence, Tuple, TypeVar

from nerfstudio.utils import comms
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

T = TypeVar("T")

PROGRESS_FILE = "SPARSESTYLE_PROGRESS_FILE"
"""Environment variable with that file's path; where it isn't set, nothing is written."""
SECONDS_BETWEEN_LINES, SHARE_BETWEEN_LINES = (10.0, 60.0), 0.05
"""In a log, the least and the most time between lines, and the share of the work after which one comes before that."""
WORTH_A_LINE = 10.0
"""Seconds from which on finished work leaves a line that says how long it took."""
SECONDS_BETWEEN_REPORTS = 1.0


@dataclass(frozen=True)
class Work:
    """A piece of work that is under way; `unit` is what is counted, `iterations` for training itself."""

    description: str
    done: float
    total: float
    unit: str


@dataclass(frozen=True)
class ProgressReport:
    """What a process says of its work: what is under way, the outermost first."""

    works: Tuple[Work, ...] = ()
    failure: str = ""
    """Why the process ended without finishing, one sentence; empty while all is well."""

    def write(self, path: Path) -> None:
        """Replaces the file, or raises an `OSError`."""
        unfinished = path.with_name(path.name + ".unfinished")
        unfinished.write_text(json.dumps(asdict(self)), encoding="utf-8")
        os.replace(unfinished, path)  # without waiting for the disk: nobody reads it after a crash of the machine

    @classmethod
    def read(cls, path: Path) -> "ProgressReport":
        """The newest report; an empty one before the first."""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return cls()
        return cls(tuple(Work(**work) for work in content["works"]), content["failure"])


def report(content: ProgressReport) -> None:
    """Writes a report, where this process is to write one; work doesn't stop because it can't be written."""
    if os.environ.get(PROGRESS_FILE):
        with suppress(OSError):
            content.write(Path(os.environ[PROGRESS_FILE]))


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
        """Work that took long and is finished leaves a line."""
        task = self.task
        if task.visible and task.finished and (task.finished_time or 0.0) >= WORTH_A_LINE:
            done = task.completed - task.fields["first"]
            say(f"{task.description}: {done:.0f}{self._unit} in {duration(task.finished_time)}")


def is_progress_line(line: str) -> bool:
    """Whether a line of a log is one of those by which `Bar.reach` says how far work is."""
    return re.match(r".+: \d+ of \d+.* \(\d+%\)", line) is not None


@contextmanager
def bar(description: str, total: float, done: float = 0, unit: str = "", visible: bool = True) -> Iterator[Bar]:
    """Shows how far work of more than one step is, of which `done` was done before; lines in a log have the `unit`."""
    global _display
    with _lock:
        if _display is None:
            _display = _make_display()
            _display.start()
        display = _display
        number = display.add_task(
            description, total=total, completed=done, visible=visible and total > 1, first=done, note="", unit=unit
        )
    one = Bar(display, next(task for task in display.tasks if task.id == number))
    try:
        yield one
    finally:
        one.end()
        with _lock:
            display.remove_task(number)
            if not display.tasks:
                display.stop()
                _display = None


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


def _make_display() -> Progress:
    can_draw = CONSOLE.is_terminal and not (CONSOLE.is_dumb_terminal or CONSOLE.quiet)
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        _TimeLeftColumn(),
        TextColumn("{task.fields[note]}", markup=False, style="dim"),
        console=CONSOLE,
        transient=True,
        refresh_per_second=4,
        speed_estimate_period=120.0,
        disable=not (can_draw and comms.is_main_process()),
    )

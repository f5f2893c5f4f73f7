"""Commands in stages: each is shown and its output passed on, one bar is for all, and what is finished isn't redone."""

import os
import queue
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Callable, Dict, Iterable, Iterator, List, Optional, Sequence, Tuple, Union

from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.interrupts import PRESSES, ending_on
from sparsestyle_ns.utils.progress import PROGRESS_FILE, Bar, ProgressReport, bar, is_progress_line, say

LINES_OF_A_FAILURE = 20
SILENCE = 20.0
"""Seconds without output after which a command is said to be still running."""
SECONDS_BETWEEN_LOOKS = 1.0
"""At how far a command says that it is."""
RULE = "─"
FINISHED = ".finished"
"""Folder, in that of the products, of notes about stages that are finished."""
Command = List[str]


class StageFailedError(Exception):
    """A stage's command ended with an error. The message says which and how."""


@dataclass
class Stage:
    """One step of the whole.

    Attributes:
        name: of its note in FOLDER/.finished.
        heading: what it does.
        commands: the commands, or a function that makes them when its turn comes, from what is there by then.
        product: a pattern below FOLDER; a finished stage is done again when nothing matches it any more.
        settings: what it depends on beside its commands and the stages before it.
        seconds: how long it takes, about; only their ratios matter, to the bar.
        works: the bars of its commands that say how far it is, with the share of its time after which each begins.
    """

    name: str
    heading: str
    commands: Union[List[Command], Callable[[], List[Command]]]
    product: str
    settings: str = ""
    seconds: float = 1.0
    works: Dict[str, float] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """What has to be the same for a finished stage to count as finished."""
        known = [] if callable(self.commands) else [shlex.join(command) for command in self.commands]
        return "\n".join([*known, self.settings])

    def is_finished(self, folder: Path) -> bool:
        """Whether it was finished with these settings, and what it made is there."""
        note = folder / FINISHED / self.name
        return note.is_file() and note.read_text() == self.key and any(folder.glob(self.product))

    def share_done(self, report: ProgressReport) -> float:
        """How far its command is, in [0, 1], by what it reports."""
        shares = [0.0]
        for work in report.works:
            if work.description in self.works and work.total > 0:
                first = self.works[work.description]
                last = min((other for other in self.works.values() if other > first), default=1.0)
                shares.append(first + (last - first) * work.done / work.total)
        return max(shares)


def run_stages(folder: Path, stages: Sequence[Stage], force: bool = False) -> List[Tuple[str, Optional[float]]]:
    """Runs stages in their order: from the first one that isn't finished, all of them.

    Args:
        folder: where their products and the notes about finished stages lie.
        stages: what to do.
        force: whether to run them all.

    Returns:
        Headings and seconds; None for a stage that was finished before.

    Raises:
        StageFailedError: a command failed; the stages before it stay finished.
        KeyboardInterrupt: Ctrl-C; the command that was under way had the time to save what it had.
        SystemExit: SIGTERM or SIGHUP, which end that command too.
    """
    with ending_on(signal.SIGTERM, signal.SIGHUP):
        return _run_all(folder, stages, force)


def _run_all(folder: Path, stages: Sequence[Stage], force: bool) -> List[Tuple[str, Optional[float]]]:
    finished = [stage.is_finished(folder) and not force for stage in stages]
    first = finished.index(False) if False in finished else len(stages)
    durations: List[Tuple[str, Optional[float]]] = []
    total = sum(stage.seconds for stage in stages)
    done = sum(stage.seconds for stage in stages[:first])
    with bar("The whole", 100.0, 100.0 * done / total) as whole:
        for number, stage in enumerate(stages):
            heading = f"[{number + 1}/{len(stages)}] {stage.heading}"
            if number < first:
                say(f"{heading}: done before")
                durations.append((stage.heading, None))
                continue
            start = time.monotonic()
            say(f"\n{heading}")
            _run_stage(folder, stage, _Part(whole, 100.0 * done / total, 100.0 * stage.seconds / total))
            done, seconds = done + stage.seconds, time.monotonic() - start
            whole.reach(100.0 * done / total)
            durations.append((stage.heading, seconds))
            say(f"      done in {clock(seconds)}")
    return durations


@dataclass
class _Part:
    """A stage's part of the whole bar."""

    bar: Bar
    start: float
    length: float

    def reach(self, share: float) -> bool:
        """Shows that this share of it is done; whether that is more than before."""
        done, before = self.start + share * self.length, self.bar.task.completed
        self.bar.reach(max(before, done))
        return done > before


def _run_stage(folder: Path, stage: Stage, part: _Part) -> None:
    note = folder / FINISHED / stage.name
    note.unlink(missing_ok=True)
    note.parent.mkdir(parents=True, exist_ok=True)
    commands = stage.commands() if callable(stage.commands) else stage.commands
    progress = note.parent / "progress.json"
    for number, command in enumerate(commands):
        progress.unlink(missing_ok=True)

        def look(number: int = number) -> bool:
            return part.reach((number + stage.share_done(ProgressReport.read(progress))) / len(commands))

        run_command(command, stage.heading, progress, look)
    progress.unlink(missing_ok=True)
    if not any(folder.glob(stage.product)):
        raise StageFailedError(f"{stage.heading}: it ended without {folder / stage.product}.")
    write_whole(note, stage.key)


def run_command(
    command: Command, heading: str, progress: Optional[Path] = None, look: Callable[[], bool] = lambda: False
) -> None:
    """Runs a command, shows it, and passes on what it prints, with the time since it started before each line.

    Ctrl-C is passed on to the command, once, and it is given the time to save what it has.

    Args:
        progress: the file in which it says how far it is; its lines about that aren't shown then.
        look: called about every second; whether the command got on.

    Raises:
        StageFailedError: it can't be started or its exit status isn't 0; the message ends with its last lines.
        KeyboardInterrupt: Ctrl-C, after the command has ended.
    """
    say(f"      $ {shlex.join(command)}")
    start, last = time.monotonic(), deque(maxlen=LINES_OF_A_FAILURE)
    reports = {} if progress is None else {PROGRESS_FILE: str(progress)}
    try:
        process = subprocess.Popen(
            [program_path(command[0]), *command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONWARNINGS": "ignore", **reports},
            encoding="utf-8",
            errors="replace",
            start_new_session=True,  # a terminal's Ctrl-C reaches this process alone, which passes it on once
        )
    except OSError as error:
        raise StageFailedError(f"{heading}: {command[0]} can't be started ({error.strerror}).") from error
    assert process.stdout is not None
    printed = read_lines(process.stdout)

    def show(text: str) -> None:
        say(f"{clock(time.monotonic() - start)} {text}")

    def pass_on() -> None:
        for line in without_config(lines_of(printed, show, look)):
            last.append(line)
            if progress is None or not is_progress_line(line):
                show(line)

    with process:
        try:
            pass_on()
        except PRESSES:
            process.send_signal(signal.SIGINT)
            try:
                pass_on()
            except PRESSES:  # a second one: at once
                process.terminate()
            raise
        except BaseException:
            process.terminate()
            raise
    if process.returncode != 0:
        tail = "\n".join(f"    {line}" for line in last)
        raise StageFailedError(
            f"{heading}: {command[0]} ended with exit status {process.returncode}; its last lines were\n{tail}"
        )


def program_path(name: str) -> str:
    """A program of the environment that this process runs in, else the one on PATH."""
    if name == "python":
        return sys.executable
    beside = Path(sys.executable).parent / name
    return str(beside) if beside.exists() else name


def clock(seconds: float) -> str:
    """Seconds as minutes and seconds, m:ss."""
    return f"{int(seconds) // 60:2d}:{int(seconds) % 60:02d}"


def read_lines(stream: IO[str]) -> "queue.Queue[Optional[str]]":
    """Reads a stream in the background into a queue, which ends with None."""
    lines: queue.Queue[Optional[str]] = queue.Queue()

    def read() -> None:
        for line in stream:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    return lines


def lines_of(
    lines: "queue.Queue[Optional[str]]", show: Callable[[str], None], look: Callable[[], bool] = lambda: False
) -> Iterator[str]:
    """The queue's lines as they come; `show` is told where for long none comes, and `look` sees no progress either."""
    silent_since = time.monotonic()
    while True:
        if look():
            silent_since = time.monotonic()
        try:
            line = lines.get(timeout=min(SECONDS_BETWEEN_LOOKS, SILENCE))
        except queue.Empty:
            if time.monotonic() - silent_since >= SILENCE:
                show("still running …")
                silent_since = time.monotonic()
            continue
        if line is None:
            return
        silent_since = time.monotonic()
        yield line


def without_config(lines: Iterable[str]) -> Iterator[str]:
    """Lines of a command's output without empty ones and without ns-train's 150 lines of configuration.

    They lie between a rule with the heading Config and a plain one; the run's config.yml has them too.
    """
    is_config = False
    for line in lines:
        is_rule = line.count(RULE) > 20
        if is_config or (is_rule and " Config " in line):
            is_config = not (is_config and is_rule)
        elif line.strip():
            yield line.rstrip()

"""Commands in stages: each is shown and its output passed on, and what is finished is not done again."""

import os
import queue
import shlex
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Callable, Iterable, Iterator, List, Optional, Sequence, Tuple, Union

NOTES = ".finished"
"""Folder of the notes about finished stages."""
LINES_OF_A_FAILURE = 20
SILENCE = 20.0
"""Seconds without output after which a command is said to be still running."""
RULE = "─"


class StageFailedError(Exception):
    """A stage's command ended with an error. The message says which and how."""


@dataclass
class Stage:
    """One step of the demo.

    Attributes:
        name: of its note in FOLDER/.finished.
        heading: what it does.
        commands: the commands, or a function that makes them when its turn comes, from what earlier stages made.
        product: a pattern below FOLDER; a finished stage is done again when nothing matches it any more.
        settings: what it depends on beside its commands and the stages before it.
    """

    name: str
    heading: str
    commands: Union[List[List[str]], Callable[[], List[List[str]]]]
    product: str
    settings: str = ""

    @property
    def key(self) -> str:
        """What has to be the same for a finished stage to count as finished."""
        known = [] if callable(self.commands) else [shlex.join(command) for command in self.commands]
        return "\n".join([*known, self.settings])


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
    """
    durations: List[Tuple[str, Optional[float]]] = []
    stale = force
    for number, stage in enumerate(stages, start=1):
        heading = f"[{number}/{len(stages)}] {stage.heading}"
        note = folder / NOTES / stage.name
        is_made = note.is_file() and note.read_text() == stage.key and any(folder.glob(stage.product))
        stale = stale or not is_made
        if not stale:
            print(f"{heading}: done before", flush=True)
            durations.append((stage.heading, None))
            continue
        print(f"\n{heading}", flush=True)
        note.unlink(missing_ok=True)
        start = time.monotonic()
        for command in stage.commands() if callable(stage.commands) else stage.commands:
            run_command(command, stage.heading)
        seconds = time.monotonic() - start
        if not any(folder.glob(stage.product)):
            raise StageFailedError(f"{stage.heading}: it ended without {folder / stage.product}.")
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_text(stage.key)
        durations.append((stage.heading, seconds))
        print(f"      done in {clock(seconds)}", flush=True)
    return durations


def run_command(command: List[str], heading: str) -> None:
    """Runs a command, shows it, and passes on what it prints, with the time since it started before each line.

    Ctrl-C reaches the command too; it is given the time to save what it has.

    Raises:
        StageFailedError: it can't be started or its exit status isn't 0; the message ends with its last lines.
    """
    print(f"      $ {shlex.join(command)}", flush=True)
    start, last = time.monotonic(), deque(maxlen=LINES_OF_A_FAILURE)
    try:
        process = subprocess.Popen(
            [program_path(command[0]), *command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONWARNINGS": "ignore"},
            encoding="utf-8",
            errors="replace",
        )
    except OSError as error:
        raise StageFailedError(f"{heading}: {command[0]} can't be started ({error.strerror}).") from error
    assert process.stdout is not None

    def show(text: str) -> None:
        print(f"{clock(time.monotonic() - start)} {text}", flush=True)

    printed = read_lines(process.stdout)
    with process:
        try:
            for line in without_config(lines_of(printed, show)):
                last.append(line)
                show(line)
        except KeyboardInterrupt:
            for line in without_config(lines_of(printed, show)):
                show(line)
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
    """A program of the environment that this script runs in, else the one on PATH."""
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


def lines_of(lines: "queue.Queue[Optional[str]]", show: Callable[[str], None]) -> Iterator[str]:
    """The queue's lines as they come; while none comes, `show` is told now and then that the command still runs."""
    while True:
        try:
            line = lines.get(timeout=SILENCE)
        except queue.Empty:
            show("still running …")
            continue
        if line is None:
            return
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

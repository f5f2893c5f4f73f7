"""Commands in processes of their own, to which a real SIGINT may be sent at a chosen moment.

They are forked from a server that has imported everything once (see `hard.trial`), and wait at the moment until the
signal comes.
"""

import atexit
import importlib
import os
import resource
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, List, Optional

from hard import trial

SECONDS = 120.0
"""After which a process that hasn't come to the moment, or to its end, is a failure."""
ENTRYPOINTS = {
    "ns-train": "nerfstudio.scripts.train:entrypoint",
    "ns-render": "nerfstudio.scripts.render:entrypoint",
    "ns-eval": "nerfstudio.scripts.eval:entrypoint",
    "ns-export": "nerfstudio.scripts.exporter:entrypoint",
    "ns-viewer": "nerfstudio.scripts.viewer.run_viewer:entrypoint",
    "sparsestyle": "sparsestyle_ns.cli:main",
}


@dataclass
class Ending:
    """How a command ended."""

    status: int
    printed: str

    def assert_told(self, sentence: str = "Stopped by Ctrl-C.") -> None:
        """After Ctrl-C it ended with status 130, no traceback, and this sentence on a line of its own."""
        assert self.status == 130, f"status {self.status}\n{self.printed[-3000:]}"
        for word in ("Traceback", "Exception ignored", "KeyboardInterrupt"):
            assert word not in self.printed, self.printed[-3000:]
        lines = [line.strip() for line in self.printed.splitlines()]
        assert any(line.startswith(sentence) for line in lines), self.printed[-3000:]


def interrupt(command: List[str], moment: str, folder: Path, presses: int = 1, call: int = 1) -> Ending:
    """Runs a command and presses Ctrl-C when it calls a function for the `call`-th time.

    Args:
        command: as typed, the program first.
        moment: the function, as `module:name` or `module:class.name`.
        folder: for what is printed.
        presses: how often, a tenth of a second apart.
    """
    folder.mkdir(parents=True, exist_ok=True)
    here, log = folder / "here", folder / "log.txt"
    process = trial.start(_run, log, [*map(str, command)], moment, here, call)
    try:
        _wait(lambda: here.exists() or not process.is_alive())
        assert here.exists(), f"{moment} was never called\n{log.read_text()[-3000:]}"
        for _ in range(presses):
            with suppress(ProcessLookupError):  # it may end before the next press
                os.kill(process.pid, signal.SIGINT)
            time.sleep(0.1)
        process.join(SECONDS)
        assert process.exitcode is not None, log.read_text()[-3000:]
    finally:
        process.kill()
        process.join()
    return Ending(process.exitcode, log.read_text())


def finish(command: List[str], folder: Path, room: Optional[int] = None) -> Ending:
    """Runs a command to its own end; with `room`, where no file can be of more bytes, as on a disk that is full."""
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "log.txt"
    process = trial.start(_run, log, [*map(str, command)], None, None, 0, room)
    try:
        process.join(SECONDS)
        assert process.exitcode is not None, log.read_text()[-3000:]
    finally:
        process.kill()
        process.join()
    return Ending(process.exitcode, log.read_text())


def _wait(condition: Any) -> None:
    end = time.monotonic() + SECONDS
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)


def _run(
    command: List[str], moment: Optional[str], here: Optional[Path], call: int, room: Optional[int] = None
) -> None:
    """What the process does: the command, as its console script would."""
    from sparsestyle_ns.utils.interrupts import guard_nerfstudio

    signal.signal(signal.SIGINT, signal.default_int_handler)  # the server ignores it
    sys.argv = command
    if room is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    module, name = ENTRYPOINTS[command[0]].split(":")
    try:
        guard_nerfstudio(("coarse-fewshot", "hier-style"))  # as when the package is loaded
        if moment is not None:
            _linger_at(moment, here, call)
        getattr(importlib.import_module(module), name)()
    finally:
        atexit._run_exitfuncs()  # which multiprocessing leaves out


def _linger_at(moment: str, here: Path, call: int) -> None:
    module, name = moment.split(":")
    owner: Any = importlib.import_module(module)
    *classes, last = name.split(".")
    for each in classes:
        owner = getattr(owner, each)
    original, calls = getattr(owner, last), []

    def lingering(*arguments: Any, **settings: Any) -> Any:
        calls.append(None)
        if len(calls) == call:
            here.touch()
            for _ in range(50):
                time.sleep(0.02)
        return original(*arguments, **settings)

    setattr(owner, last, lingering)

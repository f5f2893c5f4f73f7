"""Ctrl-C in a command: one sentence on stderr and exit status 130, wherever it comes; what was half made goes away.

`sparsestyle` is guarded from its first line. nerfstudio's commands are guarded from when they load this package: they
swallow a `KeyboardInterrupt`, print its traceback, and end with status 0. Python code that calls this package is left
alone, and gets `KeyboardInterrupt` as ever.
"""

import atexit
import os
import re
import signal
import sys
import threading
import time
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, Callable, Iterator, List, NoReturn, Optional, Tuple

STATUS = 130
"""Exit status after Ctrl-C, as shells have it: 128 and the signal's number."""
SENTENCE = "Stopped by Ctrl-C."
SECONDS_OF_GRACE = 5.0
"""After Ctrl-C what is half made is taken away; to press it again ends the process at once only after so long."""
SECONDS_UNTIL_AGAIN = 0.1
"""After which a press that was lost is made again: what lost it has come to its end by then."""
SECONDS_UNTIL_MINDED = 1.0
"""After which a press that has ended nothing is made again."""
VIEWER_MODULE = "nerfstudio.scripts.viewer.run_viewer"
"""Whose main thread sleeps until Ctrl-C."""
NS_COMMANDS = {"train": "train", "render": "render", "eval": "eval", "exporter": "export", "run_viewer": "viewer"}
"""nerfstudio's modules of commands, and the commands' names behind `ns-`."""

_pressed_at: Optional[float] = None
_is_said = False
_leftovers: List[Callable[[], object]] = []


class StoppedByCtrlC(SystemExit):
    """The user has pressed Ctrl-C, and the process is on its way to its end, with status 130."""

    def __init__(self) -> None:
        super().__init__(STATUS)


PRESSES = (KeyboardInterrupt, StoppedByCtrlC)
"""What Ctrl-C raises, without and with the guard."""


def stop(sentence: str) -> NoReturn:
    """Ends the process after Ctrl-C with a sentence of its own."""
    global _is_said
    _is_said = False
    _say(sentence)
    raise StoppedByCtrlC from None


def end_on_ctrl_c() -> None:
    """Guards this process, a command, until its end; nothing where somebody else handles Ctrl-C, or ignores it."""
    is_free = threading.current_thread() is threading.main_thread()
    if is_free and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _on_press)
        sys.unraisablehook = partial(_on_unraisable, sys.unraisablehook)
        atexit.register(lambda: None if _pressed_at is None else _say(SENTENCE))  # once all has come to its end


def mind_swallowed_presses() -> None:
    """Has Ctrl-C pressed again where the C code of a library has swallowed it, and the viewer waits for ever.

    The thread that looks after it is there before, as a signal's handler that starts one may wait for itself.
    """

    def look() -> None:
        while True:
            time.sleep(SECONDS_UNTIL_MINDED)
            frame = sys._current_frames().get(threading.main_thread().ident)
            waits = frame is not None and frame.f_globals.get("__name__") == VIEWER_MODULE
            if waits and _pressed_at is not None and time.monotonic() - _pressed_at > SECONDS_UNTIL_MINDED:
                _press_again()

    threading.Thread(target=look, name="Ctrl-C", daemon=True).start()


@contextmanager
def ended_by_ctrl_c() -> Iterator[None]:
    """Ctrl-C within it ends the process as in one that is guarded, also where none is, as where Python calls it."""
    try:
        yield
    except KeyboardInterrupt:
        stop(SENTENCE)


@contextmanager
def ending_on(*signals: signal.Signals) -> Iterator[None]:
    """Signals that would end this process at once end it so that its command ends, too."""
    before = {number: signal.signal(number, lambda number, _: sys.exit(128 + number)) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def stop_if_pressed() -> None:
    """Ends the process if Ctrl-C was pressed before, whatever went wrong after that."""
    if _pressed_at is not None:
        raise StoppedByCtrlC


def take_away_at_end(leftover: Callable[[], object]) -> None:
    """Calls a function at the end of the process, also where a second Ctrl-C ends it at once."""
    _leftovers.append(leftover)
    atexit.register(leftover)


def guard_nerfstudio(methods: Tuple[str, ...]) -> None:
    """Guards this process if it is a command of nerfstudio's on a method, or a run, whose name starts with these."""
    command = ns_command()
    if command is not None:
        _refuse_missing_run(methods)
    is_run = command is not None and _run_is_of(methods)
    if command == "export" and is_run:
        _mind_output_dir()
    is_asked_for = command == "train" and any(word.startswith(methods) for word in sys.argv[1:])
    if is_asked_for or is_run:
        end_on_ctrl_c()
        if command == "viewer":
            mind_swallowed_presses()


def _refuse_missing_run(methods: Tuple[str, ...]) -> None:
    """Ends the process with a sentence where --load-config names no file, but what would be a run of such a method."""
    path = Path(ns_option("load-config") or "").expanduser()
    if path.is_file() or not any(part.startswith(methods) for part in path.absolute().parts):
        return
    if (path / "config.yml").is_file():
        raise SystemExit(f"Error: --load-config {path} is a folder; give {path / 'config.yml'}.")
    raise SystemExit(f"Error: There is no run's config at --load-config {path}; give a run's config.yml.")


def _mind_output_dir() -> None:
    """Sees to it that ns-export leaves no empty folders: it makes its own before anything else, or fails to."""
    path = Path(ns_option("output-dir") or "")
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    around = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not around.is_dir():
        raise SystemExit(f"Error: --output-dir {path} can't be made, as {around} is no folder; name another place.")

    def take_away() -> None:
        for folder in missing:
            with suppress(OSError):  # it isn't empty
                folder.rmdir()

    take_away_at_end(take_away)


def ns_command() -> Optional[str]:
    """Which command of nerfstudio's this process is, such as train of ns-train; None where it is none."""
    name = Path(sys.argv[0]).stem
    if name.startswith("ns-"):
        return name.removeprefix("ns-")
    if name == "-c":  # a script of one line
        found = [each for each in NS_COMMANDS if _is_loaded(each)]
        return NS_COMMANDS[found[0]] if len(found) == 1 else None
    return NS_COMMANDS.get(name) if "nerfstudio" in Path(sys.argv[0]).parts else None


def _is_loaded(module: str) -> bool:
    return any(name.startswith("nerfstudio.scripts.") and name.endswith("." + module) for name in sys.modules)


def ns_option(name: str, default: Optional[str] = None) -> Optional[str]:
    """What this process's command line says of a flag, given without its dashes; the last, where it does so twice."""
    found, words = default, sys.argv[1:]
    for word, following in zip(words, [*words[1:], None], strict=False):
        flag, is_joined, value = word.partition("=")
        if flag.startswith("--") and flag[2:].replace("_", "-") == name:
            found = value if is_joined else following
    return found


def _run_is_of(methods: Tuple[str, ...]) -> bool:
    """Whether --load-config names a run of such a method."""
    config = ns_option("load-config")
    text = ""
    with suppress(OSError):
        text = "" if config is None else Path(config).read_text(encoding="utf-8", errors="replace")
    found = re.search(r"^method_name: *(\S+)", text, flags=re.MULTILINE)
    return found is not None and found[1].startswith(methods)


def _on_press(number: int, frame: Optional[FrameType]) -> None:
    global _pressed_at
    if _pressed_at is None:
        _pressed_at = time.monotonic()
        raise StoppedByCtrlC
    if time.monotonic() - _pressed_at > SECONDS_OF_GRACE:
        for leftover in _leftovers:
            with suppress(Exception):
                leftover()
        _say(SENTENCE)
        os._exit(STATUS)


def _on_unraisable(before: Callable[[Any], None], lost: Any) -> None:
    """A press while Python clears something away, or while C calls it back, is lost there: it is made again."""
    if not issubclass(lost.exc_type, StoppedByCtrlC):
        return before(lost)
    again = threading.Timer(SECONDS_UNTIL_AGAIN, _press_again)
    again.daemon = True
    again.start()


def _press_again() -> None:
    global _pressed_at
    _pressed_at = None
    signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)


def _say(sentence: str) -> None:
    global _is_said
    if not _is_said:
        _is_said = True
        with suppress(OSError, ValueError):  # stderr may be closed by now
            print(sentence, file=sys.stderr, flush=True)

"""How the scripts in this folder talk to the person at the keyboard: options, errors of one sentence, a last line."""

import math
import shlex
import sys
from pathlib import Path
from typing import Callable, Optional, Sequence, TypeVar

import tyro

Options = TypeVar("Options")


class ScriptError(Exception):
    """Something could not be made. The message is one sentence: what went wrong, where, and what to do."""


def parse(options: type[Options], description: str, arguments: Optional[Sequence[str]]) -> Options:
    """Fills a dataclass from the command line; its fields' docstrings are the help.

    Args:
        options: The dataclass. A ValueError from its `__post_init__` is shown and ends the process with status 2.
        description: What the help begins with.
        arguments: None for the process's own.
    """
    return tyro.cli(options, args=arguments, description=description, config=(tyro.conf.FlagCreatePairsOff,))


def check_ranges(options: object, **ranges: tuple[float, float]) -> None:
    """Checks that the named options are from `least` to `most`, or None.

    Raises:
        ValueError: One of them is not; the message names its flag.
    """
    for name, (least, most) in ranges.items():
        value = getattr(options, name)
        if value is not None and not least <= value <= most:
            limits = f"at least {least}" if most == math.inf else f"between {least} and {most}"
            raise ValueError(f"--{name.replace('_', '-')} is {value}, but has to be {limits}")


def exit_status(work: Callable[[], None]) -> int:
    """Runs a script's work, which makes all of something or nothing.

    Returns 0, 1 after saying why it failed, or 130 after Ctrl-C.
    """
    try:
        work()
    except ScriptError as error:
        print(f"Error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Error: Interrupted; nothing was changed.", file=sys.stderr)
        return 130
    return 0


def print_made(made: Path, next_command: Sequence[object]) -> None:
    """Prints a script's last line: what it made, and what to type next."""
    print(f"Made {made} – next: {shlex.join(map(str, next_command))}")

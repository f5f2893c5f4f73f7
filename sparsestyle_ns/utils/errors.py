"""How the package speaks to the person at the keyboard when their input cannot be used."""

import functools
from pathlib import Path
from typing import Callable, Optional, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class InputError(ValueError):
    """Something the user gave cannot be used. The message is one sentence: what is wrong, where, and what to do.

    Attributes:
        fault: the sentence without `advice`, which is given where it names flags that not all commands have.
    """

    def __init__(self, fault: str, advice: Optional[str] = None) -> None:
        super().__init__(fault if advice is None else f"{fault}; {advice}." if advice else f"{fault}.")
        self.fault, self.advice = fault.removesuffix("."), advice


class CommandOptions:
    """The options of a `sparsestyle` command, a dataclass whose docstrings are the command's help."""

    def expand_paths(self) -> None:
        """Replaces ~ in paths by the home folder, which a shell does only where it begins a word."""
        for name, value in vars(self).items():
            if isinstance(value, Path):
                setattr(self, name, value.expanduser())
            if isinstance(value, tuple):
                setattr(self, name, tuple(part.expanduser() if isinstance(part, Path) else part for part in value))

    def check(self) -> None:
        """Raises an InputError for what can't be used, before torch is loaded, which takes seconds."""


def exit_on_input_error(function: Callable[P, R]) -> Callable[P, R]:
    """Has `function`, a boundary to the command line, end the process on an `InputError`: its message, and status 1."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except InputError as error:
            raise SystemExit(f"Error: {error}") from error

    return wrapper

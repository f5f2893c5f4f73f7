"""How the package speaks to the person at the keyboard when their input cannot be used."""

import functools
from typing import Callable, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class InputError(ValueError):
    """Something the user gave cannot be used. The message is one sentence: what is wrong, where, and what to do.

    Attributes:
        fault: the sentence without `advice`, which is kept apart where it names flags that not all commands have.
    """

    def __init__(self, fault: str, advice: str = "") -> None:
        super().__init__(f"{fault}: {advice}." if advice else fault)
        self.fault = fault.removesuffix(".")


class CommandOptions:
    """The options of a `sparsestyle` command, a dataclass whose docstrings are the command's help."""

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

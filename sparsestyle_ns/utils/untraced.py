"""Work that nerfstudio's viewer must not break off in the middle."""

import functools
import sys
from typing import Callable, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def untraced(function: Callable[P, R]) -> Callable[P, R]:
    """Has `function` run without the thread's trace function, which is back in place afterwards.

    The viewer breaks a picture off by an exception that its trace function raises between any two lines of Python.
    Inside of a lock's own code, such as that of numba's compiler, that would leave the lock taken for good.
    """

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        trace = sys.gettrace()
        sys.settrace(None)
        try:
            return function(*args, **kwargs)
        finally:
            sys.settrace(trace)

    return wrapper

"""Inner loops that torch has no operator for, compiled by numba for the CPU.

Numba's own thread pools can't be entered from two threads at once, as a viewer does: work is shared out here.
"""

import contextlib
import functools
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Callable, ParamSpec, Sequence, Set, Tuple, TypeVar

import numba
import torch

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[..., None]) -> Callable[..., None]:
    """Compiles a function of arrays and numbers, on its first call, to run without the GIL; nothing checks bounds."""
    options = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
    with contextlib.suppress(OSError):
        _forget_stale(Path(function.__code__.co_filename), function.__name__)
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor a cache folder can be written to
        return numba.njit(**options)(function)


def _forget_stale(source: Path, name: str) -> None:
    """Removes the index of what was compiled of a kernel before its file, or one that has parts of it, changed.

    numba looks at the kernel's own file alone, and only after it has read an index, which a renamed class makes
    unreadable.
    """
    changed = max(each.stat().st_mtime for each in {source, *_files_of_parts})
    for index in (source.parent / "__pycache__").glob(f"{source.stem}.{name}-*.nbi"):
        if index.stat().st_mtime < changed:
            index.unlink(missing_ok=True)


_files_of_parts: Set[Path] = set()
"""Those that kernels may be compiled from, beside their own: a module's parts are there before its kernels."""


def inlined(function: Callable[..., R]) -> Callable[..., R]:
    """Compiles a part of a kernel into whatever calls it: a call would hand over each array as a handful of numbers."""
    _files_of_parts.add(Path(function.__code__.co_filename))
    return numba.njit(nogil=True, error_model="numpy", fastmath={"contract"}, forceinline=True)(function)


def run_on_threads(function: Callable[..., None], parts: Sequence[Tuple]) -> None:
    """Calls `function(*part)` for each part, on as many threads as torch uses; an error in one is raised here."""
    threads = min(torch.get_num_threads(), len(parts))
    if threads <= 1:
        for part in parts:
            function(*part)
        return
    with ThreadPoolExecutor(threads) as pool:
        results = []
        for part in parts:
            try:
                results.append(pool.submit(function, *part))
            except RuntimeError:  # Python's end has begun, at which no pool takes work any more
                function(*part)
        for result in results:
            result.result()


def even_parts(length: int, count: int) -> Sequence[Tuple[int, int]]:
    """(start, end) of at most `count` runs of nearly the same length that together cover `length`; none is empty."""
    size = max(1, -(-length // max(count, 1)))
    return [(start, min(start + size, length)) for start in range(0, length, size)]


def untraced(function: Callable[P, R]) -> Callable[P, R]:
    """Has `function` run without the thread's trace function, by which the viewer breaks a picture off.

    Its exception, inside of a lock's own code such as that of numba's compiler, would leave the lock taken for good.
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

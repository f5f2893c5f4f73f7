"""A folder that is either all there or not at all."""

import contextlib
import os
import tempfile
from pathlib import Path
from typing import Iterator

from _command_line import ScriptError


@contextlib.contextmanager
def new_folder(target: Path, force: bool) -> Iterator[Path]:
    """An empty folder to fill, which becomes `target` when the context ends without an exception.

    It stands in a temporary folder beside `target`; other files there are gone when the context ends.

    Args:
        target: Folders on the way to it are made.
        force: Whether to replace a `target` that is there already.

    Raises:
        ScriptError: There is a `target` already, or something cannot be written; what was there is as before.
    """
    if target.exists() and not force:
        raise ScriptError(f"{target} exists already; add --force to replace it, or choose another OUTPUT.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=target.parent) as temporary:
            folder = Path(temporary) / "new"
            folder.mkdir()
            yield folder
            _put_in_place(folder, target, Path(temporary) / "replaced")
    except OSError as error:
        raise ScriptError(
            f"Cannot write to {target.parent}: {error.strerror or error}; choose another OUTPUT."
        ) from error


def _put_in_place(folder: Path, target: Path, replaced: Path) -> None:
    """Moves `folder` to `target`, whose former contents, if any, end up in `replaced`."""
    if target.exists():
        os.replace(target, replaced)
    try:
        os.replace(folder, target)
    except OSError:
        if replaced.exists():
            os.replace(replaced, target)
        raise

"""Files that are either the former ones or the new ones, whatever happens while they are written."""

import os
from pathlib import Path
from typing import BinaryIO, Callable, Optional


def write_whole(target: Path, write: Callable[[BinaryIO], None], temporary: Optional[Path] = None) -> None:
    """Writes a file that gets its name only when it is whole and on the disk.

    A process that is killed meanwhile leaves the former file as it was, and the unfinished one under another name,
    which the next call overwrites.

    Args:
        target: the file to make or to replace.
        write: writes the content into an open file.
        temporary: where the unfinished file stands, on the same disk; None: beside `target`, as NAME.unfinished.

    Raises:
        OSError: the file can't be written; the former one is still there.
    """
    unfinished = temporary or target.with_name(target.name + ".unfinished")
    with open(unfinished, "wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(unfinished, target)
    folder = os.open(target.parent, os.O_RDONLY)  # the new name is on the disk once its folder is
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_text_whole(target: Path, text: str) -> None:
    """Writes a UTF-8 text file with `write_whole`."""
    write_whole(target, lambda file: file.write(text.encode("utf-8")))

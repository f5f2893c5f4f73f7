"""Files that are either the former ones or the new ones, whatever happens while they are written."""

import os
from pathlib import Path
from typing import BinaryIO, Callable, Optional, Union


def write_whole(
    target: Path, content: Union[str, bytes, Callable[[BinaryIO], None]], temporary: Optional[Path] = None
) -> Path:
    """Writes a file that gets its name only when it is whole and on the disk; returns its path.

    A process that is killed meanwhile leaves the former file as it was, and the unfinished one under another name,
    which the next call overwrites. Folders on the way to it are made.

    Args:
        target: the file to make or to replace.
        content: text, which is written in UTF-8, bytes, or a function that writes them into an open file.
        temporary: where the unfinished file stands, on the same disk; None: beside `target`, as NAME.unfinished.

    Raises:
        OSError: the file can't be written; the former one is still there.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = temporary or target.with_name(target.name + ".unfinished")
    with open(unfinished, "wb") as file:
        if callable(content):
            content(file)
        else:
            file.write(content.encode("utf-8") if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(unfinished, target)
    folder = os.open(target.parent, os.O_RDONLY)  # the new name is on the disk once its folder is
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return target

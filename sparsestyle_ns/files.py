"""Writing files that are whole or not there."""

import os
from pathlib import Path
from typing import Union


def write_whole(path: Path, content: Union[str, bytes]) -> Path:
    """Writes a file, in UTF-8; it gets its name, and replaces what had it, only when it is whole.

    Folders on the way to it are made.

    Raises:
        OSError: it can't be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".unfinished")
    unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
    os.replace(unfinished, path)
    return path

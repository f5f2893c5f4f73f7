"""Names that people gave to files: fit for any disk, and told apart where two are the same."""

import re
from pathlib import PurePath
from typing import Iterable

LONGEST = 120
"""Bytes of a file's name, in UTF-8, at most: file systems take 255, encrypted ones 143, and unfinished files have some
more behind it."""
LONGEST_SUFFIX = 16
"""Characters of its suffix, at most."""


def free_name(name: str, taken: Iterable[str]) -> str:
    """A name that isn't taken: this, else with a number behind it."""
    taken, number = set(taken), 2
    found = name
    while found in taken:
        found, number = f"{name} {number}", number + 1
    return found


def safe_file_name(name: str, otherwise: str) -> str:
    """A file's name for any disk and shell: letters and digits of any script, spaces, and a few signs.

    `name` is as it was given, without folders; `otherwise` is taken where nothing of it is left.
    """
    # Neither hidden, nor "..", nor an end that some file systems drop.
    allowed = re.sub(r"[^\w .,()+-]", "_", name).strip(" .") or otherwise
    suffix = PurePath(allowed).suffix[:LONGEST_SUFFIX]
    room = LONGEST - len(suffix.encode())
    return PurePath(allowed).stem.encode()[:room].decode(errors="ignore") + suffix

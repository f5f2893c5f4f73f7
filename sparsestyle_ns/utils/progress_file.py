"""How a process tells the one that started it how far it is: a small JSON file, named by an environment variable.

The file holds a `ProgressReport` and is replaced as a whole, so that a reader finds one that is complete or none.
"""

import contextlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Optional, Tuple

PROGRESS_FILE = "SPARSESTYLE_PROGRESS_FILE"
"""Environment variable with the file's path; where it isn't set, nothing is written."""


@dataclass(frozen=True)
class Work:
    """One piece of work that is under way.

    Attributes:
        description: what is being done, a word or two.
        done, total: how much is done, of how much.
        unit: what is counted; `iterations` for training itself.
    """

    description: str
    done: float
    total: float
    unit: str


@dataclass(frozen=True)
class ProgressReport:
    """What a process says of its work.

    Attributes:
        works: what is under way, the outermost first.
        failure: why the process ended without finishing, one sentence; empty while all is well.
    """

    works: Tuple[Work, ...] = ()
    failure: str = ""

    def write(self, path: Path) -> None:
        """Replaces the file.

        Raises:
            OSError: it can't be written.
        """
        unfinished = path.with_name(path.name + ".unfinished")
        unfinished.write_text(json.dumps(asdict(self)), encoding="utf-8")
        os.replace(unfinished, path)  # without waiting for the disk: nobody reads it after a crash of the machine

    @classmethod
    def read(cls, path: Path) -> "ProgressReport":
        """The newest report; an empty one before the first."""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return cls()
        return cls(tuple(Work(**work) for work in content["works"]), content["failure"])


def progress_file() -> Optional[Path]:
    """The file that this process is to write; None where nobody asked for one."""
    name = os.environ.get(PROGRESS_FILE)
    return Path(name) if name else None


def report(content: ProgressReport) -> None:
    """Writes a report, where this process is to write one; work doesn't stop because it can't be written."""
    path = progress_file()
    if path is not None:
        with contextlib.suppress(OSError):
            content.write(path)

"""How a process tells the one that started it how far it is: a small JSON file, named by an environment variable.

The file holds a `ProgressReport` and is replaced as a whole, so that a reader finds one that is complete or none.
"""

import contextlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Tuple

PROGRESS_FILE = "SPARSESTYLE_PROGRESS_FILE"
"""Environment variable with the file's path; where it isn't set, nothing is written."""


@dataclass(frozen=True)
class Work:
    """One piece of work that is under way; `unit` is what is counted, `iterations` for training itself."""

    description: str
    done: float
    total: float
    unit: str


@dataclass(frozen=True)
class ProgressReport:
    """What a process says of its work: what is under way, the outermost first."""

    works: Tuple[Work, ...] = ()
    failure: str = ""
    """Why the process ended without finishing, one sentence; empty while all is well."""

    def write(self, path: Path) -> None:
        """Replaces the file, or raises an `OSError`."""
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


def report(content: ProgressReport) -> None:
    """Writes a report, where this process is to write one; work doesn't stop because it can't be written."""
    if os.environ.get(PROGRESS_FILE):
        with contextlib.suppress(OSError):
            content.write(Path(os.environ[PROGRESS_FILE]))

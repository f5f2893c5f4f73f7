"""Runs on disk: finding the config of one."""

import re
from pathlib import Path

from sparsestyle_ns.utils.errors import InputError

COARSE_METHOD = "coarse-fewshot"
"""What the names of stage 1's methods start with."""
STYLE_METHOD = "hier-style"
"""What the names of stage 2's methods start with."""

REPORT_FILE = "evaluation.json"
"""What was measured of a run, in its folder."""


def find_config(run: Path, method: str = "") -> Path:
    """The config.yml of a run, given by its folder or by that file; reads no more than its method's name.

    Args:
        run: the folder or the file.
        method: what the name of the run's method starts with; empty for either method of this package.

    Raises:
        InputError: it isn't there, or is a run of another method.
    """
    path = run if run.name == "config.yml" else run / "config.yml"
    if not path.is_file():
        what = "There is no run at" if not run.exists() else "There is no config.yml in"
        example = f"outputs/fern/{method or STYLE_METHOD}/2026-01-31_120000"
        raise InputError(f"{what} {run}; name a run's folder, such as {example}.")
    try:
        name = re.search(r"^method_name: *(\S+)", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} can't be read; name the folder of a run that ns-train made.") from error
    if name is None:
        raise InputError(f"{path} is no config of a nerfstudio run; name the folder of a run that ns-train made.")
    if not name[1].startswith((method,) if method else (COARSE_METHOD, STYLE_METHOD)):
        raise InputError(
            f"{run} is a run of {name[1]}; name a run of {method or COARSE_METHOD + ' or ' + STYLE_METHOD}."
        )
    return path

"""Runs on disk: finding and reading the config of one. Without torch, so that commands say at once what is wrong."""

import contextlib
import fcntl
import os
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Dict, Sequence

import yaml

from sparsestyle_ns.utils.errors import InputError

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

COARSE_METHOD, STYLE_METHOD = "coarse-fewshot", "hier-style"
"""What the names of stage 1's methods start with, and those of stage 2's."""
REPORT_FILE = "evaluation.json"
"""What was measured of a run, in its folder."""


def find_config(run: Path, method: str = "") -> Path:
    """The config.yml of a run, given by its folder or by that file; reads no more than its method's name.

    InputError where it isn't there, or that name doesn't start with `method`; empty: either method of this package.
    """
    path = run if run.name == "config.yml" else run / "config.yml"
    if not path.is_file():
        what = "There is no run at" if not run.exists() else "There is no config.yml in"
        example = f"outputs/fern/{method or STYLE_METHOD}/2026-01-31_120000"
        raise InputError(f"{what} {run}; name a run's folder, such as {example}.")
    name = re.search(r"^method_name: *(\S+)", path.read_text(encoding="utf-8", errors="replace"), flags=re.MULTILINE)
    if name is None:
        raise InputError(f"{path} is no config of a nerfstudio run; name the folder of a run that ns-train made.")
    expected = (method,) if method else (COARSE_METHOD, STYLE_METHOD)
    if not name[1].startswith(expected):
        raise InputError(f"{run} is a run of {name[1]}; name a run of {' or '.join(expected)}.")
    return path


_held: Dict[Path, int] = {}


def hold_folder(folder: Path) -> None:
    """Makes a run's folder, and keeps it for this process until `release_folder`, or its end, however that comes.

    InputError where another process keeps it; OSError where it can't be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if folder.resolve() in _held:
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise InputError(
            f"Another ns-train is at work in {folder} right now; wait for its end, or name a new run with --timestamp."
        ) from error
    except OSError:  # the file system has no locks
        os.close(descriptor)
        return
    _held[folder.resolve()] = descriptor


def release_folder(folder: Path) -> None:
    """Lets other processes write into a run's folder again, if this one has kept it."""
    descriptor = _held.pop(folder.resolve(), None)
    if descriptor is not None:
        fcntl.flock(descriptor, fcntl.LOCK_UN)  # also where a process that was forked meanwhile has the file open
        os.close(descriptor)


def is_held(folder: Path) -> bool:
    """Whether another process keeps a run's folder; False where that can't be told."""
    if folder.resolve() in _held:
        return False
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass
    finally:
        os.close(descriptor)
    return False


def remove_empty_run(folder: Path, around: Sequence[Path]) -> None:
    """Removes a run's folder that has neither a checkpoint nor a picture, and folders around it that held it alone.

    What else a run has says only what it would have been.
    """
    if folder.is_dir() and not any(folder.glob("*/*.ckpt")) and not any(folder.glob("previews/*")):
        shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # of a folder that has something in it
            for outer in around:
                outer.rmdir()


def read_config(folder: Path) -> "TrainerConfig":
    """What is in the config.yml of a run's folder; InputError where it can't be read."""
    path = folder / "config.yml"
    try:
        config = yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.Loader)
        if not hasattr(config, "relative_model_dir"):
            raise ValueError("it holds no settings of ns-train")
        return config
    except Exception as error:  # yaml builds arbitrary objects, so anything can go wrong in it
        raise InputError(f"{path} can't be read ({error}); name the folder of a run that ns-train made.") from error

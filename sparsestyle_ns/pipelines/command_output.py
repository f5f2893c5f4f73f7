"""What `ns-render`, `ns-export` and `ns-eval` write: never over what is there, and all of it or nothing.

ns-render opens its film before the first frame and ends it in any case, so that one which was broken off looks like any
other; ns-export may have written only the first of several files; none of them looks at what is there. A command is
therefore run once more within itself, from where it has read the run's config.yml: there is seen what stops it, and
whether it comes to its end.
"""

import re
import signal
import sys
import traceback
from pathlib import Path
from typing import Any, List, Optional

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import all_or_nothing, check_writable, not_writable, numbered
from sparsestyle_ns.utils.interrupts import ending_on, ns_command, stop_if_pressed
from sparsestyle_ns.utils.ply import is_whole_ply

SCRIPTS = {"render": "What is rendered", "exporter": "What is exported", "eval": "The figures"}
"""nerfstudio's modules of commands that write something, and what that is."""
FILMS = (".mp4", ".m4v", ".mov", ".mkv")
"""Kinds of files that hold the films that nerfstudio writes."""
FILES = (*FILMS, ".json", ".ply", ".obj", ".mtl", ".png")
"""Kinds of files that its commands write, beside folders."""
TEXTURED_MESH = ("mesh.obj", "material_0.mtl", "material_0.png")
LONGEST_REASON = 200
"""Characters of another library's error that are quoted."""
_under_way: List[Any] = []


def running_command(script: str) -> Optional[Any]:
    """The command of one of nerfstudio's scripts, with its options, that is setting up a pipeline; else None."""
    frame = sys._getframe(1)
    while frame is not None:
        command = frame.f_locals.get("self")
        if frame.f_globals.get("__name__") == f"nerfstudio.scripts.{script}" and command is not None:
            return command
        frame = frame.f_back
    return None


def claim_output(command: Any, script: str) -> None:
    """Sees to it that a command writes where nothing is yet: under a new name, where none was given.

    InputError where something is at the place that was named, or nothing can be written there.
    """
    for option in ("output_path", "render_output_path", "output_dir"):
        if getattr(command, option, None) is not None:
            _claim(command, option, SCRIPTS[script])


def _claim(command: Any, option: str, what: str) -> None:
    flag, named = f"--{option.replace('_', '-')}", getattr(command, option)
    path = Path(named).expanduser()
    if _is_film(command):
        if path.suffix == "":
            path = path.with_suffix(".mp4")
        if path.suffix.lower() not in FILMS:
            raise InputError(f"--output-path {named} is no name of a film; take {path.with_suffix('.mp4')}.")
    setattr(command, option, path)
    number, taken = 1, _taken(command, option)
    while _taken(command, option):
        number += 1
        setattr(command, option, numbered(path, number))
    if number > 1 and named != getattr(type(command), option, None):
        which, other = f" ({taken.name})" if option == "output_dir" else "", getattr(command, option)
        raise InputError(f"Something is at {flag} {named} already{which}; take {other} or another place.")
    check_writable(targets(command, option)[0], what, flag)


def _is_film(command: Any) -> bool:
    return getattr(command, "output_format", "images") == "video"


def targets(command: Any, option: str = "output_path") -> List[Path]:
    """The files or the folders that a command fills for an option; those of a camera path may need a folder aside."""
    path = getattr(command, option)
    if option == "output_dir":
        return [path / name for name in exported_files(command)]
    if hasattr(command, "split"):
        folders, names = [path / split for split in command.split.split("+")], command.rendered_output_names
        return folders if names is None else [folder / name for folder in folders for name in names]
    if hasattr(command, "render_output_path"):
        return [path]
    aside = [path.parent / f"{path.stem}_temp"] if hasattr(command, "camera_path_filename") else []
    return [path if _is_film(command) else path.parent / path.stem, *aside]


def exported_files(command: Any) -> List[str]:
    """Names of the files that a command of ns-export writes."""
    kind = type(command).__name__
    names = {
        "ExportPointCloud": ["point_cloud.ply"],
        "ExportTSDFMesh": ["tsdf_mesh.ply"],
        "ExportPoissonMesh": ["poisson_mesh.ply"],
        "ExportCameraPoses": ["transforms_train.json", "transforms_eval.json"],
    }[kind]
    points = ["point_cloud.ply"] if getattr(command, "save_point_cloud", False) else []
    return [*names, *points, *(TEXTURED_MESH if getattr(command, "texture_method", None) == "nerf" else ())]


def _taken(command: Any, option: str) -> Optional[Path]:
    """The first place of a command's at which something is."""
    return next((path for path in targets(command, option) if _is_taken(path)), None)


def _is_taken(path: Path) -> bool:
    is_free_folder = path.suffix.lower() not in FILES and path.is_dir() and not any(path.iterdir())
    return path.exists() and not is_free_folder


def _refuse(command: Any, error: Exception) -> None:
    """Raises an InputError for an error that none of this package's own code has met: some option asks too much."""
    frames = traceback.extract_tb(error.__traceback__)
    if any(Path(__file__).parents[1] in Path(frame.filename).parents for frame in frames[1:]):
        return
    if "Surface level must be within" in str(error):
        raise InputError(
            "There is no surface in the box from --bounding-box-min to --bounding-box-max, as far as the photos see; "
            "place it where the scene is, or take more cells with --resolution."
        ) from error
    reason = " ".join(re.sub(r"\x1b\[[0-9;]*m", "", str(error)).split())[:LONGEST_REASON] or "no reason given"
    raise InputError(
        f"nerfstudio's {type(command).__name__} has failed ({type(error).__name__}: {reason}); leave out options that "
        "aren't needed, or give smaller numbers."
    ) from error


def run_whole(command: Any, script: str) -> None:
    """Runs a command that has just begun, the process's own, as a whole, and ends the process; else does nothing.

    An InputError says where something can't be written.
    """
    if ns_command() != {"exporter": "export"}.get(script, script) or _under_way:
        return
    _under_way.append(command)
    options = [name for name in ("output_path", "render_output_path", "output_dir") if getattr(command, name, None)]
    places, what = [path for option in options for path in targets(command, option)], SCRIPTS[script]
    first, flag = getattr(command, options[0]), f"--{options[0].replace('_', '-')}"
    with ending_on(signal.SIGTERM, signal.SIGHUP), all_or_nothing(places):
        try:
            command.main()
        except Exception as error:
            stop_if_pressed()  # in a terminal Ctrl-C ends ffmpeg, too, and so a film that is being written
            if isinstance(error, BrokenPipeError) or str(error).startswith("Error writing"):
                raise not_writable(first, what, "ffmpeg has ended", flag) from error
            if isinstance(error, OSError):
                raise not_writable(first, what, error.strerror, flag) from error
            if str(error).startswith("Error encountered while export"):  # PyMeshLab's
                raise not_writable(first, what, " ".join(str(error).split(": ")[-1].split()), flag) from error
            _refuse(command, error)
            raise
        # What writes PLY files for nerfstudio says nothing where it can't, or where the disk is full by then.
        for path in (each for each in places if each.suffix == ".ply"):
            if not path.exists() or not is_whole_ply(path):
                raise not_writable(path, what, "it is cut short" if path.exists() else "it isn't there", flag)
    raise SystemExit(0)

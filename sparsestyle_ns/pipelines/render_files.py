"""What `ns-render` writes: never over what is there, and all of it or nothing.

It opens its film before the first frame and ends it in any case, so that one which was broken off looks like any other.
A command is therefore run once more within itself, from where it has read the run's config.yml: there is seen what
stops it, and whether it comes to its end.
"""

import shutil
import signal
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Iterator, List

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import check_writable, not_writable
from sparsestyle_ns.utils.interrupts import ending_on, ns_command, stop_if_pressed, take_away_at_end

FILMS = (".mp4", ".m4v", ".mov", ".mkv")
"""Kinds of files that hold the films that nerfstudio writes."""
WHAT = "What is rendered"
_under_way: List[Any] = []


def claim_output(command: Any) -> None:
    """Sees to it that a command of ns-render writes where nothing is yet: under a new name, where none was given.

    InputError where something is at the place that was named, or nothing can be written there.
    """
    named = command.output_path
    path = command.output_path = Path(named).expanduser()
    if _is_film(command):
        if path.suffix == "":
            path = command.output_path = path.with_suffix(".mp4")
        if path.suffix.lower() not in FILMS:
            raise InputError(f"--output-path {named} is no name of a film; take {path.with_suffix('.mp4')}.")
    number = 1
    while any(map(_is_taken, targets(command))):
        number += 1
        command.output_path = path.with_name(f"{path.stem}-{number}{path.suffix}")
    if number > 1 and named != type(command).output_path:
        raise InputError(f"Something is at --output-path {named} already; take {command.output_path} or another place.")
    check_writable(targets(command)[0], WHAT)


def _is_film(command: Any) -> bool:
    return getattr(command, "output_format", "images") == "video"


def targets(command: Any) -> List[Path]:
    """The file or the folders that a command of ns-render fills; those of a camera path may need a folder aside."""
    path = command.output_path
    if hasattr(command, "split"):
        folders, names = [path / split for split in command.split.split("+")], command.rendered_output_names
        return folders if names is None else [folder / name for folder in folders for name in names]
    aside = [path.parent / f"{path.stem}_temp"] if hasattr(command, "camera_path_filename") else []
    return [path if _is_film(command) else path.parent / path.stem, *aside]


def _is_taken(path: Path) -> bool:
    is_free_folder = path.suffix.lower() not in FILMS and path.is_dir() and not any(path.iterdir())
    return path.exists() and not is_free_folder


def render_whole(command: Any) -> None:
    """Runs a command that has just begun, the process's own, as a whole, and ends the process; else does nothing.

    An InputError says where something can't be written.
    """
    if ns_command() != "render" or _under_way:
        return
    _under_way.append(command)
    output_path = command.output_path
    with ending_on(signal.SIGTERM, signal.SIGHUP), all_or_nothing(targets(command)):
        try:
            command.main()
        except (OSError, RuntimeError) as error:
            stop_if_pressed()  # in a terminal Ctrl-C ends ffmpeg, too, and so a film that is being written
            if isinstance(error, BrokenPipeError) or str(error).startswith("Error writing"):
                raise not_writable(output_path, WHAT, "ffmpeg has ended") from error
            if isinstance(error, OSError):
                raise not_writable(output_path, WHAT, error.strerror) from error
            raise
    raise SystemExit(0)


@contextmanager
def all_or_nothing(paths: List[Path]) -> Iterator[None]:
    """What is made at these paths, at which nothing is yet, goes away where the context doesn't come to its end."""
    folders = {part for path in paths for part in (path, *path.parents) if not part.exists()}
    unfinished = list(paths)

    def take_away() -> None:
        for path in unfinished:
            for part in path.iterdir() if path.is_dir() else [path]:
                shutil.rmtree(part) if part.is_dir() else part.unlink(missing_ok=True)
        for folder in sorted(folders, key=lambda folder: len(folder.parts), reverse=True) if unfinished else ():
            with suppress(OSError):  # never made, or somebody else has put something there
                folder.rmdir()

    take_away_at_end(take_away)
    try:
        yield
        unfinished.clear()
    finally:
        take_away()

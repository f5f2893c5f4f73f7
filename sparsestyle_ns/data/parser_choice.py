"""Which dataparser reads a scene, as far as its name or the scene's files tell."""

from pathlib import Path
from typing import Optional

from sparsestyle_ns.utils.errors import InputError

MARKERS = {
    "poses_bounds.npy": "llff-data",
    "transforms_train.json": "blender-data",
    "transforms.json": "nerfstudio-data",
}
"""What a scene's folder has in it, and which dataparser reads it."""


def marker_of(folder: Path) -> Optional[str]:
    """The file in a scene's folder that tells its dataparser (see `MARKERS`); None where there is none."""
    return next((marker for marker in MARKERS if (folder / marker).is_file()), None)


def advice(folder: Path, missing: str) -> str:
    """The end of a sentence that says that a file is missing in a scene's folder: which dataparser to name instead.

    Args:
        missing: the file that another dataparser looked for.

    Returns:
        Words that begin with a semicolon; none where the folder's files don't tell.
    """
    marker = marker_of(folder)
    if marker is None or marker == missing:
        return ""
    return f"; it has {marker}, which {MARKERS[marker]} reads: put {MARKERS[marker]} at the end of the command"


def check_parser(name: str) -> None:
    """Makes sure that there is a dataparser of a name.

    Raises:
        InputError: there isn't.
    """
    from nerfstudio.configs.dataparser_configs import all_dataparsers  # which loads this package's llff-data

    if name not in all_dataparsers:
        raise InputError(f"There is no dataparser {name}; name one of {', '.join(sorted(all_dataparsers))}.")

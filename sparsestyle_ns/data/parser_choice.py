"""Which dataparser reads a scene: as the command line says, or as the scene's files tell."""

from pathlib import Path
from typing import Optional, Sequence

import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig

from sparsestyle_ns.utils.errors import InputError

MARKERS = {
    "poses_bounds.npy": "llff-data",
    "transforms_train.json": "blender-data",
    "transforms.json": "nerfstudio-data",
}
"""Files that tell a scene's dataparser."""


def _marker_of(place: Path) -> Optional[str]:
    if place.is_file():  # which of dataparsers only nerfstudio's takes
        return place.name if MARKERS.get(place.name) == "nerfstudio-data" else None
    return next((marker for marker in MARKERS if (place / marker).is_file()), None)


def parser_name(folder: Path) -> Optional[str]:
    """The dataparser that a scene's files tell of; None where there is none."""
    marker = _marker_of(folder)
    return None if marker is None else MARKERS[marker]


def advice(folder: Path, missing: str) -> str:
    """What to do about a missing file: which dataparser to name instead, if there is one that reads the folder."""
    marker = _marker_of(folder)
    if marker in (None, missing):
        return ""
    return f"it has {marker}, which {MARKERS[marker]} reads: put {MARKERS[marker]} at the end of the command"


def parse_dataparser(words: Sequence[str], data: Path) -> DataParserConfig:
    """A dataparser's config from its name and options, as after ns-train; without them from what the folder holds.

    Args:
        words: such as `["colmap", "--colmap-path", "sparse/0"]`.

    Raises:
        InputError: there is no such dataparser or scene, or nothing tells which dataparser reads it.
    """
    # Imported here, as nerfstudio's table of dataparsers loads this package's llff-data, which needs `advice`.
    from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion, all_dataparsers

    if words and words[0] not in all_dataparsers:
        raise InputError(f"There is no dataparser {words[0]}; name one of {', '.join(sorted(all_dataparsers))}.")
    if not data.exists():
        raise InputError(f"There is no scene at --data {data}; name its folder.")
    if not words:
        marker = _marker_of(data)
        if marker is None and (data.is_file() or (data / "config.yml").is_file()):
            raise InputError(f"--data {data} is a {'file' if data.is_file() else 'run'}; name the folder of a scene.")
        if marker is None:
            unknown = f"{data} has none of {', '.join(MARKERS)}, so the dataparser isn't known"
            raise InputError(unknown, "name it last, such as colmap")
        words = [MARKERS[marker]]
    return tyro.cli(AnnotatedDataParserUnion, args=list(words), prog="sparsestyle")

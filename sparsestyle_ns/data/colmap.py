"""COLMAP models, read as nerfstudio's parser reads them but for two of its edges.

It asks on the terminal whether photos of more than 1,600 pixels may be reduced, and writes them beside the user's; here
the data manager reduces them in memory. And in a model of text files it takes names only up to their first space.
"""

import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Iterator, List, Optional

from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig

from sparsestyle_ns.utils.errors import InputError

SPACE = "\ue000"
"""Stands for a space in a name while nerfstudio reads it; no name has this character, which is nobody's."""
PLACES = ("sparse/0", "colmap/sparse/0", "sparse", "colmap/sparse", "0", "colmap", ".")
"""Where a scene's folder may have a model."""
NAME = 9
"""The place of the name in a line of images.txt."""


def read_colmap(parser: ColmapDataParser, split: str) -> DataparserOutputs:
    """One split of a COLMAP scene; InputError where it has no photos of the size that was asked for."""
    config = parser.config
    if config.downscale_factor is not None:
        _check_reduced(config)
    _check_model(config)
    with _without_spaces((config.data / config.colmap_path).absolute()) as model:  # nerfstudio puts `data` before it
        parser.config = replace(config, downscale_factor=config.downscale_factor or 1, colmap_path=model)
        try:
            outputs = parser.get_dataparser_outputs(split)
        finally:
            parser.config = config
    return replace(
        outputs,
        image_filenames=_with_spaces(outputs.image_filenames),
        mask_filenames=outputs.mask_filenames and _with_spaces(outputs.mask_filenames),
    )


def _check_model(config: ColmapDataParserConfig) -> None:
    if (config.data / config.colmap_path).is_dir():
        return
    places = (place for place in PLACES if any((config.data / place).glob("cameras.*")))
    place = next(places, None)
    raise InputError(
        f"There is no COLMAP model at {config.data / config.colmap_path}",
        "say where it is behind the word colmap, as by --colmap-path sparse/0"
        if place is None
        else f"there is one at {place}: add --colmap-path {place} behind the word colmap",
    )


def _check_reduced(config: ColmapDataParserConfig) -> None:
    folder = config.data / f"{config.images_path}_{config.downscale_factor}"
    if config.downscale_factor < 1 or (config.downscale_factor > 1 and not folder.is_dir()):
        raise InputError(
            f"There is no folder {folder} for --downscale-factor {config.downscale_factor}: leave that out, as photos "
            "are reduced to --max-image-side while they are read."
        )


@contextmanager
def _without_spaces(model: Path) -> Iterator[Path]:
    """A folder with the same model, with `SPACE` for spaces in names; the model itself where it needs none."""
    lines = _lines_of(model / "images.txt")
    changed = [line if name is None else _renamed(line, name) for line, name in zip(lines, _names(lines), strict=True)]
    if changed == lines or not (model / "cameras.txt").exists():  # by that file nerfstudio tells a model of text
        yield model
        return
    with tempfile.TemporaryDirectory(prefix="colmap-") as folder:
        for file in model.resolve().iterdir():
            if file.name != "images.txt":
                (Path(folder) / file.name).symlink_to(file)
        (Path(folder) / "images.txt").write_text("\n".join(changed) + "\n", encoding="utf-8")
        yield Path(folder)


def _lines_of(path: Path) -> List[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):  # another kind of model, or one of which nerfstudio says what is wrong
        return []


def _names(lines: List[str]) -> List[Optional[str]]:
    """The photo that each line names; None of those lines that hold its points, and of comments."""
    names: List[Optional[str]] = []
    is_points = False
    for line in lines:
        is_image = not is_points and line.strip() != "" and not line.strip().startswith("#")
        words = line.strip().split(maxsplit=NAME)
        names.append(words[NAME] if is_image and len(words) > NAME else None)
        is_points = is_image
    return names


def _renamed(line: str, name: str) -> str:
    return line.rstrip().removesuffix(name) + name.replace(" ", SPACE)


def _with_spaces(paths: List[Path]) -> List[Path]:
    return [Path(str(path).replace(SPACE, " ")) for path in paths]

"""Fetches a synthetic scene in NeRF's Blender layout: `train/`, `val/`, `test/` and `transforms_*.json`.

    python data_scripts/fetch_blender.py data/blender                     # lego, from the NeRF authors' example data
    python data_scripts/fetch_blender.py data/blender --half-resolution   # 400 x 400, as few-shot methods use it
    python data_scripts/fetch_blender.py data/blender --scene ship --url file:///downloads/nerf_synthetic.zip

The example data holds only lego. With `--url`, any zip archive that holds a folder of the scene's name with a
`transforms_train.json` in it will do.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Optional, Sequence

import imageio.v2 as imageio
import numpy as np
from _command_line import ScriptError, parse
from _download import FetchOptions, run


@dataclass(frozen=True)
class BlenderOptions(FetchOptions):
    """The options of this script."""

    scene: str = "lego"
    """Name of the scene's folder, in the archive as in OUTPUT."""
    half_resolution: bool = False
    """Halve the pictures: 800 x 800 -> 400 x 400."""


def halve_image(image: np.ndarray) -> np.ndarray:
    """Halves a picture by averaging squares of 2 x 2 pixels.

    Colours are weighted with alpha, so that halving and laying the picture over a background can be swapped.

    Args:
        image: (2 H, 2 W, 3) or, with alpha not multiplied in, (2 H, 2 W, 4), uint8.

    Returns:
        (H, W, 3) or (H, W, 4), uint8; colours are 0 where alpha is.

    Raises:
        ValueError: If the picture has other channels, more than 8 bits, or an odd number of rows or columns.
    """
    if (
        image.dtype != np.uint8
        or image.ndim != 3
        or image.shape[2] not in (3, 4)
        or image.shape[0] % 2
        or image.shape[1] % 2
    ):
        raise ValueError(f"{image.dtype} values of shape {image.shape}")
    height, width, channels = image.shape
    squares = image.astype(np.float64).reshape(height // 2, 2, width // 2, 2, channels)
    if channels == 3:
        return np.rint(squares.mean(axis=(1, 3))).astype(np.uint8)
    alpha = squares[..., 3:]
    weight = alpha.sum(axis=(1, 3))
    colours = (squares[..., :3] * alpha).sum(axis=(1, 3)) / np.maximum(weight, 1)
    return np.rint(np.concatenate([colours, weight / 4], axis=-1)).astype(np.uint8)


def halve_scene(folder: Path) -> None:
    """Halves every PNG picture below `folder`, in place. The camera angles in the JSON files stay true.

    Raises:
        ScriptError: A picture cannot be read or halved.
    """
    for path in sorted(folder.rglob("*.png")):
        try:
            halved = halve_image(np.asarray(imageio.imread(path)))
        except (OSError, ValueError, SyntaxError) as error:
            name = path.relative_to(folder)
            raise ScriptError(f"Cannot halve {name} ({error}); leave out --half-resolution.") from error
        imageio.imwrite(path, halved)


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The command line; `arguments` default to the process's own. Returns the exit status."""
    options = parse(BlenderOptions, __doc__, arguments)
    return run(options, "transforms_train.json", "blender-data", halve_scene if options.half_resolution else None)


if __name__ == "__main__":
    sys.exit(main())

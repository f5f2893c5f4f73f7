"""Options of `sparsestyle effects` and `prepare`. Nothing heavy is imported here, so that help is there at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional, Tuple

import tyro

from sparsestyle_ns.utils.errors import CommandOptions


@dataclass
class EffectsOptions(CommandOptions):
    """Prints which effects a scene needs, and why, without training.

    Each effect has what was measured, the threshold it was compared with, and the reason.
    """

    data: Path
    """The scene's folder or file."""
    dataparser: Annotated[
        Tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[DATAPARSER [OPTION ...]]")
    ] = ()
    """What reads the scene, where its files don't tell: llff-data, blender-data, nerfstudio-data, colmap …; its options
    come after two dashes: -- colmap --colmap-path sparse/0."""
    json: bool = False
    """Print JSON: a list `effects` of name, on, measured, threshold, reason."""
    num_views: Optional[int] = None
    """How many photos to train on, as for ns-train."""
    view_ids: Optional[Tuple[int, ...]] = None
    """Which photos to train on, as for ns-train."""
    coarse_run: Optional[Path] = None
    """A coarse run of the scene, to measure the effects of stage 2; left out, they are assumed."""
    style_image: Optional[Path] = None
    """The painting, to compare its palette with the photos'; left out, it counts as another."""


@dataclass
class PrepareOptions(CommandOptions):
    """Makes a scene of three to eight photos, or of a video: of one size, and with camera poses.

    Poses are those in a poses_bounds.npy or transforms.json beside the photos; without such a file they are estimated
    from the photos alone, with the focal length that EXIF gives, if it does.

    Photos are turned upright as EXIF says. With poses from a file they stay as they are stored, because such poses are
    for the stored pixels, unless only the upright photo has the pose's shape.

    Prints what is wrong with the photos: too few features or matches, too little overlap, a camera that only turned, or
    that only moved along its line of sight; and which photo to take next.
    """

    photos: Annotated[Path, tyro.conf.Positional]
    """Folder of the photos: JPEG, PNG, WebP, TIFF, and HEIC where pillow-heif is installed; or a video."""
    output: Path
    """Folder to write the scene to."""
    poses: Literal["auto", "file", "estimate"] = "auto"
    """Where the camera poses are from: a poses_bounds.npy or transforms.json beside the photos (file), the photos alone
    (estimate), or the file if there is one, else the photos alone (auto)."""

"""Films of a stylised scene: one that is there already, a flight between its photos, or a turn about it."""

import tempfile
from pathlib import Path
from typing import Optional, Sequence

import imageio.v3 as iio
import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras

from sparsestyle_ns.core.camera_paths import is_forward_facing, showing_path
from sparsestyle_ns.gallery.layout import Film
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.page import Pixels
from sparsestyle_ns.utils.progress import track

FRAMES_PER_SECOND = 16
CONSTANT_RATE_FACTOR = "20"
"""x264's measure of quality: 18 can't be told from the original, 23 is its default."""


def read_film(path: Path) -> Film:
    """A film from an MP4 file; `InputError` if it can't be read or is no MP4."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"The video {path} can't be read ({error.strerror}).") from error
    if content[4:8] != b"ftyp":
        raise InputError(f"{path} is no MP4 video; give one that ns-render wrote.")
    return Film(content, "A flight through the stylised scene.")


@torch.no_grad()
def make_film(model: HierStyleModel, cameras: Cameras, frames: int, longest_side: int) -> Optional[Film]:
    """Films a scene along the path that its training views give; None where there is only one.

    Frames are baked renders, at most `longest_side` pixels a side: they are near to each other, so that most of each is
    there already.
    """
    if len(cameras) < 2:
        return None
    path = showing_path(cameras, frames)
    path.rescale_output_resolution(min(1.0, longest_side / int(max(path.width.max(), path.height.max()))))
    # H.264 keeps one colour for two by two pixels, so sides have to be even.
    path.width, path.height = path.width - path.width % 2, path.height - path.height % 2
    pictures = []
    with model.display.rendering("baked"):
        for index in track(range(frames), "Filming"):
            outputs = model.get_outputs_for_camera(path[index : index + 1].to(model.device))
            pictures.append(as_pixels(outputs["rgb"].cpu().numpy()))
    flies = is_forward_facing(cameras.camera_to_worlds.cpu().float())
    what = "A flight through the photos' viewpoints" if flies else "A turn about the scene"
    return Film(encode_mp4(pictures), f"{what}, in baked renders.")


def encode_mp4(pictures: Sequence[Pixels]) -> bytes:
    """Frames of one size, with even sides, as an H.264 film, which every browser shows."""
    options = ["-crf", CONSTANT_RATE_FACTOR, "-preset", "slow", "-movflags", "+faststart"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        settings = {"fps": FRAMES_PER_SECOND, "codec": "libx264", "macro_block_size": 2, "output_params": options}
        iio.imwrite(path, np.stack(pictures), plugin="FFMPEG", quality=None, **settings)
        return path.read_bytes()


def as_pixels(image: Float[np.ndarray, "H W 3"]) -> Pixels:
    """Colours in [0, 1] as bytes."""
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)

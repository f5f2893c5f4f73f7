"""A painting, in whatever form an artist saved it."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Union

import numpy as np
import torch
from jaxtyping import Float, Shaped
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import digest
from sparsestyle_ns.utils.pictures import decode, orientation_of
from sparsestyle_ns.utils.progress import say

SMALLEST_SIDE, THUMBNAIL_SIDE = 8, 200
"""Pixels: what each side of a painting must have, and the longer side of its thumbnail."""


@dataclass(frozen=True)
class Painting:
    """A painting, decoded once: all that Pillow reads, PNG of 16 bits without loss, transparent pixels laid over white.

    Colour profiles are not applied. `name` is its file's, without folders, and `data` what is in it.
    """

    name: str
    data: bytes
    pixels: Float[Tensor, "3 H W"]
    """RGB in [0, 1], float32, on the CPU, upright as its EXIF orientation says."""

    @property
    def digest(self) -> str:
        """By which the file is known again."""
        return digest(self.data)

    @classmethod
    def read(cls, path: Union[str, Path]) -> "Painting":
        """Reads a file; an `InputError` where it isn't an image of 8 pixels a side or more."""
        path = Path(path).expanduser()
        data = _read_bytes(path)
        return cls(path.name, data, _decode(data, path))

    @classmethod
    def received(cls, name: str, data: bytes) -> "Painting":
        """Takes what a browser sent over as the file `name`; raises as `read` does."""
        name = Path(name.replace("\\", "/")).name or "upload"
        return cls(name, data, _decode(data, name))

    def thumbnail(self) -> bytes:
        """A small JPEG."""
        picture = Image.fromarray((255 * self.pixels).round().byte().permute(1, 2, 0).numpy())
        picture.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
        file = io.BytesIO()
        picture.save(file, format="JPEG", quality=85)
        return file.getvalue()


def _read_bytes(path: Path) -> bytes:
    if path.is_dir():
        raise InputError(f"The style image {path} is a folder: give one image file in it.")
    if path.exists() and not path.is_file():  # a device may never end
        raise InputError(f"The style image {path} is no file: give a JPEG, PNG or WebP file.")
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"The style image {path} does not exist: check the path.") from error
    except OSError as error:
        raise InputError(f"The style image {path} cannot be opened ({error.strerror}): check the path.") from error


def _decode(data: bytes, name: Union[str, Path]) -> Float[Tensor, "3 H W"]:
    if not data:
        raise InputError(f"The style image {name} is an empty file: give an undamaged JPEG, PNG or WebP file.")
    try:
        with Image.open(io.BytesIO(data)) as image:
            # Pillow can say what is wrong with a damaged file; OpenCV only that there is no image.
            image.load()
            frames = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)  # a telephone's second one is small
            stored, orientation = decode(image, data), orientation_of(image)
    except UnidentifiedImageError as error:
        raise InputError(
            f"The style image {name} is in no known image format: give a JPEG, PNG or WebP file."
        ) from error
    # Decoders meet a damaged file with errors of many kinds: OSError, SyntaxError, struct.error, and others.
    except Exception as error:
        raise InputError(
            f"The style image {name} cannot be read as an image ({error}): give an undamaged JPEG, PNG or WebP file."
        ) from error
    pixels = _turn_upright(_to_rgb(stored), orientation)
    height, width = pixels.shape[:2]
    if min(height, width) < SMALLEST_SIDE:
        raise InputError(
            f"The style image {name} is {width} × {height} pixels: give one of at least {SMALLEST_SIDE} pixels a side."
        )
    if stored.shape[2] == 4:
        _look_at_opacity(stored[..., 3], name)
    if frames > 1:
        say(f"The style image {name} has {frames} frames; its first is the painting.")
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous().clamp(0, 1)


def _look_at_opacity(opacity: Shaped[np.ndarray, "H W"], name: Union[str, Path]) -> None:
    """Says that a painting is transparent in places; an `InputError` where it is so all over."""
    if opacity.max() == 0:
        raise InputError(f"The style image {name} is transparent all over: give one that shows something.")
    if opacity.min() < np.iinfo(opacity.dtype).max:
        say(f"The style image {name} is transparent in places, and laid over white.")


def _to_rgb(pixels: Shaped[np.ndarray, "H W channels"]) -> Float[np.ndarray, "H W 3"]:
    """Integers as colours in [0, 1], laid over white where they have an opacity."""
    pixels = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    color, alpha = pixels[..., :3], pixels[..., 3:]
    return color * alpha + (1 - alpha) if alpha.size else color


def _turn_upright(pixels: Float[np.ndarray, "H W 3"], orientation: int) -> Float[np.ndarray, "H W 3"]:
    """Undoes the camera's orientation: EXIF 5 to 8 swap rows and columns, then some flip either."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)

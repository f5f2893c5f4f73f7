"""A painting, in whatever form an artist saved it."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Union

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from PIL import ExifTags, Image, UnidentifiedImageError
from torch import Tensor

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import digest

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
            # Of 16 bits a channel in a PNG, whose header has the depth at byte 24, Pillow would keep 8.
            is_deep = data.startswith(b"\x89PNG\r\n\x1a\n") and data[24] == 16
            pixels = _to_rgb(_decode_deep_png(data) if is_deep else _decode_with_pillow(image))
            pixels = _turn_upright(pixels, image.getexif().get(ExifTags.Base.Orientation, 1))
    except UnidentifiedImageError as error:
        raise InputError(
            f"The style image {name} is in no known image format: give a JPEG, PNG or WebP file."
        ) from error
    # Decoders meet a damaged file with errors of many kinds: OSError, SyntaxError, struct.error, and others.
    except Exception as error:
        raise InputError(
            f"The style image {name} cannot be read as an image ({error}): give an undamaged JPEG, PNG or WebP file."
        ) from error
    height, width = pixels.shape[:2]
    if min(height, width) < SMALLEST_SIDE:
        raise InputError(
            f"The style image {name} is {width} × {height} pixels: give one of at least {SMALLEST_SIDE} pixels a side."
        )
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous().clamp(0, 1)


def _decode_deep_png(data: bytes) -> Shaped[np.ndarray, "H W channels"]:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("its 16-bit PNG data cannot be decoded")
    to_rgb = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
    return cv2.cvtColor(pixels, to_rgb[1 if pixels.ndim == 2 else pixels.shape[2]])


def _decode_with_pillow(image: Image.Image) -> Shaped[np.ndarray, "H W channels"]:
    if image.mode.startswith("I;16"):
        return np.repeat(np.asarray(image).astype(np.uint16)[..., None], 3, axis=2)
    if image.mode in ("I", "F"):
        raise ValueError(f"pixels of the kind {image.mode} have no fixed range")
    return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


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

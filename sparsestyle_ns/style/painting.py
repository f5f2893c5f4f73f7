"""Reading a style image, in whatever form an artist saved it."""

import io
from pathlib import Path
from typing import Optional, Union

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from PIL import ExifTags, Image, UnidentifiedImageError
from torch import Tensor

from sparsestyle_ns.utils.errors import InputError

SMALLEST_SIDE = 8
"""Pixels a side that the feature network needs: it halves an image twice before block 3."""


def load_style_image(path: Union[str, Path], max_side: Optional[int] = None) -> Float[Tensor, "3 H W"]:
    """Reads a picture as RGB in [0, 1], float32, on the CPU, upright as its EXIF orientation says.

    Everything Pillow reads is taken: JPEG (CMYK too), PNG (grey, palette, transparent, 16 bits without loss), WebP,
    TIFF and others; of an animation the first frame. Transparent pixels are laid over white. Colour profiles are not
    applied.

    Args:
        path: the image file.
        max_side: the longer side of the result in pixels, reached by averaging over areas; smaller images keep
            their size. None keeps every image's size.

    Raises:
        InputError: there is no such file, it cannot be read as an image, or it has, or would be reduced to, fewer
            than 8 pixels a side.
    """
    path = Path(path).expanduser()
    return decode_style_image(read_bytes(path), path, max_side)


def decode_style_image(data: bytes, name: Union[str, Path], max_side: Optional[int] = None) -> Float[Tensor, "3 H W"]:
    """`load_style_image` of a file's contents.

    Args:
        data: what is in the file.
        name: what to call it where something is wrong.
    """
    rgb = _decode_pixels(data, name)
    height, width = rgb.shape[:2]
    if min(height, width) < SMALLEST_SIDE:
        raise InputError(
            f"The style image {name} is {width} × {height} pixels: give one of at least {SMALLEST_SIDE} pixels a side."
        )
    if max_side is not None and max(height, width) > max_side:
        scale = max_side / max(height, width)
        size = (round(width * scale), round(height * scale))
        if min(size) < SMALLEST_SIDE:
            raise InputError(
                f"The style image {name}, {width} × {height} pixels, would be reduced to {size[0]} × {size[1]}: allow "
                f"a longer side than {max_side}, or crop it, so that {SMALLEST_SIDE} pixels a side remain."
            )
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(rgb).permute(2, 0, 1).contiguous().clamp(0, 1)


def _decode_pixels(data: bytes, name: Union[str, Path]) -> Float[np.ndarray, "H W 3"]:
    if not data:
        raise InputError(f"The style image {name} is an empty file: give an undamaged JPEG, PNG or WebP file.")
    try:
        with Image.open(io.BytesIO(data)) as image:
            # Pillow can say what is wrong with a damaged file; OpenCV only that there is no image.
            image.load()
            pixels = _decode_deep_png(data) if _is_deep_png(data) else _decode(image)
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    except UnidentifiedImageError as error:
        raise InputError(
            f"The style image {name} is in no known image format: give a JPEG, PNG or WebP file."
        ) from error
    # Decoders meet a damaged file with errors of many kinds: OSError, SyntaxError, struct.error, and others.
    except Exception as error:
        raise InputError(
            f"The style image {name} cannot be read as an image ({error}): give an undamaged JPEG, PNG or WebP file."
        ) from error
    return _turn_upright(_lay_over_white(pixels), orientation)


def read_bytes(path: Path) -> bytes:
    """What is in a style image's file.

    Raises:
        InputError: there is no such file, or it can't be opened.
    """
    if path.is_dir():
        raise InputError(f"The style image {path} is a folder: give one image file in it.")
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"The style image {path} does not exist: check the path.") from error
    except OSError as error:
        raise InputError(f"The style image {path} cannot be opened ({error.strerror}): check the path.") from error


def _is_deep_png(data: bytes) -> bool:
    """Whether this is a PNG of 16 bits a channel, of which Pillow would keep 8; the header has the depth at byte 24."""
    return data.startswith(b"\x89PNG\r\n\x1a\n") and data[24] == 16


def _decode_deep_png(data: bytes) -> Float[np.ndarray, "H W channels"]:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("its 16-bit PNG data cannot be decoded")
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    color = np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., 2::-1]
    return _to_unit_range(np.concatenate([color, pixels[..., 3:]], axis=2))


def _decode(image: Image.Image) -> Float[np.ndarray, "H W channels"]:
    if image.mode.startswith("I;16"):
        return _to_unit_range(np.repeat(np.asarray(image).astype(np.uint16)[..., None], 3, axis=2))
    if image.mode in ("I", "F"):
        raise ValueError(f"pixels of the kind {image.mode} have no fixed range")
    return _to_unit_range(np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB")))


def _to_unit_range(pixels: Shaped[np.ndarray, "H W channels"]) -> Float[np.ndarray, "H W channels"]:
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def _lay_over_white(pixels: Float[np.ndarray, "H W channels"]) -> Float[np.ndarray, "H W 3"]:
    if pixels.shape[2] == 3:
        return pixels
    color, alpha = pixels[..., :3], pixels[..., 3:]
    return color * alpha + (1 - alpha)


def _turn_upright(pixels: Float[np.ndarray, "H W 3"], orientation: int) -> Float[np.ndarray, "H W 3"]:
    """Undoes the camera's orientation: EXIF 5 to 8 swap rows and columns, then each of 2 to 8 flips what it says."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)

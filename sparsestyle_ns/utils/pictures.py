"""Pictures of every kind that Pillow reads, decoded with their bit depth, and masks: the one reader of both."""

import io

import cv2
import numpy as np
from jaxtyping import Bool, Shaped
from PIL import ExifTags, Image

DEEP_PNG = b"\x89PNG\r\n\x1a\n"
"""What a PNG begins with; its header has the bit depth at byte 24."""
NO_RANGE = ("I", "F")
"""Kinds of pixels that don't say which number is white."""
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""By EXIF's orientation, what brings a picture upright."""


class UnknownPixelsError(ValueError):
    """Pixels of a kind whose numbers have no known meaning; the message is what they are."""


def decode(image: Image.Image, data: bytes) -> Shaped[np.ndarray, "H W channels"]:
    """A picture as RGB, or RGBA where it has an opacity: uint16 where it has 16 bits a channel, else uint8.

    Args:
        image: opened and loaded; not turned by its EXIF orientation, except a TIFF, which Pillow turns itself.
        data: the file's bytes, from which `image` was opened.

    Raises:
        UnknownPixelsError: the pixels are of a kind whose range or colour space isn't known.
    """
    if data.startswith(DEEP_PNG) and data[24] == 16:  # of which Pillow would keep 8 bits
        return _decode_deep_png(data)
    if image.mode.startswith("I;16"):
        return np.repeat(_deep_grey(image)[..., None], 3, axis=2)
    if image.mode in NO_RANGE:
        raise UnknownPixelsError(f"pixels of the kind {image.mode}, which have no fixed range")
    if image.mode == "LAB":
        raise UnknownPixelsError(f"pixels of the kind {image.mode}, which aren't RGB")
    return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def _decode_deep_png(data: bytes) -> Shaped[np.ndarray, "H W channels"]:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("its 16-bit PNG data cannot be decoded")
    to_rgb = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
    return cv2.cvtColor(pixels, to_rgb[1 if pixels.ndim == 2 else pixels.shape[2]])


def _deep_grey(image: Image.Image) -> Shaped[np.ndarray, "H W"]:
    pixels = np.asarray(image).astype(np.uint16)
    is_negative = getattr(image, "tag_v2", {}).get(262) == 0  # a TIFF's WhiteIsZero, which Pillow heeds for 8 bits only
    return np.uint16(65535) - pixels if is_negative else pixels


def orientation_of(image: Image.Image) -> int:
    """EXIF's orientation, from 1 (upright) to 8; 1 where it says nothing that has a meaning."""
    found = image.getexif().get(ExifTags.Base.Orientation)
    return found if found in TURNS else 1


def to_8_bits(image: Image.Image, data: bytes) -> Image.Image:
    """A picture with 8 bits a channel, RGB, or RGBA where any pixel isn't opaque; arguments and errors of `decode`."""
    pixels = decode(image, data)
    if pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if pixels.shape[2] == 4 and pixels[..., 3].min() == 255:
        pixels = pixels[..., :3]
    return Image.fromarray(np.ascontiguousarray(pixels))


def read_mask(data: bytes) -> Bool[np.ndarray, "H W"]:
    """Which pixels a mask leaves in: those that aren't black or transparent, as nerfstudio has it.

    In a JPEG, which isn't black where it was, those of more than half brightness. Turned as it is stored.

    Raises:
        ValueError, OSError: it can't be read.
    """
    with Image.open(io.BytesIO(data)) as image:
        image.load()
        if image.mode in (*NO_RANGE, "LAB"):  # any number but 0 is white
            return np.asarray(image).reshape(image.height, image.width, -1)[..., 0] != 0
        pixels = decode(image, data)
        threshold = np.iinfo(pixels.dtype).max // 2 if image.format in ("JPEG", "MPO") else 0
    shown = pixels[..., :3].max(axis=2) > threshold
    return shown if pixels.shape[2] == 3 else shown & (pixels[..., 3] > threshold)


def as_upright(image: Image.Image, orientation: int) -> Image.Image:
    """A picture without EXIF, turned by an orientation that it had."""
    return image if orientation == 1 else image.transpose(TURNS[orientation])

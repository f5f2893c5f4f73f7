"""Pictures of every mode and bit depth, as photos and as masks: each is read as it is meant, or named."""

import io

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sparsestyle_ns.prepare.framing import read_photo
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.pictures import UnknownPixelsError, decode, read_mask, to_8_bits

MODES = ["1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "LAB", "HSV", "I", "F", "I;16", "I;16B"]
FORMATS = ["PNG", "TIFF", "WEBP", "JPEG", "BMP", "PPM", "TGA", "GIF"]


def file_of(image: Image.Image, format: str, **settings) -> bytes:
    file = io.BytesIO()
    image.save(file, format, **settings)
    return file.getvalue()


def read(data: bytes) -> Image.Image:
    with Image.open(io.BytesIO(data)) as image:
        image.load()
        return to_8_bits(image, data)


def ramp(height: int = 12, width: int = 16) -> np.ndarray:
    return np.linspace(0, 255, height * width).round().astype(np.uint8).reshape(height, width)


@pytest.mark.parametrize("format", ["PNG", "TIFF"])
def test_a_grey_picture_of_16_bits_is_the_one_of_8_that_it_was_made_from(format):
    deep = Image.fromarray(ramp().astype("uint16") * 257)
    found = np.asarray(read(file_of(deep, format)))
    np.testing.assert_array_equal(found, np.repeat(ramp()[..., None], 3, axis=2))


def test_a_tiff_of_16_bits_whose_white_is_0_is_turned_as_one_of_8_bits_is():
    deep = Image.fromarray(np.uint16(65535) - ramp() * np.uint16(257))  # the numbers that are in the file
    found = read(file_of(deep, "TIFF", tiffinfo={262: 0}))
    shallow = read(file_of(Image.fromarray(ramp()), "TIFF", tiffinfo={262: 0}))  # Pillow turns these itself
    np.testing.assert_array_equal(np.asarray(found), np.asarray(shallow))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_png_of_16_bits_keeps_them_in_every_kind(channels):
    values = np.random.default_rng(0).integers(0, 65536, (8, 9, channels), dtype=np.uint16)
    values[..., 3:] = 65535
    data = cv2.imencode(".png", values)[1].tobytes()
    with Image.open(io.BytesIO(data)) as image:
        image.load()
        found = decode(image, data)
    expected = np.repeat(values, 3, axis=2) if channels == 1 else values[..., [2, 1, 0, 3][:channels]]
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.asarray(read(data)), (expected[..., :3] / 257).round().astype(np.uint8))


@given(st.sampled_from(MODES), st.sampled_from(FORMATS), st.integers(0, 255), st.integers(0, 255))
def test_a_picture_of_any_mode_is_read_as_it_looks_or_named(tmp_path, mode, format, first, second):
    pixels = np.full((8, 8), first, np.uint8)
    pixels[:, 4:] = second
    try:
        image = Image.fromarray(pixels.astype(np.uint16) * 257) if mode.startswith("I;16") else Image.fromarray(pixels)
        data = file_of(image if image.mode == mode else image.convert(mode), format)
    except (OSError, ValueError, KeyError):
        return  # no picture of this mode can be saved in this format
    path = tmp_path / f"photo.{format.lower()}"
    path.write_bytes(data)
    try:
        found = np.asarray(read_photo(path).image)
    except InputError as error:
        assert str(path) in str(error)
        assert any(f"of the kind {kind}" in str(error) for kind in ("I", "F", "LAB"))
        return
    expected = np.where(pixels > 127, 255, 0) if mode == "1" else pixels  # which dithers, so only its extremes are sure
    if mode != "1" or {first, second} <= {0, 255}:
        assert np.abs(found[..., :3].astype(int) - expected[..., None]).max() <= (
            12 if format in ("JPEG", "WEBP") else 3
        )


@pytest.mark.parametrize("mode", ["I", "F", "LAB"])
def test_pixels_whose_range_nobody_knows_are_named(tmp_path, mode):
    path = tmp_path / "photo.tif"
    path.write_bytes(file_of(Image.new(mode, (8, 8)), "TIFF"))
    with pytest.raises(InputError, match=f"photo.tif has pixels of the kind {mode}.*; save it as 8-bit RGB or grey"):
        read_photo(path)
    with pytest.raises(UnknownPixelsError):
        read(path.read_bytes())


@given(st.sampled_from(["1", "L", "LA", "P", "RGB", "RGBA", "I;16", "I", "CMYK"]), st.sampled_from([1, 100, 255]))
def test_a_mask_of_any_mode_leaves_in_what_is_not_black(mode, white):
    inside = np.zeros((6, 7), bool)
    inside[1:4, 2:5] = True
    white = 255 if mode == "1" else white
    grey = np.where(inside, white, 0)
    if mode in ("I;16", "I"):
        image = Image.fromarray(grey.astype(np.uint16 if mode == "I;16" else np.int32))
    else:
        image = Image.fromarray(grey.astype(np.uint8)).convert(mode)
    data = file_of(image, "TIFF" if mode in ("I", "CMYK") else "PNG")
    np.testing.assert_array_equal(read_mask(data), inside)


def test_a_transparent_part_of_a_mask_is_left_out():
    pixels = np.full((6, 7, 4), 255, np.uint8)
    pixels[:3, :, 3] = 0
    np.testing.assert_array_equal(read_mask(file_of(Image.fromarray(pixels), "PNG"))[:, 0], np.arange(6) >= 3)


def test_a_jpeg_mask_has_no_noise_at_its_border():
    inside = np.zeros((32, 32), bool)
    inside[9:23, 9:23] = True
    data = file_of(Image.fromarray(np.where(inside, 255, 0).astype(np.uint8)), "JPEG", quality=60)
    assert (np.asarray(Image.open(io.BytesIO(data))) > 0)[~inside].any()
    np.testing.assert_array_equal(read_mask(data), inside)

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from sparsestyle_ns.style.painting import THUMBNAIL_SIDE, Painting
from sparsestyle_ns.utils.errors import InputError

HEIGHT, WIDTH = 12, 20


@pytest.fixture
def pixels():
    return np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.fixture
def smooth():
    """A picture without detail, which lossy formats keep within a few of 255 steps."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack([40 + 8 * rows, 60 + 6 * columns, 120 + 3 * (rows + columns)], axis=2).astype(np.uint8)


def as_tensor(pixels, white=255):
    return torch.from_numpy((np.asarray(pixels).astype(np.float64) / white).astype(np.float32)).permute(2, 0, 1)


def saved(path, image, **options):
    image.save(path, **options)
    return path


def deep_png(path, samples, color_type, chunks=()):
    """A PNG of 16 bits a channel, written by hand: Pillow cannot write one, and OpenCV no grey with alpha."""
    height, width, _ = samples.shape

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in samples)
    header = struct.pack(">IIBBBBB", width, height, 16, color_type, 0, 0, 0)
    body = [(b"IHDR", header), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(kind, data) for kind, data in body))
    return path


def test_a_png_comes_back_exactly_as_float32_rgb_in_the_unit_range(tmp_path, pixels):
    image = Painting.read(saved(tmp_path / "style.png", Image.fromarray(pixels))).pixels
    assert image.shape == (3, HEIGHT, WIDTH)
    assert image.dtype == torch.float32
    assert image.device.type == "cpu"
    assert image.is_contiguous()
    assert torch.equal(image, as_tensor(pixels))


def test_a_path_may_be_a_string_and_start_at_the_home_folder(tmp_path, pixels, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    saved(tmp_path / "style.png", Image.fromarray(pixels))
    assert torch.equal(Painting.read("~/style.png").pixels, as_tensor(pixels))


@pytest.mark.parametrize(("name", "options"), [("a.jpg", {"quality": 95}), ("a.webp", {"quality": 95})])
def test_lossy_formats_are_read(name, options, tmp_path, smooth):
    image = Painting.read(saved(tmp_path / name, Image.fromarray(smooth), **options)).pixels
    assert (image - as_tensor(smooth)).abs().max() < 0.04


@pytest.mark.parametrize("name", ["a.webp", "a.tiff", "a.bmp"])
def test_lossless_formats_are_read_exactly(name, tmp_path, pixels):
    options = {"lossless": True} if name == "a.webp" else {}
    assert torch.equal(
        Painting.read(saved(tmp_path / name, Image.fromarray(pixels), **options)).pixels, as_tensor(pixels)
    )


def test_the_name_of_a_file_does_not_decide_its_format(tmp_path, pixels):
    path = saved(tmp_path / "style.jpg", Image.fromarray(pixels), format="PNG")
    assert torch.equal(Painting.read(path).pixels, as_tensor(pixels))


def test_a_cmyk_jpeg_is_read_as_rgb(tmp_path, smooth):
    path = saved(tmp_path / "print.jpg", Image.fromarray(smooth).convert("CMYK"), quality=95)
    assert Image.open(path).mode == "CMYK"
    assert (Painting.read(path).pixels - as_tensor(smooth)).abs().max() < 0.04


def test_grey_becomes_three_equal_channels(tmp_path, pixels):
    grey = pixels[..., 0]
    image = Painting.read(saved(tmp_path / "grey.png", Image.fromarray(grey))).pixels
    assert torch.equal(image, as_tensor(np.stack([grey] * 3, axis=2)))


def test_black_and_white_pixels_of_one_bit_are_read(tmp_path, pixels):
    bits = pixels[..., 0] > 127
    image = Painting.read(saved(tmp_path / "bits.png", Image.fromarray(bits))).pixels
    assert torch.equal(image, as_tensor(np.stack([bits] * 3, axis=2), white=1))


def test_transparent_pixels_are_laid_over_white(tmp_path, pixels):
    alpha = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 1), dtype=np.uint8)
    opacity = alpha / 255
    image = Painting.read(saved(tmp_path / "rgba.png", Image.fromarray(np.concatenate([pixels, alpha], axis=2)))).pixels
    torch.testing.assert_close(image, as_tensor(pixels * opacity + 255 * (1 - opacity)))

    grey_alpha = Image.fromarray(np.concatenate([pixels[..., :1], alpha], axis=2))
    assert grey_alpha.mode == "LA"
    image = Painting.read(saved(tmp_path / "la.png", grey_alpha)).pixels
    grey = pixels[..., :1].repeat(3, axis=2)
    torch.testing.assert_close(image, as_tensor(grey * opacity + 255 * (1 - opacity)))


def palette_image():
    indices = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 3
    image = Image.fromarray(indices.astype(np.uint8), mode="P")
    image.putpalette([255, 0, 0, 0, 200, 0, 0, 0, 100])
    colors = np.array([[255, 0, 0], [0, 200, 0], [0, 0, 100]])
    return image, colors, indices


def test_a_palette_is_looked_up(tmp_path):
    image, colors, indices = palette_image()
    assert torch.equal(Painting.read(saved(tmp_path / "p.png", image)).pixels, as_tensor(colors[indices]))


def test_transparent_palette_entries_are_white(tmp_path):
    image, colors, indices = palette_image()
    path = saved(tmp_path / "p.png", image, transparency=1)
    colors[1] = 255
    assert torch.equal(Painting.read(path).pixels, as_tensor(colors[indices]))


def test_half_transparent_palette_entries_are_mixed_with_white(tmp_path):
    image, colors, indices = palette_image()
    path = saved(tmp_path / "p.png", image, transparency=bytes([255, 51, 255]))
    colors[1] = [204, 244, 204]
    torch.testing.assert_close(Painting.read(path).pixels, as_tensor(colors[indices]))


def deep_samples(channels):
    return np.random.default_rng(2).integers(0, 1 << 16, (HEIGHT, WIDTH, channels)).astype(np.uint16)


def test_rgb_of_16_bits_keeps_every_bit(tmp_path):
    samples = deep_samples(3)
    cv2.imwrite(str(tmp_path / "deep.png"), samples[..., ::-1])
    assert torch.equal(Painting.read(tmp_path / "deep.png").pixels, as_tensor(samples, white=65535))


def test_grey_of_16_bits_keeps_every_bit(tmp_path):
    samples = deep_samples(1)
    expected = as_tensor(samples.repeat(3, axis=2), white=65535)
    for name in ("deep.png", "deep.tiff"):
        cv2.imwrite(str(tmp_path / name), samples)
        assert torch.equal(Painting.read(tmp_path / name).pixels, expected)


@pytest.mark.parametrize(("color_type", "channels"), [(4, 2), (6, 4)])
def test_transparency_of_16_bits_is_laid_over_white(color_type, channels, tmp_path):
    samples = deep_samples(channels)
    opacity = samples[..., -1:] / 65535
    color = np.broadcast_to(samples[..., :-1], (HEIGHT, WIDTH, 3))
    image = Painting.read(deep_png(tmp_path / "deep.png", samples, color_type)).pixels
    torch.testing.assert_close(image, as_tensor(color * opacity + 65535 * (1 - opacity), white=65535))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photograph_is_turned_upright_as_exif_says(orientation, tmp_path, pixels):
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = saved(tmp_path / "turned.png", Image.fromarray(pixels), exif=exif)
    upright = ImageOps.exif_transpose(Image.open(path))
    assert torch.equal(Painting.read(path).pixels, as_tensor(upright))
    assert upright.size == ((WIDTH, HEIGHT) if orientation < 5 else (HEIGHT, WIDTH))


def exif_chunk(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    return b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_picture_of_16_bits_is_turned_upright_too(orientation, tmp_path):
    samples = deep_samples(3)
    path = deep_png(tmp_path / "deep.png", samples, 2, chunks=[exif_chunk(orientation)])
    # Pillow keeps the upper 8 of the 16 bits, which is enough to tell how the picture lies.
    upright = ImageOps.exif_transpose(Image.open(path))
    assert (Painting.read(path).pixels - as_tensor(upright)).abs().max() < 1.5 / 255


def test_a_jpeg_is_turned_upright(tmp_path, smooth):
    exif = Image.Exif()
    exif[0x0112] = 6
    path = saved(tmp_path / "turned.jpg", Image.fromarray(smooth), quality=95, exif=exif)
    assert (Painting.read(path).pixels - as_tensor(np.rot90(smooth, -1))).abs().max() < 0.04


def message_of(path):
    with pytest.raises(InputError) as caught:
        Painting.read(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def test_a_missing_file_is_named(tmp_path):
    assert "does not exist: check the path" in message_of(tmp_path / "missing.png")


def test_a_folder_is_refused(tmp_path):
    assert "is a folder: give one image file in it" in message_of(tmp_path)


def test_a_path_through_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("text")
    assert "cannot be opened (Not a directory): check the path" in message_of(tmp_path / "file" / "style.png")


def test_an_empty_file_is_refused(tmp_path):
    (tmp_path / "empty.png").touch()
    assert "is an empty file: give an undamaged JPEG, PNG or WebP file" in message_of(tmp_path / "empty.png")


def test_a_text_is_refused(tmp_path):
    (tmp_path / "style.png").write_text("not an image")
    assert "is in no known image format: give a JPEG, PNG or WebP file" in message_of(tmp_path / "style.png")


def test_pixels_without_a_range_are_refused(tmp_path):
    path = saved(tmp_path / "float.tiff", Image.fromarray(np.ones((16, 16), np.float32)))
    assert "have no fixed range): give an undamaged JPEG, PNG or WebP file" in message_of(path)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("a.png", "file is truncated"),
        ("a.jpg", "runcated"),
        ("a.webp", "decoder object"),
        ("deep.png", "file is truncated"),
    ],
)
@pytest.mark.parametrize("kept", [0.1, 0.6, 0.95])
def test_a_truncated_file_is_refused_with_the_decoders_reason(name, reason, kept, tmp_path):
    if name == "deep.png":
        path = deep_png(tmp_path / name, deep_samples(3), 2, chunks=[exif_chunk(orientation=1)])
    else:
        noise = np.random.default_rng(3).integers(0, 256, (64, 64, 3), dtype=np.uint8)
        path = saved(tmp_path / name, Image.fromarray(noise))
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    message = message_of(path)
    assert "cannot be read as an image" in message
    # The path holds the name of this test.
    assert reason in message.replace(str(path), "")


def test_damaged_bytes_give_an_image_or_an_error_for_the_user(tmp_path):
    random = np.random.default_rng(4)
    buffer = io.BytesIO()
    Image.fromarray(random.integers(0, 256, (16, 16, 3), dtype=np.uint8)).save(buffer, format="PNG")
    deep = deep_png(tmp_path / "deep.png", deep_samples(3), 2).read_bytes()
    path = tmp_path / "damaged.png"
    refused = 0
    for data in [buffer.getvalue(), deep]:
        for _ in range(100):
            damaged = bytearray(data)
            damaged[random.integers(8, len(data))] = random.integers(0, 256)
            path.write_bytes(damaged)
            try:
                assert Painting.read(path).pixels.shape[0] == 3
            except InputError:
                refused += 1
    assert refused > 100


@pytest.mark.parametrize("size", [(7, 30), (30, 7), (1, 1)])
def test_an_image_of_fewer_than_8_pixels_a_side_is_refused(size, tmp_path):
    path = saved(tmp_path / "tiny.png", Image.new("RGB", size))
    assert f"is {size[0]} × {size[1]} pixels: give one of at least 8 pixels a side" in message_of(path)


def test_8_pixels_a_side_are_enough(tmp_path):
    assert Painting.read(saved(tmp_path / "small.png", Image.new("RGB", (8, 8)))).pixels.shape == (3, 8, 8)


def test_a_painting_keeps_its_file_and_its_name_and_makes_a_small_jpeg(tmp_path, pixels):
    path = saved(tmp_path / "style.png", Image.fromarray(np.tile(pixels, (20, 20, 1))))
    read, received = Painting.read(path), Painting.received("C:\\pictures\\style.png", path.read_bytes())
    assert read.name == received.name == "style.png"
    assert read.data == received.data == path.read_bytes()
    assert torch.equal(read.pixels, received.pixels)
    with Image.open(io.BytesIO(read.thumbnail())) as small:
        assert small.format == "JPEG" and max(small.size) == THUMBNAIL_SIDE
    assert Painting.received("", path.read_bytes()).name == "upload"


def test_a_painting_that_is_transparent_all_over_is_refused_and_in_places_named(tmp_path, capsys):
    pixels = np.full((16, 16, 4), 255, np.uint8)
    pixels[:8, :, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "half.png")
    Painting.read(tmp_path / "half.png")
    assert "half.png is transparent in places, and laid over white." in " ".join(capsys.readouterr().out.split())
    pixels[..., 3] = 0
    Image.fromarray(pixels).save(tmp_path / "clear.png")
    with pytest.raises(InputError, match=r"clear\.png is transparent all over: give one that shows something"):
        Painting.read(tmp_path / "clear.png")


@pytest.mark.parametrize("name", ["moving.gif", "moving.webp", "pages.tif"])
def test_of_several_frames_the_first_is_the_painting_and_that_is_said(tmp_path, capsys, name):
    first, second = (Image.new("RGB", (16, 16), color) for color in ("red", "blue"))
    first.save(tmp_path / name, save_all=True, append_images=[second])
    red = Painting.read(tmp_path / name).pixels[:, 8, 8]
    assert red[0] > 0.9 and red[2] < 0.1
    assert f"{name} has 2 frames; its first is the painting." in " ".join(capsys.readouterr().out.split())

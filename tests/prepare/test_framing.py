"""Photos come in upright and of one size, whatever they were."""

import sys

import numpy as np
import pytest
from photo_sets import save_with_orientation
from PIL import Image

from sparsestyle_ns.prepare.framing import Framing, find_photos, frame_photos, read_photo, write_photos
from sparsestyle_ns.utils.errors import InputError


def gradient(width, height):
    """Red grows to the right, green downwards."""
    rows, columns = np.mgrid[:height, :width]
    return Image.fromarray(np.stack([columns, rows, 0 * rows], axis=-1).astype(np.uint8))


def test_exif_rotation_is_applied(tmp_path):
    # Orientation 6: the stored picture has to be turned clockwise by 90 degrees.
    save_with_orientation(gradient(40, 20), tmp_path / "a.png", 6)
    turned = np.asarray(read_photo(tmp_path / "a.png").image)
    assert turned.shape == (40, 20, 3)
    np.testing.assert_array_equal(turned, np.rot90(np.asarray(gradient(40, 20)), -1))
    stored = read_photo(tmp_path / "a.png", upright=False)
    assert (stored.image.size, stored.orientation, stored.upright) == ((40, 20), 6, False)


@pytest.mark.parametrize("orientation", [0, 1, 9, 6000])
def test_orientations_that_ask_for_nothing_count_as_upright(tmp_path, orientation):
    save_with_orientation(gradient(40, 20), tmp_path / "a.png", orientation)
    photo = read_photo(tmp_path / "a.png")
    assert (photo.image.size, photo.orientation) == ((40, 20), 1)


def test_a_tiff_is_upright_when_it_is_read_as_nerfstudio_reads_it(tmp_path):
    """Pillow turns TIFFs by itself, so there is nothing left to be said of them."""
    save_with_orientation(gradient(40, 20), tmp_path / "a.tiff", 6)
    photo = read_photo(tmp_path / "a.tiff", upright=False)
    assert (photo.image.size, photo.orientation) == ((20, 40), 1)
    np.testing.assert_array_equal(np.asarray(photo.image), np.asarray(Image.open(tmp_path / "a.tiff")))


def test_only_real_transparency_is_kept(tmp_path):
    Image.new("RGBA", (8, 8), (10, 20, 30, 255)).save(tmp_path / "opaque.png")
    Image.new("RGBA", (8, 8), (10, 20, 30, 100)).save(tmp_path / "glass.png")
    assert read_photo(tmp_path / "opaque.png").image.mode == "RGB"
    assert read_photo(tmp_path / "glass.png").image.mode == "RGBA"


def test_photos_of_one_size_stay_as_they_are():
    framings = frame_photos([(40, 30)] * 3)
    assert framings == [Framing((40, 30), (40, 30), (0, 0), (40, 30))] * 3
    np.testing.assert_array_equal(np.asarray(framings[0].apply(gradient(40, 30))), np.asarray(gradient(40, 30)))


def test_longer_sides_are_scaled_to_the_shortest_and_the_rest_is_cropped_about_the_middle():
    large, portrait, small = frame_photos([(400, 300), (150, 200), (200, 150)])
    assert [framing.scaled for framing in (large, portrait, small)] == [(200, 150), (150, 200), (200, 150)]
    assert {framing.size for framing in (large, portrait, small)} == {(150, 150)}
    assert (large.corner, portrait.corner, small.corner) == ((25, 0), (0, 25), (25, 0))


def test_a_cropped_photo_shows_its_middle():
    framing = frame_photos([(200, 150), (150, 200)])[0]
    pixels = np.asarray(framing.apply(gradient(200, 150)))
    assert pixels.shape == (150, 150, 3)
    assert pixels[0, 0].tolist() == [25, 0, 0]
    assert pixels[-1, -1].tolist() == [174, 149, 0]


def test_written_photos_keep_their_order_and_are_png_where_nothing_was_lost_yet(tmp_path):
    for name in ("b.png", "a.png", "c.png"):
        gradient(16, 12).save(tmp_path / name)
    photos = [read_photo(path) for path in find_photos(tmp_path)]
    assert [photo.path.name for photo in photos] == ["a.png", "b.png", "c.png"]
    framings = frame_photos([photo.image.size for photo in photos])
    assert write_photos(photos, framings, tmp_path / "out")[2] == "photo_002.png"
    gradient(16, 12).save(tmp_path / "d.jpg")
    mixed = [read_photo(path) for path in find_photos(tmp_path)]
    names = write_photos(mixed, frame_photos([photo.image.size for photo in mixed]), tmp_path / "mixed")
    assert names == [f"photo_00{number}.jpg" for number in range(4)]


@pytest.mark.parametrize(("count", "words"), [(0, "has no photo"), (1, "has only one photo"), (2, "has only 2 photos")])
def test_too_few_photos_are_counted(tmp_path, count, words):
    for number in range(count):
        gradient(8, 8).save(tmp_path / f"{number}.png")
    (tmp_path / "notes.txt").write_text("no photo")
    with pytest.raises(InputError, match=f"{words}.* a scene needs at least 3"):
        find_photos(tmp_path)


def test_a_damaged_photo_is_named(tmp_path):
    (tmp_path / "torn.jpg").write_bytes(b"\xff\xd8\xff\xe0 torn")
    gradient(64, 64).save(tmp_path / "cut.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "cut.png").read_bytes()[:100])
    for name in ("torn.jpg", "cut.png"):
        with pytest.raises(InputError, match=name):
            read_photo(tmp_path / name)


def test_heic_without_its_package_names_the_ways_out(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    with pytest.raises(InputError, match="pip install pillow-heif, or save the photos as JPEG"):
        read_photo(tmp_path / "a.HEIC")


def test_heic_is_read_where_its_package_is(tmp_path, monkeypatch):
    class Package:
        @staticmethod
        def register_heif_opener():
            Image.register_extension("PNG", ".heic")

    monkeypatch.setitem(sys.modules, "pillow_heif", Package)
    gradient(8, 8).save(tmp_path / "a.heic", format="PNG")
    assert read_photo(tmp_path / "a.heic").image.size == (8, 8)

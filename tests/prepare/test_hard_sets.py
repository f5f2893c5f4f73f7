"""Sets of photos from which poses can't be told, or only of some: which photos, why, and which photo to take next."""

import sys

import imageio.v2 as imageio
import numpy as np
import pytest
from photo_sets import ASIDE, AWAY, TURNED, WALK, bricks, photo, save_photos, save_with_orientation, tiles, write_photos
from PIL import ExifTags, Image, ImageFilter

from sparsestyle_ns.data.llff import read_poses_bounds
from sparsestyle_ns.prepare.prepare_scene import prepare_scene
from sparsestyle_ns.utils.errors import InputError


def refusal(folder, images) -> str:
    """The sentences with which a set of photos is refused."""
    with pytest.raises(InputError) as refused:
        prepare_scene(save_photos(folder / "photos", images), folder / "scene")
    assert not (folder / "scene").exists()
    assert "\n" not in str(refused.value)
    return str(refused.value)


def focal_lengths(scene):
    """Of the photos of a scene, in widths."""
    cameras = read_poses_bounds(scene)
    return (cameras.focals / cameras.full_sizes[:, 0]).tolist()


@pytest.mark.parametrize("shake", [0.0, 0.02])
def test_a_camera_that_only_turned_is_refused(tmp_path, shake):
    """Also in the hand, which shakes."""
    places = [((shake * i, 0.0, 1.3 - 0.5 * shake * i), target) for i, (_, target) in enumerate(TURNED)]
    said = refusal(tmp_path, [photo(place) for place in places])
    assert "The camera turned without moving" in said
    assert "from where a.png was taken half a metre to the left" in said


def test_a_wall_alone_is_refused(tmp_path):
    said = refusal(tmp_path, [photo(place, wall=bricks) for place in WALK[::2]])
    assert "All that the photos share lies in one plane" in said
    assert "as a step to the side of where a.png was taken" in said


def test_a_pattern_that_repeats_itself_is_refused(tmp_path):
    said = refusal(tmp_path, [photo(place, wall=tiles) for place in WALK[::2]])
    assert "One pattern comes again and again in a.png, b.png, c.png" in said
    assert "the next one beside where a.png was taken" in said


def test_too_little_overlap_is_refused_with_the_photo_to_take_next(tmp_path):
    far = ((3.4, 0.0, 1.3), (5.2, 5.0, 0.8))
    said = refusal(tmp_path, [photo(WALK[0]), photo(WALK[1]), photo(far)])
    assert "c.png shares too little with the other photos" in said
    assert "take one more photo halfway between" in said
    assert "a step to the right, with its right half still in sight" in said


def test_a_photo_of_something_else_is_left_out_and_named(tmp_path, capsys):
    photos = save_photos(tmp_path / "photos", [*map(photo, WALK[:3]), photo(AWAY), photo(WALK[3])])
    assert len(prepare_scene(photos, tmp_path / "scene").names) == 4
    printed = capsys.readouterr().out
    assert "Warning: d.png: left out, as no pose is found" in printed
    assert "d.png shares too little with the other photos" in printed


def test_a_blurred_photo_is_named(tmp_path, capsys):
    images = [photo(place) for place in WALK]
    images[2] = images[2].filter(ImageFilter.GaussianBlur(2))
    prepare_scene(save_photos(tmp_path / "photos", images), tmp_path / "scene")
    assert "Warning: c.png is blurred: take it again from the same place" in capsys.readouterr().out


def test_a_zoomed_photo_gets_a_focal_length_of_its_own(tmp_path, capsys):
    images = [photo(place, zoom=1.8 if index == 2 else 1.0) for index, place in enumerate(WALK)]
    prepare_scene(save_photos(tmp_path / "photos", images), tmp_path / "scene")
    focals = focal_lengths(tmp_path / "scene")
    assert focals[2] / focals[0] == pytest.approx(1.8, rel=0.05)
    assert focals[0] == focals[1] == focals[3] == focals[4] == pytest.approx(0.85, rel=0.12)
    assert "Warning: c.png (1.8 times) seems to be taken with another zoom" in capsys.readouterr().out


def test_second_copies_and_screenshots_are_named_and_left_out(tmp_path, capsys):
    photos = save_photos(tmp_path / "photos", [photo(place) for place in WALK[:4]])
    photo(WALK[1]).resize((256, 192), Image.Resampling.BICUBIC).save(photos / "copy of b.jpg", quality=80)
    photo(WALK[4]).crop((100, 0, 210, 240)).save(photos / "Screenshot_2026.png")
    assert len(prepare_scene(photos, tmp_path / "scene").names) == 4
    printed = capsys.readouterr().out
    assert "copy of b.jpg is left out: it is the same photo as b.png." in printed
    assert "Screenshot_2026.png is left out: it is a screenshot, not a photo." in printed


def test_too_few_are_left_without_copies(tmp_path):
    assert "Only 2 of the 3 photos can be used" in refusal(tmp_path, [photo(WALK[0]), photo(WALK[2]), photo(WALK[2])])


def test_sizes_and_orientations_may_be_mixed(tmp_path, capsys):
    photos = save_photos(tmp_path / "photos", [photo(place) for place in WALK[:3]])
    photo(WALK[3]).resize((640, 480), Image.Resampling.BICUBIC).save(photos / "large.png")
    save_with_orientation(photo(WALK[4]).rotate(90, expand=True), photos / "turned.png", 6)
    assert len(prepare_scene(photos, tmp_path / "scene").names) == 5
    assert focal_lengths(tmp_path / "scene") == pytest.approx([0.85] * 5, rel=0.12)


def test_heic_that_cant_be_read_names_the_ways_out(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    write_photos(tmp_path / "photos")
    (tmp_path / "photos" / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    with pytest.raises(InputError, match="pip install pillow-heif, or save the photos as JPEG"):
        prepare_scene(tmp_path / "photos", tmp_path / "scene")


def write_video(path, images):
    """Frames, 15 a second."""
    with imageio.get_writer(path, fps=15, quality=9, macro_block_size=1) as writer:
        for image in images:
            writer.append_data(np.asarray(image))


def test_of_a_video_sharp_frames_from_different_places_are_taken(tmp_path, capsys):
    places = [((x, 0.0, 1.3), (0.3 * x, 5.0, 0.8)) for x in np.linspace(-0.9, 0.9, 13).round(3).tolist()]
    frames = [image for place in places for image in (photo(place).filter(ImageFilter.GaussianBlur(3)), photo(place))]
    write_video(tmp_path / "walk.mp4", frames)
    scene = prepare_scene(tmp_path / "walk.mp4", tmp_path / "scene")
    assert scene.parser == "llff-data" and 3 <= len(scene.names) <= 8
    printed = capsys.readouterr().out
    assert "frames of walk.mp4 are taken, at" in printed and "blurred" not in printed
    assert focal_lengths(tmp_path / "scene") == pytest.approx([0.85] * len(scene.names), rel=0.12)
    steps = np.diff(read_poses_bounds(tmp_path / "scene").camera_to_worlds[:, 0, 3].numpy())
    assert (np.abs(steps) > 0.5 * np.abs(steps).mean()).all()


def test_a_video_in_which_nothing_moves_is_refused(tmp_path):
    write_video(tmp_path / "still.mp4", [photo(ASIDE[0])] * 12)
    with pytest.raises(InputError, match=r"The camera hardly moves in .*still\.mp4: film a slow walk"):
        prepare_scene(tmp_path / "still.mp4", tmp_path / "scene")


def test_a_file_that_is_no_video_is_refused(tmp_path):
    (tmp_path / "torn.mp4").write_bytes(b"no film")
    with pytest.raises(InputError, match=r"torn\.mp4 can't be read as a video"):
        prepare_scene(tmp_path / "torn.mp4", tmp_path / "scene")


def test_what_a_telephone_says_of_its_screenshots_is_read(tmp_path, capsys):
    photos = save_photos(tmp_path / "photos", [photo(place) for place in WALK[:4]])
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "Pocket"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.UserComment] = b"ASCII\0\0\0Screenshot"
    photo(WALK[4]).save(photos / "e.png", exif=exif)
    assert len(prepare_scene(photos, tmp_path / "scene").names) == 4
    assert "e.png is left out: it is a screenshot" in capsys.readouterr().out

"""`sparsestyle prepare`: scenes that the dataparsers read, poses that still fit the photos, and clear words if not."""

import json

import numpy as np
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from photo_sets import (
    ASIDE,
    FOCAL,
    HEIGHT,
    TURNED,
    WIDTH,
    photo,
    save_with_orientation,
    write_photos,
    write_poses_bounds,
    write_transforms,
)
from PIL import ExifTags, Image
from test_commands import write_ring
from test_commands import write_transforms as write_capture

from sparsestyle_ns.cli import main
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.prepare.prepare_scene import prepare_scene
from sparsestyle_ns.utils.errors import InputError


def parse_llff(folder):
    return LLFFDataParserConfig(data=folder).setup().get_dataparser_outputs("train")


def parse_nerfstudio(folder):
    settings = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
    return NerfstudioDataParserConfig(data=folder, **settings).setup().get_dataparser_outputs("train")


def change_transforms(folder, change):
    """Rewrites a transforms.json."""
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize("place", ["", "images"])
def test_photos_with_poses_bounds_become_an_llff_scene(tmp_path, capsys, place):
    photos = tmp_path / "photos"
    write_photos(photos / place)
    write_poses_bounds(photos)
    main(["prepare", str(photos), "--output", str(tmp_path / "scene")])
    outputs = parse_llff(tmp_path / "scene")
    assert len(outputs.image_filenames) == 3
    assert outputs.cameras.fx[0].item() == pytest.approx(FOCAL)
    np.testing.assert_array_equal(np.asarray(Image.open(outputs.image_filenames[1])), np.asarray(photo(ASIDE[1])))
    printed = capsys.readouterr().out
    assert "Warning" not in printed
    made, command = printed.splitlines()[-1].split(" – next: ")
    assert made == f"Made {tmp_path / 'scene'}, 3 photos with poses"
    assert command == f"ns-train coarse-fewshot --data {tmp_path / 'scene'} llff-data"


def test_photos_with_transforms_become_a_nerfstudio_scene(tmp_path):
    names = write_photos(tmp_path / "photos")
    write_transforms(tmp_path / "photos", names)
    scene = prepare_scene(tmp_path / "photos", tmp_path / "scene")
    assert scene.parser == "nerfstudio-data"
    cameras = parse_nerfstudio(tmp_path / "scene").cameras
    assert cameras.fx.flatten().tolist() == pytest.approx([FOCAL] * 3)
    assert (cameras.cx[0].item(), cameras.cy[0].item()) == (150.0, 130.0)
    assert cameras.distortion_params[0, 0].item() == pytest.approx(0.01)


def test_a_point_is_seen_at_the_same_spot_of_a_scaled_and_cropped_photo(tmp_path):
    """Three sizes and both aspects: what a pixel shows is where the new intrinsics say."""
    names = write_photos(tmp_path / "photos")
    write_transforms(tmp_path / "photos", names)
    content = json.loads((tmp_path / "photos" / "transforms.json").read_text())
    portrait = photo(ASIDE[2]).crop((70, 0, 250, 240))  # 180 × 240: its own intrinsics have the moved centre
    portrait.save(tmp_path / "photos" / names[2])
    content["frames"][2].update(fl_x=FOCAL, fl_y=FOCAL, cx=80.0, cy=130.0, w=180, h=240)
    photo(ASIDE[1]).resize((640, 480), Image.Resampling.BICUBIC).save(tmp_path / "photos" / names[1])
    (tmp_path / "photos" / "transforms.json").write_text(json.dumps(content))
    prepare_scene(tmp_path / "photos", tmp_path / "scene")
    cameras = parse_nerfstudio(tmp_path / "scene").cameras
    # The shortest longer side is 240; 240 × 180 and 180 × 240 have 180 × 180 in common.
    assert {(int(w), int(h)) for w, h in zip(cameras.width, cameras.height, strict=True)} == {(180, 180)}
    assert cameras.fx.flatten().tolist() == pytest.approx([0.75 * FOCAL, 0.75 * FOCAL, FOCAL])
    assert cameras.cx.flatten().tolist() == pytest.approx([0.75 * 150 - 30, 0.75 * 150 - 30, 80.0])
    assert cameras.cy.flatten().tolist() == pytest.approx([0.75 * 130, 0.75 * 130, 130 - 30])
    original = np.asarray(photo(ASIDE[1]).convert("L"), float)
    prepared = np.asarray(Image.open(tmp_path / "scene" / "images" / "photo_001.png").convert("L"), float)
    for x, y in ((150.0, 130.0), (100.0, 60.0), (210.0, 200.0)):
        column = 0.75 * FOCAL * (x - 150.0) / FOCAL + cameras.cx[1].item()
        row = 0.75 * FOCAL * (y - 130.0) / FOCAL + cameras.cy[1].item()
        before = original[int(y) - 4 : int(y) + 4, int(x) - 4 : int(x) + 4].mean()
        after = prepared[int(row) - 3 : int(row) + 3, int(column) - 3 : int(column) + 3].mean()
        assert after == pytest.approx(before, abs=6)


def test_poses_bounds_follow_the_photos_size(tmp_path):
    names = write_photos(tmp_path / "photos")
    write_poses_bounds(tmp_path / "photos")
    for name in names:
        image = Image.open(tmp_path / "photos" / name)
        image.resize((160, 120)).save(tmp_path / "photos" / name)
    prepare_scene(tmp_path / "photos", tmp_path / "scene")
    cameras = parse_llff(tmp_path / "scene").cameras
    assert (int(cameras.width[0]), cameras.fx[0].item()) == (160, pytest.approx(FOCAL / 2))


@pytest.mark.parametrize("orientation", [2, 3, 4, 6])
@pytest.mark.parametrize("write_poses", ["poses_bounds", "transforms"])
def test_a_photo_with_a_pose_stays_as_it_is_stored(tmp_path, capsys, orientation, write_poses):
    """nerfstudio's readers and COLMAP leave EXIF alone, so this is what the pose was found with."""
    photos = tmp_path / "photos"
    names = write_photos(photos)
    save_with_orientation(photo(ASIDE[0]), photos / names[0], orientation)
    write_poses_bounds(photos) if write_poses == "poses_bounds" else write_transforms(photos, names)
    scene = prepare_scene(photos, tmp_path / "scene")
    said = f"a.png: not turned, though EXIF says so, since poses in {photos / write_poses}"
    assert [line.startswith(said) for line in capsys.readouterr().out.splitlines()].count(True) == 1
    prepared = Image.open(tmp_path / "scene" / "images" / scene.names[0])
    np.testing.assert_array_equal(np.asarray(prepared), np.asarray(photo(ASIDE[0])))
    assert ExifTags.Base.Orientation not in prepared.getexif()


def test_a_square_photo_with_a_pose_stays_as_it_is_stored(tmp_path):
    names = write_photos(tmp_path / "photos")
    write_transforms(tmp_path / "photos", names, w=HEIGHT, h=HEIGHT, cx=120.0, cy=120.0)
    square = [photo(place).crop((40, 0, 280, 240)) for place in ASIDE]
    for name, image in zip(names, square, strict=True):
        save_with_orientation(image, tmp_path / "photos" / name, 6)
    prepare_scene(tmp_path / "photos", tmp_path / "scene")
    prepared = Image.open(tmp_path / "scene" / "images" / "photo_000.png")
    np.testing.assert_array_equal(np.asarray(prepared), np.asarray(square[0]))


def test_where_transforms_give_no_size_photos_stay_as_they_are_stored(tmp_path):
    names = write_photos(tmp_path / "photos")
    write_transforms(tmp_path / "photos", names)
    change_transforms(tmp_path / "photos", lambda content: [content.pop(key) for key in ("w", "h")])
    for name, place in zip(names, ASIDE, strict=True):
        save_with_orientation(photo(place), tmp_path / "photos" / name, 6)
    prepare_scene(tmp_path / "photos", tmp_path / "scene")
    prepared = Image.open(tmp_path / "scene" / "images" / "photo_000.png")
    np.testing.assert_array_equal(np.asarray(prepared), np.asarray(photo(ASIDE[0])))


def test_a_photo_is_turned_upright_where_only_so_it_has_the_shape_of_its_pose(tmp_path, capsys):
    names = write_photos(tmp_path / "photos")
    write_poses_bounds(tmp_path / "photos")
    # Orientation 6: the stored picture has to be turned clockwise by 90 degrees.
    save_with_orientation(photo(ASIDE[0]).rotate(90, expand=True), tmp_path / "photos" / names[0], 6)
    prepare_scene(tmp_path / "photos", tmp_path / "scene")
    assert "a.png: turned upright, as EXIF says, since only then the shape is" in capsys.readouterr().out
    prepared = Image.open(tmp_path / "scene" / "images" / "photo_000.png")
    np.testing.assert_array_equal(np.asarray(prepared), np.asarray(photo(ASIDE[0])))


def test_photos_without_poses_are_turned_upright_and_become_a_scene(tmp_path, capsys):
    write_photos(tmp_path / "photos")
    turned = photo(ASIDE[0]).rotate(90, expand=True).resize((480, 640), Image.Resampling.BICUBIC)
    save_with_orientation(turned, tmp_path / "photos" / "a.png", 6)
    main(["prepare", str(tmp_path / "photos"), "--output", str(tmp_path / "scene")])
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "a.png: turned upright, as EXIF says"
    assert printed[-1].endswith(f"ns-train coarse-fewshot --data {tmp_path / 'scene'} llff-data")
    outputs = parse_llff(tmp_path / "scene")
    assert [Image.open(path).size for path in outputs.image_filenames] == [(WIDTH, HEIGHT)] * 3


def test_where_poses_cant_be_estimated_the_photos_faults_are_the_answer(tmp_path):
    write_photos(tmp_path / "photos", TURNED)
    with pytest.raises(InputError, match=r"can't be told\. The camera turned without moving"):
        prepare_scene(tmp_path / "photos", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_poses_may_be_estimated_though_a_file_has_some(tmp_path):
    write_photos(tmp_path / "photos")
    write_poses_bounds(tmp_path / "photos")
    prepare_scene(tmp_path / "photos", tmp_path / "scene", "estimate")
    assert json.loads((tmp_path / "scene" / "transforms.json").read_text())["poses_estimated"] is True


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda photos: (photos / "a.png").unlink(), "2 photos"),
        (lambda photos: photo(ASIDE[0]).save(photos / "d.png"), "4 photos, but .* has 3 poses"),
        (lambda photos: photo(ASIDE[0]).crop((0, 0, 240, 240)).save(photos / "b.png"), "b.png is 240 × 240 pixels"),
        (lambda photos: (photos / "poses_bounds.npy").write_bytes(b"nothing"), "cannot be read as an array"),
    ],
)
def test_photos_and_poses_that_do_not_fit_are_refused(tmp_path, spoil, sentence):
    write_photos(tmp_path / "photos")
    write_poses_bounds(tmp_path / "photos")
    spoil(tmp_path / "photos")
    with pytest.raises(InputError, match=sentence):
        prepare_scene(tmp_path / "photos", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_transforms_of_other_photos_are_refused(tmp_path):
    photos = tmp_path / "photos"
    write_photos(photos)
    write_transforms(photos, ["x.png", "y.png", "z.png"])
    with pytest.raises(InputError, match="has poses for 0 of the 3 photos"):
        prepare_scene(photos, tmp_path / "scene")


def lists(key, value):
    return lambda content: content.update({key: value})


def frame_lists(key, value):
    return lambda content: content["frames"][1].update({key: value})


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda content: content.clear(), "has no list of frames"),
        (lambda content: content["frames"][1].pop("transform_matrix"), r"Frame 1 .*b.png, has a transform_matrix that"),
        (frame_lists("transform_matrix", [[1, 2], [3]]), r"Frame 1 .*b.png, has a transform_matrix that"),
        (frame_lists("transform_matrix", [[0] * 4] * 4), r"Frame 1 .*b.png, has a transform_matrix that"),
        (frame_lists("file_path", None), "Frame 1 .*names no photo"),
        (lambda content: content.pop("fl_x"), "no focal length .*a.png"),
        (lists("fl_x", None), r"transforms.json has fl_x null: give a number of pixels above 0"),
        (lists("fl_x", "500"), r'has fl_x "500": give a number of pixels above 0'),
        (lists("fl_y", 0), r"has fl_y 0: give a number of pixels above 0"),
        (lists("w", "640px"), r'has w "640px": give a number of pixels above 0'),
        (lists("h", True), r"has h true: give a number of pixels above 0"),
        (lists("h", 1e-9), r"a.png is 320 × 240 pixels, which is no scaled version"),
        (lists("cx", [160]), r"has cx \[160\]: give a number, or take it out"),
        (lists("k1", None), r"has k1 null: give a number, or take it out"),
        (lists("distortion_params", [0.1]), r"has distortion_params \[0.1\]: give six numbers"),
        (lists("camera_angle_x", 4), r"has camera_angle_x 4: give the horizontal angle"),
        (frame_lists("fl_x", None), r"frame 1 \(from 0\) of .*has fl_x null: give a number"),
        (frame_lists("file_path", "r/a.jpg"), "Two frames .*images/a.png and r/a.jpg, may both be of"),
        (lists("val_filenames", "images/a.png"), r"val_filenames that is no list of names"),
        (lists("train_filenames", None), r"train_filenames that is no list of names"),
        (lists("train_filenames", ["images/gone.png"]), r"None of the photos with poses is in train_filenames"),
    ],
)
def test_what_is_wrong_with_transforms_is_said_in_one_sentence(tmp_path, spoil, sentence):
    photos = tmp_path / "photos"
    write_transforms(photos, write_photos(photos))
    change_transforms(photos, spoil)
    with pytest.raises(InputError, match=sentence) as refused:
        prepare_scene(photos, tmp_path / "scene")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "scene").exists()


def test_two_photos_for_one_pose_are_refused(tmp_path):
    write_transforms(tmp_path / "photos", write_photos(tmp_path / "photos"))
    photo(ASIDE[0]).save(tmp_path / "photos" / "a.jpg")
    with pytest.raises(InputError, match=r"a.jpg and .*a.png may both be the photo of images/a.png"):
        prepare_scene(tmp_path / "photos", tmp_path / "scene")


def test_a_frame_whose_path_leads_to_a_photo_is_that_photos_own(tmp_path):
    """Others of the same name, in another folder or of another kind, are left out."""
    scene = tmp_path / "photos"
    names = write_photos(scene / "images")
    write_transforms(scene, names)
    write_photos(scene / "images", suffix=".jpg")
    stray = {"file_path": "left/a.png", "transform_matrix": np.eye(4).tolist()}
    change_transforms(scene, lambda content: content["frames"].insert(0, stray))
    prepare_scene(scene, tmp_path / "scene")
    poses = parse_nerfstudio(tmp_path / "scene").cameras.camera_to_worlds
    np.testing.assert_allclose(poses[0, :, 3].tolist(), ASIDE[0][0], atol=1e-6)
    assert len(list((tmp_path / "scene" / "images").iterdir())) == 3


@pytest.mark.parametrize("held_out", [["./images/d.png", "images/gone.png"], ["images/gone.png"]])
def test_the_photos_that_a_file_trains_on_are_those_of_the_scene(tmp_path, held_out):
    """Under their new names; nerfstudio reads a file only if each of its lists names photos that are there."""
    photos = tmp_path / "photos"
    places = [*ASIDE, TURNED[0]]
    names = write_photos(photos, places)
    write_transforms(photos, names, places, train_filenames=["images/c.png", "images/a.png"], val_filenames=held_out)
    prepare_scene(photos, tmp_path / "scene")
    parser = NerfstudioDataParserConfig(data=tmp_path / "scene", downscale_factor=1).setup()
    found = {
        split: [path.name for path in read_scene(parser, split).image_filenames] for split in ("train", "val", "test")
    }
    kept = ["photo_003.png"] if "./images/d.png" in held_out else []
    assert found == {"train": ["photo_000.png", "photo_002.png"], "val": kept, "test": []}


def test_a_folder_with_something_in_it_is_left_alone(tmp_path):
    write_photos(tmp_path / "photos")
    write_poses_bounds(tmp_path / "photos")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="is there already"):
        prepare_scene(tmp_path / "photos", tmp_path / "scene")
    assert [path.name for path in (tmp_path / "scene").iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("name", ["photos", "photos/inside", "photos/new/scene", "linked/inside"])
def test_a_scene_is_never_written_into_the_folder_of_the_photos(tmp_path, name):
    write_photos(tmp_path / "photos")
    write_poses_bounds(tmp_path / "photos")
    (tmp_path / "linked").symlink_to(tmp_path / "photos")
    (tmp_path / "photos-scene").touch()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "photos").rglob("*")}
    with pytest.raises(InputError, match=f"only read; take {tmp_path / 'photos-scene-2'} or another place outside"):
        prepare_scene(tmp_path / "photos", tmp_path / name)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "photos").rglob("*")} == before
    assert prepare_scene(tmp_path / "photos", tmp_path / "photos-scene-2").names


def test_a_place_that_cant_be_written_to_is_said_before_photos_are_read(tmp_path):
    (tmp_path / "photos").mkdir()  # without any
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"The scene can't be written to .* name another place with --output\."):
        prepare_scene(tmp_path / "photos", tmp_path / "file" / "scene")


def test_photos_without_a_frame_and_frames_without_a_photo_are_named(tmp_path, capsys):
    write_capture(tmp_path, write_ring(tmp_path))
    for old, new in (("2.png", "other.png"), ("4.png", "more.png")):
        (tmp_path / "images" / old).rename(tmp_path / "images" / new)
    assert len(prepare_scene(tmp_path, tmp_path.with_name("made")).names) == 4
    printed = capsys.readouterr().out
    assert "whose photos aren't there, and are left out: images/2.png, images/4.png\n" in printed
    assert "which are left out: more.png, other.png\n" in printed


def test_a_link_that_leads_nowhere_is_no_photo_that_one_passes_over(tmp_path):
    write_photos(tmp_path / "photos")
    (tmp_path / "photos" / "link.jpg").symlink_to("nowhere.jpg")
    with pytest.raises(InputError, match=r"link\.jpg is a link that leads nowhere; put the photo there"):
        prepare_scene(tmp_path / "photos", tmp_path / "scene")


def test_a_file_that_is_no_video_is_called_so(tmp_path):
    (tmp_path / "photo.jpg").touch()
    with pytest.raises(InputError, match=r"photo\.jpg is a file, and no video; name the folder"):
        prepare_scene(tmp_path / "photo.jpg", tmp_path / "scene")


def test_poses_are_asked_of_a_file_that_is_not_there(tmp_path):
    write_photos(tmp_path / "photos")
    with pytest.raises(InputError, match=r"Neither poses_bounds.npy nor transforms.json"):
        prepare_scene(tmp_path / "photos", tmp_path / "scene", "file")


def with_masks(folder, count=3, size=(WIDTH, HEIGHT)):
    """Gives the first photos of a capture a mask that leaves their upper left quarter in, beside a depth map."""
    (folder / "masks").mkdir()
    inside = np.zeros(size[::-1], np.uint8)
    inside[: size[1] // 2, : size[0] // 2] = 255
    for index in range(count):
        Image.fromarray(inside).save(folder / "masks" / f"{index}.png")

    def change(content):
        for index, frame in enumerate(content["frames"][:count]):
            frame.update(mask_path=f"masks/{index}.png", depth_file_path="depth.png")

    change_transforms(folder, change)


def test_masks_come_along_at_the_size_of_their_photos(tmp_path, capsys):
    names = write_photos(tmp_path / "photos")
    write_transforms(tmp_path / "photos", names)
    with_masks(tmp_path / "photos", count=2)
    narrow = photo(ASIDE[2]).crop((0, 60, WIDTH, HEIGHT)).resize((WIDTH // 2, (HEIGHT - 60) // 2))
    narrow.save(tmp_path / "photos" / names[2])  # so that the others are scaled by a half, and cropped
    change_transforms(tmp_path / "photos", lambda content: content["frames"][2].update(w=WIDTH, h=HEIGHT - 60, cy=100))
    prepare_scene(tmp_path / "photos", tmp_path / "scene")
    outputs = parse_nerfstudio(tmp_path / "scene")
    masks = [np.asarray(Image.open(path)) for path in outputs.mask_filenames]
    assert [path.stem for path in outputs.mask_filenames] == [path.stem for path in outputs.image_filenames]
    height, width = (HEIGHT - 60) // 2, WIDTH // 2
    assert all(mask.shape == (height, width) for mask in masks)
    expected = np.zeros((height, width), np.uint8)
    expected[: HEIGHT // 4 - 15, : width // 2] = 255  # 15 rows are cut off above, and 15 below
    np.testing.assert_array_equal(masks[0], expected)
    assert (masks[2] == 255).all()
    printed = capsys.readouterr().out
    assert f"Photos without a mask in {tmp_path / 'photos' / 'transforms.json'}, of which nothing is left" in printed
    assert "Left out of the scene, as they are for photos of the former size: depth_file_path" in printed
    assert all("depth_file_path" not in frame for frame in read_frames(tmp_path / "scene"))


def read_frames(folder):
    return json.loads((folder / "transforms.json").read_text())["frames"]


def test_a_mask_is_turned_with_its_photo(tmp_path):
    names = write_photos(tmp_path / "photos")
    write_transforms(tmp_path / "photos", names)
    for name in names:  # as stored they lie on their side, and the poses are for them upright
        path = tmp_path / "photos" / name
        save_with_orientation(Image.open(path).transpose(Image.Transpose.ROTATE_90), path, 6)
    with_masks(tmp_path / "photos", size=(HEIGHT, WIDTH))
    prepare_scene(tmp_path / "photos", tmp_path / "scene")
    mask = np.asarray(Image.open(tmp_path / "scene" / "masks" / "photo_000.png"))
    expected = np.zeros((HEIGHT, WIDTH), np.uint8)
    expected[: HEIGHT // 2, WIDTH // 2 :] = 255  # a quarter turn to the right
    np.testing.assert_array_equal(mask, expected)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda folder: (folder / "masks" / "1.png").unlink(), r"masks/1\.png doesn't fit .*isn't there: replace it"),
        (
            lambda folder: Image.new("L", (9, 9), 255).save(folder / "masks" / "1.png"),
            "it is 9x9 pixels, and the photo",
        ),
        (lambda folder: Image.new("L", (WIDTH, HEIGHT)).save(folder / "masks" / "1.png"), "leaves nothing of .* in:"),
        (
            lambda folder: change_transforms(folder, lambda content: content["frames"][1].update(mask_path=None)),
            r"Frame 1 \(from 0\) of .* has a mask_path that is no name: correct it or drop it",
        ),
    ],
)
def test_a_mask_that_cant_come_along_is_named(tmp_path, spoil, sentence):
    write_transforms(tmp_path / "photos", write_photos(tmp_path / "photos"))
    with_masks(tmp_path / "photos")
    spoil(tmp_path / "photos")
    with pytest.raises(InputError, match=sentence):
        prepare_scene(tmp_path / "photos", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_masks_whose_photos_nothing_names_are_said_to_have_no_use(tmp_path, capsys):
    write_photos(tmp_path / "photos")
    write_poses_bounds(tmp_path / "photos")
    (tmp_path / "photos" / "masks").mkdir()
    prepare_scene(tmp_path / "photos", tmp_path / "scene")
    assert f"Not used: {tmp_path / 'photos' / 'masks'}; a photo's mask is what" in capsys.readouterr().out

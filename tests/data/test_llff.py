"""LLFF folders, written here with cameras whose poses can be worked out by hand, and the real fern where it is."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from PIL import Image

from sparsestyle_ns.core.ndc import ndc_rays
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.scene_info import scene_info
from sparsestyle_ns.utils.errors import InputError

DATA = Path(os.environ.get("SPARSESTYLE_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
FERN = DATA / "llff" / "fern"

WIDTH, HEIGHT, FOCAL = 64, 48, 80.0
"""Full size of the tiny scenes; at 1/8 that is 8x6 pixels and a focal length of 10."""


def pose_row(position=(0.0, 0.0, 0.0), rotation=None, bounds=(4.0, 20.0), size=(HEIGHT, WIDTH, FOCAL)):
    """A row of poses_bounds.npy for a camera whose rotation has the columns right, up, back (default: the axes)."""
    right, up, back = (np.eye(3) if rotation is None else np.asarray(rotation)).T
    matrix = np.stack([-up, right, back, np.asarray(position), np.asarray(size)], axis=1)
    return np.concatenate([matrix.ravel(), bounds])


def line_of_cameras(count):
    """Cameras side by side, a tenth apart, looking along -z."""
    return np.stack([pose_row((0.1 * i, 0.0, 0.0)) for i in range(count)])


def write_images(folder, count, size=(8, 6), suffix=".png"):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        Image.new("RGB", size, (i, 100, 200)).save(folder / f"view{i:03d}{suffix}")


@pytest.fixture
def scene(tmp_path):
    """Writes an LLFF folder and returns it."""

    def write(rows=None, count=None, folders=("images_8",), size=(8, 6)):
        rows = line_of_cameras(count or 3) if rows is None else rows
        np.save(tmp_path / "poses_bounds.npy", rows)
        for folder in folders:
            write_images(tmp_path / folder, len(rows) if count is None else count, size)
        return tmp_path

    return write


def parse(data, split="train", **settings):
    return LLFFDataParserConfig(data=data, **settings).setup().get_dataparser_outputs(split)


def view_ids(outputs):
    return list(scene_info(outputs).view_ids)


def view_names(outputs):
    return [path.name for path in outputs.image_filenames]


def error_of(data, **settings):
    """The message of the InputError, after seeing that it is one sentence."""
    with pytest.raises(InputError) as caught:
        parse(data, **settings)
    message = str(caught.value)
    assert message.endswith(".") and "\n" not in message and ". " not in message
    return message


def rotation_about(axis, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array({"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}[axis])


# Poses and bounds


def test_two_cameras_worked_out_by_hand(scene):
    # Mean position (4, 5, 7); one unit is 0.75 * the smallest near bound 4 = 3.
    data = scene(np.stack([pose_row((3, 5, 7), bounds=(4, 20)), pose_row((5, 5, 7), bounds=(6, 30))]))
    outputs = parse(data)
    expected = torch.eye(3, 4).repeat(2, 1, 1)
    expected[:, 0, 3] = torch.tensor([-1 / 3, 1 / 3])
    torch.testing.assert_close(outputs.cameras.camera_to_worlds, expected)
    assert scene_info(outputs).ndc.depth_range == pytest.approx((0.9 * 4 / 3, 1.1 * 10.0))  # with a margin of 10%
    assert outputs.dataparser_scale == pytest.approx(1 / 3)
    torch.testing.assert_close(
        outputs.dataparser_transform, torch.tensor([[1.0, 0, 0, -4], [0, 1, 0, -5], [0, 0, 1, -7]])
    )


def test_columns_down_right_back_become_right_up_back(scene):
    # Two cameras turned 20 degrees to the left and to the right: the average looks straight on.
    rows = np.stack([pose_row(rotation=rotation_about("y", angle)) for angle in (20, -20)])
    rotations = parse(scene(rows)).cameras.camera_to_worlds[:, :, :3]
    expected = np.stack([rotation_about("y", 20), rotation_about("y", -20)])
    torch.testing.assert_close(rotations, torch.from_numpy(expected).float())


def turned_and_moved_rows():
    world = rotation_about("y", 130) @ rotation_about("x", -35)
    generator = np.random.default_rng(0)
    rows = []
    for _ in range(6):
        tilt = rotation_about("y", generator.uniform(-8, 8)) @ rotation_about("x", generator.uniform(-8, 8))
        position = world @ generator.uniform(-0.5, 0.5, size=3) + np.array([10.0, -20.0, 30.0])
        rows.append(pose_row(position, world @ tilt, bounds=(generator.uniform(3, 5), 40.0)))
    return np.stack(rows)


def test_the_recentred_average_camera_is_the_identity(scene):
    cameras = parse(scene(turned_and_moved_rows())).cameras.camera_to_worlds
    mean = cameras.mean(0)
    torch.testing.assert_close(mean[:, 3], torch.zeros(3), atol=1e-6, rtol=0)
    torch.testing.assert_close(mean[:, 2] / mean[:, 2].norm(), torch.tensor([0.0, 0.0, 1.0]), atol=1e-6, rtol=0)
    # The mean up vector need not be orthogonal to the mean back vector, but it leans neither left nor right.
    assert abs(mean[0, 1]) < 1e-6 and mean[1, 1] > 0


def test_where_the_rig_stands_in_the_file_does_not_matter(scene):
    rows = turned_and_moved_rows()
    before = parse(scene(rows)).cameras.camera_to_worlds
    turn = rotation_about("x", 70) @ rotation_about("y", 25)
    matrices = rows[:, :15].reshape(-1, 3, 5)
    matrices[..., :4] = turn @ matrices[..., :4]
    matrices[..., 3] += np.array([-3.0, 8.0, 1.0])
    after = parse(scene(rows)).cameras.camera_to_worlds
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)


def test_poses_lead_back_to_those_of_the_file(scene):
    rows = turned_and_moved_rows()
    outputs = parse(scene(rows))
    original = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, camera_convention="opengl")
    matrices = torch.from_numpy(rows[:, :15].reshape(-1, 3, 5)).float()
    expected = torch.stack([matrices[..., 1], -matrices[..., 0], matrices[..., 2], matrices[..., 3]], dim=-1)
    # The positions are some tens of units from the file's origin, so float32 keeps about five decimals.
    torch.testing.assert_close(original, expected, atol=1e-4, rtol=0)


def test_bound_scale_sets_the_unit(scene):
    data = scene()
    for settings, nearest in (({}, 1 / 0.75), ({"bound_scale": 0.5}, 2.0)):
        assert scene_info(parse(data, **settings)).ndc.depth_range[0] == pytest.approx(0.9 * nearest)


def test_both_splits_live_in_the_same_world(scene):
    # The smallest near bound is that of a held-out view, and it sets the unit of both splits.
    rows = line_of_cameras(10)
    rows[8, 15] = 2.0
    data = scene(rows)
    train, test = parse(data, "train"), parse(data, "test")
    assert train.dataparser_scale == test.dataparser_scale == pytest.approx(1 / 1.5)
    assert torch.equal(train.dataparser_transform, test.dataparser_transform)
    assert torch.equal(train.scene_box.aabb, test.scene_box.aabb)


# Intrinsics and NDC


def test_intrinsics_follow_the_images_on_disk(scene):
    cameras = parse(scene()).cameras
    assert (cameras.camera_type == CameraType.PERSPECTIVE.value).all()
    assert cameras.width.flatten().tolist() == [8, 8, 8] and cameras.height.flatten().tolist() == [6, 6, 6]
    assert cameras.fx.flatten().tolist() == cameras.fy.flatten().tolist() == [10.0, 10.0, 10.0]
    assert (cameras.cx == 4).all() and (cameras.cy == 3).all()


def test_a_size_rounded_to_whole_pixels_is_accepted(scene):
    rows = np.stack([pose_row((0.1 * i, 0, 0), size=(755, 1008, 900.0)) for i in range(2)])  # 755 / 8 = 94.375
    for size in ((126, 94), (126, 95)):
        assert parse(scene(rows, size=size)).cameras.fx[0].item() == pytest.approx(900 / 8)


def test_metadata_tells_the_model_how_to_map_rays_to_ndc(scene):
    ndc = scene_info(parse(scene())).ndc
    assert ndc.near == 1.0
    assert ndc.focal_over_half_size == pytest.approx((20 / 8, 20 / 6))


def test_the_scene_box_of_one_camera_is_the_ndc_cube_with_a_margin(scene):
    # x and y are in [-1, 1], 2 wide, and 5% of that are 0.1.
    aabb = parse(scene(count=1)).scene_box.aabb
    torch.testing.assert_close(aabb, torch.tensor([[-1.1, -1.1, -1.0], [1.1, 1.1, 1.0]]))


def test_the_scene_box_of_two_cameras_worked_out_by_hand(scene):
    # Cameras at x = -1/3 and 1/3: on the near plane they see [-1, 1] shifted by 2f/w * 1/3 = 2.5/3 either way, and at
    # infinity [-1, 1]. So x reaches 1 + 2.5/3 = 11/6, the width is 11/3, and 5% of it are 11/60.
    aabb = parse(scene(np.stack([pose_row((-1, 0, 0)), pose_row((1, 0, 0))]))).scene_box.aabb
    x = 11 / 6 + 11 / 60
    torch.testing.assert_close(aabb, torch.tensor([[-x, -1.1, -1.0], [x, 1.1, 1.0]]))


@pytest.mark.parametrize("split", ["train", "test"])
def test_every_pixel_of_every_view_stays_inside_the_scene_box(scene, split):
    rows = np.concatenate([turned_and_moved_rows(), turned_and_moved_rows()[:4]])
    outputs = parse(scene(rows), split)
    rays = outputs.cameras.generate_rays(camera_indices=torch.arange(len(outputs.cameras))[:, None])
    ndc = scene_info(outputs).ndc
    origins, directions, valid = ndc_rays(rays.origins, rays.directions, ndc.focal_over_half_size, ndc.near)
    assert valid.all()
    t = torch.linspace(0, 1, 9)[:, None]
    points = origins[..., None, :] + t * directions[..., None, :]
    low, high = outputs.scene_box.aabb
    # z reaches exactly -1 and, after rounding, 1.
    assert (points >= low - 1e-6).all() and (points <= high + 1e-6).all()


# Splits


@pytest.mark.parametrize("split", ["val", "test"])
def test_every_eighth_of_twenty_images_is_held_out(scene, split):
    data = scene(count=20)
    held_out, train = parse(data, split), parse(data, "train")
    assert view_ids(held_out) == [0, 8, 16]
    assert view_ids(train) == [i for i in range(20) if i not in (0, 8, 16)]
    assert view_names(held_out) == ["view000.png", "view008.png", "view016.png"]
    assert len(held_out.cameras) == 3 and len(train.cameras) == 17


def test_cameras_belong_to_the_images_of_the_split(scene):
    outputs = parse(scene(count=20), "test")
    # Cameras a tenth apart, centred about 0.95, with one unit of 0.75 * 4 = 3.
    x = (torch.tensor([0.0, 0.8, 1.6]) - 0.95) / 3
    torch.testing.assert_close(outputs.cameras.camera_to_worlds[:, 0, 3], x)


def test_eval_interval_sets_how_many_are_held_out(scene):
    data = scene(count=8)
    assert view_ids(parse(data, "test", eval_interval=4)) == [0, 4]
    assert view_ids(parse(data, "train", eval_interval=4)) == [1, 2, 3, 5, 6, 7]


@pytest.mark.parametrize("count", [1, 3, 8])
def test_a_folder_of_at_most_eight_photos_is_trained_and_evaluated_on_all_and_says_so(scene, count, capsys):
    data = scene(count=count)
    assert view_ids(parse(data, "train")) == list(range(count))
    assert "too few" not in capsys.readouterr().out
    assert view_ids(parse(data, "test")) == list(range(count))
    assert "too few" in capsys.readouterr().out


def test_an_unknown_split_is_a_programming_error(scene):
    with pytest.raises(ValueError, match="train, val or test"):
        parse(scene(), "holdout")


# Image folders


@pytest.mark.parametrize(
    "folders, settings, chosen",
    [
        (("images", "images_4", "images_8"), {}, "images_8"),
        (("images", "images_4"), {}, "images_4"),
        (("images", "images_2"), {}, "images"),
        (("images", "images_4", "images_8"), {"downscale_factor": 4}, "images_4"),
        (("images", "images_8"), {"downscale_factor": 1}, "images"),
        (("images_2", "images_8"), {"downscale_factor": 2}, "images_2"),
    ],
)
def test_which_image_folder_is_read(scene, folders, settings, chosen):
    outputs = parse(scene(folders=folders), **settings)
    assert {path.parent.name for path in outputs.image_filenames} == {chosen}


def test_images_come_sorted_whatever_their_suffix_and_other_files_are_passed_over(scene):
    data = scene(count=3, folders=())
    folder = data / "images"
    folder.mkdir()
    for name in ("c.JPG", "a.png", "b.jpeg", "._a.png"):
        Image.new("RGB", (8, 6)).save(folder / name, format="PNG" if name.endswith("png") else "JPEG")
    (folder / "notes.txt").write_text("not an image")
    assert view_names(parse(data)) == ["a.png", "b.jpeg", "c.JPG"]


# What cannot be used


def test_a_missing_folder_is_named(tmp_path):
    assert str(tmp_path / "nowhere") in error_of(tmp_path / "nowhere")


def test_a_folder_without_poses_says_what_an_llff_folder_needs(tmp_path):
    message = error_of(tmp_path)
    assert "no poses_bounds.npy" in message and "images_8" in message and "transforms" not in message


@pytest.mark.parametrize(
    "file, parser", [("transforms_train.json", "blender-data"), ("transforms.json", "nerfstudio-data")]
)
def test_a_folder_of_another_kind_names_its_dataparser(tmp_path, file, parser):
    (tmp_path / file).write_text("{}")
    assert f"{file}, which {parser} reads" in error_of(tmp_path)


@pytest.mark.parametrize("kind", ["text", "empty", "truncated", "pickle", "npz", "folder"])
def test_poses_that_are_no_array_of_numbers_are_refused(scene, kind):
    data = scene()
    path = data / "poses_bounds.npy"
    whole = path.read_bytes()
    path.unlink()
    if kind == "text":
        path.write_text("0 1 2 3\n")
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "truncated":
        path.write_bytes(whole[:-40])
    elif kind == "pickle":
        np.save(path, np.array([{"pose": 1}], dtype=object), allow_pickle=True)
    elif kind == "npz":
        with path.open("wb") as file:
            np.savez(file, poses=np.zeros((3, 17)))
    else:
        path.mkdir()
    message = error_of(data)
    assert str(path) in message
    assert "cannot be read as an array of numbers" in message or "not one array of real numbers" in message


@pytest.mark.parametrize("shape", [(3, 15), (17,), (0, 17), (3, 3, 5)])
def test_poses_of_another_shape_are_refused_with_their_shape(scene, shape):
    data = scene()
    np.save(data / "poses_bounds.npy", np.zeros(shape))
    assert str(shape) in error_of(data)


def test_poses_of_text_or_complex_numbers_are_refused(scene):
    data = scene()
    for array in (np.full((3, 17), "1.0"), np.zeros((3, 17), dtype=complex)):
        np.save(data / "poses_bounds.npy", array)
        assert "not one array of real numbers" in error_of(data)


@pytest.mark.parametrize(
    "column, value, fault",
    [
        (3, np.nan, "not finite"),
        (16, np.inf, "not finite"),
        (4, 0.0, "image size"),
        (14, 0.0, "focal length"),
        (14, -80.0, "focal length"),
        (15, 0.0, "near bound that is not above 0"),
        (15, -1.0, "near bound that is not above 0"),
        (16, 4.0, "not below its far bound"),
        (0, 0.5, "not a rotation"),
        (6, 1.0, "not a rotation"),
    ],
)
def test_a_row_that_describes_no_camera_is_named(scene, column, value, fault):
    rows = line_of_cameras(3)
    rows[1, column] = value
    message = error_of(scene(rows))
    assert message.startswith("Row 1 ") and fault in message


def test_a_mirrored_camera_is_refused(scene):
    rows = line_of_cameras(3)
    rows[2, [0, 5, 10]] *= -1  # the down vector
    assert "not a rotation" in error_of(scene(rows))


def test_missing_image_folders_are_named_with_those_that_are_there(scene):
    message = error_of(scene(folders=()))
    assert "no folder images_8 or images_4 or images" in message and "put the photos into images" in message
    message = error_of(scene(folders=("images_2",)))
    assert "choose from images_2 with --downscale-factor" in message
    message = error_of(scene(folders=("images_2",)), downscale_factor=16)
    assert "no folder images_16" in message


def test_an_empty_image_folder_is_named(scene):
    data = scene(folders=())
    (data / "images_8").mkdir()
    message = error_of(data)
    assert str(data / "images_8") in message and "no .jpg, .jpeg or .png image" in message


def test_too_few_images_are_counted(scene):
    data = scene(line_of_cameras(3), count=2)
    message = error_of(data)
    assert f"{data / 'images_8'} has 2 images" in message and "has 3 poses" in message


def test_an_image_of_another_size_is_named_with_both_sizes(scene):
    data = scene()
    odd = data / "images_8" / "view000.png"
    Image.new("RGB", (16, 12)).save(odd)
    message = error_of(data)
    assert message.startswith(f"{odd} is 16x12 pixels") and "8x6" in message


def test_images_of_another_aspect_than_the_poses_are_refused_with_both_sizes(scene):
    message = error_of(scene(size=(60, 80)))
    assert "view000.png is 60x80 pixels" in message and "64x48" in message


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_image_that_is_cut_short_is_named(tmp_path, suffix):
    np.save(tmp_path / "poses_bounds.npy", line_of_cameras(3))
    write_images(tmp_path / "images_8", 3, size=(64, 48), suffix=suffix)
    noise = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    path = tmp_path / "images_8" / f"view001{suffix}"
    Image.fromarray(noise).save(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    message = error_of(tmp_path)
    assert str(path) in message and "cannot be read as an image" in message


def test_a_file_that_is_no_image_is_named(scene):
    data = scene()
    (data / "images_8" / "view001.png").write_text("<html>404</html>")
    assert "view001.png cannot be read as an image" in error_of(data)


@pytest.mark.parametrize("mode", ["P", "I;16", "LA"])
def test_pixels_that_nerfstudio_would_misread_are_refused(scene, mode):
    data = scene()
    Image.new(mode, (8, 6)).save(data / "images_8" / "view002.png")
    message = error_of(data)
    assert "view002.png" in message and mode in message and "8-bit RGB" in message


def test_cameras_that_face_each_other_are_sent_to_another_dataparser(scene):
    rows = np.stack([pose_row(), pose_row(rotation=rotation_about("y", 180))])
    assert "nerfstudio-data" in error_of(scene(rows))


def test_a_camera_that_looks_far_aside_is_named(scene):
    rows = np.stack([pose_row() for _ in range(5)] + [pose_row(rotation=rotation_about("y", 95))])
    message = error_of(scene(rows))
    assert "view005.png looks too far aside" in message


@pytest.mark.parametrize(
    "settings, flag",
    [
        ({"eval_interval": 1}, "--eval-interval 1"),
        ({"eval_interval": 0}, "--eval-interval 0"),
        ({"bound_scale": 0.0}, "--bound-scale 0.0"),
        ({"bound_scale": float("nan")}, "--bound-scale nan"),
        ({"bound_scale": float("inf")}, "--bound-scale inf"),
        ({"downscale_factor": 0}, "--downscale-factor 0"),
    ],
)
def test_a_setting_out_of_range_is_named(scene, settings, flag):
    assert flag in error_of(scene(), **settings)


# The registry and the real scene


def test_nerfstudio_finds_llff_data_without_a_circular_import():
    """In a fresh process, as `ns-train` does: the specification first, then the registry of dataparsers."""
    code = """
import sys
import sparsestyle_ns.data.llff
heavy = ("nerfstudio.data.datamanagers", "nerfstudio.pipelines", "nerfstudio.engine", "nerfstudio.models")
loaded = [name for name in sys.modules if name.startswith(heavy)]
assert not loaded, loaded
from nerfstudio.configs.dataparser_configs import all_dataparsers
print(type(all_dataparsers["llff-data"]).__name__)
"""
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.split()[-1] == "LLFFDataParserConfig"


@pytest.mark.skipif(not FERN.is_dir(), reason=f"{DATA} has no llff/fern; set SPARSESTYLE_DATA")
def test_the_real_fern():
    train, test = parse(FERN, "train"), parse(FERN, "test")
    assert view_ids(test) == [0, 8, 16] and len(train.image_filenames) == 17
    for outputs in (train, test):
        torch.testing.assert_close(outputs.cameras.fx, torch.full_like(outputs.cameras.fx, 3260.5263 / 8))
        assert (outputs.cameras.width == 504).all() and (outputs.cameras.height == 378).all()
        rotations = outputs.cameras.camera_to_worlds[:, :, :3]
        # All cameras look forward, with up about upwards.
        assert (rotations[:, 2, 2] > 0.9).all() and (rotations[:, 1, 1] > 0.9).all()
    assert scene_info(train).ndc == scene_info(test).ndc
    assert scene_info(train).ndc.depth_range[0] == pytest.approx(0.9 / 0.75)
    low, high = train.scene_box.aabb
    assert (low[:2] > -2.5).all() and (low[:2] < -1).all() and (high[:2] > 1).all() and (high[:2] < 2.5).all()

"""Whatever is in the files of a scene, reading them ends in success or in an `InputError`, never in another error."""

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard.table import hard_case
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from test_commands import write_ring, write_transforms

from sparsestyle_ns.data.llff import LLFFDataParserConfig, read_poses_bounds
from sparsestyle_ns.data.photos import open_photo, photo_size
from sparsestyle_ns.data.view_selection import select_views
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.prepare.framing import frame_photos
from sparsestyle_ns.prepare.poses import TransformsPoses, fits
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError

FUZZ = settings(
    derandomize=True,
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
CUTS = st.tuples(st.integers(0, 1 << 16), st.integers(0, 255), st.sampled_from(["change", "cut", "insert", "drop"]))


def damaged(data: bytes, cuts: list) -> bytes:
    """Bytes with a few places changed, cut off, inserted or dropped."""
    found = bytearray(data)
    for place, value, action in cuts:
        place %= max(1, len(found))
        if action == "change" and found:
            found[place] = value
        elif action == "cut":
            del found[place:]
        elif action == "insert":
            found[place:place] = bytes([value]) * 3
        else:
            del found[place : place + 7]
    return bytes(found)


def read_or_refuse(read: Any, *arguments: Any) -> None:
    """Calls a reader; an `InputError` must be one sentence, and no other error may come out."""
    try:
        read(*arguments)
    except InputError as error:
        assert len(str(error)) > 20
        assert "\n" not in str(error)


def load_scene(folder: Path, parser: Any) -> None:
    config = FewShotDataManagerConfig(data=folder, dataparser=parser)
    config.setup(device="cpu", test_mode="val").load_pixels()


@pytest.fixture()
def llff_copy(llff_scene: Path, tmp_path: Path) -> Path:
    return shutil.copytree(llff_scene, tmp_path / "llff")


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A nerfstudio capture and, of the same photos, a Blender scene."""
    folder = tmp_path_factory.mktemp("ring")
    poses = write_ring(folder)
    write_transforms(folder, poses)
    frames = [{"file_path": f"./images/{i}", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    for split in ("train", "val", "test"):
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.9, "frames": frames}))
    return folder


@hard_case(
    "files",
    case="poses_bounds.npy with bytes changed, cut off or inserted",
    could_go_wrong="a traceback out of numpy, or memory for an array of a header's imagination",
    must_hold="read, or refused in one sentence",
)
@FUZZ
@given(cuts=st.lists(CUTS, min_size=1, max_size=6))
def test_damaged_poses_are_read_or_refused(llff_copy: Path, cuts: list) -> None:
    path = llff_copy / "poses_bounds.npy"
    original = path.with_name("original")
    if not original.exists():
        original.write_bytes(path.read_bytes())
    path.write_bytes(damaged(original.read_bytes(), cuts))
    read_or_refuse(read_poses_bounds, llff_copy)


@hard_case(
    "files",
    case="poses_bounds.npy of any shape and type, with any numbers in it",
    could_go_wrong="NaN, infinite, huge or singular poses become cameras",
    must_hold="refused in one sentence, or the cameras are finite",
)
@FUZZ
@given(
    rows=arrays.arrays(
        st.sampled_from([np.float64, np.float32, np.float16, np.int64, np.uint8, np.bool_, np.complex64]),
        st.one_of(st.just((12, 17)), arrays.array_shapes(min_dims=0, max_dims=3, max_side=18)),
    )
)
def test_any_array_of_poses_is_read_or_refused(llff_copy: Path, rows: np.ndarray) -> None:
    np.save(llff_copy / "poses_bounds.npy", rows)
    read_or_refuse(load_scene, llff_copy, LLFFDataParserConfig())


@hard_case(
    "files",
    case="poses_bounds.npy of true poses with one number replaced by an extreme one",
    could_go_wrong="an overflow in recentring or scaling, found much later as NaN",
    must_hold="refused in one sentence, or all rays are finite",
)
@FUZZ
@given(place=st.integers(0, 12 * 17 - 1), value=st.floats(allow_nan=True, allow_infinity=True))
def test_one_extreme_number_in_the_poses_is_refused_or_gives_finite_rays(llff_copy, llff_scene, place, value):
    rows = np.load(llff_scene / "poses_bounds.npy")
    rows.flat[place] = value
    np.save(llff_copy / "poses_bounds.npy", rows)
    config = FewShotDataManagerConfig(data=llff_copy, dataparser=LLFFDataParserConfig())
    try:
        manager = config.setup(device="cpu", test_mode="val")
        manager.load_pixels()
    except InputError:
        return
    assert manager.pixels.origins.isfinite().all()
    assert manager.pixels.directions.isfinite().all()


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=12,
)
PLACES = st.sampled_from(
    [
        ("frames",),
        ("camera_angle_x",),
        ("fl_x",),
        ("cx",),
        ("w",),
        ("h",),
        ("camera_model",),
        ("k1",),
        ("distortion_params",),
        ("train_filenames",),
        ("frames", 1),
        ("frames", 0, "file_path"),
        ("frames", 2, "transform_matrix"),
        ("frames", 2, "transform_matrix", 0),
        ("frames", 2, "transform_matrix", 1, 2),
        ("frames", 0, "transform_matrix", 2, 3),
    ]
)


def replaced(content: Any, place: tuple, value: Any) -> Any:
    """A JSON document with one value, where there is such a place, replaced."""
    content = json.loads(json.dumps(content))
    part = content
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    return content


@hard_case(
    "files",
    case="transforms.json and transforms_train.json with anything in place of what belongs there",
    could_go_wrong="KeyError, TypeError and a dozen others out of nerfstudio's parsers, or cameras of NaN",
    must_hold="read, or refused in one sentence; rays are finite",
)
@FUZZ
@given(place=PLACES, value=VALUES, blender=st.booleans())
def test_transforms_with_strange_values_are_read_or_refused(ring, tmp_path, place, value, blender):
    folder = tmp_path / "scene"
    if not folder.exists():
        shutil.copytree(ring, folder)
    name = "transforms_train.json" if blender else "transforms.json"
    (folder / name).write_text(json.dumps(replaced(json.loads((ring / name).read_text()), place, value)))
    parser = BlenderDataParserConfig() if blender else NerfstudioDataParserConfig(downscale_factor=1)
    try:
        manager = FewShotDataManagerConfig(data=folder, dataparser=parser).setup(device="cpu", test_mode="val")
        manager.load_pixels()
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert manager.pixels.origins.isfinite().all()
    assert manager.pixels.directions.isfinite().all()


@hard_case(
    "files",
    case="transforms.json with bytes changed, cut off or inserted",
    could_go_wrong="a JSONDecodeError, UnicodeDecodeError or RecursionError",
    must_hold="read, or refused in one sentence",
)
@FUZZ
@given(cuts=st.lists(CUTS, min_size=1, max_size=6), blender=st.booleans())
def test_damaged_transforms_are_read_or_refused(ring, tmp_path, cuts, blender):
    folder = tmp_path / "scene"
    if not folder.exists():
        shutil.copytree(ring, folder)
    name = "transforms_train.json" if blender else "transforms.json"
    (folder / name).write_bytes(damaged((ring / name).read_bytes(), cuts))
    parser = BlenderDataParserConfig() if blender else NerfstudioDataParserConfig(downscale_factor=1)
    read_or_refuse(load_scene, folder, parser)


@hard_case(
    "files",
    case="transforms.json beside photos that are to be prepared, with anything in place of what belongs there",
    could_go_wrong="a TypeError, KeyError or ZeroDivisionError, or intrinsics that are no numbers in the new file",
    must_hold="refused in one sentence, or every new frame has finite intrinsics and its photo's name",
)
@FUZZ
@given(place=PLACES, value=VALUES)
def test_transforms_with_strange_values_are_prepared_or_refused(ring, tmp_path, place, value):
    content = replaced(json.loads((ring / "transforms.json").read_text()), place, value)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    try:
        poses = TransformsPoses(tmp_path / "transforms.json")
        photos = poses.photos(sorted((ring / "images").iterdir()))
        size = photo_size(photos[0])
        if not all(poses.size(index) is None or fits(size, poses.size(index)) for index in range(len(photos))):
            return
        names = [path.name for path in photos]
        (tmp_path / "scene").mkdir(exist_ok=True)
        poses.write(tmp_path / "scene", names, frame_photos([size] * len(photos)))
    except InputError as error:
        assert "\n" not in str(error)
        return
    frames = json.loads((tmp_path / "scene" / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"images/{name}" for name in names]
    assert np.isfinite([[frame[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")] for frame in frames]).all()


def test_deeply_nested_json_is_refused(ring, tmp_path):
    folder = shutil.copytree(ring, tmp_path / "scene")
    (folder / "transforms_train.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="can't be read as JSON"):
        load_scene(folder, BlenderDataParserConfig())


def encoded(kind: str, mode: str) -> bytes:
    noise = np.random.default_rng(0).integers(0, 256, (20, 24, 4), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).convert(mode).save(buffer, format=kind)
    return buffer.getvalue()


IMAGES = {
    (kind, mode): encoded(kind, mode)
    for kind, mode in [("PNG", "RGB"), ("PNG", "RGBA"), ("PNG", "P"), ("JPEG", "RGB"), ("WEBP", "RGB"), ("TIFF", "F")]
}


@hard_case(
    "files",
    case="photos and paintings, PNG, JPEG, WebP and TIFF, with bytes changed, cut off or inserted",
    could_go_wrong="one of the many errors that decoders raise, or numbers that aren't in [0, 1]",
    must_hold="read, with finite colours in [0, 1], or refused in one sentence",
)
@FUZZ
@given(image=st.sampled_from(sorted(IMAGES)), cuts=st.lists(CUTS, max_size=6))
def test_damaged_images_are_read_or_refused(tmp_path, image, cuts):
    path = tmp_path / "image.png"
    path.write_bytes(damaged(IMAGES[image], cuts))
    read_or_refuse(open_photo, path)
    try:
        picture = Painting.read(path).pixels
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert picture.isfinite().all()
    assert picture.min() >= 0 and picture.max() <= 1


@hard_case(
    "files",
    case="--num-views and --view-ids with any numbers",
    could_go_wrong="an IndexError, no view at all, or one view twice",
    must_hold="different views that exist, as many as asked for, or one sentence",
)
@FUZZ
@given(
    count=st.integers(0, 30),
    num_views=st.none() | st.integers(-3, 40),
    view_ids=st.none() | st.lists(st.integers(-2, 32), max_size=6),
    standard=st.none() | st.lists(st.integers(0, 40), max_size=8),
)
def test_any_choice_of_views_is_met_or_refused(count, num_views, view_ids, standard):
    available = list(range(count))
    try:
        chosen = select_views(available, num_views, view_ids, standard=standard)
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert len(set(chosen)) == len(chosen) >= 1
    assert all(0 <= position < count for position in chosen)
    if view_ids is not None:
        assert [available[position] for position in chosen] == view_ids
    elif num_views is not None:
        assert len(chosen) == num_views

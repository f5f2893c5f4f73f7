"""Poses from the photos alone: how near to the known ones they are, what is written with them, and how it is read."""

import json
import os
import shutil
from pathlib import Path

import make_sample_scene
import numpy as np
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import ExifTags, Image
from true_poses import degrees_off

from sparsestyle_ns.data.llff import LLFFDataParserConfig, read_poses_bounds
from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.data.scene_info import scene_info
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.effects.matched_depth import triangulate
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.prepare.prepare_scene import prepare_scene

FERN = Path(os.environ.get("SPARSESTYLE_DATA", "data")) / "llff" / "fern"
SPLITS = {3: (1, 10, 19), 5: (1, 6, 10, 14, 19), 8: (1, 3, 6, 9, 11, 14, 17, 19)}
"""Photos of a scene of twenty, by how many are taken."""


@pytest.fixture(scope="session")
def sample(tmp_path_factory):
    """Twenty photos of the still life at 400 pixels across, with their poses."""
    folder = tmp_path_factory.mktemp("sample")
    make_sample_scene.main([str(folder), "--layout", "llff", "--width", "400", "--supersample", "1"])
    return folder / "llff"


def copy_photos(source: Path, target: Path, chosen, images: str = "images") -> Path:
    """Some photos of a scene without their poses."""
    target.mkdir()
    for index, path in enumerate(sorted((source / images).iterdir())):
        if index in chosen:
            shutil.copy(path, target / path.name)
    return target


def write_focal(folder: Path, equivalent: float) -> None:
    """Gives photos the focal length of 35 mm film in EXIF."""
    for path in sorted(folder.iterdir()):
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = "Pocket"
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = round(equivalent)
        Image.open(path).save(path, exif=exif)


def errors(scene: Path, source: Path, chosen) -> dict:
    """Of an LLFF scene's cameras against those of the scene that its photos are from."""
    found, known = read_poses_bounds(scene), read_poses_bounds(source)
    widths = (cameras.full_sizes[0, 0] for cameras in (found, known))
    focals = [cameras.focals[0] / width for cameras, width in zip((found, known), widths, strict=True)]
    poses = known.camera_to_worlds[list(chosen)].numpy()
    return {**degrees_off(found.camera_to_worlds.numpy(), poses), "focal": float(focals[0] / focals[1] - 1.0)}


@pytest.mark.parametrize("count", [3, 5, pytest.param(8, marks=pytest.mark.slow)])
@pytest.mark.parametrize("with_exif", [False, True])
def test_sample_photos_are_placed_where_they_were_taken(tmp_path, sample, count, with_exif):
    photos = copy_photos(sample, tmp_path / "photos", SPLITS[count])
    if with_exif:
        write_focal(photos, 0.85 * 0.8 * 43.27)  # 4:3, whose width is 0.8 of the diagonal
    scene = prepare_scene(photos, tmp_path / "scene")
    assert (scene.parser, len(scene.names)) == ("llff-data", count)
    off = errors(tmp_path / "scene", sample, SPLITS[count])
    assert off["rotation"] < 0.5
    assert off["translation"] < 3.0
    assert abs(off["focal"]) < (0.03 if with_exif else 0.12)


@pytest.mark.skipif(not FERN.is_dir(), reason="fern isn't below SPARSESTYLE_DATA")
@pytest.mark.parametrize("count", [3, 5, pytest.param(8, marks=pytest.mark.slow)])
def test_fern_is_placed_as_it_is_known(tmp_path, count):
    """Its known poses are themselves found from photos, and its lens is not quite straight."""
    photos = copy_photos(FERN, tmp_path / "photos", SPLITS[count], "images_8")
    scene = prepare_scene(photos, tmp_path / "scene")
    assert (scene.parser, len(scene.names)) == ("llff-data", count)
    off = errors(tmp_path / "scene", FERN, SPLITS[count])
    assert off["rotation"] < 1.5
    assert off["translation"] < 4.0
    assert abs(off["focal"]) < 0.12


@pytest.fixture(scope="session")
def prepared(tmp_path_factory, sample):
    """A scene of three photos of the still life, without their poses."""
    folder = tmp_path_factory.mktemp("prepared")
    prepare_scene(copy_photos(sample, folder / "photos", SPLITS[3]), folder / "scene")
    return folder / "scene"


def test_the_scene_says_that_its_poses_are_estimated(prepared):
    assert json.loads((prepared / "transforms.json").read_text())["poses_estimated"] is True
    for config in (LLFFDataParserConfig(data=prepared), NerfstudioDataParserConfig(data=prepared, downscale_factor=1)):
        assert scene_info(read_scene(config.setup())).poses_estimated


def test_a_scene_with_known_poses_does_not_say_so(sample):
    info = scene_info(read_scene(LLFFDataParserConfig(data=sample).setup()))
    assert (info.poses_estimated, info.tracks) == (False, None)


def test_cameras_that_face_one_way_get_ndc_and_bounds_about_what_they_see(prepared, sample):
    scene = Scene(read_scene(LLFFDataParserConfig(data=prepared).setup()))
    assert decide(scene, EffectSettings()).on("ndc")
    near, far = read_poses_bounds(prepared).bounds.numpy().T
    true_near, true_far = read_poses_bounds(sample).bounds.numpy()[list(SPLITS[3])].T
    moves = [
        np.linalg.norm(np.ptp(read_poses_bounds(folder).camera_to_worlds.numpy()[rows, :, 3], axis=0))
        for folder, rows in ((prepared, [0, 1, 2]), (sample, list(SPLITS[3])))
    ]
    scale = moves[1] / moves[0]
    assert ((0.6 * true_near < scale * near) & (scale * near < 1.3 * true_near)).all()
    assert ((0.7 * true_far < scale * far) & (scale * far < 1.5 * true_far)).all()


def test_depths_come_from_the_tracks_that_the_poses_do(prepared):
    outputs = read_scene(LLFFDataParserConfig(data=prepared).setup())
    tracks, rays = scene_info(outputs).tracks, triangulate(Scene(outputs))
    pairs = sum(
        len(np.intersect1d(*(tracks.points[tracks.photos == photo] for photo in pair)))
        for pair in ((0, 1), (0, 2), (1, 2))
    )
    assert 0.95 * pairs <= len(rays) / 2 <= pairs
    ends = (rays.origins + rays.distances * rays.directions).view(2, -1, 3)
    assert ((ends[0] - ends[1]).norm(dim=-1) < 0.01 * rays.distances[: len(ends[0]), 0]).float().mean() > 0.95


def test_a_bent_lens_is_found_and_kept(tmp_path):
    arguments = ["--layout", "nerfstudio", "--distortion", "-0.1", "--width", "400", "--supersample", "1"]
    make_sample_scene.main([str(tmp_path), *arguments, "--num-views", "24"])
    photos = copy_photos(tmp_path / "nerfstudio", tmp_path / "photos", range(4))
    prepare_scene(photos, tmp_path / "scene")
    frames = json.loads((tmp_path / "scene" / "transforms.json").read_text())["frames"]
    assert all(frame["k1"] == pytest.approx(-0.1, abs=0.03) for frame in frames)
    scene = Scene(read_scene(LLFFDataParserConfig(data=tmp_path / "scene").setup()))
    assert scene.cameras.distortion_params[:, 0].tolist() == pytest.approx([frame["k1"] for frame in frames])
    assert decide(scene, EffectSettings()).on("lens_distortion")


def test_photos_from_all_around_become_a_scene_of_nerfstudios(tmp_path):
    arguments = ["--layout", "nerfstudio", "--width", "400", "--supersample", "1", "--num-views", "24"]
    make_sample_scene.main([str(tmp_path), *arguments])
    chosen = range(8)  # a third of the circle
    scene = prepare_scene(copy_photos(tmp_path / "nerfstudio", tmp_path / "photos", chosen), tmp_path / "scene")
    assert (scene.parser, len(scene.names)) == ("nerfstudio-data", 8)
    assert not (tmp_path / "scene" / "poses_bounds.npy").exists()
    frames, known = (
        json.loads((folder / "transforms.json").read_text())["frames"]
        for folder in (tmp_path / "scene", tmp_path / "nerfstudio")
    )
    off = degrees_off(*([np.array(frame["transform_matrix"]) for frame in part[:8]] for part in (frames, known)))
    assert off["rotation"] < 0.8 and off["translation"] < 3.0
    effects = decide(Scene(read_scene(NerfstudioDataParserConfig(data=tmp_path / "scene").setup())), EffectSettings())
    assert effects.on("contraction") and effects["matched_depth"].measured > 0

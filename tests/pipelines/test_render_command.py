"""What ns-render would stumble over is said before it does: camera paths, one held-out view, options without effect."""

import contextlib
import copy
import json
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import TINY, ns_train, only_run, run_entrypoint
from hypothesis import given
from hypothesis import strategies as st
from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.scripts import render
from PIL import Image

from sparsestyle_ns.pipelines import nerfstudio_options as options
from sparsestyle_ns.pipelines.command_output import claim_output
from sparsestyle_ns.pipelines.render_command import find_ends, read_camera_path
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import all_or_nothing

CAMERA = {"camera_to_world": np.eye(4).flatten().tolist(), "fov": 50, "aspect": 1}
CROP = {
    "crop_center": [0, 0, 0],
    "crop_scale": [1, 1, 1],
    "crop_rot": [0, 0, 0],
    "crop_bg_color": {"r": 255, "g": 0, "b": 255},
}
PATH = {
    "camera_type": "perspective",
    "render_height": 4,
    "render_width": 6,
    "fps": 2,
    "seconds": 1,
    "crop": CROP,
    "camera_path": [CAMERA, CAMERA],
}
STRANGE = [
    None,
    True,
    0,
    -1,
    0.5,
    1e300,
    10**400,
    "",
    "12",
    [],
    [[]],
    {},
    "fisheye",
    "equirectangular",
    "VR180",
    [1, 2, 3],
]
PLACES = [
    *((key,) for key in PATH),
    *(("crop", key) for key in CROP),
    *(("crop", "crop_bg_color", part) for part in "rgb"),
    *(("camera_path", 1, key) for key in CAMERA),
    ("camera_path", 1, "camera_to_world", 5),
    ("camera_path", 1, "render_time"),
    ("camera_path", 0),
]


def is_rendered_or_refused(folder, content) -> str:
    """The refusal, or nothing where nerfstudio can make finite rays of what is in a camera path."""
    path = folder / "path.json"
    path.write_text(json.dumps(content))
    try:
        content = read_camera_path(path)
    except InputError as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return str(error)
    crop, cameras = render.get_crop_from_json(content), get_path_from_json(content)
    assert content["seconds"] > 0
    if int(cameras.height[0]) * int(cameras.width[0]) < 10_000:
        rays = cameras[0:1].generate_rays(camera_indices=0, obb_box=None if crop is None else crop.obb)
        assert rays.directions.isfinite().all()
    return ""


@given(st.sampled_from(PLACES), st.sampled_from(STRANGE), st.booleans())
def test_camera_paths_with_strange_values_are_rendered_or_refused(tmp_path, place, value, missing):
    content = copy.deepcopy(PATH)
    part = content
    for step in place[:-1]:
        part = part[step]
    part[place[-1]] = value
    if missing and isinstance(part, dict):
        del part[place[-1]]
    is_rendered_or_refused(tmp_path, content)


@given(
    st.recursive(st.none() | st.integers() | st.floats() | st.text(max_size=3), lambda each: st.lists(each, max_size=3))
)
def test_any_json_is_refused(tmp_path, content):
    assert is_rendered_or_refused(tmp_path, content)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"camera_path": []}, "has no cameras in camera_path: add keyframes"),
        ({"seconds": None}, "doesn't say in seconds, a number above 0, how long the film is"),
        ({"camera_type": "orthographic"}, 'has the camera_type "orthographic": name one of perspective, fisheye'),
        ({"render_width": 0}, "has no render_width from 1"),
        ({"seconds": 1e-9}, "shows 2 frames in 1e-09 seconds, and a film has from 0.01 to 1000 a second"),
        ({"seconds": 1e6}, "a second: correct seconds."),
        ({"crop": {"crop_center": [0, 0, 0]}}, "has no crop_scale of three numbers"),
    ],
)
def test_what_is_wrong_with_a_camera_path_is_said(tmp_path, change, sentence):
    assert sentence in is_rendered_or_refused(tmp_path, {**PATH, **change})


def test_a_camera_path_that_is_not_there_is_named(tmp_path):
    with pytest.raises(
        InputError, match=r"There is no camera path .*nowhere\.json: name one with --camera-path-filename"
    ):
        read_camera_path(tmp_path / "nowhere.json")


def flight(**settings):
    command = {"pose_source": "eval", "interpolation_steps": 10, "frame_rate": 24}
    return SimpleNamespace(**{**command, **settings})


def test_with_one_held_out_view_the_flight_is_between_the_training_views(capsys):
    manager = SimpleNamespace(eval_dataset=[1], train_dataset=[1, 2, 3])
    find_ends(SimpleNamespace(datamanager=manager), flight())
    assert manager.eval_dataset == [1, 2, 3]
    assert "as by --pose-source train" in capsys.readouterr().out


def test_one_view_in_all_is_too_few_for_a_flight():
    manager = SimpleNamespace(eval_dataset=[1], train_dataset=[1])
    for source in ("eval", "train"):
        with pytest.raises(InputError, match="only one view, and a flight needs two"):
            find_ends(SimpleNamespace(datamanager=manager), flight(pose_source=source))


@pytest.mark.parametrize(
    ("table", "kinds"),
    [
        (options.DATA_MANAGER, [VanillaDataManagerConfig]),
        (options.MODEL, [ModelConfig]),
        (
            options.RENDER,
            [render.RenderCameraPath, render.RenderInterpolated, render.SpiralRender, render.DatasetRender],
        ),
    ],
)
def test_every_option_of_nerfstudios_is_used_or_named(table, kinds):
    assert {each.name for kind in kinds for each in fields(kind)} <= table.keys()


def test_an_option_without_effect_is_named_where_it_is_given():
    assert options.unused(VanillaDataManagerConfig(), options.DATA_MANAGER) == []
    (line,) = options.unused(VanillaDataManagerConfig(patch_size=8), options.DATA_MANAGER, "pipeline.datamanager.")
    assert line == "--pipeline.datamanager.patch-size has no effect here: single pixels are drawn."
    (line,) = options.unused(ColmapDataParserConfig(load_3D_points=False), options.DATAPARSER)
    assert "--load-3D-points" in line
    command = render.SpiralRender(load_config=None, camera_idx=3)
    assert "--camera-idx has no effect" in options.render_options(command)[0]


def rendering(**settings):
    command = render.RenderInterpolated(load_config=None, **settings)
    claim_output(command, "render")
    return str(command.output_path)


def test_a_film_never_takes_the_place_of_another(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert rendering() == "renders/output.mp4"
    (tmp_path / "renders" / "output").mkdir(parents=True)
    (tmp_path / "renders" / "output.mp4").touch()
    assert rendering() == "renders/output-2.mp4"
    assert rendering(output_format="images") == "renders/output.mp4"  # an empty folder, of the name without suffix
    (tmp_path / "renders" / "output" / "00000.jpg").touch()
    assert rendering(output_format="images") == "renders/output-2.mp4"
    assert rendering(output_path=tmp_path / "film") == str(tmp_path / "film.mp4")
    (tmp_path / "film.mp4").mkdir()
    with pytest.raises(InputError, match=r"Something is at --output-path .*film already; take .*film-2\.mp4 or"):
        rendering(output_path=tmp_path / "film")
    with pytest.raises(InputError, match=r"can't be written to .*output\.mp4/a\.mp4 \(Not a directory\)"):
        rendering(output_path=tmp_path / "renders" / "output.mp4" / "a.mp4")


def test_pictures_of_views_never_mix_with_those_of_another_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "renders" / "test" / "rgb").mkdir(parents=True)
    (tmp_path / "renders" / "test" / "rgb" / "a.jpg").touch()
    for settings, expected in (
        ({}, "renders-2"),
        ({"split": "train+test"}, "renders-2"),
        ({"split": "train"}, "renders"),
        ({"rendered_output_names": ["rgb"]}, "renders-2"),
        ({"rendered_output_names": ["depth"]}, "renders"),
    ):
        command = render.DatasetRender(load_config=None, **settings)
        claim_output(command, "render")
        assert str(command.output_path) == expected


def test_a_folder_of_ones_own_isnt_taken_for_a_films_own(tmp_path):
    (tmp_path / "film_temp").mkdir()  # which nerfstudio would fill and then delete, for films of two eyes' views
    (tmp_path / "film_temp" / "mine").touch()
    command = render.RenderCameraPath(load_config=None, output_path=tmp_path / "film.mp4")
    with pytest.raises(InputError, match="Something is at"):
        claim_output(command, "render")


@pytest.mark.parametrize("ends_well", [True, False])
def test_what_is_made_stays_only_if_all_of_it_is_made(tmp_path, ends_well):
    film, pictures = tmp_path / "new" / "film.mp4", tmp_path / "pictures"
    pictures.mkdir()
    with contextlib.suppress(RuntimeError), all_or_nothing([film, pictures]):
        film.parent.mkdir()
        film.touch()
        (pictures / "deep").mkdir()
        (pictures / "deep" / "a.png").touch()
        if not ends_well:
            raise RuntimeError
    left = {path.name for path in tmp_path.rglob("*")}
    assert left == ({"new", "film.mp4", "pictures", "deep", "a.png"} if ends_well else {"pictures"})


@pytest.mark.parametrize("parser", ["llff-data", "blender-data"])
def test_views_of_any_scene_are_rendered_at_a_share_of_their_size(llff_scene, tmp_path, parser):
    import make_sample_scene

    scene = llff_scene
    if parser == "blender-data":
        make_sample_scene.main([str(tmp_path), "--layout", "blender", "--width", "32", "--num-views", "8"])
        scene = tmp_path / "blender"
    ns_train("coarse-fewshot", scene, tmp_path / "outputs", "--max-num-iterations", "1", *TINY, parser=parser)
    config = only_run(tmp_path / "outputs", "coarse-fewshot") / "config.yml"
    flags = ["--load-config", config, "--rendered-output-names", "rgb", "gt-rgb", "--downscale-factor", "2"]
    run_entrypoint(render.entrypoint, ["dataset", *flags, "--output-path", tmp_path / "pictures"])
    sizes = {Image.open(path).size for path in (tmp_path / "pictures").rglob("*.jpg")}
    assert sizes == {(16, 12 if parser == "llff-data" else 16)}

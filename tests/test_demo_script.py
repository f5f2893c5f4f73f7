"""The demo's flight looks where it should, and its stages are the commands that one would type."""

import importlib
import json
import os
import shlex

import numpy as np
import pytest
import torch
from _flight import camera_path, ellipse_path, flight, orbit_path
from nerfstudio.cameras.camera_paths import get_path_from_json
from PIL import Image

from sparsestyle_ns.utils.stages import StageFailedError

# The demo makes a folder of the same name, and ruff would sort `import demo` by whether it is there.
demo = importlib.import_module("demo")


def forward_facing_poses():
    """Five cameras around the origin that look along -z, in a cross of 0.4 by 0.2."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = [(0, 0, 0), (0.2, 0, 0), (-0.2, 0, 0), (0, 0.1, 0), (0, -0.1, 0)]
    return poses


def read_path(poses, size=(252, 189), focal_over_height=1.0):
    """What ns-render makes of a camera path that went through a file."""
    return get_path_from_json(json.loads(json.dumps(camera_path(poses, size, focal_over_height))))


def seen_at(cameras, point):
    """(N, 2) pixel positions, x first, at which cameras see a point."""
    poses = cameras.camera_to_worlds
    local = torch.einsum("nij,ni->nj", poses[..., :3], torch.tensor(point) - poses[..., 3])
    focal = torch.stack([cameras.fx[:, 0], -cameras.fy[:, 0]], dim=-1).float()
    assert torch.all(local[:, 2] < 0)
    return focal * local[:, :2] / -local[:, 2:] + torch.stack([cameras.cx[:, 0], cameras.cy[:, 0]], dim=-1)


def test_ellipse_keeps_the_focus_in_the_middle_of_every_frame():
    cameras = read_path(ellipse_path(forward_facing_poses(), focus_distance=3.0, frames=12))
    assert cameras.size == 12
    middle = torch.tensor([126.0, 94.0]).expand(12, 2)
    torch.testing.assert_close(seen_at(cameras, (0.0, 0.0, -3.0)), middle, atol=1e-3, rtol=0)


def test_ellipse_is_as_wide_and_high_as_the_photos_spread():
    poses = forward_facing_poses()
    positions = ellipse_path(poses, focus_distance=1.0, frames=4)[:, :3, 3]
    spread = np.sqrt((poses[:, :3, 3] ** 2).mean(0))
    expected = [(spread[0], 0, 0), (0, spread[1], 0), (-spread[0], 0, 0), (0, -spread[1], 0)]
    np.testing.assert_allclose(positions, expected, atol=1e-12)


def test_ellipse_moves_even_where_all_photos_were_taken_from_one_spot():
    positions = ellipse_path(np.tile(np.eye(4), (3, 1, 1)), focus_distance=2.0, frames=8)[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(positions, axis=-1), 0.06)


def test_ellipse_follows_the_cameras_into_any_direction():
    turn = np.array([[0.0, 0, 1, 4], [1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 0, 1]])
    straight = ellipse_path(forward_facing_poses(), 3.0, 6)
    np.testing.assert_allclose(ellipse_path(turn @ forward_facing_poses(), 3.0, 6), turn @ straight, atol=1e-12)


def test_orbit_goes_all_around_at_the_photos_height_and_looks_at_the_origin():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = [(3, 0, 2), (0, 3, 2), (-3, 0, 2), (0, -3, 2)]
    path = orbit_path(poses, 8)
    np.testing.assert_allclose(path[:, 2, 3], 2.0)
    np.testing.assert_allclose(np.linalg.norm(path[:, :3, 3], axis=-1), np.sqrt(13))
    assert np.allclose(path[:, :3, 3].mean(0), (0, 0, 2))
    cameras = read_path(path, size=(100, 100))
    torch.testing.assert_close(seen_at(cameras, (0.0, 0.0, 0.0)), torch.full((8, 2), 50.0), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    "path",
    [ellipse_path(forward_facing_poses(), 3.0, 5), orbit_path(forward_facing_poses()[1:], 5)],
    ids=["ellipse", "orbit"],
)
def test_poses_are_rotations(path):
    rotations = path[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


def test_camera_path_has_the_photos_lens_and_even_sides():
    path = camera_path(np.eye(4)[None], (253, 189), focal_over_height=0.85)
    assert (path["render_width"], path["render_height"]) == (252, 188)
    cameras = get_path_from_json(path)
    assert cameras.fx.item() == pytest.approx(0.85 * 188)
    assert (cameras.cx.item(), cameras.cy.item()) == (126, 94)


def test_flight_before_an_llff_scene_is_in_nerfstudios_world(tmp_path):
    row = np.concatenate([np.c_[np.eye(3), np.zeros(3), (189.0, 252.0, 214.2)].ravel(), (2.0, 8.0)])
    np.save(tmp_path / "poses_bounds.npy", np.tile(row, (3, 1)))
    (tmp_path / "scene.json").write_text(json.dumps({"cameras": forward_facing_poses()[:, :3].tolist()}))
    cameras = get_path_from_json(flight("llff", tmp_path, tmp_path, frames=6, longer_side=252))
    # 1 / (0.25 / 2 + 0.75 / 8) of the file's units, in which the near bound of 2 is 4/3 in nerfstudio's world
    focus = (0.0, 0.0, -32 / 7 * (4 / 3) / 2)
    torch.testing.assert_close(seen_at(cameras, focus), torch.tensor([[126.0, 94.0]]).expand(6, 2), atol=1e-3, rtol=0)
    assert cameras.fx[0].item() == pytest.approx(214.2 / 189 * 188)


def test_flight_around_a_blender_scene_has_its_pictures_shape_and_angle(tmp_path):
    (tmp_path / "train").mkdir()
    Image.new("RGBA", (60, 40)).save(tmp_path / "train" / "r_0.png")
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": np.pi / 2}))
    poses = orbit_path(forward_facing_poses()[1:], 3)
    (tmp_path / "scene.json").write_text(json.dumps({"cameras": poses[:, :3].tolist()}))
    path = flight("blender", tmp_path, tmp_path, frames=4, longer_side=30)
    assert (path["render_width"], path["render_height"]) == (30, 20)
    assert get_path_from_json(path).fx[0].item() == pytest.approx(15.0)


def test_newest_run_is_the_one_configured_last(tmp_path):
    for age, name in enumerate(("b", "c", "a")):
        config = tmp_path / "hier-style-draft" / name / "config.yml"
        config.parent.mkdir(parents=True)
        config.write_text("")
        os.utime(config, (age, age))
    assert demo.newest_run(tmp_path, "hier-style-draft").name == "a"
    with pytest.raises(StageFailedError, match="no run of coarse-fewshot"):
        demo.newest_run(tmp_path, "coarse-fewshot")


def test_stages_are_the_commands_a_newcomer_would_type(tmp_path):
    options = demo.Options(output=tmp_path, scene="blender", iterations_coarse=300)
    stages = demo.make_stages(options)
    coarse, stylised = (shlex.join(stage.commands[0]) for stage in stages[2:4])
    assert coarse.startswith(f"ns-train coarse-fewshot-draft --data {tmp_path}/scene/blender --output-dir")
    assert coarse.endswith("--max-num-iterations 300 blender-data")
    assert stylised.startswith(f"ns-train hier-style-draft --style-image {tmp_path}/style.png --data")
    assert "--max-num-iterations" not in stylised


def test_impossible_option_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        demo.main(["--frames", "0"])
    assert ended.value.code == 2
    assert "--frames is 0, but has to be at least 1" in capsys.readouterr().err


@pytest.mark.parametrize("name", demo.PRODUCTS)
def test_a_folder_with_files_of_ones_own_is_refused_and_stays(tmp_path, capsys, name):
    (tmp_path / name).mkdir() if "." not in name else (tmp_path / name).write_text("mine")
    assert demo.main(["--output", str(tmp_path)]) == 1
    assert f"has a {name} that isn't the demo's; name a new folder with --output." in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == [name]


def test_other_files_may_lie_in_the_demos_folder(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    demo.claim_folder(tmp_path)
    (tmp_path / "style.png").touch()
    demo.claim_folder(tmp_path)  # which is the demo's own by now
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_file_in_place_of_the_folder_is_said(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert demo.main(["--output", str(tmp_path / "file")]) == 1
    assert "can't be used" in capsys.readouterr().err


def test_the_film_of_an_earlier_demo_makes_room(tmp_path, monkeypatch):
    (tmp_path / "outputs" / "llff" / "hier-style-draft" / "a").mkdir(parents=True)
    (tmp_path / "outputs" / "llff" / "hier-style-draft" / "a" / "config.yml").touch()
    for name in ("stylised.mp4", "stylised/00000.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.setattr(demo, "flight", lambda *_: {})
    film, pictures = demo.make_stages(demo.Options(output=tmp_path, images=True))[4].commands()
    assert not (tmp_path / "stylised.mp4").exists() and not (tmp_path / "stylised").exists()
    assert film[film.index("--output-path") + 1] == pictures[pictures.index("--output-path") + 1]


def test_after_ctrl_c_the_same_command_goes_on_with_the_stage_under_way(tmp_path, monkeypatch, capsys):
    from sparsestyle_ns.utils import stages

    begun = []

    def run(command, heading, *_):
        begun.append(heading)
        if heading.startswith("Painting") and begun.count(heading) == 1:
            raise KeyboardInterrupt
        for product in ("scene/llff/a", "style.png"):
            (tmp_path / product).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / product).touch()

    monkeypatch.setattr(stages, "run_command", run)
    every_stage = demo.make_stages
    monkeypatch.setattr(demo, "make_stages", lambda options: every_stage(options)[:2])
    monkeypatch.setattr(demo, "newest_run", lambda *_: tmp_path)
    command = ["--output", str(tmp_path)]
    assert demo.main(command) == 130
    assert "the same command goes on with the stage that was under way." in capsys.readouterr().err
    assert demo.main(command) == 0
    assert [heading.split()[0] for heading in begun] == ["Photographing", "Painting", "Painting"]

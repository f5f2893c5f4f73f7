"""`sparsestyle stylise` runs the commands that one would type, goes on where it was, and says so."""

import itertools
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from sparsestyle_ns import cli
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.stylise import stylise as stylise_module
from sparsestyle_ns.stylise.stylise import make_stages
from sparsestyle_ns.stylise.stylise_options import StyliseOptions
from sparsestyle_ns.utils import stages as stages_module
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.stages import StageFailedError


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for index in range(3):
        Image.new("RGB", (40, 30), (80 * index, 90, 90)).save(folder / f"{index}.png")
    return folder


@pytest.fixture
def painting(tmp_path):
    Image.new("RGB", (20, 20), (200, 30, 30)).save(tmp_path / "hat.png")
    return tmp_path / "hat.png"


def options(photos, painting, **changed):
    return StyliseOptions(photos, painting, photos.parent / "out", **changed)


def commands_of(options):
    found = [stage.commands() if callable(stage.commands) else stage.commands for stage in make_stages(options)]
    return [shlex.join(command) for commands in found for command in commands]


class Recorded:
    """Stands for running commands: notes them, and makes what they would make."""

    def __init__(self, monkeypatch, stops_at=None):
        self.commands, self.stops_at = [], stops_at
        monkeypatch.setattr(stages_module, "run_command", self)

    def __call__(self, command, heading, *_):
        self.commands.append(command)
        if self.stops_at in command:
            raise KeyboardInterrupt
        flags = dict(itertools.pairwise(command))
        if command[0] == "ns-train":
            where = Path(flags["--output-dir"]) / Path(flags["--data"]).stem / command[1] / flags["--timestamp"]
            self._make(where / "config.yml", f"method_name: {command[1]}\nmax_num_iterations: 10\n")
            self._make(where / "nerfstudio_models" / "step-000000009.ckpt")
        elif command[1] == "prepare":
            self._make(Path(flags["--output"]) / "transforms.json")
        else:
            self._make(Path(flags["--output-path"]))

    def _make(self, path, content=""):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)

    @property
    def kinds(self):
        return [command[1] for command in self.commands]


def stylise(monkeypatch, photos, painting, *flags):
    arguments = ["stylise", str(photos), str(painting), "--output", str(photos.parent / "out"), *flags]
    monkeypatch.setattr(sys, "argv", ["sparsestyle", *arguments])
    cli.main(arguments)


WHOLE = ["prepare", "coarse-fewshot", "hier-style", "gallery", "export"]


def test_it_is_five_commands(photos, painting, monkeypatch, capsys):
    recorded = Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting)
    assert recorded.kinds == WHOLE
    prepare, coarse, style, gallery, export = map(shlex.join, recorded.commands)
    out = photos.parent / "out"
    scene = Path(prepare.split()[-1])
    assert prepare == f"sparsestyle prepare {photos} --output {scene}"
    assert scene.parent == out and scene.name.startswith("scene-")
    assert coarse.startswith(f"ns-train coarse-fewshot --data {scene} --output-dir {out / 'outputs'}")
    assert coarse.endswith(" nerfstudio-data")
    run = Path(style.split("--coarse-run ")[1].split()[0])
    assert run.parent == out / "outputs" / scene.name / "coarse-fewshot" and f"--timestamp {run.name}" in coarse
    assert f"--style-image {painting}" in style
    stylised = Path(gallery.split()[2])
    assert stylised.name.startswith("hat-") and f"--timestamp {stylised.name}" in style
    assert export.startswith(f"sparsestyle export {stylised} --output-path {out / 'scene.html'}")
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"Made {out / 'index.html'} – next: ")


def test_strokes_of_another_size_are_another_run_of_the_same_scene(photos, painting):
    usual, wide = (commands_of(options(photos, painting, stroke_size=size)) for size in (1.0, 2.0))
    assert usual[1] == wide[1] and "--stroke-size" not in usual[2] and "--stroke-size 2" in wide[2]
    run_of = [command.split("--timestamp ")[1].split()[0] for command in (usual[2], wide[2])]
    assert run_of[0] != run_of[1]
    with pytest.raises(InputError, match="--stroke-size is 3; give a number"):
        options(photos, painting, stroke_size=3.0).check()


def test_a_scene_is_used_as_it_is(tmp_path, painting):
    scene = tmp_path / "photos"
    (scene / "images").mkdir(parents=True)
    np.save(scene / "poses_bounds.npy", np.zeros((3, 17)))
    coarse, *_ = commands_of(options(scene, painting))
    assert coarse.startswith(f"ns-train coarse-fewshot --data {scene} ") and coarse.endswith(" llff-data")


def test_photos_with_poses_beside_them_are_prepared(photos, painting):
    np.save(photos / "poses_bounds.npy", np.zeros((3, 17)))
    assert make_stages(options(photos, painting))[0].name == "scene"


def test_few_options_reach_the_commands(photos, painting, monkeypatch):
    recorded = Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting, "--methods", "draft", "--device", "cpu", "--seed", "7")
    assert recorded.kinds == ["prepare", "coarse-fewshot-draft", "hier-style-draft", "gallery", "export"]
    coarse, style = map(shlex.join, recorded.commands[1:3])
    for command, own in ((coarse, "pipeline.model.seed"), (style, "pipeline.seed")):
        assert "--machine.device-type cpu" in command
        for seed in ("machine.seed", "pipeline.datamanager.seed", own):
            assert f"--{seed} 7" in command


def test_a_second_start_does_what_is_left(photos, painting, monkeypatch, capsys):
    Recorded(monkeypatch, stops_at="hier-style")
    with pytest.raises(SystemExit) as ended:
        stylise(monkeypatch, photos, painting)
    assert ended.value.code == 130
    command = shlex.join(["sparsestyle", "stylise", str(photos), str(painting), "--output", str(photos.parent / "out")])
    assert f"goes on where it was:\n  {command}" in capsys.readouterr().err
    again = Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting)
    assert again.kinds == WHOLE[2:]
    assert Recorded(monkeypatch).commands == []


def test_a_run_that_was_interrupted_is_gone_on_with(photos, painting, monkeypatch):
    recorded = Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting)
    out = photos.parent / "out"
    (run,) = out.glob("outputs/scene-*/coarse-fewshot/*")
    (run / "nerfstudio_models" / "step-000000009.ckpt").rename(run / "nerfstudio_models" / "step-000000004.ckpt")
    (out / ".finished" / "coarse").unlink()
    for method in ("coarse-fewshot", "hier-style"):
        (config,) = out.glob(f"outputs/scene-*/{method}/*/config.yml")
        config.write_text(yaml.dump(replace(method_config(method), max_num_iterations=10)))
    recorded = Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting)
    assert recorded.kinds == ["coarse-fewshot", "gallery", "export"]  # stage 2 has all its iterations
    assert f"--load-dir {run / 'nerfstudio_models'}" in shlex.join(recorded.commands[0])


def test_another_painting_leaves_stage_1_alone(photos, painting, monkeypatch):
    Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting)
    Image.new("RGB", (20, 20), (0, 0, 250)).save(painting)
    recorded = Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting)
    assert recorded.kinds == WHOLE[2:]


def test_other_photos_begin_anew(photos, painting, monkeypatch):
    Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting)
    Image.new("RGB", (40, 30), (1, 2, 3)).save(photos / "1.png")
    recorded = Recorded(monkeypatch)
    stylise(monkeypatch, photos, painting)
    assert recorded.kinds == WHOLE
    assert len(list((photos.parent / "out").glob("scene-*"))) == 2


def test_pages_of_others_are_not_written_over(photos, painting, monkeypatch):
    (photos.parent / "out").mkdir()
    (photos.parent / "out" / "index.html").touch()
    recorded = Recorded(monkeypatch)
    with pytest.raises(SystemExit, match=r"has a index\.html that this command didn't make"):
        stylise(monkeypatch, photos, painting)
    assert recorded.commands == []


def test_a_video_is_prepared(tmp_path, painting):
    (tmp_path / "walk.mp4").write_bytes(b"frames")
    first, *_ = commands_of(StyliseOptions(tmp_path / "walk.mp4", painting, tmp_path / "out"))
    assert first.startswith(f"sparsestyle prepare {tmp_path / 'walk.mp4'} --output ")


def test_a_command_that_fails_says_why_and_how_to_go_on(photos, painting, monkeypatch, capsys):
    def fail(*_):
        raise StageFailedError("Stage 1: ns-train ended with exit status 1; its last lines were\n    Error: no")

    monkeypatch.setattr(stages_module, "run_command", fail)
    with pytest.raises(SystemExit) as ended:
        stylise(monkeypatch, photos, painting)
    assert "Error: no" in str(ended.value) and "sparsestyle stylise" in str(ended.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"photos": "nowhere"}, "There is no folder nowhere"),
        ({"painting": "nothing.jpg"}, "There is no painting nothing.jpg"),
        ({"seed": -1}, "--seed is -1"),
    ],
)
def test_what_cannot_be_used_is_refused_at_once(photos, painting, monkeypatch, change, words):
    given = {"photos": str(photos), "painting": str(painting), "seed": 1, **change}
    with pytest.raises(SystemExit, match=words):
        stylise(monkeypatch, Path(given["photos"]), given["painting"], "--seed", str(given["seed"]))


def test_nothing_is_made_in_the_folder_of_the_photos(photos, painting, monkeypatch):
    monkeypatch.setattr(stages_module, "run_command", lambda *_: pytest.fail("a stage was begun"))
    before = sorted(photos.rglob("*"))
    with pytest.raises(SystemExit, match="is in the folder of the photos, which are only read; take "):
        stylise(monkeypatch, photos, painting, "--output", str(photos / "made"))
    assert sorted(photos.rglob("*")) == before


@pytest.mark.parametrize("content", [b"", b"not a picture"])
def test_a_painting_that_cannot_be_read_is_refused_before_the_first_stage(photos, tmp_path, monkeypatch, content):
    bad = tmp_path / "bad.png"
    bad.write_bytes(content)
    monkeypatch.setattr(stages_module, "run_command", lambda *_: pytest.fail("a stage was begun"))
    with pytest.raises(SystemExit, match=r"bad\.png"):
        stylise(monkeypatch, photos, bad)


def test_is_scene_needs_images_beside_llff_poses(photos):
    assert not stylise_module.is_scene(photos)
    (photos / "transforms.json").write_text("{}")
    assert stylise_module.is_scene(photos)

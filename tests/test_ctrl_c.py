"""Ctrl-C, as a real signal to a real process, at any moment of any long command: one sentence, and status 130."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import List

import pytest
from conftest import TINY, TINY_STYLE
from interrupted import interrupt

from sparsestyle_ns.utils import interrupts

FLIGHT = {
    "camera_type": "vr180",
    "render_height": 8,
    "render_width": 8,
    "seconds": 1,
    "camera_path": [{"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 50}] * 4,
}
QUIET = ["--vis", "tensorboard", "--viewer.quit-on-train-completion", "True"]


def coarse_command(scene: Path, outputs: Path, *flags: str) -> List[str]:
    command = ["ns-train", "coarse-fewshot", "--data", str(scene), "--output-dir", str(outputs), *QUIET]
    return [*command, "--max-num-iterations", "4", *TINY, *flags, "llff-data"]


def style_command(runs: SimpleNamespace, scene: Path, painting: Path, outputs: Path) -> List[str]:
    command = ["ns-train", "hier-style", "--data", str(scene), "--output-dir", str(outputs), *QUIET]
    command += ["--style-image", str(painting), "--coarse-run", str(runs.coarse), "--max-num-iterations", "4"]
    return [*command, *TINY_STYLE, "llff-data"]


def slow(cases: dict) -> list:
    """All cases but the last are left to `pytest -m slow`: each takes seconds."""
    *others, (name, last) = cases.items()
    return [
        *(pytest.param(each, id=name, marks=pytest.mark.slow) for name, each in others),
        pytest.param(last, id=name),
    ]


BEFORE_STAGE_1 = {
    "reading the scene": "sparsestyle_ns.pipelines.datamanager:read_scene",
    "measuring effects": "sparsestyle_ns.pipelines.scene_pipeline:decide",
    "in nerfstudio's own code": "nerfstudio.utils.writer:setup_event_writer",
    "recording the scene": "sparsestyle_ns.engine.trainer:record_scene",
    "loading photos": "sparsestyle_ns.pipelines.datamanager:gather_pixels",
}
BEFORE_STAGE_2 = {
    "reading the painting": "sparsestyle_ns.style.painting:Painting.read",
    "looking for surfaces": "sparsestyle_ns.core.occupancy:DensityVolume.measure",
    "freezing views": "sparsestyle_ns.pipelines.scene_views:SceneViews._photo_view",
    "warming up": "sparsestyle_ns.pipelines.hier_style:HierStylePipeline.warm_start_loss",
}


@pytest.mark.parametrize("moment", slow(BEFORE_STAGE_1))
def test_before_the_first_iteration_of_stage_1_nothing_is_left(llff_scene, tmp_path, moment):
    command = coarse_command(llff_scene, tmp_path / "outputs")
    interrupt(command, moment, tmp_path / "log", presses=2).assert_told()
    assert not list((tmp_path / "outputs").rglob("*"))


@pytest.mark.parametrize("moment", slow(BEFORE_STAGE_2))
def test_before_the_first_iteration_of_stage_2_nothing_is_left(runs, llff_scene, painting, tmp_path, moment):
    command = style_command(runs, llff_scene, painting, tmp_path / "outputs")
    interrupt(command, moment, tmp_path / "log", presses=2).assert_told()
    assert not list((tmp_path / "outputs").rglob("*"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "moment",
    [
        "sparsestyle_ns.engine.trainer:training_step",
        "sparsestyle_ns.engine.previews:render_preview",
        "sparsestyle_ns.runs.checkpoints:write_checkpoint",
    ],
)
def test_in_training_the_iteration_is_finished_and_saved(llff_scene, tmp_path, moment):
    command = coarse_command(llff_scene, tmp_path / "outputs", "--previews", "0.5")
    ending = interrupt(command, moment, tmp_path / "log", presses=2)
    ending.assert_told("Ctrl-C: finishing this iteration, then saving.")
    assert list((tmp_path / "outputs").rglob("*.ckpt"))
    assert " – next: " in ending.printed.splitlines()[-1]


STUDIES = {
    "tradeoff": " before anything was measured.",
    **dict.fromkeys(("compare", "ablate"), "; the same command goes on where it was."),
}
"""What studies say more than other commands."""
FRAME = "sparsestyle_ns.models.hier_style:HierStyleModel.get_outputs"
COMMANDS = {
    "a film": ("ns-render interpolate --pose-source train --output-path {tmp}/a/b.mp4", "style", FRAME, 5),
    "films of two eyes": (
        "ns-render camera-path --camera-path-filename {path} --output-path {tmp}/a.mp4",
        "coarse",
        "sparsestyle_ns.models.coarse_fewshot:CoarseFewShotModel.get_outputs",
        6,
    ),
    "pictures of a film": (
        "ns-render interpolate --pose-source train --output-format images --output-path {tmp}/a",
        "style",
        FRAME,
        5,
    ),
    "pictures of views": ("ns-render dataset --split train --output-path {tmp}/a", "style", FRAME, 2),
    "cloud": ("ns-export pointcloud --output-dir {tmp} --normal-method open3d --num-points 100000", "style", FRAME, 3),
    "mesh": (
        "ns-export tsdf --output-dir {tmp}/new/folder --downscale-factor 1 --resolution 16",
        "style",
        "nerfstudio.exporter.texture_utils:export_textured_mesh",  # its first file is there by then
    ),
    "tradeoff": (
        "sparsestyle tradeoff --data {scene} --output-dir {tmp}/a",
        "coarse",
        "sparsestyle_ns.studies.workbench:Workbench.start",
    ),
    "compare": (
        "sparsestyle compare --data {scene} --style-images {painting} --output-path {tmp}/a.html --output-dir {tmp}/o",
        "coarse",
        "sparsestyle_ns.studies.run_queue:RunQueue._train",
    ),
    "ablate": (
        "sparsestyle ablate --data {scene} --style-images {painting} --output-path {tmp}/a.html --output-dir {tmp}/o",
        "coarse",
        "sparsestyle_ns.studies.run_queue:RunQueue._train",
    ),
    "eval": ("ns-eval --output-path {tmp}/a.json", "style", "sparsestyle_ns.evaluation.held_out:exact_outputs"),
    "evaluate": ("sparsestyle evaluate {run}", "style", "sparsestyle_ns.evaluation.held_out:exact_outputs"),
    "gallery": (
        "sparsestyle gallery {run} --output-path {tmp}/a.html --frames 0",
        "style",
        "sparsestyle_ns.gallery.make_gallery:_render_views",
    ),
    "baking": (
        "sparsestyle export {run} --format html --output-path {tmp}/a.html",
        "style",
        "sparsestyle_ns.rendering.baked:BakedVolume.fill",
    ),
    "points": (
        "sparsestyle export {run} --format ply --output-path {tmp}/a.ply",
        "style",
        "sparsestyle_ns.models.hier_style:HierStyleModel.get_outputs",
    ),
    "effects": ("sparsestyle effects --data {scene}", "coarse", "sparsestyle_ns.data.matches:find_features"),
    "prepare": (
        "sparsestyle prepare {scene} --output {tmp}/a",
        "coarse",
        "sparsestyle_ns.prepare.prepare_scene:read_for_pose",
    ),
}


@pytest.mark.parametrize("case", slow(COMMANDS))
def test_other_commands_make_nothing(runs, llff_scene, painting, tmp_path, case):
    words, kind, moment, *call = case
    run, path = getattr(runs, kind), tmp_path / "path.json"
    path.write_text(json.dumps(FLIGHT))
    places = {"scene": llff_scene, "painting": painting, "path": path, "tmp": tmp_path / "made"}
    command = words.format(run=run, **places).split()
    if command[0].startswith("ns-"):
        command += ["--load-config", str(run / "config.yml")]
    before = {path for path in runs.outputs.rglob("*")}
    (tmp_path / "made").mkdir()
    sentence = "Stopped by Ctrl-C" + STUDIES.get(command[1], ".")
    interrupt(command, moment, tmp_path / "log", 2, *call).assert_told(sentence)
    assert not list((tmp_path / "made").iterdir())
    assert {path for path in runs.outputs.rglob("*")} == before


@pytest.mark.slow
def test_the_viewer_is_closed_by_ctrl_c(runs):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [str(Path(sys.executable).with_name("ns-viewer")), "--load-config", str(runs.style / "config.yml")]
    command += ["--viewer.websocket-port", str(port), "--viewer.websocket-host", "127.0.0.1"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as viewer:
        printed = ""
        while "viser" not in printed and (line := viewer.stdout.readline()):
            printed += line
        time.sleep(2.0)
        viewer.send_signal(signal.SIGINT)
        try:
            printed += viewer.communicate(timeout=120)[0]
        finally:
            viewer.kill()
    assert viewer.returncode == 130, printed[-3000:]
    assert "Traceback" not in printed
    assert printed.splitlines()[-1] == "Stopped by Ctrl-C."


SCRIPT = """
import signal, sys, time
from sparsestyle_ns.utils import interrupts
interrupts.SECONDS_OF_GRACE = float(sys.argv[1])
interrupts.end_on_ctrl_c()
interrupts.take_away_at_end(lambda: print("taken away", flush=True))
try:
    print("here", flush=True)
    time.sleep(60)
finally:
    print("clearing up", flush=True)
    time.sleep(1.5)
    print("cleared up", flush=True)
"""


@pytest.mark.parametrize(
    ("grace", "ending"), [(30.0, ["clearing up", "cleared up", "taken away"]), (0.1, ["clearing up", "taken away"])]
)
def test_a_second_press_breaks_nothing_off_at_first_and_ends_at_once_later(grace, ending):
    command = [sys.executable, "-c", SCRIPT, str(grace)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "here\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "clearing up\n"
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        printed, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert printed.split("\n")[:-1] == ending[1:]
    assert error == "Stopped by Ctrl-C.\n"


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["/usr/bin/ns-train", "hier-style"], "train"),
        (["/lib/nerfstudio/scripts/render.py"], "render"),
        (["/usr/bin/pytest"], None),
        (["/home/train.py"], None),
        (["/usr/bin/sparsestyle", "evaluate"], None),
    ],
)
def test_only_nerfstudios_commands_are_guarded(monkeypatch, words, command):
    monkeypatch.setattr(sys, "argv", words)
    assert interrupts.ns_command() == command


@pytest.mark.parametrize(
    "words, is_guarded",
    [
        (["ns-train", "hier-style-draft"], True),
        (["ns-train", "nerfacto"], False),
        (["ns-train"], False),
        (["ns-render", "interpolate", "--load-config={ours}"], True),
        (["ns-viewer", "--load-config", "{theirs}"], False),
        (["ns-viewer", "--load-config"], False),
        (["ns-viewer", "--load-config", "nowhere"], False),
    ],
)
def test_other_methods_keep_nerfstudios_ways(monkeypatch, tmp_path, words, is_guarded):
    for name, method in (("ours", "coarse-fewshot"), ("theirs", "nerfacto")):
        (tmp_path / name).write_text(f"method_name: {method}\n")
    guarded = []
    monkeypatch.setattr(interrupts, "end_on_ctrl_c", lambda: guarded.append(True))
    monkeypatch.setattr(
        sys, "argv", [word.format(ours=tmp_path / "ours", theirs=tmp_path / "theirs") for word in words]
    )
    interrupts.guard_nerfstudio(("coarse-fewshot", "hier-style"))
    assert bool(guarded) is is_guarded


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("ns-render interpolate --load-config {run}", r"is a folder; give .*/hier-style/a/config\.yml\."),
        ("ns-viewer --load-config {run}/confg.yml", "There is no run's config at"),
        ("ns-eval --load-config={run}b/config.yml", "There is no run's config at"),
        ("ns-eval --load-config {run}/config.yml", None),
        ("ns-eval --load-config elsewhere/nerfacto/a", None),
        ("ns-eval", None),
    ],
)
def test_a_run_that_is_not_there_is_said_where_it_would_be_one_of_these_methods(monkeypatch, tmp_path, words, sentence):
    run = tmp_path / "hier-style" / "a"
    run.mkdir(parents=True)
    (run / "config.yml").write_text("method_name: hier-style\n")
    monkeypatch.setattr(interrupts, "end_on_ctrl_c", lambda: None)
    monkeypatch.chdir("/")
    monkeypatch.setattr(sys, "argv", words.format(run=run).split())
    if sentence is None:
        interrupts.guard_nerfstudio(("coarse-fewshot", "hier-style"))
        return
    with pytest.raises(SystemExit, match=sentence):
        interrupts.guard_nerfstudio(("coarse-fewshot", "hier-style"))


LOST = """
import time
from sparsestyle_ns.utils import interrupts

class Slow:
    def __del__(self):
        print("here", flush=True)
        time.sleep(60)

interrupts.end_on_ctrl_c()
slow = Slow()
del slow
while True:
    time.sleep(0.01)
"""


SWALLOWED = """
import time
from sparsestyle_ns.utils import interrupts

interrupts.end_on_ctrl_c()
interrupts.mind_swallowed_presses()
try:
    print("here", flush=True)
    time.sleep(60)
except BaseException:
    pass
exec("while True: time.sleep(0.01)", {"__name__": interrupts.VIEWER_MODULE, "time": time})
"""


@pytest.mark.parametrize("script", [LOST, SWALLOWED], ids=["while Python clears up", "by a library"])
def test_a_press_that_is_lost_counts_all_the_same(script):
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"here\n"
        process.send_signal(signal.SIGINT)
        try:
            printed = process.communicate(timeout=60)[1].decode()
        finally:
            process.kill()
    assert process.returncode == 130 and printed == "Stopped by Ctrl-C.\n"

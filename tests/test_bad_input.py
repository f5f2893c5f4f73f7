"""What the commands say when they can't go on: one sentence, exit status not 0, and nothing is lost."""

import copy
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Callable, Dict, List

import numpy as np
import pytest
from conftest import TINY, TINY_STYLE, ns_train
from nerfstudio.configs.dataparser_configs import all_dataparsers
from PIL import Image
from test_commands import write_ring, write_transforms

from sparsestyle_ns.cli import main
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.utils.errors import InputError


def refusal(method: str, scene: Path, outputs: Path, *flags: str) -> str:
    """The sentence with which a command ends."""
    with pytest.raises(SystemExit) as ended:
        ns_train(method, scene, outputs, "--max-num-iterations", "2", *flags)
    message = str(ended.value.code)
    assert message.startswith("Error: ")
    assert message.count("\n") == 0
    return message


def style_flags(runs: SimpleNamespace, painting: Path) -> List[str]:
    return ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *TINY_STYLE]


def test_a_refusal_goes_to_stderr_without_a_traceback_and_exits_with_1(llff_scene: Path, tmp_path: Path) -> None:
    script = "from nerfstudio.scripts.train import entrypoint; entrypoint()"
    command = [sys.executable, "-c", script, "hier-style", "--data", str(llff_scene), "--output-dir", str(tmp_path)]
    result = subprocess.run([*command, "llff-data"], capture_output=True, text=True, timeout=300)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert result.stderr.strip().splitlines()[-1].startswith("Error: There is no style image: name a painting with")


def test_a_missing_style_image_is_named_before_anything_is_trained(llff_scene: Path, tmp_path: Path) -> None:
    message = refusal("hier-style", llff_scene, tmp_path, "--style-image", "nowhere.png")
    assert "nowhere.png" in message
    assert not list(tmp_path.rglob("coarse-fewshot"))


def test_a_broken_style_image_is_named(llff_scene: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"\x89PNG not really")
    assert "broken.png" in refusal("hier-style", llff_scene, tmp_path / "outputs", "--style-image", str(broken))


def test_a_folder_without_poses_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    message = refusal("coarse-fewshot", tmp_path / "photos", tmp_path / "outputs")
    assert "poses_bounds.npy" in message


@pytest.mark.parametrize(
    ("file", "given", "named"),
    [
        ("poses_bounds.npy", "blender-data", "llff-data"),
        ("transforms.json", "blender-data", "nerfstudio-data"),
        ("transforms_train.json", "nerfstudio-data", "blender-data"),
        ("transforms_train.json", "llff-data", "blender-data"),
    ],
)
def test_a_scene_for_another_dataparser_has_that_one_named(tmp_path: Path, file: str, given: str, named: str) -> None:
    (tmp_path / file).touch()
    config = replace(all_dataparsers[given], data=tmp_path)
    with pytest.raises(InputError, match=f"it has {file}, which {named} reads: put {named} at the end of the command"):
        FewShotDataManagerConfig(dataparser=config).setup(device="cpu", test_mode="inference")


def test_a_folder_that_isnt_there_is_named(tmp_path: Path) -> None:
    for parser in ("llff-data", "blender-data", "nerfstudio-data"):
        config = FewShotDataManagerConfig(data=tmp_path / "gone", dataparser=copy.deepcopy(all_dataparsers[parser]))
        with pytest.raises(InputError, match=r"There is no folder .*/gone.*--data"):
            config.setup(device="cpu", test_mode="inference")


def test_photos_that_dont_match_the_poses_in_number_are_counted(llff_scene: Path, tmp_path: Path) -> None:
    scene = shutil.copytree(llff_scene, tmp_path / "scene")
    (scene / "images" / "image003.png").unlink()
    message = refusal("coarse-fewshot", scene, tmp_path / "outputs")
    assert "11" in message
    assert "12" in message


def test_a_photo_of_another_size_is_named(llff_scene: Path, tmp_path: Path) -> None:
    scene = shutil.copytree(llff_scene, tmp_path / "scene")
    Image.fromarray(np.zeros((24, 24, 3), np.uint8)).save(scene / "images" / "image005.png")
    assert "image005.png" in refusal("coarse-fewshot", scene, tmp_path / "outputs")


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--view-ids", "1", "99"], "99"),
        (["--view-ids", "0", "1"], "can be trained on are 1, 2"),
        (["--view-ids", "1", "1"], "only once"),
        (["--num-views", "0"], "at least one"),
        (["--num-views", "11"], "only 10 views"),
    ],
)
def test_views_that_dont_exist_are_named(llff_scene: Path, tmp_path: Path, flags: List[str], words: str) -> None:
    assert words in refusal("coarse-fewshot", llff_scene, tmp_path, *flags)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--max-image-side", "0"], "--max-image-side is 0; give 8 pixels or more"),
        (["--pipeline.datamanager.train-num-rays-per-batch", "0"], "rays-per-batch is 0; give 1 or more"),
        (["--pipeline.model.even-share", "0"], "--pipeline.model.even-share is 0.0; give a number above 0"),
        (["--pipeline.model.early-iterations", "-1"], "early-iterations is -1.0; give a number from 0 to 1"),
        (["--pipeline.model.num-samples", "0"], "--pipeline.model.num-samples is 0; give 1 sample or more"),
        (["--pipeline.model.early-samples", "0"], "--pipeline.model.early-samples is 0; give 1 sample or more"),
        (["--machine.device-type", "cuda", "--machine.num-devices", "99"], "--machine.num-devices 99, but torch finds"),
    ],
)
def test_numbers_that_no_run_can_have_are_named(llff_scene: Path, tmp_path: Path, flags: List[str], words: str) -> None:
    assert words in refusal("coarse-fewshot", llff_scene, tmp_path, *flags)


def test_a_coarse_run_of_another_scene_is_refused(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path
) -> None:
    other = shutil.copytree(llff_scene, tmp_path / "other")
    poses = np.load(other / "poses_bounds.npy")
    poses[5, 3] += 0.5
    np.save(other / "poses_bounds.npy", poses)
    message = refusal("hier-style", other, tmp_path / "outputs", *style_flags(runs, painting))
    assert "doesn't fit" in message


def test_a_coarse_run_of_other_views_is_refused(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path
) -> None:
    flags = [*style_flags(runs, painting), "--num-views", "2"]
    assert "trained on views [1, 5, 11]" in refusal("hier-style", llff_scene, tmp_path, *flags)


def test_a_coarse_run_that_is_none_is_refused(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path
) -> None:
    for path, words in ((tmp_path / "nowhere", "There is no run at"), (runs.style, "name a run of coarse-fewshot")):
        flags = ["--style-image", str(painting), "--coarse-run", str(path), *TINY_STYLE]
        assert words in refusal("hier-style", llff_scene, tmp_path / "outputs", *flags)


def test_missing_weights_name_all_three_ways_out(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import urllib.error

    import torch

    def no_network(*args: object, **kwargs: object) -> None:
        raise urllib.error.URLError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "empty"))
    monkeypatch.setattr(torch.hub, "download_url_to_file", no_network)
    message = refusal("hier-style", llff_scene, tmp_path, *style_flags(runs, painting), "--backbone", "vgg16")
    for way in ("--vgg-weights", "vgg16-397923af.pth", "vgg16-shift-tolerant"):
        assert way in message


def test_an_output_folder_that_cant_be_written_to_is_named(llff_scene: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    message = refusal("coarse-fewshot", llff_scene, tmp_path / "file", *TINY)
    assert "--output-dir" in message


def test_nothing_to_resume_is_said(llff_scene: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for folder, words in ((tmp_path / "nowhere", "nothing to resume"), (tmp_path / "empty", "no checkpoint")):
        flags = ["--load-dir", str(folder), *TINY]
        assert words in refusal("coarse-fewshot", llff_scene, tmp_path / "outputs", *flags)


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ("--load-dir {models} --load-step 7", "no checkpoint of iteration 7 in .* leave --load-step out to go on"),
        ("--load-dir {models} --load-step -1", "There is no checkpoint of iteration -1 in .* go on from 2, the newest"),
        ("--load-dir {models}/step-000000002.ckpt", "There is no checkpoint in .*ckpt; name a run's nerfstudio_models"),
        ("--load-checkpoint {models}", "--load-checkpoint .* is a folder; name it with --load-dir"),
    ],
)
def test_a_checkpoint_that_isnt_there_is_said(
    runs: SimpleNamespace, llff_scene: Path, tmp_path: Path, flags: str, sentence: str
) -> None:
    words = flags.format(models=runs.coarse / "nerfstudio_models").split()
    assert re.search(sentence, refusal("coarse-fewshot", llff_scene, tmp_path / "outputs", *words, *TINY))


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ("{run}", "Error: --data {run} is a run; name the folder of a scene."),
        ("{run}/config.yml", "Error: --data {run}/config.yml is a file; name the folder of a scene."),
        ("{scene}/images/image003.png", "Error: --data {scene}/images/image003.png is a file; name"),
        ("{scene}/images", "Error: {scene}/images has none of poses_bounds.npy"),
    ],
)
def test_what_is_no_scene_is_called_what_it_is(
    runs: SimpleNamespace, llff_scene: Path, data: str, sentence: str
) -> None:
    places = {"run": runs.coarse, "scene": llff_scene}
    with pytest.raises(SystemExit) as ended:
        main(["effects", "--data", data.format(**places)])
    assert str(ended.value.code).startswith(sentence.format(**places))


def test_a_scene_may_be_named_by_its_file(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_transforms(tmp_path, write_ring(tmp_path))
    main(["effects", "--data", str(tmp_path / "transforms.json")])
    assert f"--data {tmp_path / 'transforms.json'} nerfstudio-data" in capsys.readouterr().out.splitlines()[-1]


def named_twice(content: Dict[str, Any]) -> None:
    content["frames"][4]["file_path"] = content["frames"][1]["file_path"]


def at_one_place(content: Dict[str, Any]) -> None:
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] = 1.0


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (named_twice, r"Frames 1 and 4 \(from 0\) of .* are both of images/1\.png: drop one of them"),
        (at_one_place, "All cameras of .* stand at one place: give it photos from other places"),
        (lambda content: content.update(camera_model="FOO"), 'has the camera_model "FOO": name one of .*OPENCV'),
        (
            lambda content: content.update(train_filenames="images/0.png"),
            "has train_filenames that is no list of names",
        ),
        (
            lambda content: content.update(train_filenames=[], val_filenames=[], test_filenames=["images/0.png"]),
            "lists no photo in train_filenames: list some there, or take train_filenames, .* out",
        ),
    ],
)
def test_what_a_capture_cant_mean_is_named(tmp_path: Path, spoil: Callable[[Dict[str, Any]], None], words: str) -> None:
    write_transforms(tmp_path, write_ring(tmp_path))
    content = json.loads((tmp_path / "transforms.json").read_text())
    spoil(content)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(SystemExit, match=words):
        ns_train("coarse-fewshot", tmp_path, tmp_path / "outputs", *TINY, parser="nerfstudio-data")


def test_photos_that_are_held_out_and_trained_on_are_named(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_transforms(tmp_path, write_ring(tmp_path))
    names = [f"images/{index}.png" for index in range(6)]
    content = json.loads((tmp_path / "transforms.json").read_text())
    content.update(train_filenames=names[:4], val_filenames=names[3:], test_filenames=names[3:])
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    flags = ["--view-ids", "0", "1", "3", "--max-num-iterations", "1", *TINY]
    ns_train("coarse-fewshot", tmp_path, tmp_path / "outputs", *flags, parser="nerfstudio-data")
    printed = " ".join(capsys.readouterr().out.split())
    assert "Held out, but trained on as well, so that figures say less: 3.png." in printed


def test_a_mask_that_isnt_there_is_named(tmp_path: Path) -> None:
    write_transforms(tmp_path, write_ring(tmp_path))
    content = json.loads((tmp_path / "transforms.json").read_text())
    for index, frame in enumerate(content["frames"]):
        frame["mask_path"] = f"masks/{index}.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    config = FewShotDataManagerConfig(data=tmp_path, dataparser=copy.deepcopy(all_dataparsers["nerfstudio-data"]))
    with pytest.raises(InputError, match=r"The mask .*masks/0\.png doesn't fit .*images/0\.png, as it isn't there"):
        config.setup(device="cpu", test_mode="inference").train_dataset[0]


def test_a_refused_command_leaves_no_folder(llff_scene: Path, tmp_path: Path) -> None:
    script = "from nerfstudio.scripts.train import entrypoint; entrypoint()"
    command = [sys.executable, "-c", script, "coarse-fewshot", "--data", str(llff_scene), "--vis", "tensorboard"]
    command += ["--output-dir", str(tmp_path / "new" / "outputs"), "--view-ids", "99", "llff-data"]
    assert subprocess.run(command, capture_output=True, timeout=300).returncode == 1
    assert not list(tmp_path.iterdir())


def test_a_refused_command_leaves_former_runs_alone(runs: SimpleNamespace, llff_scene: Path, painting: Path) -> None:
    before = {path: os.stat(path).st_mtime_ns for path in runs.outputs.rglob("*") if path.is_file()}
    refusal("hier-style", llff_scene, runs.outputs, "--style-image", "nowhere.png")
    after = {path: os.stat(path).st_mtime_ns for path in before}
    assert before == after

"""The commands that a user types, run as nerfstudio runs them on a tiny scene."""

import json
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from conftest import TINY, TINY_STYLE, ns_train, only_run, run_entrypoint
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from scipy.spatial.transform import Rotation

from sparsestyle_ns import method_configs
from sparsestyle_ns.effects.registry import EFFECTS
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.engine.trainer import SparseStyleTrainer
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.runs.checkpoints import newest_checkpoint
from sparsestyle_ns.runs.coarse_run import read_coarse_run
from sparsestyle_ns.style import vgg

METHODS = tuple(
    f"{method}{variant}" for method in ("coarse-fewshot", "hier-style") for variant in ("", "-draft", "-paper")
)
HASH_TABLE = "_model.residual.grid.table"


def load(run: Path) -> dict:
    return torch.load(newest_checkpoint(run / "nerfstudio_models"), weights_only=True)


def render(subcommand: str, run: Path, output: Path, *flags: str) -> None:
    from nerfstudio.scripts import render

    run_entrypoint(
        render.entrypoint, [subcommand, "--load-config", str(run / "config.yml"), "--output-path", str(output), *flags]
    )


def press_ctrl_c_at(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Has the user press Ctrl-C in the middle of an iteration."""
    train_iteration = SparseStyleTrainer.train_iteration

    def press(trainer: SparseStyleTrainer, current: int):
        if current == step:
            signal.raise_signal(signal.SIGINT)
        return train_iteration(trainer, current)

    monkeypatch.setattr(SparseStyleTrainer, "train_iteration", press)


def train_until_ctrl_c(*arguments: object) -> None:
    """`ns_train` where Ctrl-C comes, which ends the command with status 130."""
    with pytest.raises(SystemExit) as ended:
        ns_train(*arguments)
    assert ended.value.code == 130


def assert_same_state(first: dict, second: dict) -> None:
    assert first.keys() == second.keys()
    for key, value in first.items():
        assert torch.equal(value, second[key]), key


def test_a_fresh_process_lists_the_methods_and_the_llff_dataparser() -> None:
    script = (
        "from nerfstudio.configs.method_configs import all_methods; print(*all_methods); "
        "from nerfstudio.data.datamanagers.base_datamanager import AnnotatedDataParserUnion; "
        "from nerfstudio.configs.dataparser_configs import all_dataparsers; print(*all_dataparsers)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    words = result.stdout.split()
    assert set(METHODS) <= set(words)
    assert "llff-data" in words


def test_drafts_are_the_same_methods_with_other_numbers() -> None:
    for method in ("coarse-fewshot", "hier-style"):
        full, draft = method_config(method), method_config(f"{method}-draft")
        assert type(full) is type(draft)
        assert type(full.pipeline.model) is type(draft.pipeline.model)
        assert draft.max_num_iterations <= full.max_num_iterations
        assert draft.pipeline.datamanager.max_image_side < full.pipeline.datamanager.max_image_side


def test_variants_named_after_the_paper_have_its_settings() -> None:
    coarse, style = method_config("coarse-fewshot-paper"), method_config("hier-style-paper")
    assert coarse.max_num_iterations == 50_000
    assert coarse.pipeline.datamanager.train_num_rays_per_batch == 1024
    for group in coarse.optimizers.values():
        assert type(group["optimizer"]).__name__ == "FusedAdamConfig"
        assert (group["optimizer"].lr, group["scheduler"]) == (5e-4, None)
    assert coarse.pipeline.model.distortion_weight == 0.0
    field = coarse.pipeline.model.coarse_field
    assert (field.num_levels, field.num_layers) == (7, 6)
    optimizer, scheduler = (style.optimizers["fields"][part] for part in ("optimizer", "scheduler"))
    assert (optimizer.lr, optimizer.betas) == (5e-3, (0.9, 0.999))
    assert (scheduler.gamma, scheduler.milestones, scheduler.warm_up) == (0.33, (0.25, 0.5), 0.0)
    settings, model = style.pipeline, style.pipeline.model
    (level,) = settings.levels(style.max_num_iterations)
    assert (level.scale, level.length) == (1.0, 200)
    assert settings.loss_weights == {"content": 10.0, "style": 1.0, "colors": 0.0, "textures": 0.0, "structure": 0.0}
    assert settings.content_decay == 0.01
    assert settings.content_share * level.length == 100
    assert (settings.warm_start_steps, settings.thinning) == (0, 0.0)
    assert style.coarse_method().method_name == "coarse-fewshot-paper"
    assert (model.hash_levels, model.min_resolution, model.max_resolution) == (8, 128, 512)
    assert (model.features_per_level, model.log2_table_size) == (4, 19)
    assert (model.hidden_layers, model.layer_width) == (2, 256)


def test_by_default_effects_are_decided_by_the_scene() -> None:
    for method in ("coarse-fewshot", "hier-style", "coarse-fewshot-draft", "hier-style-draft"):
        effects = method_config(method).pipeline.effects
        assert {getattr(effects, name) for name in EFFECTS} == {"auto"}


def test_the_views_in_use_are_saved_with_the_run(runs: SimpleNamespace) -> None:
    for run in (runs.coarse, runs.style):
        scene = json.loads((run / "scene.json").read_text())
        assert scene["view_ids"] == [1, 5, 11]  # of 12 photos, 0 and 8 are held out; evenly spaced in the other ten
        assert scene["view_names"] == ["image001.png", "image005.png", "image011.png"]
        assert scene["effects"]["ndc"]


def test_a_stylised_checkpoint_holds_the_whole_scene_and_nothing_else(runs: SimpleNamespace) -> None:
    coarse, style = load(runs.coarse)["pipeline"], load(runs.style)["pipeline"]
    fields = {key for key in coarse if key.startswith(("_model.field.", "_model.space."))}
    assert set(coarse) == fields | {"_model.device_indicator_param", "_model.grid.density"}
    assert set(style) == fields | {
        "_model.device_indicator_param",
        "_model.occupancy.occupied",
        "_model.volume.log_density",
        HASH_TABLE,
        *(f"_model.residual.mlp.layers.{layer}.{part}" for layer in (0, 1) for part in ("weight", "bias")),
        *(f"_model.residual.{head}_head.{part}" for head in ("color", "density") for part in ("weight", "bias")),
        *(f"_model.residual.recoloring.{part}" for part in ("matrix", "offset", "table")),
    }
    assert_same_state({key: coarse[key] for key in fields}, {key: style[key] for key in fields})
    backbone = load(runs.style)["backbone"]
    assert backbone["name"] in ("vgg16", "vgg16-shift-tolerant")
    assert len(backbone["sha256"]) == 64


def test_a_run_says_how_fine_its_hash_grid_is_so_that_it_stays_so_with_photos_of_another_size(runs) -> None:
    config = yaml.load((runs.style / "config.yml").read_text(), Loader=yaml.Loader)
    cells = config.pipeline.model.max_resolution
    photo = load_run(runs.style / "config.yml").pipeline.datamanager.photo_side
    assert load(runs.style)["max_resolution"] == cells and photo <= cells < photo + 16


def test_a_stylised_run_renders_without_painting_weights_and_coarse_run(
    runs: SimpleNamespace, llff_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sparsestyle_ns.pipelines.hier_style as pipeline
    import sparsestyle_ns.pipelines.scene_pipeline as base

    def refuse(*args: object) -> None:
        raise AssertionError("rendering asked for the painting or the feature network")

    monkeypatch.setattr(pipeline.Painting, "read", refuse)
    monkeypatch.setattr(base, "load_backbone", refuse)
    hidden = runs.coarse.rename(runs.coarse.parent / "hidden")
    try:
        names = ["rgb", "rgb_coarse", "depth", "accumulation"]
        render("dataset", runs.style, tmp_path, "--split", "test", "--rendered-output-names", *names)
    finally:
        hidden.rename(runs.coarse)
    for name in names:
        pictures = sorted((tmp_path / "test" / name).glob("*.jpg"))
        assert [path.stem for path in pictures] == ["image000", "image008"]
        assert iio.imread(pictures[0]).shape[:2] == (24, 32)


def test_a_run_renders_from_voxels_when_its_config_says_so(
    runs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sparsestyle_ns.rendering.baked import BakedVolume

    filled = []
    fill = BakedVolume.fill
    monkeypatch.setattr(BakedVolume, "fill", lambda volume, cells: (filled.append(len(cells)), fill(volume, cells)))
    text = (runs.style / "config.yml").read_text()
    assert "    render_mode: exact\n" in text
    pictures = {}
    for mode in ("exact", "baked"):
        (tmp_path / mode).mkdir()
        (tmp_path / mode / "config.yml").write_text(text.replace("render_mode: exact", f"render_mode: {mode}"))
        flags = ["--split", "test", "--rendered-output-names", "rgb", "--image-format", "png"]
        render("dataset", tmp_path / mode, tmp_path / mode, *flags)
        pictures[mode] = iio.imread(tmp_path / mode / "test" / "rgb" / "image000.png").astype(float)
        assert bool(filled) == (mode == "baked")
    assert np.abs(pictures["exact"] - pictures["baked"]).mean() < 3  # of 255


@pytest.mark.parametrize("kind", ["coarse", "style"])
def test_interpolated_spiral_and_camera_paths_render(runs: SimpleNamespace, tmp_path: Path, kind: str) -> None:
    run, images = getattr(runs, kind), ["--output-format", "images"]
    render("interpolate", run, tmp_path / "between", *images, "--interpolation-steps", "2", "--pose-source", "train")
    render("spiral", run, tmp_path / "spiral", *images, "--seconds", "0.1", "--frame-rate", "20")
    pose = np.eye(4)
    camera = {"camera_to_world": pose.flatten().tolist(), "fov": 50, "aspect": 1}
    path = tmp_path / "path.json"
    path.write_text(
        json.dumps(
            {
                "camera_type": "perspective",
                "render_height": 16,
                "render_width": 20,
                "fps": 2,
                "seconds": 1,
                "camera_path": [camera, camera],
            }
        )
    )
    render("camera-path", run, tmp_path / "path", *images, "--camera-path-filename", str(path))
    assert len(list((tmp_path / "between").glob("*.jpg"))) >= 3
    assert len(list((tmp_path / "spiral").glob("*.jpg"))) == 2
    frames = sorted((tmp_path / "path").glob("*.jpg"))
    assert [iio.imread(frame).shape for frame in frames] == [(16, 20, 3)] * 2


def test_ns_eval_writes_the_coarse_fields_quality_for_both_methods(runs: SimpleNamespace, tmp_path: Path) -> None:
    from nerfstudio.scripts import eval as ns_eval

    values = {}
    for kind, prefix in (("coarse", ""), ("style", "coarse_")):
        output = tmp_path / f"{kind}.json"
        arguments = ["--load-config", str(getattr(runs, kind) / "config.yml"), "--output-path", str(output)]
        run_entrypoint(ns_eval.entrypoint, arguments)
        results = json.loads(output.read_text())["results"]
        values[kind] = results[f"{prefix}psnr"]
        assert 0 < values[kind] < 50
        assert -1 <= results[f"{prefix}ssim"] <= 1
    assert values["style"] == pytest.approx(values["coarse"], abs=1.0)  # the same field, sampled in two ways


@pytest.mark.parametrize("method", ["coarse-fewshot", "hier-style"])
def test_a_resumed_run_ends_as_one_that_was_never_stopped(
    runs: SimpleNamespace,
    llff_scene: Path,
    painting: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
) -> None:
    flags = TINY
    if method == "hier-style":
        flags = ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *TINY_STYLE]
    ns_train(method, llff_scene, tmp_path / "whole", "--max-num-iterations", "6", *flags)
    with monkeypatch.context() as patch:
        press_ctrl_c_at(patch, step=2)
        train_until_ctrl_c(method, llff_scene, tmp_path / "first", "--max-num-iterations", "6", *flags)
    first = only_run(tmp_path / "first", method)
    resume = ["--load-dir", str(first / "nerfstudio_models"), "--max-num-iterations", "6"]
    ns_train(method, llff_scene, tmp_path / "second", *resume, *flags)
    whole, second = load(only_run(tmp_path / "whole", method)), load(only_run(tmp_path / "second", method))
    assert whole["step"] == second["step"] == 5
    assert_same_state(whole["pipeline"], second["pipeline"])
    assert whole["schedulers"] == second["schedulers"]
    groups = (state["optimizers"]["fields"]["param_groups"][0]["lr"] for state in (whole, second))
    assert len(set(groups)) == 1


def test_ctrl_c_takes_nothing_from_the_iteration_it_comes_in(
    llff_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the fifth of six iterations empty space is decided about, and the preview is due."""
    flags = [*TINY[: TINY.index("--pipeline.effects.empty-space")], "--max-num-iterations", "6", "--previews", "0.8"]
    ns_train("coarse-fewshot", llff_scene, tmp_path / "whole", *flags)
    with monkeypatch.context() as patch:
        press_ctrl_c_at(patch, step=4)
        train_until_ctrl_c("coarse-fewshot", llff_scene, tmp_path / "first", *flags)
    first, whole = (only_run(tmp_path / name, "coarse-fewshot") for name in ("first", "whole"))
    assert [path.name for path in (first / "previews").iterdir()] == ["after-000005.png"]
    ns_train("coarse-fewshot", llff_scene, tmp_path / "second", "--load-dir", str(first / "nerfstudio_models"), *flags)
    ends = load(whole), load(only_run(tmp_path / "second", "coarse-fewshot"))
    assert ends[0]["effects"] == ends[1]["effects"]
    assert_same_state(ends[0]["pipeline"], ends[1]["pipeline"])


def test_a_run_remembers_where_its_painting_is(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(painting.parent)
    flags = ["--style-image", painting.name, "--coarse-run", str(runs.coarse), "--max-num-iterations", "1"]
    ns_train("hier-style", llff_scene, tmp_path, *flags, *TINY_STYLE)
    config = yaml.load((only_run(tmp_path, "hier-style") / "config.yml").read_text(), Loader=yaml.Loader)
    assert config.pipeline.style_image == painting.resolve()


def test_a_coarse_run_that_isnt_finished_is_said_to_be(runs: SimpleNamespace, tmp_path: Path) -> None:
    assert read_coarse_run(runs.coarse).in_words() == str(runs.coarse)
    folder = shutil.copytree(runs.coarse, tmp_path / "run")
    config = (folder / "config.yml").read_text().replace("max_num_iterations: 3", "max_num_iterations: 30")
    (folder / "config.yml").write_text(config)
    assert read_coarse_run(folder).in_words() == f"{folder}, which isn't finished (3 of 30 iterations)"


@pytest.fixture
def short_coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes coarse-fewshot a method of two iterations of a narrow field."""
    coarse = method_configs.coarse_fewshot.config
    monkeypatch.setattr(coarse, "max_num_iterations", 2)
    monkeypatch.setattr(coarse.pipeline.model.coarse_field, "layer_width", 32)


@pytest.mark.usefixtures("short_coarse")
def test_hier_style_trains_the_coarse_run_itself_where_there_is_none(
    llff_scene: Path, painting: Path, tmp_path: Path
) -> None:
    style = ["--style-image", str(painting), "--num-views", "2", "--max-num-iterations", "2", *TINY_STYLE]
    ns_train("hier-style", llff_scene, tmp_path, *style)
    trained, stylised = only_run(tmp_path, "coarse-fewshot"), only_run(tmp_path, "hier-style")
    config = yaml.load((stylised / "config.yml").read_text(), Loader=yaml.Loader)
    assert config.pipeline.coarse_run == trained.resolve()
    assert json.loads((trained / "scene.json").read_text())["view_ids"] == [1, 11]
    assert load(trained)["step"] == load(stylised)["step"] == 1


@pytest.mark.usefixtures("short_coarse")
def test_a_coarse_run_that_ctrl_c_ends_within_hier_style_is_finished_by_the_command_it_names(
    llff_scene: Path, painting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    from nerfstudio.scripts import train

    style = ["--style-image", str(painting), "--num-views", "2", "--max-num-iterations", "1", *TINY_STYLE]
    with monkeypatch.context() as patch:
        press_ctrl_c_at(patch, step=0)
        train_until_ctrl_c("hier-style", llff_scene, tmp_path, *style)
    (resume,) = re.findall("finish it with (ns-train .*) and run this command again", capsys.readouterr().err)
    interrupted = only_run(tmp_path, "coarse-fewshot")
    time.sleep(1)  # runs are named by the second, and the one that goes on is to be another one
    run_entrypoint(train.entrypoint, shlex.split(resume)[1:])
    ns_train("hier-style", llff_scene, tmp_path, *style)
    (checkpoint,) = tmp_path.glob("*/hier-style/*/nerfstudio_models/*.ckpt")
    config = yaml.load((checkpoint.parents[1] / "config.yml").read_text(), Loader=yaml.Loader)
    assert config.pipeline.coarse_run.parent == interrupted.resolve().parent
    assert config.pipeline.coarse_run != interrupted.resolve()
    assert load(config.pipeline.coarse_run)["step"] == 1


def test_ctrl_c_leaves_a_checkpoint_that_renders(
    llff_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    press_ctrl_c_at(monkeypatch, step=2)
    train_until_ctrl_c("coarse-fewshot", llff_scene, tmp_path / "outputs", "--max-num-iterations", "50", *TINY)
    run = only_run(tmp_path / "outputs", "coarse-fewshot")
    assert load(run)["step"] == 2
    printed = capsys.readouterr().out
    assert "Stopped after iteration 3 of 50" in printed
    resume = f"ns-train coarse-fewshot --load-dir {run / 'nerfstudio_models'} --data {llff_scene}"
    assert printed.splitlines()[-1].startswith(f"Made {run}, up to iteration 3 of 50 – next: {resume}")
    render("dataset", run, tmp_path / "pictures", "--split", "test", "--rendered-output-names", "rgb")
    assert len(list((tmp_path / "pictures").rglob("*.jpg"))) == 2


def test_resuming_a_finished_run_says_so_and_keeps_it(runs: SimpleNamespace, llff_scene: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(runs.coarse / "nerfstudio_models", tmp_path / "models")
    flags = ["--load-dir", str(folder), "--max-num-iterations", "3", *TINY]
    with pytest.raises(SystemExit, match="raise it to train on"):
        ns_train("coarse-fewshot", llff_scene, tmp_path / "outputs", *flags)
    assert newest_checkpoint(folder) is not None


def test_a_checkpoint_of_another_shape_is_refused_instead_of_loaded_in_part(
    runs: SimpleNamespace, llff_scene: Path, tmp_path: Path
) -> None:
    flags = ["--load-dir", str(runs.coarse / "nerfstudio_models"), "--max-num-iterations", "6"]
    with pytest.raises(SystemExit, match="doesn't fit this configuration"):
        ns_train("coarse-fewshot", llff_scene, tmp_path, *flags, "--pipeline.model.coarse-field.layer-width", "16")


@pytest.mark.parametrize(
    "note, sentence",
    [
        ({"backbone": {"name": "vgg16"}}, "There are no weights for --backbone vgg16"),
        ({"fine_encoding": "frequency"}, "doesn't fit this configuration"),
    ],
)
def test_what_was_chosen_when_a_run_began_is_not_chosen_again_when_it_goes_on(
    runs: SimpleNamespace,
    llff_scene: Path,
    painting: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    note: dict,
    sentence: str,
) -> None:
    """By notes that say what can't be here: they would only be missed if they were looked at."""
    monkeypatch.setattr(vgg, "_download", lambda target: False)
    folder = shutil.copytree(runs.style / "nerfstudio_models", tmp_path / "models")
    state = torch.load(newest_checkpoint(folder), weights_only=True)
    assert set(note) <= set(state)
    torch.save({**state, **note}, newest_checkpoint(folder))
    flags = [*TINY_STYLE, "--style-image", str(painting), "--load-dir", str(folder), "--max-num-iterations", "6"]
    with pytest.raises(SystemExit, match=sentence):
        ns_train("hier-style", llff_scene, tmp_path / "outputs", *flags)


def test_tiny_cuda_nn_is_refused_in_a_sentence_where_it_isnt(
    runs: SimpleNamespace, llff_scene: Path, painting: Path, tmp_path: Path
) -> None:
    flags = ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *TINY_STYLE]
    with pytest.raises(
        SystemExit, match="is tiny-cuda-nn, which isn't installed here, finds no GPU, or has no rows of"
    ):
        ns_train("hier-style", llff_scene, tmp_path, *flags, "--pipeline.model.fine-encoding", "tiny-cuda-nn")


def test_blender_scenes_train_too(tmp_path: Path, painting: Path) -> None:
    import make_sample_scene

    sizes = ["--num-train", "9", "--num-val", "1", "--num-test", "1", "--width", "16"]
    make_sample_scene.main([str(tmp_path), "--layout", "blender", *sizes])
    scene, outputs = tmp_path / "blender", tmp_path / "outputs"
    ns_train("coarse-fewshot", scene, outputs, "--max-num-iterations", "2", *TINY, parser="blender-data")
    style = ["--style-image", str(painting), "--max-num-iterations", "2", *TINY_STYLE]
    ns_train("hier-style", scene, outputs, *style, parser="blender-data")
    saved = json.loads((only_run(outputs, "hier-style") / "scene.json").read_text())
    assert saved["effects"]["box"] and saved["background_color"] == [1.0, 1.0, 1.0]
    assert saved["view_ids"] == [0, 1, 2, 3, 5, 6, 7, 8]  # eight evenly spaced of nine: too few for the standard eight


def write_ring(folder: Path) -> np.ndarray:
    """Six photos, 16 × 12, taken from all around; returns their poses, looking along −z with y up."""
    (folder / "images").mkdir(parents=True)
    poses = []
    for index, angle in enumerate(np.linspace(0, 2 * np.pi, 6, endpoint=False)):
        back = np.array([np.cos(angle), np.sin(angle), 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([np.cross([0, 0, 1.0], back), [0, 0, 1.0], back, 2 * back], axis=-1)
        poses.append(pose)
        colors = np.random.default_rng(index).integers(0, 256, (12, 16, 3), dtype=np.uint8)
        iio.imwrite(folder / "images" / f"{index}.png", colors)
    return np.array(poses)


def write_transforms(folder: Path, poses: np.ndarray) -> None:
    """nerfstudio's transforms.json for the photos of `write_ring`."""
    frames = [
        {"file_path": f"images/{index}.png", "transform_matrix": pose.tolist()} for index, pose in enumerate(poses)
    ]
    camera = {"fl_x": 16.0, "fl_y": 16.0, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12, "camera_model": "OPENCV"}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))


def test_nerfstudio_captures_train_on_the_views_asked_for_in_contracted_space(tmp_path: Path) -> None:
    write_transforms(tmp_path / "capture", write_ring(tmp_path / "capture"))
    flags = ["--num-views", "4", "--max-num-iterations", "2", *TINY]
    ns_train("coarse-fewshot", tmp_path / "capture", tmp_path / "outputs", *flags, parser="nerfstudio-data")
    scene = json.loads((only_run(tmp_path / "outputs", "coarse-fewshot") / "scene.json").read_text())
    assert scene["effects"]["contraction"] and scene["background_color"] is None
    assert len(scene["view_names"]) == 4


def test_a_capture_too_small_to_hold_views_out_can_still_be_evaluated(tmp_path: Path) -> None:
    data = FewShotDataManagerConfig(data=tmp_path / "capture", dataparser=NerfstudioDataParserConfig())
    write_transforms(tmp_path / "capture", write_ring(tmp_path / "capture"))
    manager = data.setup(device="cpu", test_mode="inference")
    assert len(manager.eval_dataset) == len(manager.train_dataset) == 6


def test_colmap_captures_train_on_the_views_asked_for(tmp_path: Path) -> None:
    poses = write_ring(tmp_path / "capture")
    sparse = tmp_path / "capture" / "colmap" / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text("1 PINHOLE 16 12 16 16 8 6\n")
    lines = []
    for index, pose in enumerate(poses):
        rotation = (pose[:3, :3] * [1, -1, -1]).T  # COLMAP's cameras look along +z with y down
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        lines += [" ".join(map(str, [index + 1, w, x, y, z, *(-rotation @ pose[:3, 3]), 1, f"{index}.png"])), "1 1 1"]
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "points3D.txt").write_text("1 0 0 0 255 0 0 0.5 1 0\n")
    flags = ["--num-views", "3", "--max-num-iterations", "2", *TINY]
    ns_train("coarse-fewshot", tmp_path / "capture", tmp_path / "outputs", *flags, parser="colmap")
    scene = json.loads((only_run(tmp_path / "outputs", "coarse-fewshot") / "scene.json").read_text())
    assert len(scene["view_names"]) == 3


def test_the_viewer_opens_a_stylised_run(runs: SimpleNamespace) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    script = "from nerfstudio.scripts.viewer.run_viewer import entrypoint; entrypoint()"
    command = [sys.executable, "-c", script, "--load-config", str(runs.style / "config.yml")]
    command += ["--viewer.websocket-port", str(port), "--viewer.websocket-host", "127.0.0.1"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as viewer:
        try:
            page = wait_for_page(f"http://127.0.0.1:{port}", viewer)
        finally:
            viewer.kill()
    assert "<html" in page


def wait_for_page(url: str, server: subprocess.Popen) -> str:
    """What a server answers once it is up."""
    for _ in range(240):
        assert server.poll() is None, server.stderr.read()
        try:
            with urllib.request.urlopen(url, timeout=5) as answer:
                return answer.read().decode()
        except OSError:
            time.sleep(0.5)
    raise AssertionError(f"{url} didn't answer in two minutes")

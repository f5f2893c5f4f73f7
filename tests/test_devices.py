"""Both methods on a second device (`second_device.py`): nothing is left on the CPU, and little is waited for."""

import copy
import functools
import itertools
import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Dict, Iterator

import pytest
import torch
from conftest import TINY, TINY_STYLE, ns_train, only_run, run_entrypoint
from interpreted_kernels import interpreted_kernels
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from second_device import CUDA, SecondDevice
from test_commands import render, write_ring, write_transforms

from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.engine.previews import render_preview
from sparsestyle_ns.engine.restyling import Restyling, Workshop
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.field_components import hash_grid
from sparsestyle_ns.fields.coarse import CoarseFieldConfig
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.rendering.look import Look
from sparsestyle_ns.rendering.mixing import Mix
from sparsestyle_ns.style.painting import Painting

FIELD = CoarseFieldConfig(num_levels=3, num_layers=2, layer_width=16, feature_dim=4)
EFFECTS = {"empty_space": "on", "residual_density": "on", "matched_depth": "off", "exposure": "off"}


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[SecondDevice]:
    """The second device, without Triton: its interpreter takes seconds an iteration."""
    kernels = hash_grid.fused_kernels
    monkeypatch.setattr(hash_grid, "fused_kernels", lambda where: None if where.type == "cuda" else kernels(where))
    with SecondDevice() as second:
        yield second
    assert second.mistakes == []


def set_up(config: Any, scene: Path, effects: Dict[str, str], **settings: Any) -> Any:
    """A small version of a method, with some settings of its pipeline; those of its model have names with a dot."""
    config = copy.deepcopy(config)
    config.max_num_iterations = 8
    pipeline = config.pipeline
    pipeline.datamanager.data, pipeline.datamanager.dataparser = scene, LLFFDataParserConfig()
    pipeline.datamanager.train_num_rays_per_batch = 64
    pipeline.effects = EffectSettings(**{**EFFECTS, **effects})
    pipeline.backbone, pipeline.model.coarse_field = "vgg16-shift-tolerant", FIELD
    for name, value in settings.items():
        owner, _, last = name.rpartition("__")
        assert hasattr(getattr(pipeline, owner) if owner else pipeline, last)
        setattr(getattr(pipeline, owner) if owner else pipeline, last, value)
    return config


def coarse_config(scene: Path, effects: Dict[str, str] = {}, **settings: Any) -> Any:  # noqa: B006 - only read
    sizes = {"model__volume_resolution": 8, "model__grid_resolution": 8, "model__num_steps": 12}
    return set_up(method_config("coarse-fewshot"), scene, effects, **sizes, **settings)


def style_config(scene: Path, painting: Path, effects: Dict[str, str] = {}, **settings: Any) -> Any:  # noqa: B006
    sizes = {
        "log2_table_size": 8,
        "hash_levels": 2,
        "layer_width": 16,
        "occupancy_resolution": 8,
        "bake_resolution": 16,
        "num_steps": 12,
    }
    sizes = {f"model__{name}": value for name, value in sizes.items()}
    run = {"style_image": painting, "warm_start_steps": 1, "feature_side": 32}
    return set_up(method_config("hier-style"), scene, effects, **sizes, **{**run, **settings})


def coarse_state(scene: Path, effects: Dict[str, str]) -> Dict[str, torch.Tensor]:
    """Of a coarse field that shows something."""
    torch.manual_seed(0)
    model = Training(coarse_config(scene, effects), CUDA).pipeline.model
    with torch.no_grad():
        model.field.density_head.weight.normal_(std=2.0)
    return model.state_dict()


def look(training: Training) -> None:
    """Renders a held-out view and measures it, as previews, `ns-eval` and tensorboard do."""
    pipeline = training.pipeline
    render_preview(pipeline, 16)
    pipeline.get_eval_loss_dict(0)
    pipeline.get_eval_image_metrics_and_images(0)


OUTSIDE = {"ndc": "off", "contraction": "on"}


def waits_of(device: SecondDevice, training: Training, steps: int = 3) -> Dict[str, float]:
    """What an iteration waits for, by file and kind, after a first one; in iterations whose values nobody looks at."""
    training.step()
    device.waits.clear()
    for _ in range(steps):
        training.step()
    found: Dict[str, float] = {}
    for (kind, where), count in device.waits.items():
        if kind != "copy on the way":
            key = f"{kind}, {where.split(':')[0].removeprefix('sparsestyle_ns/')}"
            found[key] = found.get(key, 0.0) + count / steps
    return found


def test_an_iteration_of_stage_1_waits_once(device: SecondDevice, llff_scene: Path) -> None:
    training = Training(coarse_config(llff_scene), CUDA)
    assert waits_of(device, training) == {"nonzero, field_components/thinned_mlp.py": 1}
    look(training)


STYLE_WAITS = {
    "nonzero, field_components/thinned_mlp.py": 1,
    "nonzero, losses/style_index.py": 3,
    "tolist, losses/style_index.py": 4,
}


@pytest.mark.parametrize("kept", [True, False])
def test_an_iteration_of_stage_2_waits_for_what_decides_on_sizes_alone(
    device: SecondDevice, llff_scene: Path, painting: Path, kept: bool
) -> None:
    settings = {} if kept else {"cache_gigabytes": 0.0}
    training = Training(style_config(llff_scene, painting, **settings), CUDA, coarse_state(llff_scene, {}))
    again = {} if kept else {"nonzero, rendering/few_samples.py": 1}
    assert waits_of(device, training) == STYLE_WAITS | again


slow = pytest.mark.slow


@pytest.mark.parametrize(
    "effects, settings",
    [
        ({**OUTSIDE, "background": "on", "exposure": "on"}, {"model__thinning": 0.0}),
        pytest.param(
            {"matched_depth": "on", "empty_space": "off", "view_color": "on"},
            {"model__occlusion_weight": 0.1},
            marks=slow,
        ),
        pytest.param({"pose_refinement": "on", "matched_depth": "on"}, {}, marks=slow, id="pose refinement"),
        pytest.param(
            {"empty_space": "auto"},
            {"semantic_weight": 0.1, "semantic_every": 2, "model__frequency_reveal": 0.9},
            marks=slow,
        ),
    ],
)
def test_stage_1_trains_there(device: SecondDevice, llff_scene: Path, effects: dict, settings: dict) -> None:
    training = Training(coarse_config(llff_scene, effects, **settings), CUDA)
    for _ in range(7):  # past three quarters, where it is decided about empty space
        training.step()
    look(training)
    training.pipeline.model.finish_learning()
    look(training)
    held = {name: str(value.device) for name, value in training.pipeline.state_dict().items()}
    assert set(held.values()) == {"cuda:0"}, held


@pytest.mark.slow
def test_distorted_cameras_around_a_box_train_and_render_there(
    device: SecondDevice, painting: Path, tmp_path: Path
) -> None:
    write_transforms(tmp_path, write_ring(tmp_path))
    content = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_text(json.dumps({**content, "k1": 0.1, "p1": 0.01}))
    effects = {"box": "on", "contraction": "off", "lens_distortion": "on", "residual_density": "on"}
    coarse, style = coarse_config(tmp_path, effects), style_config(tmp_path, painting, effects)
    for config in (coarse, style):
        config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig()
    training = Training(coarse, CUDA)
    training.step()
    look(training)
    training = Training(style, CUDA, training.pipeline.model.state_dict())
    training.step()
    look(training)
    with training.pipeline.model.display.rendering("baked"):
        look(training)


@pytest.mark.parametrize(
    "effects, settings",
    [
        ({**OUTSIDE, "background": "on", "exposure": "on", "palette": "on"}, {"cache_gigabytes": 0.0}),
        pytest.param({"empty_space": "off", "palette": "on"}, {"novel_views": 2, "samples_per_chunk": 512}, marks=slow),
        pytest.param({"view_color": "on"}, {"model__stylised_field": "coarse"}, marks=slow),
        pytest.param(
            {"residual_density": "off"}, {"model__num_samples": None, "model__fine_encoding": "frequency"}, marks=slow
        ),
        pytest.param({}, {"model__fine_encoding": "none", "style_features": 50}, marks=slow),
    ],
)
def test_stage_2_trains_and_renders_there(
    device: SecondDevice, llff_scene: Path, painting: Path, effects: dict, settings: dict
) -> None:
    config = style_config(llff_scene, painting, effects, **settings)
    training = Training(config, CUDA, coarse_state(llff_scene, effects))
    for _ in range(3):
        training.num_steps = (training.num_steps + 3) % 8  # at both sizes of the views
        training.step()
    look(training)
    with training.pipeline.model.display.rendering("baked"):
        look(training)
    held = {name: str(value.device) for name, value in training.pipeline.state_dict().items()}
    assert set(held.values()) == {"cuda:0"}, held


@pytest.mark.parametrize("residual_density", ["on", "off"])
def test_what_the_viewers_controls_ask_for_is_drawn_there(
    device: SecondDevice, llff_scene: Path, painting: Path, residual_density: str
) -> None:
    effects = {"residual_density": residual_density}
    config = style_config(llff_scene, painting, effects)
    training = Training(config, CUDA, coarse_state(llff_scene, effects))
    training.step()
    pipeline = training.pipeline.eval()
    model, camera = pipeline.model, pipeline.datamanager.train_dataset.cameras[:1].to(CUDA)
    with torch.no_grad():
        plain = model.get_outputs_for_camera(camera)
        for styles in ((model.residual,), (model.residual, copy.deepcopy(model.residual))):
            for mode, mix in itertools.product(("exact", "baked"), (Mix(), Mix(0.4, 0.7, 0.3), Mix(0.0, 0.0, 1.0))):
                shown = Look(mode, mix, styles)
                model.display.viewer = functools.partial(copy.copy, shown)
                drawn = model.get_outputs_for_camera(camera)
                for name in ("rgb", "rgb_coarse"):
                    assert drawn[name].device.type == "cuda" and drawn[name].shape == plain[name].shape


def test_the_grids_kernels_for_cuda_train_there(llff_scene: Path, painting: Path, monkeypatch) -> None:
    kernels, interpreted = hash_grid.fused_kernels, interpreted_kernels()
    monkeypatch.setattr(hash_grid, "fused_kernels", lambda on: interpreted if on.type == "cuda" else kernels(on))
    with SecondDevice() as device:
        settings = {"warm_start_steps": 0, "view_scales": (0.5,), "scale_shares": (1.0,)}
        config = style_config(llff_scene, painting, **settings)
        training = Training(config, CUDA, coarse_state(llff_scene, {}))
        training.step()
        assert training.pipeline.model.residual.grid.table.grad.count_nonzero() > 0
    assert device.mistakes == []


@pytest.mark.slow
def test_all_commands_run_there(device: SecondDevice, llff_scene: Path, painting: Path, tmp_path: Path) -> None:
    from sparsestyle_ns.cli import main

    def sparsestyle(*words: Any) -> None:
        run_entrypoint(main, [*map(str, words)])

    ns_train("coarse-fewshot", llff_scene, tmp_path, "--max-num-iterations", "3", *TINY)
    style = ["--style-image", str(painting), *TINY_STYLE, "--pipeline.effects.residual-density", "on"]
    ns_train("hier-style", llff_scene, tmp_path, "--max-num-iterations", "3", *style)
    run = only_run(tmp_path, "hier-style")
    for method, flags in (("coarse-fewshot", TINY), ("hier-style", style)):
        resumed = ["--load-dir", str(only_run(tmp_path, method) / "nerfstudio_models"), "--max-num-iterations", "5"]
        ns_train(method, llff_scene, tmp_path / "resumed", *resumed, *flags)
    sparsestyle("evaluate", only_run(tmp_path, "coarse-fewshot"))
    sparsestyle("evaluate", run, "--baked", "--output-path", tmp_path / "report.json")
    sparsestyle("export", run, "--format", "html", "--output-path", tmp_path / "page.html", "--resolution", "32")
    sparsestyle("export", run, "--format", "ply", "--output-path", tmp_path / "points.ply")
    for kind in ("splat", "mesh"):
        sparsestyle("export", run, "--format", kind, "--output-path", tmp_path / f"{kind}.ply", "--max-splats", "1000")
    sparsestyle("gallery", run, "--output-path", tmp_path / "gallery.html", "--frames", "2")
    sparsestyle("effects", "--data", llff_scene)
    render("interpolate", run, tmp_path / "between", "--output-format", "images", "--interpolation-steps", "2")
    loaded = load_run(run / "config.yml")
    assert loaded.pipeline.device == "cuda" or str(loaded.pipeline.device).startswith("cuda")
    restyling = Restyling(Workshop(loaded.pipeline, run, nullcontext()), Painting.read(painting), iterations=1)
    assert list(restyling)[-1].done == 1.0
    restyling.save()

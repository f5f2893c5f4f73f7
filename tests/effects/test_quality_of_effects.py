"""An effect that a scene calls for makes views better that weren't trained on."""

import copy
import functools
from pathlib import Path
from typing import Dict

import pytest
import torch
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation

from sparsestyle_ns.dataparsers.llff import LLFFDataParserConfig
from sparsestyle_ns.effects.registry import EffectSettings
from sparsestyle_ns.evaluation.image_metrics import psnr
from sparsestyle_ns.method_configs import method_config

PARSERS = {"llff": LLFFDataParserConfig, "blender": BlenderDataParserConfig, "nerfstudio": NerfstudioDataParserConfig}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory):
    """Makes a scene of small pictures, once for the same options."""
    import make_sample_scene

    @functools.cache
    def make(layout: str, *options: str) -> Path:
        folder = tmp_path_factory.mktemp("scene")
        sizes = ["--num-views", "16", "--num-train", "12", "--num-val", "1", "--num-test", "3", "--width", "40"]
        make_sample_scene.main([str(folder), "--layout", layout, *sizes, *options])
        return folder / layout

    return make


def held_out_psnr(folder: Path, layout: str, steps: int, effects: Dict[str, str]) -> float:
    """Mean PSNR, in dB, of the held-out views after a short training on all others."""
    config = copy.deepcopy(method_config("coarse-fewshot-draft"))
    pipeline_config = config.pipeline
    pipeline_config.effects = EffectSettings(**effects)
    manager, model = pipeline_config.datamanager, pipeline_config.model
    manager.data, manager.dataparser, manager.num_views = folder, PARSERS[layout](), 12
    model.num_samples, model.num_eval_samples, model.grid_resolution = 16, 32, 32
    model.coarse_field.layer_width, model.coarse_field.num_layers, model.coarse_field.feature_dim = 64, 3, 32
    config.max_num_iterations = steps
    torch.manual_seed(0)
    pipeline = pipeline_config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    optimizer = torch.optim.Adam(pipeline.get_param_groups()["fields"], lr=5e-3)
    attributes = TrainingCallbackAttributes(optimizers=None, grad_scaler=None, pipeline=pipeline, trainer=None)
    callbacks = pipeline.get_training_callbacks(attributes)
    pipeline.model.num_steps = steps
    for step in range(steps):
        pipeline.train()
        for callback in callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        _, losses, _ = pipeline.get_train_loss_dict(step)
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.step()
    pipeline.eval()
    dataset, values = pipeline.datamanager.eval_dataset, []
    with torch.no_grad():
        for index in range(len(dataset)):
            picture = pipeline.model.get_outputs_for_camera(dataset.cameras[index : index + 1])["rgb"]
            values.append(psnr(picture, dataset[index]["image"][..., :3]))
    return sum(values) / len(values)


@pytest.mark.slow
@pytest.mark.parametrize(
    "layout, options, on, off",
    [
        ("llff", (), {"ndc": "on"}, {"contraction": "on"}),
        ("blender", (), {"box": "on"}, {"contraction": "on"}),
        ("blender", (), {"background": "on"}, {"background": "off"}),
        ("llff", ("--shiny", "0.8"), {"view_color": "on"}, {"view_color": "off"}),
        ("llff", ("--exposure", "0.7"), {"exposure": "on"}, {"exposure": "off"}),
        ("nerfstudio", ("--distortion", "0.4"), {"lens_distortion": "on"}, {"lens_distortion": "off"}),
        ("blender", (), {"empty_space": "on"}, {"empty_space": "off"}),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else None,
)
def test_an_effect_that_a_scene_calls_for_makes_held_out_views_better(scenes, layout, options, on, off):
    folder = scenes(layout, *options)
    with_it, without = (held_out_psnr(folder, layout, 300, effects) for effects in (on, off))
    assert with_it > without

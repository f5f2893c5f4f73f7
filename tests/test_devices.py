"""Both methods on a second device (`second_device.py`): nothing is left on the CPU, and little is waited for."""

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Callable, Counter, Iterator

import pytest
import torch
from second_device import CUDA, SecondDevice

from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.field_components import hash_grid
from sparsestyle_ns.fields.coarse import CoarseFieldConfig
from sparsestyle_ns.method_configs import method_config

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


def coarse_config(scene: Path, **effects: str) -> Any:
    config = copy.deepcopy(method_config("coarse-fewshot"))
    config.max_num_iterations = 8
    pipeline = config.pipeline
    pipeline.datamanager.data, pipeline.datamanager.dataparser = scene, LLFFDataParserConfig()
    pipeline.datamanager.train_num_rays_per_batch = 64
    pipeline.effects = EffectSettings(**{**EFFECTS, **effects})
    pipeline.model.coarse_field = FIELD
    pipeline.model.volume_resolution = pipeline.model.grid_resolution = 8
    return config


def style_config(scene: Path, painting: Path, **effects: str) -> Any:
    config = copy.deepcopy(method_config("hier-style"))
    config.max_num_iterations = 8
    pipeline = config.pipeline
    pipeline.datamanager.data, pipeline.datamanager.dataparser = scene, LLFFDataParserConfig()
    pipeline.effects = EffectSettings(**{**EFFECTS, **effects})
    pipeline.style_image, pipeline.backbone, pipeline.warm_start_steps = painting, "vgg16-shift-tolerant", 1
    pipeline.model.coarse_field, pipeline.model.log2_table_size = FIELD, 8
    pipeline.model.hash_levels, pipeline.model.layer_width = 2, 16
    pipeline.model.occupancy_resolution, pipeline.model.bake_resolution = 16, 16
    return config


@pytest.fixture(scope="session")
def coarse_state(llff_scene: Path) -> dict:
    """Of a coarse field that shows something, on the CPU."""
    torch.manual_seed(0)
    model = Training(coarse_config(llff_scene), torch.device("cpu")).pipeline.model
    with torch.no_grad():
        model.field.density_head.weight.normal_(std=2.0)
    return model.state_dict()


def waits_of(device: SecondDevice, training: Training, steps: int) -> Counter:
    """What iterations wait for, after a first one."""
    training.step()
    device.waits.clear()
    for _ in range(steps):
        training.step()
    return device.waits


def test_print(device, llff_scene, painting, coarse_state):
    a = Counter(waits_of(device, Training(coarse_config(llff_scene), CUDA), 4))
    c = style_config(llff_scene, painting)
    c.pipeline.cache_gigabytes = 0.0
    b = Counter(waits_of(device, Training(c, CUDA, coarse_state), 4))
    for w in (a, b):
        print("TOTAL", sum(n for k, n in w.items() if k.kind != "copy on the way") / 4)
        for k, n in sorted(w.items(), key=lambda i: -i[1]):
            print(n / 4, *k)

"""What docs/development.md says of adding a loss, a feature network or a dataset: each is one class and one line."""

import copy
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Type

import numpy as np
import pytest
import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from PIL import Image

from sparsestyle_ns.data.scene_info import SCENE_INFO, SceneInfo, scene_info
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.evaluation.held_out import StyleFigures
from sparsestyle_ns.losses.stylization import LOSSES, default_weights
from sparsestyle_ns.losses.stylization_loss import PaintingFeatures, StylizationLoss, StylizedView
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.runs.coarse_run import read_coarse_run
from sparsestyle_ns.style.backbone import Backbone, Weights
from sparsestyle_ns.style.backbones import BACKBONES, load_backbone


class BrightnessLoss(StylizationLoss):
    """How much lighter or darker a view is than the painting."""

    def __init__(self, painting: PaintingFeatures) -> None:
        self.brightness = painting.image.mean()

    def __call__(self, view: StylizedView) -> torch.Tensor:
        return (view.image.mean() - self.brightness).abs()


class Patches(Backbone):
    """Each 4 × 4 block of pixels has its own colours as features."""

    name = "patches"
    channels = 48
    smallest_side = 4
    folder = Path()

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self.description = weights.describe(self.name)
        self.register_buffer("scale", torch.ones(()))

    @classmethod
    def find_weights(cls) -> Weights:
        return Weights(cls.folder / "patches.pth", "a file of its own")

    @classmethod
    def how_to_get(cls) -> str:
        return "make patches.pth"

    @classmethod
    def why_absent(cls) -> str:
        return "patches.pth isn't there"

    @classmethod
    def accepts(cls, state: dict) -> bool:
        return "patches" in state

    @classmethod
    def load(cls, weights: Weights, state: dict) -> "Patches":
        return cls(weights).eval()

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.scale * torch.nn.functional.pixel_unshuffle(images, 4)


@dataclass
class TurntableConfig(DataParserConfig):
    """Photos of an object on a turntable."""

    _target: Type = field(default_factory=lambda: Turntable)


class Turntable(DataParser):
    """A folder of photos 0.png, 1.png …, taken at equal angles; every fourth is held out."""

    config: TurntableConfig

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        photos = sorted(self.config.data.glob("*.png"), key=lambda path: int(path.stem))
        ids = [number for number in range(len(photos)) if (number % 4 == 0) == (split != "train")]
        angles = 2 * np.pi * torch.tensor(ids, dtype=torch.float32) / len(photos)
        zero, one = torch.zeros_like(angles), torch.ones_like(angles)
        back = torch.stack([angles.sin(), zero, angles.cos()], dim=-1)
        up = torch.stack([zero, one, zero], dim=-1)
        poses = torch.stack([torch.linalg.cross(up, back), up, back, 4 * back], dim=-1)
        width, height = Image.open(photos[0]).size
        return DataparserOutputs(
            image_filenames=[photos[number] for number in ids],
            cameras=Cameras(poses, fx=40.0, fy=40.0, cx=width / 2, cy=height / 2, width=width, height=height),
            scene_box=SceneBox(torch.tensor([[-1.0, -1, -1], [1, 1, 1]])),
            metadata={SCENE_INFO: SceneInfo(tuple(ids), standard_views=(1, 5, 9), default_num_views=3)},
        )


@dataclass
class Settings:
    """As a trainer's config has a pipeline's."""

    pipeline: HierStylePipelineConfig = field(default_factory=HierStylePipelineConfig)


def training_of(runs: SimpleNamespace, **settings: object) -> Training:
    """A stylised run's training from its start, with other settings of the pipeline."""
    config = copy.deepcopy(load_run(runs.style / "config.yml").config)
    for name, value in settings.items():
        setattr(config.pipeline, name, value)
    return Training(config, torch.device("cpu"), read_coarse_run(runs.coarse).model_state())


def test_a_new_loss_is_trained_measured_and_has_a_flag(runs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LOSSES, "brightness", BrightnessLoss)
    given = tyro.cli(Settings, args=["--pipeline.loss-weights.brightness", "0.5"]).pipeline
    assert given.loss_weights == {**default_weights(), "brightness": 0.5}

    training = training_of(runs, loss_weights=given.loss_weights)
    pipeline = training.pipeline
    told = []
    pipeline.on_losses = lambda step, losses: told.append(losses)
    training.step()
    assert told[0].terms().keys() == {f"{name}_loss" for name in LOSSES}
    assert told[0].terms()["brightness_loss"] == 0.5 * told[0].values["brightness"]
    assert "brightness" in told[0].metrics()

    view, targets = pipeline.task.levels[-1].views[0].picture, pipeline.targets
    figures = StyleFigures(targets).of(view, view.flip(0), None)
    assert figures["brightness_loss"] == pytest.approx(figures["brightness_loss_before"], abs=1e-6)


def test_a_loss_without_weight_is_not_computed(runs: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    class Refusing(BrightnessLoss):
        def __call__(self, view: StylizedView) -> torch.Tensor:
            raise AssertionError("it was computed")

    monkeypatch.setitem(LOSSES, "refusing", Refusing)
    training_of(runs, loss_weights={"content": 0.0, "style": 1.0, "refusing": 0.0}).step()


def test_a_new_feature_network_brings_its_width_and_its_least_side(
    runs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.save({"patches": torch.ones(1)}, tmp_path / "patches.pth")
    monkeypatch.setattr(Patches, "folder", tmp_path)
    monkeypatch.setitem(BACKBONES, "patches", Patches)
    assert load_backbone("auto", tmp_path / "patches.pth").description.name == "patches"

    training = training_of(runs, backbone="patches", feature_side=64)  # both sizes in patches of 4
    assert training.step().isfinite()
    assert training.pipeline.task.levels[0].views[0].features.shape[1] == 48
    assert training.pipeline.targets.features(torch.rand(1, 40, 3)).shape[2] == 1


def test_a_new_dataset_says_itself_which_views_a_run_trains_on(tmp_path: Path) -> None:
    for number in range(12):
        Image.fromarray(np.full((24, 32, 3), 20 * number + 9, np.uint8)).save(tmp_path / f"{number}.png")
    config = FewShotDataManagerConfig(data=tmp_path, dataparser=TurntableConfig())
    manager = config.setup(device="cpu", test_mode="test")
    assert scene_info(manager.train_dataparser_outputs).view_ids == (1, 5, 9)
    assert [path.name for path in manager.eval_dataset.image_filenames] == ["0.png", "4.png", "8.png"]

    chosen = FewShotDataManagerConfig(data=tmp_path, dataparser=TurntableConfig(), view_ids=(2, 7))
    assert scene_info(chosen.setup(device="cpu").train_dataparser_outputs).view_ids == (2, 7)

"""Lets every test say `from reference import ...`, and makes small scenes and runs that several tests look at."""

import shutil
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Dict, List

import hypothesis
import numpy as np
import pytest
import torch
import yaml
from PIL import Image

if TYPE_CHECKING:
    from sparsestyle_ns.effects.decisions import Decisions
    from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipeline

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "data_scripts")]
pytest_plugins = ["hard.table"]
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as behind `&` in a script; commands that tests start inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The same few examples in each run; `pytest --hypothesis-profile thorough` looks for new ones.
hypothesis.settings.register_profile(
    "quick",
    max_examples=20,
    derandomize=True,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.function_scoped_fixture],
)
hypothesis.settings.register_profile(
    "thorough", hypothesis.settings.get_profile("quick"), max_examples=200, derandomize=False
)
hypothesis.settings.load_profile("quick")

TINY = [
    *("--pipeline.datamanager.train-num-rays-per-batch", "128"),
    *("--pipeline.model.coarse-field.layer-width", "32"),
    *("--pipeline.model.coarse-field.feature-dim", "8"),
    *("--pipeline.effects.empty-space", "on"),
]
"""A coarse field that learns nothing good, in no time, and so leaves nothing empty."""
TINY_STYLE = [
    *("--pipeline.model.log2-table-size", "12"),
    *("--pipeline.model.num-steps", "16"),
    *("--pipeline.model.occupancy-resolution", "16"),
    *("--pipeline.feature-side", "48"),
    *("--pipeline.warm-start-steps", "2"),
    *("--pipeline.effects.empty-space", "on"),
]


def decided(*on: str, **parameters: Dict[str, List[float]]) -> "Decisions":
    """Decisions by which some effects are on, with parameters by the effect's name, and all others off."""
    from sparsestyle_ns.effects.decisions import Decision, Decisions
    from sparsestyle_ns.effects.registry import EFFECTS

    assert set(on) <= EFFECTS.keys()
    items = (
        Decision(name, name in on, None, None, "for a test", parameters=parameters.get(name, {})) for name in EFFECTS
    )
    return Decisions(tuple(items))


def coarse_pipeline(scene: Path, **settings: Any) -> "CoarseFewShotPipeline":
    """A pipeline of stage 1, ready to train, whose small field isn't the same everywhere.

    Args:
        scene: an LLFF scene.
        settings: the pipeline's; and `views` and `exposure`, how many photos and whether they have their own.
    """
    from nerfstudio.engine.callbacks import TrainingCallbackAttributes

    from sparsestyle_ns.data.llff import LLFFDataParserConfig
    from sparsestyle_ns.effects.decisions import EffectSettings
    from sparsestyle_ns.fields.coarse import CoarseFieldConfig
    from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModelConfig
    from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipelineConfig
    from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig

    # Without the grid, which remembers what is rendered, the same rays get the same colours twice.
    effects = EffectSettings(exposure=settings.pop("exposure", "off"), matched_depth="off", empty_space="off")
    manager = FewShotDataManagerConfig(
        data=scene, dataparser=LLFFDataParserConfig(), train_num_rays_per_batch=16, num_views=settings.pop("views", 3)
    )
    field = CoarseFieldConfig(num_levels=3, num_layers=2, layer_width=16, feature_dim=4)
    model = CoarseFewShotModelConfig(coarse_field=field, num_samples=8, precision="float32")
    torch.manual_seed(0)
    config = CoarseFewShotPipelineConfig(datamanager=manager, model=model, effects=effects, **settings)
    pipeline = config.setup(device="cpu")
    with torch.no_grad():
        pipeline.model.field.density_head.weight.normal_(std=2.0)
    pipeline.get_training_callbacks(TrainingCallbackAttributes(None, None, pipeline, None))
    return pipeline


def ns_train(method: str, data: Path, output_dir: Path, *flags: str, parser: str = "llff-data") -> None:
    """Runs `ns-train` in this process, as its console script would."""
    from nerfstudio.scripts import train

    arguments = [method, "--data", str(data), "--output-dir", str(output_dir), "--vis", "tensorboard"]
    run_entrypoint(train.entrypoint, [*arguments, "--viewer.quit-on-train-completion", "True", *flags, parser])


def run_entrypoint(entrypoint, arguments: List[str]) -> None:
    """Calls a console script's function with command line arguments."""
    before = sys.argv
    sys.argv = ["command", *map(str, arguments)]
    try:
        entrypoint()
    finally:
        sys.argv = before


def only_run(output_dir: Path, method: str) -> Path:
    """The folder of the one run of a method below an output folder."""
    (config,) = output_dir.glob(f"*/{method}/*/config.yml")
    return config.parent


@pytest.fixture(scope="session")
def llff_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A forward-facing scene of 12 photos, 32 × 24 pixels."""
    import make_sample_scene

    folder = tmp_path_factory.mktemp("scene")
    make_sample_scene.main([str(folder), "--layout", "llff", "--width", "32", "--num-views", "12"])
    return folder / "llff"


@pytest.fixture
def quick_reports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports are of photos alone: to render, and to load the networks of figures, takes longer than all else."""
    from sparsestyle_ns.evaluation.held_out import HeldOutReport, means_of
    from sparsestyle_ns.pipelines import scene_pipeline

    def measure(model: Any, views: Any, cameras: Any, targets: Any, *settings: Any) -> HeldOutReport:
        marks = {
            **({"content_ssim": 0.5} if hasattr(model, "residual") else {}),
            **({"style_loss": 1.0} if targets else {}),
        }
        values = [{"psnr": float(views[index]["image"].mean()), **marks} for index in range(len(views))]
        return HeldOutReport(means_of(values), values)

    monkeypatch.setattr(scene_pipeline, "evaluate_held_out", measure)


@pytest.fixture(scope="session")
def painting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A style image of coloured noise."""
    path = tmp_path_factory.mktemp("style") / "painting.png"
    colors = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(colors).resize((64, 48), Image.Resampling.BICUBIC).save(path)
    return path


@pytest.fixture(scope="session")
def runs(llff_scene: Path, painting: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A coarse run of 3 iterations and a stylised run of 3 on it, both by ns-train: `.coarse`, `.style`, `.outputs`."""
    outputs = tmp_path_factory.mktemp("outputs")
    ns_train("coarse-fewshot", llff_scene, outputs, "--max-num-iterations", "3", *TINY)
    # What so short a training leaves behind has no shape to be trusted, however it is measured.
    style = ["--style-image", str(painting), "--max-num-iterations", "3", *TINY_STYLE]
    style += ["--pipeline.effects.residual-density", "on"]
    ns_train("hier-style", llff_scene, outputs, *style)
    return SimpleNamespace(
        outputs=outputs, coarse=only_run(outputs, "coarse-fewshot"), style=only_run(outputs, "hier-style")
    )


@pytest.fixture(scope="session")
def patterned_run(runs: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stylised run, which a few iterations left grey all over, with weights that make shapes and colours."""
    from sparsestyle_ns.engine.loading import load_run
    from sparsestyle_ns.runs.checkpoints import newest_checkpoint

    outputs = tmp_path_factory.mktemp("outputs")
    folder = shutil.copytree(runs.style, outputs / "scene" / "hier-style" / "run")
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    config.output_dir, config.experiment_name, config.timestamp = outputs, "scene", "run"  # where ns-render looks
    (folder / "config.yml").write_text(yaml.dump(config))
    path = newest_checkpoint(folder / "nerfstudio_models")
    state = torch.load(path, weights_only=True)
    generator = torch.Generator().manual_seed(0)
    for name, value in state["pipeline"].items():
        if name.startswith(("_model.field.trunk", "_model.field.feature_head", "_model.residual")) and "weight" in name:
            value.copy_(torch.randn(value.shape, generator=generator) * (2.0 / value.shape[1]) ** 0.5)
        if name == "_model.field.trunk.layers.0.weight":
            value[:, 3:] *= 0.4 ** torch.arange(value.shape[1] - 3).div(6, rounding_mode="floor")
        if name == "_model.field.density_head.weight":
            value.copy_(3.0 * torch.randn(value.shape, generator=generator))
        if name == "_model.residual.color_head.weight":
            value *= 6.0
        if name.startswith("_model.residual.recoloring"):  # the map of what was grey all over
            value.copy_(torch.eye(3) if name.endswith("matrix") else torch.zeros_like(value))
    torch.save(state, path)
    model = load_run(folder / "config.yml").pipeline.model
    model.volume.measure(lambda points: model.field.density_and_feature(points)[0], chunk=4096)
    state["pipeline"]["_model.volume.log_density"] = model.volume.log_density  # of these weights
    torch.save(state, path)
    return folder

"""Training where numbers get out of hand: what isn't finite is never learned and never saved."""

import contextlib
import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Dict, List

import numpy as np
import pytest
import torch
from conftest import TINY, TINY_STYLE, ns_train, only_run
from hard.table import hard_case
from PIL import Image
from second_device import SecondDevice
from torch import nn
from torch.amp import GradScaler

from sparsestyle_ns.core.occupancy import DensityGrid
from sparsestyle_ns.engine.muon import Muon
from sparsestyle_ns.engine.trainer import SparseStyleTrainer
from sparsestyle_ns.engine.training import FusedAdamConfig, MuonConfig
from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipeline
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline
from sparsestyle_ns.runs.checkpoints import load_checkpoint, newest_checkpoint
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers, broken

PIPELINES = {"coarse-fewshot": CoarseFewShotPipeline, "hier-style": HierStylePipeline}
BOTH = pytest.mark.parametrize("method", list(PIPELINES))


def method_flags(method: str, runs: SimpleNamespace, painting: Path) -> List[str]:
    if method == "coarse-fewshot":
        return TINY
    return ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *TINY_STYLE]


def checkpoint_of(outputs: Path, method: str) -> Dict[str, Any]:
    return load_checkpoint(newest_checkpoint(only_run(outputs, method) / "nerfstudio_models"))


def assert_finite(checkpoint: Dict[str, Any]) -> None:
    states = [state for optimizer in checkpoint["optimizers"].values() for state in optimizer["state"].values()]
    tensors = [*checkpoint["pipeline"].values(), *(part for state in states for part in state.values())]
    assert all(tensor.isfinite().all() for tensor in tensors if tensor.is_floating_point())


def spoil_gradients(monkeypatch: pytest.MonkeyPatch, method: str, steps: Any, factor: float) -> None:
    """Has the losses of some iterations, and so all gradients, multiplied by a number."""
    pipeline = PIPELINES[method]
    original = pipeline.get_train_loss_dict

    def spoilt(self: Any, step: int) -> Any:
        outputs, losses, metrics = original(self, step)
        return outputs, {name: loss * (factor if step in steps else 1.0) for name, loss in losses.items()}, metrics

    monkeypatch.setattr(pipeline, "get_train_loss_dict", spoilt)


@hard_case(
    "training",
    case="the gradient of one iteration is NaN or infinite",
    could_go_wrong="every parameter is NaN from then on",
    must_hold="parameters and Adam's state keep their bits, the next step goes on, the report counts one",
)
@BOTH
@pytest.mark.parametrize("factor", [np.nan, np.inf])
def test_a_step_without_a_finite_gradient_changes_nothing(
    runs, llff_scene, painting, tmp_path, monkeypatch, capsys, method, factor
):
    spoil_gradients(monkeypatch, method, {3}, factor)
    states = []
    iterate = SparseStyleTrainer.train_iteration

    def watched(trainer: SparseStyleTrainer, step: int) -> Any:
        result = iterate(trainer, step)
        optimizer = trainer.optimizers.optimizers["fields"]
        states.append(copy.deepcopy([list(optimizer.param_groups[0]["params"]), optimizer.state_dict()["state"]]))
        return result

    monkeypatch.setattr(SparseStyleTrainer, "train_iteration", watched)
    flags = [*method_flags(method, runs, painting), "--max-num-iterations", "6"]
    ns_train(method, llff_scene, tmp_path, *flags)
    (before, means_before), (after, means_after), (later, _) = states[2:5]
    assert all(map(torch.equal, before, after))
    for index, means in means_before.items():
        assert all(torch.equal(part, means_after[index][name]) for name, part in means.items())
    assert not all(map(torch.equal, after, later))
    assert_finite(checkpoint_of(tmp_path, method))
    assert "weren't finite: 1 (1 in all)" in " ".join(capsys.readouterr().out.split())


@hard_case(
    "training",
    case="gradients are NaN from an iteration on",
    could_go_wrong="hours of steps that do nothing, and the last good checkpoint overwritten at the end",
    must_hold="training stops with one sentence; the checkpoint from before stays and can be gone on from",
)
@BOTH
def test_training_stops_when_gradients_stay_broken(runs, llff_scene, painting, tmp_path, monkeypatch, method):
    flags = [*method_flags(method, runs, painting), "--max-num-iterations", "60", "--steps-per-save", "5"]
    flags += ["--steps-per-eval-image", "0"]
    with monkeypatch.context() as patch:
        spoil_gradients(patch, method, range(12, 99), np.nan)
        with pytest.raises(SystemExit) as stopped:
            ns_train(method, llff_scene, tmp_path, *flags, "--max-skipped-steps", "10")
    message = str(stopped.value)
    assert message.startswith("Error: Training stopped after iteration 26, because the gradients of the last 14")
    assert "The checkpoint of iteration 11 is from before and stays." in message
    assert message.count("\n") == 0
    folder = only_run(tmp_path, method) / "nerfstudio_models"
    assert [path.name for path in folder.iterdir()] == ["step-000000010.ckpt"]
    ns_train(method, llff_scene, tmp_path / "on", *flags, "--max-num-iterations", "13", "--load-dir", str(folder))
    assert checkpoint_of(tmp_path / "on", method)["step"] == 12


@hard_case(
    "training",
    case="the last iteration's gradient is NaN",
    could_go_wrong="a run that isn't finished, or the last checkpoint known to be good deleted",
    must_hold="the run is saved and counts as finished, the former checkpoint is kept beside it",
)
def test_a_last_step_that_is_skipped_leaves_both_checkpoints(llff_scene, tmp_path, monkeypatch):
    spoil_gradients(monkeypatch, "coarse-fewshot", {7}, np.nan)
    ns_train("coarse-fewshot", llff_scene, tmp_path, *TINY, "--max-num-iterations", "8", "--steps-per-save", "4")
    folder = only_run(tmp_path, "coarse-fewshot") / "nerfstudio_models"
    assert sorted(path.name for path in folder.iterdir()) == ["step-000000004.ckpt", "step-000000007.ckpt"]
    assert_finite(checkpoint_of(tmp_path, "coarse-fewshot"))


@hard_case(
    "training",
    case="a parameter is infinite when the run is to be saved",
    could_go_wrong="a checkpoint of NaN pictures takes the place of a good one",
    must_hold="nothing is saved or deleted, and a sentence names the parameter",
)
def test_a_state_that_isnt_finite_is_never_saved(llff_scene, tmp_path, monkeypatch):
    iterate = SparseStyleTrainer.train_iteration

    def blow_up(trainer: SparseStyleTrainer, step: int) -> Any:
        result = iterate(trainer, step)
        if step == 7:
            with torch.no_grad():
                trainer.pipeline.model.field.trunk.layers[0].bias[0] = torch.inf
        return result

    monkeypatch.setattr(SparseStyleTrainer, "train_iteration", blow_up)
    with pytest.raises(SystemExit, match=r"trunk\.layers\.0\.bias isn't finite"):
        ns_train("coarse-fewshot", llff_scene, tmp_path, *TINY, "--max-num-iterations", "8", "--steps-per-save", "4")
    folder = only_run(tmp_path, "coarse-fewshot") / "nerfstudio_models"
    assert [path.name for path in folder.iterdir()] == ["step-000000004.ckpt"]


@hard_case(
    "training",
    case="one entry of a gradient is NaN, infinite, or so large that its square isn't a number",
    could_go_wrong="Adam's mean of squares is infinite for good, and the parameter never moves again",
    must_hold="skipped and counted, by fused optimisers and by others, clipped or not; later steps are taken",
)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e25])
@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("max_norm", [None, 1.0])
def test_optimisers_skip_what_adam_cant_take(value, fused, max_norm):
    parameter = nn.Parameter(torch.ones(5))
    config = {"fields": {"optimizer": FusedAdamConfig(lr=0.1, fused=fused, max_norm=max_norm), "scheduler": None}}
    optimizers = FiniteOptimizers(config, {"fields": [parameter]})
    scaler = GradScaler("cpu", enabled=False)

    def step(entry: float) -> torch.Tensor:
        parameter.grad = torch.ones(5)
        parameter.grad[2] = entry
        optimizers.optimizer_scaler_step_some(scaler, ["fields"])
        return parameter.detach().clone()

    first = step(1.0)
    state = copy.deepcopy(optimizers.optimizers["fields"].state_dict()["state"][0])
    assert torch.equal(step(value), first)
    assert torch.equal(step(value), first)
    assert optimizers.skipped() == (2, 2)
    for name, part in optimizers.optimizers["fields"].state_dict()["state"][0].items():
        assert torch.equal(part, state[name]), name
    assert (step(1.0) < first).all()
    assert optimizers.skipped() == (2, 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e25])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_muon_skips_the_same(value, device):
    with SecondDevice() if device == "cuda" else contextlib.nullcontext() as second:
        check_muon(value, device)
    if second is not None:
        assert [wait.kind for wait in second.waits if "skip_nonfinite" in wait.place] == ["tolist"]  # of `skipped`


def check_muon(value, device):
    ours, theirs = (nn.Parameter(torch.eye(4, device=device)[:3].clone()) for _ in range(2))
    optimizers = FiniteOptimizers({"matrices": {"optimizer": MuonConfig(), "scheduler": None}}, {"matrices": [ours]})
    plain = Muon([theirs])
    for step, is_broken in enumerate((True, False, True, False)):  # also before there is any momentum
        gradient = torch.rand(3, 4, generator=torch.Generator().manual_seed(step)).to(device)
        diagonal = torch.eye(3, 4, device=device).bool()
        ours.grad = torch.where(diagonal, value, gradient) if is_broken else gradient.clone()
        optimizers.optimizer_scaler_step_some(GradScaler("cpu", enabled=False), ["matrices"])
        if not is_broken:
            theirs.grad = gradient.clone()
            plain.step()
        assert torch.equal(ours, theirs)
    assert optimizers.skipped() == (2, 0)


def test_large_finite_gradients_are_no_reason_to_skip():
    parameter = nn.Parameter(torch.zeros(1000))
    parameter.grad = torch.full((1000,), 1e15)
    assert broken([parameter]) == 0.0


@hard_case(
    "training",
    case="a field gives densities of NaN or infinity for a batch",
    could_go_wrong="the grid that places samples is NaN from then on, though the step was skipped",
    must_hold="the grid stays finite, and takes what is finite",
)
def test_the_density_grid_remembers_nothing_that_isnt_finite():
    grid = DensityGrid(4)
    positions = torch.tensor([[-0.9, -0.9, -0.9], [0.9, 0.9, 0.9], [0.1, 0.1, 0.1]])
    grid.remember(positions, torch.tensor([torch.nan, torch.inf, 7.0]))
    assert grid.density.isfinite().all()
    cells = grid.cells(positions)
    torch.testing.assert_close(grid.density[cells], torch.tensor([0.8, 0.8, 7.0]))


# ----------------------------------------------------------------------------------------------------- many steps

STEPS = pytest.mark.parametrize("steps", [300, pytest.param(1000, marks=pytest.mark.slow)])
QUIET = ["--steps-per-save", "2000", "--steps-per-eval-image", "0"]
QUIET += ["--logging.steps-per-log", "500"]


def train_many_steps(
    steps: int, capsys: pytest.CaptureFixture, method: str, scene: Path, outputs: Path, *flags: str
) -> None:
    ns_train(method, scene, outputs, *flags, *QUIET, "--max-num-iterations", str(steps))
    checkpoint = checkpoint_of(outputs, method)
    assert checkpoint["step"] == steps - 1
    assert_finite(checkpoint)
    assert "Steps skipped" not in " ".join(capsys.readouterr().out.split())


@hard_case(
    "training",
    case="300 and 1,000 steps of stage 1 at ten times the default learning rate",
    could_go_wrong="densities and activations run away until something overflows",
    must_hold="no step is skipped; parameters, Adam's state and grid are finite",
)
@STEPS
def test_stage_1_stays_finite_at_ten_times_the_learning_rate(llff_scene, steps, tmp_path, capsys):
    rate = ["--optimizers.fields.optimizer.lr", "5e-3"]
    train_many_steps(steps, capsys, "coarse-fewshot", llff_scene, tmp_path, *TINY, *rate)


@hard_case(
    "training",
    case="300 and 1,000 steps of stage 1 with every regulariser on, at a hundred times its weight, and view directions",
    could_go_wrong="a loss without bounds meets densities at their cap",
    must_hold="no step is skipped; everything is finite",
)
@STEPS
def test_stage_1_stays_finite_with_every_regulariser(llff_scene, steps, tmp_path, capsys):
    model = {"distortion-weight": "1", "distortion-start": "0", "occlusion-weight": "10", "frequency-reveal": "0.5"}
    flags = [part for name, value in model.items() for part in (f"--pipeline.model.{name}", value)]
    flags += ["--pipeline.model.coarse-field.direction-levels", "4"]
    train_many_steps(steps, capsys, "coarse-fewshot", llff_scene, tmp_path, *TINY, *flags)


@hard_case(
    "training",
    case="300 and 1,000 steps of stage 1 from a field at its densest, and from an empty one",
    could_go_wrong="the first sample hides all others, or no ray has any weight: gradients of 0 / 0",
    must_hold="no step is skipped; everything is finite",
)
@pytest.mark.parametrize("activation, bias", [("exp", "40"), ("exp", "-40"), ("softplus", "40")])
@STEPS
def test_stage_1_stays_finite_from_opaque_and_empty_fields(llff_scene, steps, tmp_path, capsys, activation, bias):
    flags = ["--pipeline.model.coarse-field.density-activation", activation]
    flags += [
        "--pipeline.model.coarse-field.density-bias",
        bias,
        "--pipeline.datamanager.train-num-rays-per-batch",
        "32",
    ]
    train_many_steps(steps, capsys, "coarse-fewshot", llff_scene, tmp_path, *TINY, *flags)


@hard_case(
    "training",
    case="300 and 1,000 steps of stage 1 with one ray a step and one sample on it",
    could_go_wrong="histograms and means over a single thing: 0 / 0",
    must_hold="no step is skipped; everything is finite",
)
@STEPS
def test_stage_1_stays_finite_with_one_ray_and_one_sample(llff_scene, steps, tmp_path, capsys):
    flags = ["--pipeline.model.num-samples", "1", "--pipeline.datamanager.train-num-rays-per-batch", "1"]
    train_many_steps(steps, capsys, "coarse-fewshot", llff_scene, tmp_path, *TINY, *flags)


@pytest.fixture()
def one_colour_scene(llff_scene: Path, tmp_path: Path) -> Path:
    """The scene, all of whose photos are one white."""
    import shutil

    scene = shutil.copytree(llff_scene, tmp_path / "white")
    for path in (scene / "images").iterdir():
        Image.fromarray(np.full((24, 32, 3), 255, np.uint8)).save(path)
    return scene


@hard_case(
    "training",
    case="300 and 1,000 steps of stage 1 on photos of a single colour",
    could_go_wrong="an error of 0: the PSNR is infinite, gradients vanish, Adam divides by its ε",
    must_hold="no step is skipped; everything is finite",
)
@STEPS
def test_stage_1_stays_finite_on_photos_of_one_colour(one_colour_scene, steps, tmp_path, capsys):
    train_many_steps(steps, capsys, "coarse-fewshot", one_colour_scene, tmp_path / "outputs", *TINY)


SMALL_STYLE = [*TINY_STYLE, "--pipeline.feature-side", "32", "--pipeline.warm-start-steps", "0"]


def style_flags(runs: SimpleNamespace, painting: Path) -> List[str]:
    return ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *SMALL_STYLE]


@hard_case(
    "training",
    case="1,000 steps of stage 2 at ten times the default learning rate, with σ' in units a hundred times larger",
    could_go_wrong="σ' leaps far below −σ_c or to where exp(−σδ) is 0, and nothing comes back",
    must_hold="no step is skipped; everything is finite",
)
@pytest.mark.slow
def test_stage_2_stays_finite_when_the_density_leaps(runs, llff_scene, painting, tmp_path, capsys):
    flags = ["--optimizers.fields.optimizer.lr", "5e-2", "--pipeline.model.residual-density-scale", "1000"]
    train_many_steps(1000, capsys, "hier-style", llff_scene, tmp_path, *style_flags(runs, painting), *flags)


@hard_case(
    "training",
    case="1,000 steps of stage 2 with a painting of one colour, and with content and style far out of balance",
    could_go_wrong="features without variance: cosines of 0 / 0, a palette with a singular covariance",
    must_hold="no step is skipped; everything is finite",
)
@pytest.mark.slow
@pytest.mark.parametrize("weight", ["0", "1e6"])
def test_stage_2_stays_finite_with_a_painting_of_one_colour(runs, llff_scene, tmp_path, capsys, weight):
    Image.fromarray(np.full((16, 16, 3), 77, np.uint8)).save(tmp_path / "one.png")
    flags = [*style_flags(runs, tmp_path / "one.png"), "--pipeline.loss-weights.content", weight]
    train_many_steps(1000, capsys, "hier-style", llff_scene, tmp_path, *flags)

"""Several processes that train together give what one process gives."""

import functools
from pathlib import Path
from typing import Any, Dict

import pytest
import torch
import torch.distributed as dist
from conftest import TINY, TINY_STYLE, coarse_pipeline, ns_train, only_run
from hard import trial
from hard.table import hard_case
from torch import nn
from torch.amp import GradScaler

from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.engine.training import FusedAdamConfig
from sparsestyle_ns.runs.checkpoints import load_checkpoint, newest_checkpoint
from sparsestyle_ns.utils import distributed as processes
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers

TWO = ["--machine.num-devices", "2", "--machine.device-type", "cpu"]
COMMON = ["--pipeline.model.precision", "float32", "--max-num-iterations", "6", "--steps-per-eval-image", "0"]


def weights(outputs: Path, method: str) -> Dict[str, torch.Tensor]:
    return load_checkpoint(newest_checkpoint(only_run(outputs, method) / "nerfstudio_models"))["pipeline"]


def assert_same_within(found: Dict[str, torch.Tensor], expected: Dict[str, torch.Tensor], start: Dict, share: float):
    """Weights differ by less than a share of how far training has moved them, in the root of mean squares."""
    assert found.keys() == expected.keys() == start.keys()
    for name, value in expected.items():
        if value.is_floating_point() and value.numel() > 0:
            moved = (value - start[name]).square().mean().sqrt()
            error = (found[name] - value).square().mean().sqrt()
            assert error <= share * moved + 1e-7, f"{name}: {error} of {moved}"
        else:
            assert torch.equal(found[name], value), name


@torch.no_grad()
def picture(run: Path) -> Dict[str, torch.Tensor]:
    """The first training view as a run renders it."""
    _, pipeline, _ = load_run(run / "config.yml")
    return pipeline.model.get_outputs_for_camera(pipeline.datamanager.train_dataset.cameras[0:1])


@hard_case(
    "two processes",
    case="stage 1 on two processes, by nerfstudio's launch with gloo",
    could_go_wrong="no start without CUDA; other rays, other jitter, grids that differ; names that no reader knows",
    must_hold="the weights of one process with the same settings, to 0.01% of what 6 steps have moved them",
)
@pytest.mark.slow
def test_stage_1_on_two_processes_is_stage_1_on_one(llff_scene, tmp_path):
    whole = ["--pipeline.model.thinning", "0"]  # else each process draws which of its samples to leave out
    still = ["--max-num-iterations", "1", "--optimizers.fields.optimizer.lr", "1e-12"]
    still += ["--optimizers.hidden-layers.optimizer.lr", "1e-12"]
    method = "coarse-fewshot-paper"  # of Adam alone: Muon multiplies matrices in bfloat16, and rounds to other bits
    whole += ["--pipeline.effects.view-color", "auto", "--pipeline.effects.matched-depth", "auto"]
    whole += ["--pipeline.model.distortion-weight", "0.015"]
    for name, more in (("one", []), ("two", TWO), ("start", still)):
        ns_train(method, llff_scene, tmp_path / name, *TINY, *COMMON, *whole, *more)
    one, two, start = (weights(tmp_path / name, method) for name in ("one", "two", "start"))
    assert_same_within(two, one, start, share=1e-4)


@hard_case(
    "two processes",
    case="stage 2 on two processes: whole views, rendered in shares, after a warm start",
    could_go_wrong="gradients of half a picture, or half the gradient; different starts; each process its own view",
    must_hold="the picture of one process with the same settings, to 0.2% of what stylising has changed in it",
)
@pytest.mark.slow
def test_stage_2_on_two_processes_is_stage_2_on_one(runs, llff_scene, painting, tmp_path):
    # Weights alone say less: Adam moves one whose gradient is only rounding by as much as any other.
    flags = ["--style-image", str(painting), "--coarse-run", str(runs.coarse), *TINY_STYLE, *COMMON]
    flags += ["--pipeline.thinning", "0"]  # else each process draws which of its samples to leave out
    for name, more in (("one", []), ("two", TWO)):
        ns_train("hier-style", llff_scene, tmp_path / name, *flags, *more)
    one, two = (picture(only_run(tmp_path / name, "hier-style")) for name in ("one", "two"))
    error = (two["rgb"] - one["rgb"]).square().mean().sqrt()
    changed = (one["rgb"] - one["rgb_coarse"]).square().mean().sqrt()
    assert error <= 0.002 * changed, f"{error} of {changed}"


@hard_case(
    "two processes",
    case="bad input to two processes",
    could_go_wrong="a traceback of the process that started them, or one that waits for the other for ever",
    must_hold="the sentence, exit status 1, no traceback",
)
def test_two_processes_end_with_a_sentence(llff_scene, tmp_path, capfd):
    with pytest.raises(SystemExit) as ended:
        ns_train("coarse-fewshot", llff_scene, tmp_path, *TINY, *COMMON, *TWO, "--view-ids", "99")
    assert ended.value.code == 1
    printed = capfd.readouterr().err
    assert "Error: --view-ids names 99" in printed
    assert "Traceback" not in printed


def in_two_processes(target: Any, tmp_path: Path) -> list:
    """What `target(rank)` returns in each of two processes that can talk to each other."""
    started = [trial.start(_join, tmp_path / f"log{rank}.txt", target, rank, tmp_path) for rank in (0, 1)]
    for rank, process in enumerate(started):
        process.join(timeout=120)
        assert process.exitcode == 0, (tmp_path / f"log{rank}.txt").read_text()[-3000:]
    return [torch.load(tmp_path / f"result{rank}.pt") for rank in (0, 1)]


def _join(target: Any, rank: int, tmp_path: Path) -> None:
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/meeting", world_size=2, rank=rank)
    torch.save(target(rank), tmp_path / f"result{rank}.pt")
    dist.destroy_process_group()


def _step_with_one_broken_gradient(rank: int) -> torch.Tensor:
    parameter = nn.Parameter(torch.ones(4))
    config = {"fields": {"optimizer": FusedAdamConfig(lr=0.1), "scheduler": None}}
    optimizers = FiniteOptimizers(config, {"fields": [parameter]})
    seen = []
    for step in range(3):
        parameter.grad = torch.full((4,), torch.nan if (rank, step) == (1, 1) else 1.0 + rank)
        optimizers.optimizer_scaler_step_some(GradScaler("cpu", enabled=False), ["fields"])
        seen.append(parameter.detach().clone())
    return torch.stack([*seen, torch.tensor([*map(float, optimizers.skipped()), 0.0, 0.0])])


@hard_case(
    "two processes",
    case="the gradient isn't finite in one of two processes",
    could_go_wrong="one skips the step, the other takes it, and they hold different models from then on",
    must_hold="both skip it, and both take the next",
)
def test_a_broken_gradient_in_one_process_skips_the_step_in_all(tmp_path):
    first, second = in_two_processes(_step_with_one_broken_gradient, tmp_path)
    assert torch.equal(first, second)
    assert torch.equal(first[0], first[1])
    assert (first[2] < first[1]).all()
    assert first[3].tolist() == [1, 0, 0, 0]


def _gradient_of_an_unseen_view(scene: Path, rank: int) -> torch.Tensor:
    pipeline = coarse_pipeline(scene, semantic_weight=1.0, semantic_side=16)
    pipeline.model.config.thinning = 0.0
    parameters = list(pipeline.model.field.parameters())
    pipeline.unseen.loss(pipeline.model, torch.Generator().manual_seed(0)).backward()
    processes.average_gradients(parameters)
    return torch.cat([parameter.grad.flatten() for parameter in parameters])


@hard_case(
    "two processes",
    case="the semantic loss of an unseen view",
    could_go_wrong="other views, half a picture for the network, or half the gradient",
    must_hold="the gradient of one process, to 0.01% of its length",
)
def test_an_unseen_views_gradient_in_two_processes_is_that_in_one(llff_scene, tmp_path):
    target = functools.partial(_gradient_of_an_unseen_view, llff_scene)
    expected = target(0)
    for found in in_two_processes(target, tmp_path):
        assert (found - expected).norm() <= 1e-4 * expected.norm()


def _square_in_shares(rank: int) -> torch.Tensor:
    weight = nn.Parameter(torch.tensor([2.0, 3.0]))
    rows = torch.arange(14.0).view(7, 2)
    own = (processes.shard_rays(rows) * weight).square()
    whole = processes.gather_rays(own, 7)
    whole.cos().mean().backward()
    processes.average_gradients([weight])
    return torch.cat([whole.detach().flatten(), weight.grad])


@hard_case(
    "two processes",
    case="an odd number of rays on two processes",
    could_go_wrong="shares of different lengths, a ray that is lost or counted twice, gradients of another scale",
    must_hold="rows in their order, and the gradient of one process",
)
def test_shares_put_together_are_the_whole_with_its_gradient(tmp_path):
    found = in_two_processes(_square_in_shares, tmp_path)
    expected = _square_in_shares(0)
    for part in found:
        torch.testing.assert_close(part, expected)


def test_one_process_gets_back_what_it_gave():
    values = torch.rand(5, 3)
    assert processes.shard_rays(values) is values
    assert processes.gather_rays(values, 5) is values
    assert processes.from_first_process(values) is values
    assert processes.any_process(True, values.device) is True

"""One step of training, the same for the trainer, warm start, restyling and studies, and training of such steps."""

import copy
import functools
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Callable, Dict, Iterator, Mapping, Optional, Tuple, Type

import torch
from jaxtyping import Float
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import AdamOptimizerConfig, OptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import MultiStepSchedulerConfig, Scheduler
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from torch import Tensor
from torch.amp import GradScaler
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, StyleTask
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam in one pass over memory."""

    betas: Tuple[float, float] = (0.9, 0.999)
    """Decay of the running means of the gradient and its square."""
    fused: bool = True
    """Whether to use the fused implementation; the values are the same up to rounding."""


@dataclass
class MuonConfig(OptimizerConfig):
    """Muon (Jordan 2024), for the matrices of hidden layers: each step is the gradient's nearest orthogonal matrix."""

    _target: Type = torch.optim.Muon
    lr: float = 0.02
    eps: float = 1e-7
    momentum: float = 0.95
    """Decay of the running mean of gradients."""
    weight_decay: float = 0.0


@dataclass
class WarmUpSchedulerConfig(MultiStepSchedulerConfig):
    """A learning rate that rises evenly in the first iterations, and falls by a factor at some later ones."""

    _target: Type = field(default_factory=lambda: WarmUpScheduler)
    warm_up: int = 15
    """Iterations until it is whole; Adam's first steps are as long as its learning rate, whatever the gradient is."""


class WarmUpScheduler(Scheduler):
    """See `WarmUpSchedulerConfig`."""

    config: WarmUpSchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LRScheduler:
        """The schedule of an optimiser."""

        def factor(step: int) -> float:
            falls = sum(step >= milestone for milestone in self.config.milestones)
            return min(1.0, (step + 1) / max(1, self.config.warm_up)) * self.config.gamma**falls

        return LambdaLR(optimizer, factor)


def training_step(
    optimizers: Optimizers,
    compute_losses: Callable[[], Tuple[Dict[str, Float[Tensor, ""]], Dict[str, Any]]],
    step: int,
    scaler: Optional[GradScaler] = None,
    accumulate: Optional[Mapping[str, int]] = None,
) -> Tuple[Float[Tensor, ""], Dict[str, Float[Tensor, ""]], Dict[str, Any]]:
    """Minimises a sum of losses by one step of the optimisers and their schedules; returns it, the losses and metrics.

    Args:
        compute_losses: gives the losses by name, weighted, and metrics.
        step: the iteration, from 0.
        scaler: of gradients, for half precision.
        accumulate: of a group of parameters, the iterations whose gradients are added up for a step; 1 if not named.
    """
    scaler, every = scaler or GradScaler(enabled=False), accumulate or {}
    groups = list(optimizers.parameters)
    optimizers.zero_grad_some([name for name in groups if step % every.get(name, 1) == 0])
    losses, metrics = compute_losses()
    loss = functools.reduce(torch.add, losses.values())
    scaler.scale(loss).backward()
    due = [name for name in groups if (step + 1) % every.get(name, 1) == 0]
    optimizers.optimizer_scaler_step_some(scaler, due)
    scale = scaler.get_scale()
    scaler.update()
    if scale <= scaler.get_scale():  # a smaller one says that the step was skipped
        for scheduler in optimizers.schedulers.values():
            scheduler.step()
    return loss.detach(), losses, metrics


def warm_start(pipeline: HierStylePipeline, task: StyleTask, following: Optimizers) -> Iterator[int]:
    """Fits a new style's colours to whole photos (`HierStylePipeline.warm_start_loss`); an iterator of its steps.

    By an Adam of its own, with the learning rate of the optimisers of the iterations that follow.
    """
    rate = following.config["fields"]["optimizer"].lr
    adam = {"fields": {"optimizer": FusedAdamConfig(lr=rate), "scheduler": None}}
    optimizers = FiniteOptimizers(adam, {"fields": list(task.style.parameters())})
    for step in range(pipeline.config.warm_start_steps):
        training_step(optimizers, lambda step=step: (pipeline.warm_start_loss(task, step), {}), step)
        yield step
    optimizers.zero_grad_all()


def check_skipped(optimizers: FiniteOptimizers, most: int, step: int, advice: str) -> int:
    """How many steps up to iteration `step` were skipped in a row, as gradients weren't finite; waits for a GPU.

    InputError, ending with `advice`, where there are `most` or more.
    """
    _, in_a_row = optimizers.skipped()
    if in_a_row >= most:
        raise InputError(
            f"Training stopped after iteration {step + 1}, because the gradients of the last {in_a_row} weren't "
            f"finite; {advice}"
        )
    return in_a_row


class Training:
    """Training of any nerfstudio method without its trainer: iterations that can be timed one by one.

    Args:
        coarse_state: of the coarse model that a stylised one builds on.
        prepare: called with the pipeline before its training is set up; may give it what other runs have made.
    """

    def __init__(
        self,
        config: TrainerConfig,
        device: torch.device,
        coarse_state: Optional[Dict[str, Tensor]] = None,
        prepare: Optional[Callable[[VanillaPipeline], None]] = None,
    ) -> None:
        self.pipeline: VanillaPipeline = config.pipeline.setup(device=str(device), test_mode="val")
        if coarse_state is not None:
            self.pipeline.model.adopt_coarse(coarse_state)
        if prepare is not None:
            prepare(self.pipeline)
        kind = FiniteOptimizers if isinstance(self.pipeline, CheckedPipeline) else Optimizers
        self.optimizers = kind(copy.deepcopy(config.optimizers), self.pipeline.get_param_groups())
        attributes = TrainingCallbackAttributes(self.optimizers, None, self.pipeline, SimpleNamespace(config=config))
        self.callbacks = self.pipeline.get_training_callbacks(attributes)
        self.num_steps = 0
        if isinstance(self.pipeline, HierStylePipeline):
            for _ in warm_start(self.pipeline, self.pipeline.task, self.optimizers):
                pass

    def step(self) -> Tensor:
        """One iteration of nerfstudio's trainer without its logging; returns its loss."""
        self.pipeline.train()
        for callback in self.callbacks:
            callback.run_callback_at_location(self.num_steps, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        step = self.num_steps
        loss, *_ = training_step(self.optimizers, lambda: self.pipeline.get_train_loss_dict(step)[1:], step)
        self.num_steps += 1
        return loss

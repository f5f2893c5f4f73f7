"""One step of training, the same for the trainer, warm start, restyling and studies, and training of such steps."""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Callable, Dict, Iterator, Mapping, Optional, Tuple, Type

import torch
from jaxtyping import Float
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import AdamOptimizerConfig, OptimizerConfig, Optimizers
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from torch import Tensor
from torch.amp import GradScaler

from sparsestyle_ns.engine.muon import Muon
from sparsestyle_ns.engine.schedules import over_iterations
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

    _target: Type = Muon
    lr: float = 0.02
    eps: float = 1e-7
    momentum: float = 0.95
    """Decay of the running mean of gradients."""
    weight_decay: float = 0.0


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
        optimizers = over_iterations(config.optimizers, config.max_num_iterations)
        self.optimizers = kind(optimizers, self.pipeline.get_param_groups())
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
        for callback in self.callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        self.num_steps += 1
        return loss

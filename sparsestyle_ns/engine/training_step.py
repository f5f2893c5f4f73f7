"""One step of training, the same for the trainer, the warm start, restyling and studies."""

import functools
from typing import Callable, Iterator, Mapping, Optional

import torch
from jaxtyping import Float
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.amp import GradScaler

from sparsestyle_ns.engine.optimizers import FusedAdamConfig
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, StyleTask
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers


def training_step(
    optimizers: Optimizers,
    compute_losses: Callable[[int], Mapping[str, Float[Tensor, ""]]],
    step: int,
    scaler: Optional[GradScaler] = None,
    accumulate: Optional[Mapping[str, int]] = None,
) -> Float[Tensor, ""]:
    """Minimises a sum of losses by one step of the optimisers and their schedules.

    Args:
        optimizers: of all parameters that learn.
        compute_losses: gives the losses of an iteration by name, weighted.
        step: the iteration, from 0.
        scaler: of gradients, for half precision; None: gradients as they are.
        accumulate: of a group of parameters, the iterations whose gradients are added up for a step; 1 if not named.

    Returns:
        The sum, without its gradient.
    """
    scaler, every = scaler or GradScaler(enabled=False), accumulate or {}
    groups = list(optimizers.parameters)
    optimizers.zero_grad_some([name for name in groups if step % every.get(name, 1) == 0])
    loss = functools.reduce(torch.add, compute_losses(step).values())
    scaler.scale(loss).backward()
    due = [name for name in groups if (step + 1) % every.get(name, 1) == 0]
    optimizers.optimizer_scaler_step_some(scaler, due)
    scale = scaler.get_scale()
    scaler.update()
    if scale <= scaler.get_scale():  # a smaller one says that the step was skipped
        for scheduler in optimizers.schedulers.values():
            scheduler.step()
    return loss.detach()


def warm_start(pipeline: HierStylePipeline, task: StyleTask, learning_rate: float) -> Iterator[int]:
    """Fits a new style's colours to whole photos (`HierStylePipeline.warm_start_loss`); an iterator of its steps.

    Args:
        pipeline: of the scene.
        task: the field and its views.
        learning_rate: Adam's; that of the iterations that follow.
    """
    adam = {"fields": {"optimizer": FusedAdamConfig(lr=learning_rate), "scheduler": None}}
    optimizers = FiniteOptimizers(adam, {"fields": list(task.style.parameters())})
    for step in range(pipeline.config.warm_start_steps):
        training_step(optimizers, lambda step: pipeline.warm_start_loss(task, step), step)
        yield step
    optimizers.zero_grad_all()


def check_skipped(optimizers: FiniteOptimizers, most: int, stopped: str, advice: str) -> int:
    """How many steps were skipped in a row up to now, because their gradients weren't finite; waits for a GPU.

    Raises:
        InputError: so many that training can't go on; the sentence begins with `stopped` and ends with `advice`.
    """
    in_a_row = optimizers.skipped().in_a_row
    if in_a_row >= most:
        raise InputError(f"{stopped}, because the gradients of the last {in_a_row} weren't finite; {advice}")
    return in_a_row

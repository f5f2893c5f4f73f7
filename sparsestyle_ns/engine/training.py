"""A method's training without nerfstudio's trainer: iterations that can be timed one by one."""

import copy
import functools
from types import SimpleNamespace
from typing import Any, Dict, Optional

import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import TrainerConfig
from torch import Tensor
from torch.amp import GradScaler

from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers


class Training:
    """A method's pipeline and optimisers. `step` is an iteration of nerfstudio's trainer without its logging.

    Args:
        config: of any nerfstudio method.
        device: where to train.
        coarse_state: the state of the coarse model that a stylised one builds on.
    """

    def __init__(
        self, config: TrainerConfig, device: torch.device, coarse_state: Optional[Dict[str, Tensor]] = None
    ) -> None:
        self.pipeline: Any = config.pipeline.setup(device=str(device), test_mode="val", world_size=1, local_rank=0)
        if coarse_state is not None:
            self.pipeline.model.adopt_coarse(coarse_state)
        kind = FiniteOptimizers if isinstance(config, SparseStyleTrainerConfig) else Optimizers
        self.optimizers = kind(copy.deepcopy(config.optimizers), self.pipeline.get_param_groups())
        self.grad_scaler = GradScaler(device.type, enabled=False)
        attributes = TrainingCallbackAttributes(
            optimizers=self.optimizers,
            grad_scaler=None,
            pipeline=self.pipeline,
            trainer=SimpleNamespace(config=config, _start_step=0),
        )
        self.callbacks = self.pipeline.get_training_callbacks(attributes)
        self.num_steps = 0

    def step(self) -> Tensor:
        """One iteration; returns its loss."""
        self.pipeline.train()
        for callback in self.callbacks:
            callback.run_callback_at_location(self.num_steps, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        self.optimizers.zero_grad_all()
        _, losses, _ = self.pipeline.get_train_loss_dict(self.num_steps)
        loss = functools.reduce(torch.add, losses.values())
        loss.backward()
        self.optimizers.optimizer_scaler_step_some(self.grad_scaler, list(self.optimizers.parameters))
        for scheduler in self.optimizers.schedulers.values():
            scheduler.step()
        self.num_steps += 1
        return loss.detach()

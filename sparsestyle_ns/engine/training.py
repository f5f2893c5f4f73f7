"""A method's training without nerfstudio's trainer: iterations that can be timed one by one."""

import copy
from types import SimpleNamespace
from typing import Callable, Dict, Optional

import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from torch import Tensor

from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.engine.training_step import training_step, warm_start
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers


class Training:
    """A method's pipeline and optimisers. `step` is an iteration of nerfstudio's trainer without its logging.

    Args:
        config: of any nerfstudio method.
        device: where to train.
        coarse_state: the state of the coarse model that a stylised one builds on.
        prepare: called with the pipeline before its training is set up; may give it what other runs have made.
    """

    def __init__(
        self,
        config: TrainerConfig,
        device: torch.device,
        coarse_state: Optional[Dict[str, Tensor]] = None,
        prepare: Optional[Callable[[VanillaPipeline], None]] = None,
    ) -> None:
        self.pipeline: VanillaPipeline = config.pipeline.setup(
            device=str(device), test_mode="val", world_size=1, local_rank=0
        )
        if coarse_state is not None:
            self.pipeline.model.adopt_coarse(coarse_state)
        if prepare is not None:
            prepare(self.pipeline)
        kind = FiniteOptimizers if isinstance(config, SparseStyleTrainerConfig) else Optimizers
        self.optimizers = kind(copy.deepcopy(config.optimizers), self.pipeline.get_param_groups())
        attributes = TrainingCallbackAttributes(
            optimizers=self.optimizers,
            grad_scaler=None,
            pipeline=self.pipeline,
            trainer=SimpleNamespace(config=config),
        )
        self.callbacks = self.pipeline.get_training_callbacks(attributes)
        self.num_steps = 0
        if isinstance(self.pipeline, HierStylePipeline):
            rate = self.optimizers.optimizers["fields"].param_groups[0]["lr"]
            for _ in warm_start(self.pipeline, self.pipeline.task, rate):
                pass

    def step(self) -> Tensor:
        """One iteration; returns its loss."""
        self.pipeline.train()
        for callback in self.callbacks:
            callback.run_callback_at_location(self.num_steps, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        loss = training_step(self.optimizers, lambda step: self.pipeline.get_train_loss_dict(step)[1], self.num_steps)
        self.num_steps += 1
        return loss

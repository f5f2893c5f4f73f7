"""The pipeline of `coarse-fewshot`: batches of rays of a few photos."""

from dataclasses import dataclass, field
from typing import List, Type

from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.utils.rich_utils import CONSOLE

from sparsestyle_ns.effects.registry import decide_again
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel, CoarseFewShotModelConfig
from sparsestyle_ns.pipelines.base import CheckedPipeline, CheckedPipelineConfig


@dataclass
class CoarseFewShotPipelineConfig(CheckedPipelineConfig):
    """Settings of stage 1."""

    _target: Type = field(default_factory=lambda: CoarseFewShotPipeline)
    model: ModelConfig = field(default_factory=CoarseFewShotModelConfig)
    """The coarse field and how it is trained."""


class CoarseFewShotPipeline(CheckedPipeline):
    """Stage 1. nerfstudio's own steps on our data manager and model."""

    config: CoarseFewShotPipelineConfig
    model: CoarseFewShotModel

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> List[TrainingCallback]:
        """Adds the decision about empty space to nerfstudio's callbacks."""
        callbacks = super().get_training_callbacks(training_callback_attributes)
        if self.effects["empty_space"].choice == "auto":
            where = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
            callbacks.append(TrainingCallback(where_to_run=where, func=self.decide_empty_space))
        return callbacks

    def decide_empty_space(self, step: int) -> None:
        """After every tenth of the iterations from three quarters on, measures whether skipping empty space pays.

        Before, the field is still half the fog that it starts as, and a measurement would say so.
        """
        done, total = step + 1, self.model.num_steps
        if done % max(1, total // 10) or not 3 * total <= 4 * done < 4 * total:
            return
        scene = self.datamanager.scene
        scene.coarse_density = lambda points: self.model.field.density_and_feature(points.to(self.device))[0]
        before = self.effects.on("empty_space")
        self.config.decided = decide_again(self.effects, "empty_space", scene)
        if self.effects.on("empty_space") != before:
            self.model.build_grid(self.effects)
            decision = self.effects["empty_space"]
            CONSOLE.print(
                f"Empty-space skipping is {'on' if decision.on else 'off'} from iteration {done} on: "
                f"{decision.measured:.0%} {decision.reason}."
            )

"""The pipeline of `coarse-fewshot`: batches of rays of a few photos."""

from dataclasses import dataclass, field
from typing import Type

from nerfstudio.data.datamanagers.base_datamanager import DataManagerConfig
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from sparsestyle_ns.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModelConfig
from sparsestyle_ns.pipelines.base import CheckedPipeline


@dataclass
class CoarseFewShotPipelineConfig(VanillaPipelineConfig):
    """Settings of stage 1."""

    _target: Type = field(default_factory=lambda: CoarseFewShotPipeline)
    datamanager: DataManagerConfig = field(default_factory=FewShotDataManagerConfig)
    """The photos."""
    model: ModelConfig = field(default_factory=CoarseFewShotModelConfig)
    """The coarse field and how it is trained."""


class CoarseFewShotPipeline(CheckedPipeline):
    """Stage 1. nerfstudio's own steps on our data manager and model."""

    config: CoarseFewShotPipelineConfig

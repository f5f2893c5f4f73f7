"""The trainer of stage 1."""

from dataclasses import asdict, replace
from typing import List

from sparsestyle_ns.engine.hints import ns_train_style
from sparsestyle_ns.engine.trainer import SparseStyleTrainer
from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipeline
from sparsestyle_ns.runs.checkpoints import CheckpointNotes


class CoarseFewShotTrainer(SparseStyleTrainer):
    """Trains a coarse field."""

    stage = "Stage 1"
    pipeline: CoarseFewShotPipeline

    def notes(self) -> CheckpointNotes:
        """What `SparseStyleTrainer.notes` has and, where a feature network took part, which."""
        unseen = self.pipeline.unseen
        notes = super().notes()
        return notes if unseen is None else replace(notes, backbone=asdict(unseen.backbone.description))

    def next_command(self) -> List[str]:
        """See `SparseStyleTrainer.next_command`."""
        return ns_train_style(self.base_dir, self.config)

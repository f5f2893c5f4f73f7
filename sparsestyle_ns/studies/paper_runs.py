"""The runs of the paper's tables: each *kind* of stage 1 or stage 2 is a set of settings of the same methods."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Dict, Optional, Tuple

from sparsestyle_ns.losses.stylization import LOSSES
from sparsestyle_ns.studies.run_queue import Run, Settings
from sparsestyle_ns.studies.study import Stage, Study
from sparsestyle_ns.style.backbones import available_backbone

HIGH_FREQUENCIES: Settings = {"pipeline.model.coarse_field.num_levels": 10, "pipeline.model.distortion_weight": 0.0}
VANILLA: Settings = {**HIGH_FREQUENCIES, "pipeline.model.coarse_field.num_layers": 8}
COARSE_KINDS: Dict[str, Settings] = {
    "ours": {},
    "paper": {"pipeline.model.distortion_weight": 0.0},
    "vanilla": VANILLA,
    "dietnerf": {**VANILLA, "pipeline.semantic_weight": 0.1},
    "freenerf": {**HIGH_FREQUENCIES, "pipeline.model.frequency_reveal": 0.9, "pipeline.model.occlusion_weight": 0.01},
}
"""Stage 1: as it is; as the paper writes it, on colours alone; NeRF's ten octaves, eight layers, view dependence; the
same with a semantic loss of DietNeRF's kind; and ten octaves with FreeNeRF's regularisers."""
COLORS_ALONE: Settings = {"pipeline.effects.view_color": "on", "pipeline.effects.matched_depth": "off"}
"""What both stages have to be told of every kind of stage 1 but ours."""
CONSTANT: Settings = {"pipeline.content_decay": 1.0, "pipeline.content_restart": 1.0}
"""The content weight stays as it is in all iterations, at each size of the views."""
PAPER_LOSSES: Settings = {
    **{f"pipeline.loss_weights.{name}": 0.0 for name in LOSSES if name not in ("content", "style")},
    "pipeline.object_style": 1.0,
}
"""Content and style alone, as ARF and the paper have it."""
CONTENT_WEIGHTS = (2.0, 0.2, 0.02)
"""What ours begins with, ends with, and the middle between."""
FINE_TUNING: Settings = {
    "pipeline.model.stylised_field": "coarse",
    "optimizers.fields.optimizer.lr": 5e-4,
    "pipeline.palette_transfer": "moments",
    **PAPER_LOSSES,
    "pipeline.loss_weights.content": 0.1,
    **CONSTANT,
    # Every step counts as a sample, and of those that show all activations are kept: about 10 KB each.
    "pipeline.samples_per_chunk": 1 << 19,
}
STYLE_KINDS: Dict[str, Settings] = {
    "ours": {},
    "arf": FINE_TUNING,
    "ec-only": {"pipeline.model.fine_encoding": "none"},
    "frequency": {"pipeline.model.fine_encoding": "frequency"},
    "coarse-density": {"pipeline.effects.residual_density": "off"},
    **{f"lambda-{weight:g}": {"pipeline.loss_weights.content": weight, **CONSTANT} for weight in CONTENT_WEIGHTS},
}
"""Stage 2: as it is; the coarse field itself fine-tuned, as ARF does, at stage 1's learning rate and with a content
weight of 0.1; and the paper's ablations."""
EVERY_LOSS: Settings = {"logging.steps_per_log": 1}
"""Plots of the losses take those of every iteration."""
PICTURES = (20, 100)
"""Iterations after which the paper shows what different content weights have done (Fig. 7 a)."""


@dataclass
class PaperRuns:
    """The runs on one scene."""

    study: Study
    output_dir: Path
    found_backbone: Optional[str] = field(default_factory=available_backbone)
    """The feature network of all runs, unless the study's flags name weights; None: there is none."""

    def __post_init__(self) -> None:
        stages: Tuple[Stage, Stage] = ("coarse-fewshot", "hier-style")
        # Parses the flags, too, so that a wrong one is known before anything is trained.
        self._own_weights = {stage: self.study.config(stage).pipeline.vgg_weights is not None for stage in stages}

    def _network(self, stage: Stage) -> Settings:
        """One network for all runs, whatever can be downloaded by the time that they begin."""
        if self.found_backbone is None or self._own_weights[stage]:
            return {}
        return {"pipeline.backbone": self.found_backbone}

    def coarse_kinds(self) -> Tuple[str, ...]:
        """The kinds of stage 1 that can be trained here: without weights of a feature network, not `dietnerf`."""
        found = self.found_backbone is not None or self._own_weights["coarse-fewshot"]
        return tuple(kind for kind in COARSE_KINDS if found or kind != "dietnerf")

    def coarse(self, kind: str) -> Run:
        """The run of stage 1 of a kind."""
        network = self._network("coarse-fewshot") if kind == "dietnerf" else {}
        settings = {**COARSE_KINDS[kind], **({} if kind == "ours" else COLORS_ALONE), **network}
        return Run(self.study, self.output_dir, kind, "coarse-fewshot", tuple(settings.items()))

    def stylised(
        self,
        painting: Path,
        style_kind: str = "ours",
        coarse_kind: str = "ours",
        varied: Optional[Tuple[str, float]] = None,
        own_iterations: Optional[int] = None,
    ) -> Run:
        """The run of stage 2 of a kind, on a coarse field of a kind; if given, with a setting varied, or longer."""
        iterations = own_iterations or self.study.iterations("hier-style")
        colors = {} if coarse_kind == "ours" else COLORS_ALONE
        setting = {} if varied is None else dict([varied])
        settings = {**STYLE_KINDS[style_kind], **setting, **colors, **EVERY_LOSS, **self._network("hier-style")}
        return Run(
            self.study,
            self.output_dir,
            name=f"{coarse_kind}-{style_kind}-{painting.stem}" + ("" if varied is None else f"-{varied[1]:g}"),
            stage="hier-style",
            settings=tuple(settings.items()),
            painting=painting,
            coarse=self.coarse(coarse_kind),
            own_iterations=own_iterations,
            pictures=(*(count for count in PICTURES if count < iterations), iterations),
        )

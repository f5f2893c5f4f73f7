"""The methods that this package adds to nerfstudio: for people, for a first look, and as the paper has them."""

import copy
import functools
from typing import Any, Dict, Optional, Type

from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, ViewerConfig
from nerfstudio.plugins.types import MethodSpecification

from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.engine.schedules import ShareSchedulerConfig
from sparsestyle_ns.engine.style_trainer import HierStyleTrainerConfig
from sparsestyle_ns.engine.trainer import CoarseFewShotTrainer, SparseStyleTrainerConfig
from sparsestyle_ns.engine.training import FusedAdamConfig, MuonConfig
from sparsestyle_ns.losses.stylization import LOSSES
from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipelineConfig
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.viewer.panel import EffectsPanel, StylePanel


def adam(lr: float, scheduler: Optional[ShareSchedulerConfig] = None) -> Dict[str, Any]:
    """Adam for a group of parameters, and how its learning rate falls."""
    return {"optimizer": FusedAdamConfig(lr=lr), "scheduler": scheduler}


COARSE_ITERATIONS = 2500


def coarse_optimizers() -> Dict[str, Any]:
    """Muon for the hidden layers' matrices, which is several times as fast as Adam alone; learning rates fall.

    In a longer run they stay at their ends: many iterations at a high rate fit the photos, and not the scene.
    """

    def falling(final: float) -> ShareSchedulerConfig:
        return ShareSchedulerConfig(final=final, longest_fall=COARSE_ITERATIONS)

    muon = {"optimizer": MuonConfig(lr=0.02), "scheduler": falling(0.02)}
    return {"fields": adam(1e-3, falling(0.1)), "hidden_layers": muon, "cameras": adam(5e-4, falling(0.01))}


def method(
    kind: Type[SparseStyleTrainerConfig], description: str, steps_per_log: int, **settings: Any
) -> MethodSpecification:
    """A method, with what both stages have in common."""
    # Without nerfstudio's table and its profile at the end: the trainer has a bar and a last line of its own.
    local = LocalWriterConfig(enable=False)
    config = kind(
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        viewer=ViewerConfig(num_rays_per_chunk=1 << 13),
        logging=LoggingConfig(steps_per_log=steps_per_log, local_writer=local, profiler="none"),
        vis="viewer+tensorboard",
        **settings,
    )
    return MethodSpecification(config, description)


def variant(of: MethodSpecification, suffix: str, description: str, settings: Dict[str, Any]) -> MethodSpecification:
    """A method with another end to its name, and other settings, by their paths in the config as flags have them."""
    config = copy.deepcopy(of.config)
    for path, value in {"method_name": of.config.method_name + suffix, **settings}.items():
        *owners, name = path.split(".")
        owner = functools.reduce(getattr, owners, config)
        assert hasattr(owner, name), path
        setattr(owner, name, value)
    return MethodSpecification(config, description)


coarse_fewshot = method(
    SparseStyleTrainerConfig,
    "Coarse radiance field from three to eight photos (stage 1): about four minutes on two CPU cores at 504 pixels.",
    _target=CoarseFewShotTrainer,
    method_name="coarse-fewshot",
    max_num_iterations=COARSE_ITERATIONS,
    steps_per_save=500,
    steps_per_log=50,
    pipeline=CoarseFewShotPipelineConfig(
        datamanager=FewShotDataManagerConfig(train_num_rays_per_batch=256), panel=EffectsPanel
    ),
    optimizers=coarse_optimizers(),
)


def coarse_fewshot_config() -> SparseStyleTrainerConfig:
    """A copy of coarse-fewshot's config, for hier-style."""
    return copy.deepcopy(coarse_fewshot.config)


hier_style = method(
    HierStyleTrainerConfig,
    "A coarse-fewshot scene in the style of a painting, --style-image FILE (stage 2); both about eight minutes there.",
    coarse_method=coarse_fewshot_config,
    method_name="hier-style",
    max_num_iterations=200,
    steps_per_save=100,
    steps_per_log=5,
    pipeline=HierStylePipelineConfig(datamanager=FewShotDataManagerConfig(), panel=StylePanel),
    optimizers={"fields": adam(5e-3, ShareSchedulerConfig(warm_up=0.075, milestones=(0.5, 0.8)))},
)

DRAFT = {"preview_side": 128, "pipeline.datamanager.max_image_side": 252}
A_FIRST_LOOK = "for a first look: pictures of 252 pixels, both stages about two minutes on two CPU cores."
coarse_fewshot_draft = variant(
    coarse_fewshot,
    "-draft",
    f"coarse-fewshot {A_FIRST_LOOK}",
    {**DRAFT, "max_num_iterations": 1000, "steps_per_save": 500},
)


def coarse_fewshot_draft_config() -> SparseStyleTrainerConfig:
    """A copy of coarse-fewshot-draft's config, for hier-style-draft."""
    return copy.deepcopy(coarse_fewshot_draft.config)


hier_style_draft = variant(
    hier_style,
    "-draft",
    f"hier-style {A_FIRST_LOOK}",
    {
        **DRAFT,
        "coarse_method": coarse_fewshot_draft_config,
        "max_num_iterations": 80,
        "pipeline.view_side": 252,
        "pipeline.view_scales": (0.5, 1.0),
        "pipeline.scale_shares": (0.85, 0.15),
    },
)

THE_PAPER = "with the paper's own settings: hours on a CPU, for comparisons."
coarse_fewshot_paper = variant(
    coarse_fewshot,
    "-paper",
    f"coarse-fewshot {THE_PAPER}",
    {
        "max_num_iterations": 50_000,
        "steps_per_save": 5000,
        "pipeline.datamanager.train_num_rays_per_batch": 1024,
        "pipeline.effects": EffectSettings(view_color="on", matched_depth="off"),
        "pipeline.model.distortion_weight": 0.0,
        "pipeline.model.early_iterations": 0.0,
        "optimizers": {"fields": adam(5e-4), "hidden_layers": adam(5e-4), "cameras": adam(5e-4)},
    },
)


def coarse_fewshot_paper_config() -> SparseStyleTrainerConfig:
    """A copy of coarse-fewshot-paper's config, for hier-style-paper."""
    return copy.deepcopy(coarse_fewshot_paper.config)


hier_style_paper = variant(
    hier_style,
    "-paper",
    f"hier-style {THE_PAPER}",
    {
        "coarse_method": coarse_fewshot_paper_config,
        "max_num_iterations": 200,
        "pipeline.effects": EffectSettings(view_color="on", matched_depth="off", residual_density="on", palette="off"),
        "pipeline.view_side": "photos",
        "pipeline.view_scales": (1.0,),
        "pipeline.scale_shares": (1.0,),
        "pipeline.content_share": 0.5,
        "pipeline.object_style": 1.0,
        "pipeline.loss_weights": {**dict.fromkeys(LOSSES, 0.0), "content": 10.0, "style": 1.0},
        "pipeline.model.min_resolution": 128,
        "pipeline.model.max_resolution": 512,
        "pipeline.model.depth_cells": 1.0,
        "pipeline.warm_start_steps": 0,
        "pipeline.thinning": 0.0,
        "optimizers": {"fields": adam(5e-3, ShareSchedulerConfig(milestones=(0.25, 0.5)))},
    },
)


def method_config(name: str) -> SparseStyleTrainerConfig:
    """A copy of the config of one of this package's methods, by its name on the command line."""
    methods = (coarse_fewshot, coarse_fewshot_draft, coarse_fewshot_paper)
    methods += (hier_style, hier_style_draft, hier_style_paper)
    return copy.deepcopy(next(method.config for method in methods if method.config.method_name == name))

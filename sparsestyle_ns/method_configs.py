"""The methods that this package adds to nerfstudio: the paper's settings, and drafts for small machines."""

import copy
import functools
from typing import Any, Dict, Optional, Type

from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, ViewerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig, MultiStepSchedulerConfig, SchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from sparsestyle_ns.engine.style_trainer import HierStyleTrainerConfig
from sparsestyle_ns.engine.trainer import CoarseFewShotTrainer, SparseStyleTrainerConfig
from sparsestyle_ns.engine.training import FusedAdamConfig
from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipelineConfig
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.viewer.panel import EffectsPanel, StylePanel


def adam(lr: float, scheduler: Optional[SchedulerConfig] = None) -> Dict[str, Any]:
    """The optimiser of a field, and how its learning rate falls."""
    return {"fields": {"optimizer": FusedAdamConfig(lr=lr), "scheduler": scheduler}}


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
    "Coarse radiance field from three to eight photos (stage 1).",
    _target=CoarseFewShotTrainer,
    method_name="coarse-fewshot",
    max_num_iterations=50_000,
    steps_per_save=5000,
    steps_per_log=100,
    pipeline=CoarseFewShotPipelineConfig(
        datamanager=FewShotDataManagerConfig(train_num_rays_per_batch=1024, max_image_side=1008), panel=EffectsPanel
    ),
    optimizers=adam(5e-4),
)


def coarse_fewshot_config() -> SparseStyleTrainerConfig:
    """A copy of coarse-fewshot's config, for hier-style."""
    return copy.deepcopy(coarse_fewshot.config)


hier_style = method(
    HierStyleTrainerConfig,
    "A coarse-fewshot scene in the style of a painting, --style-image FILE (stage 2).",
    coarse_method=coarse_fewshot_config,
    method_name="hier-style",
    max_num_iterations=200,
    steps_per_save=50,
    steps_per_log=5,
    pipeline=HierStylePipelineConfig(datamanager=FewShotDataManagerConfig(max_image_side=1008), panel=StylePanel),
    optimizers=adam(5e-3, MultiStepSchedulerConfig(gamma=0.33, milestones=(50, 100))),
)

DRAFT = {"preview_side": 80, "pipeline.datamanager.max_image_side": 128}
SMALL = "for small machines: images of 128 pixels, about two minutes on two CPU cores."
coarse_fewshot_draft = variant(
    coarse_fewshot,
    "-draft",
    f"coarse-fewshot {SMALL}",
    {
        **DRAFT,
        "max_num_iterations": 2500,
        "steps_per_save": 1000,
        "logging.steps_per_log": 50,
        "pipeline.datamanager.train_num_rays_per_batch": 256,
        "pipeline.model.num_eval_samples": 32,
        "optimizers": adam(1e-3, ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=2500)),
    },
)


def coarse_fewshot_draft_config() -> SparseStyleTrainerConfig:
    """A copy of coarse-fewshot-draft's config, for hier-style-draft."""
    return copy.deepcopy(coarse_fewshot_draft.config)


hier_style_draft = variant(
    hier_style,
    "-draft",
    f"hier-style {SMALL}",
    {
        **DRAFT,
        "coarse_method": coarse_fewshot_draft_config,
        "pipeline.model.num_steps": 64,
        "pipeline.model.occupancy_resolution": 96,
        # A quarter of the paper's, as the images are: cells finer than pixels don't reach new views.
        "pipeline.model.min_resolution": 32,
        "pipeline.model.max_resolution": 128,
        "pipeline.feature_side": 252,
        "pipeline.warm_start_steps": 40,
        "optimizers": adam(5e-3, MultiStepSchedulerConfig(gamma=0.33, milestones=(80, 160))),
    },
)


def method_config(name: str) -> SparseStyleTrainerConfig:
    """The config of one of this package's methods, by its name on the command line."""
    methods = (coarse_fewshot, coarse_fewshot_draft, hier_style, hier_style_draft)
    return next(method.config for method in methods if method.config.method_name == name)

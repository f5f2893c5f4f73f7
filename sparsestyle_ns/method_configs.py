"""The methods that this package adds to nerfstudio: the paper's settings, and drafts for small machines."""

import copy

from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, ViewerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig, MultiStepSchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification

from sparsestyle_ns.engine.coarse_trainer import CoarseFewShotTrainer
from sparsestyle_ns.engine.optimizers import FusedAdamConfig
from sparsestyle_ns.engine.style_trainer import HierStyleTrainer, HierStyleTrainerConfig
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModelConfig
from sparsestyle_ns.models.hier_style import HierStyleModelConfig
from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipelineConfig
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.viewer.effects_panel import EffectsPanel
from sparsestyle_ns.viewer.panel import StylePanel


def _logging(steps_per_log: int) -> LoggingConfig:
    """Without nerfstudio's table and its profile at the end: the trainer has a bar and a last line of its own."""
    return LoggingConfig(steps_per_log=steps_per_log, local_writer=LocalWriterConfig(enable=False), profiler="none")


def _coarse_fewshot(draft: bool) -> TrainerConfig:
    """Stage 1; the draft is for images of about 128 pixels and two CPU cores."""
    iterations = 2500 if draft else 50_000
    return SparseStyleTrainerConfig(
        _target=CoarseFewShotTrainer,
        method_name="coarse-fewshot-draft" if draft else "coarse-fewshot",
        max_num_iterations=iterations,
        steps_per_save=1000 if draft else 5000,
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        preview_side=80 if draft else 256,
        steps_per_eval_all_images=0,
        pipeline=CoarseFewShotPipelineConfig(
            datamanager=FewShotDataManagerConfig(
                train_num_rays_per_batch=256 if draft else 1024,
                max_image_side=128 if draft else 1008,
            ),
            model=CoarseFewShotModelConfig(num_eval_samples=32 if draft else 64),
            panel=EffectsPanel,
        ),
        optimizers={
            "fields": {
                "optimizer": FusedAdamConfig(lr=1e-3 if draft else 5e-4),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=iterations) if draft else None,
            }
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 13),
        logging=_logging(50 if draft else 100),
        vis="viewer+tensorboard",
    )


def _hier_style(draft: bool) -> TrainerConfig:
    """Stage 2; the draft is for images of about 128 pixels and two CPU cores."""
    return HierStyleTrainerConfig(
        _target=HierStyleTrainer,
        coarse_method=new_coarse_draft if draft else new_coarse,
        method_name="hier-style-draft" if draft else "hier-style",
        max_num_iterations=200,
        steps_per_save=50,
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        preview_side=80 if draft else 256,
        steps_per_eval_all_images=0,
        pipeline=HierStylePipelineConfig(
            datamanager=FewShotDataManagerConfig(max_image_side=128 if draft else 1008),
            model=HierStyleModelConfig(
                num_steps=64,
                occupancy_resolution=96,
                # A quarter of the paper's, as the images are: cells finer than pixels don't reach new views.
                min_resolution=32,
                max_resolution=128,
            )
            if draft
            else HierStyleModelConfig(),
            feature_side=252 if draft else 504,
            warm_start_steps=40 if draft else 60,
            panel=StylePanel,
        ),
        optimizers={
            "fields": {
                "optimizer": FusedAdamConfig(lr=5e-3),
                "scheduler": MultiStepSchedulerConfig(gamma=0.33, milestones=(80, 160) if draft else (50, 100)),
            }
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 13),
        logging=_logging(5),
        vis="viewer+tensorboard",
    )


coarse_fewshot = MethodSpecification(
    config=_coarse_fewshot(draft=False),
    description="Coarse radiance field from three to eight photos (stage 1).",
)
coarse_fewshot_draft = MethodSpecification(
    config=_coarse_fewshot(draft=True),
    description="coarse-fewshot for small machines: images of 128 pixels, about two minutes on two CPU cores.",
)


def new_coarse() -> TrainerConfig:
    """The settings of `coarse-fewshot`, for a run of them."""
    return copy.deepcopy(coarse_fewshot.config)


def new_coarse_draft() -> TrainerConfig:
    """The same of `coarse-fewshot-draft`."""
    return copy.deepcopy(coarse_fewshot_draft.config)


hier_style = MethodSpecification(
    config=_hier_style(draft=False),
    description="A coarse-fewshot scene in the style of a painting, --style-image FILE (stage 2).",
)
hier_style_draft = MethodSpecification(
    config=_hier_style(draft=True),
    description="hier-style for small machines: images of 128 pixels, about two minutes on two CPU cores.",
)


def method_config(name: str) -> TrainerConfig:
    """The config of one of this package's methods, by its name on the command line."""
    methods = (coarse_fewshot, coarse_fewshot_draft, hier_style, hier_style_draft)
    return next(method.config for method in methods if method.config.method_name == name)

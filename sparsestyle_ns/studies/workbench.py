"""What curves are measured on: a scene with its photos, and what has been trained on it so far."""

import copy
import gc
import math
from dataclasses import replace
from pathlib import Path
from typing import Callable, Dict, List, Optional, Sequence, Tuple, TypeVar, Union

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig, MultiStepSchedulerConfig
from torch import Tensor

from sparsestyle_ns.data.view_selection import evenly_spaced
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.metrics.image import image_metrics
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.pipelines.base import CheckedPipeline
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, HierStylePipelineConfig
from sparsestyle_ns.pipelines.scene_views import SceneViews
from sparsestyle_ns.runs.coarse_run import check_scene, read_coarse_run
from sparsestyle_ns.runs.scene_record import record_scene
from sparsestyle_ns.studies.pareto import root_mean_square
from sparsestyle_ns.studies.study import Study
from sparsestyle_ns.studies.time_budget import Budget, OutOfTimeError
from sparsestyle_ns.utils.machine import LoadWatch, synchronize

Model = Union[CoarseFewShotModel, HierStyleModel]
T = TypeVar("T")

HELD_OUT_VIEWS = 3
"""Held-out views that are measured at most; evenly spaced among all."""
PROBE_STEPS = 3
"""Iterations from which the time of one is estimated, after one that doesn't count."""


def squeezed(config: SparseStyleTrainerConfig, iterations: int) -> SparseStyleTrainerConfig:
    """A copy of a method's config whose schedules end after `iterations` as they would have at the preset's end."""
    config = copy.deepcopy(config)
    share = iterations / config.max_num_iterations

    def scaled(count: int) -> int:
        return max(1, round(count * share))

    config.max_num_iterations = iterations
    for parts in config.optimizers.values():
        scheduler = parts["scheduler"]
        if isinstance(scheduler, ExponentialDecaySchedulerConfig):
            parts["scheduler"] = replace(scheduler, max_steps=scaled(scheduler.max_steps))
        elif isinstance(scheduler, MultiStepSchedulerConfig):
            parts["scheduler"] = replace(scheduler, milestones=tuple(map(scaled, scheduler.milestones)))
    pipeline = config.pipeline
    if isinstance(pipeline, HierStylePipelineConfig):
        pipeline.content_steps = scaled(pipeline.content_steps)
        pipeline.warm_start_steps = scaled(pipeline.warm_start_steps) if pipeline.warm_start_steps else 0
    return config


class Workbench:
    """The scene, and what has been trained on it so far.

    Args:
        study: the scene and the presets.
        budget: all the time there is.
        style_image: the painting; None leaves out what needs one.
        coarse_run: a coarse run to render; None: the one that is trained here.
        rounds: repetitions of each measurement at most.

    Raises:
        InputError: scene, painting, feature network or coarse run can't be used.
    """

    def __init__(
        self,
        study: Study,
        budget: Budget,
        style_image: Optional[Path] = None,
        coarse_run: Optional[Path] = None,
        rounds: int = 1,
    ) -> None:
        self.study, self.budget, self.clock, self.rounds = study, budget, budget.clock, rounds
        self.trains_coarse = coarse_run is None
        self.watch = LoadWatch()
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.coarse_config = study.config("coarse-fewshot")
        self.style_config = study.config("hier-style", style_image=style_image)
        self.manager: FewShotDataManager = self.coarse_config.pipeline.datamanager.setup(
            device=str(self.device), test_mode="test", world_size=1, local_rank=0
        )
        self.effects = decide(self.manager.scene, self.coarse_config.pipeline.effects)
        self.manager.set_effects(self.effects)
        self.eval_dataset = self.manager.eval_dataset
        count = min(HELD_OUT_VIEWS, len(self.eval_dataset))
        self.views = list(evenly_spaced(len(self.eval_dataset), count))
        self.photos = {view: self.eval_dataset[view]["image"][..., :3].to(self.device) for view in self.views}
        self.scene_views: Optional[SceneViews] = None
        self._targets: Dict[Tuple[int, Optional[int], Optional[int]], StyleTargets] = {}
        self.targets = None if style_image is None else self.targets_for(self.style_config.pipeline)
        self.coarse_state: Optional[Dict[str, Tensor]] = None
        self.coarse_model: Optional[CoarseFewShotModel] = None
        self.own_error: Optional[float] = None
        self.style_model: Optional[HierStyleModel] = None
        self.is_stylised = False
        self.view_seconds: Dict[type, float] = {}
        if coarse_run is not None:
            self._adopt_coarse_run(coarse_run)

    def _adopt_coarse_run(self, folder: Path) -> None:
        run = read_coarse_run(folder)
        scene = record_scene(self.study.data, self.manager.train_dataparser_outputs, self.effects)
        check_scene(run, scene)
        config = copy.deepcopy(self.coarse_config)
        config.pipeline.model = copy.deepcopy(run.config.pipeline.model)
        model = self._setup_pipeline(config).model
        model.load_state_dict(run.model_state())
        self.keep_coarse(model)
        self.evaluate(model, self.views)

    # ------------------------------------------------------------------------------------------------------- scene

    @property
    def size(self) -> Tuple[int, int]:
        """(height, width) of a view."""
        height, width, _ = self.photos[self.views[0]].shape
        return height, width

    @property
    def pixels(self) -> int:
        """Pixels of a view."""
        return math.prod(self.size)

    def camera(self, view: int) -> Cameras:
        """The camera of a held-out view."""
        return self.eval_dataset.cameras[view : view + 1].to(self.device)

    def some_rays(self, count: int) -> RayBundle:
        """Rays of random pixels of the held-out views, the same each time."""
        bundles = [self.camera(view).generate_rays(camera_indices=0, keep_shape=False).flatten() for view in self.views]
        origins, directions, areas = (
            torch.cat([getattr(bundle, name).view(-1, size) for bundle in bundles])
            for name, size in (("origins", 3), ("directions", 3), ("pixel_area", 1))
        )
        order = torch.randperm(len(origins), generator=torch.Generator().manual_seed(0))[:count].to(self.device)
        indices = torch.zeros(len(order), 1, dtype=torch.long, device=self.device)
        return RayBundle(origins[order], directions[order], areas[order], camera_indices=indices)

    # ----------------------------------------------------------------------------------------------------- training

    @staticmethod
    def collect_garbage() -> None:
        """Gives memory of runs before back; what was there before them needn't be searched, which takes most time."""
        gc.collect()
        gc.freeze()

    def targets_for(self, config: HierStylePipelineConfig) -> StyleTargets:
        """The painting's features with a run's settings, worked out once."""
        key = config.feature_side, config.style_side, config.style_features
        if key not in self._targets:
            self._targets[key] = config.targets_of(*config.load_style(), self.device)
        return self._targets[key]

    def _setup_pipeline(self, config: SparseStyleTrainerConfig) -> CheckedPipeline:
        config.pipeline.decided = self.effects
        return config.pipeline.setup(device=str(self.device), test_mode="test", world_size=1, local_rank=0)

    def start(self, config: SparseStyleTrainerConfig, budget: Budget, seed: int = 0) -> Training:
        """Training with a method's config, its schedules as they are there.

        Raises:
            OutOfTimeError: the time is over, before the views of stage 2 are frozen.
        """
        torch.manual_seed(seed)
        config = copy.deepcopy(config)
        if hasattr(config.pipeline.model, "seed"):
            config.pipeline.model.seed += seed
        config.pipeline.datamanager.seed += seed
        config.pipeline.decided = self.effects
        if not isinstance(config.pipeline, HierStylePipelineConfig):
            return Training(config, self.device)

        def share(pipeline: HierStylePipeline) -> None:
            budget.check()
            pipeline.targets = self.targets_for(config.pipeline)
            if self.scene_views is None:
                self.scene_views = pipeline.freeze_views()
            for view in self.scene_views.views:
                view.features = None  # they depend on the size that the network sees, which a run may change
            pipeline.scene_views = self.scene_views

        return Training(config, self.device, self.coarse_state, share)

    def adapted_style_config(self) -> SparseStyleTrainerConfig:
        """Stage 2's preset with the shape of the coarse field that there is.

        Raises:
            OutOfTimeError: no coarse field could be trained in the time there was.
        """
        if self.coarse_model is None:
            raise OutOfTimeError
        config = copy.deepcopy(self.style_config)
        config.pipeline.model.coarse_field = copy.deepcopy(self.coarse_model.config.coarse_field)
        return config

    def step_seconds(self, training: Training, budget: Budget) -> float:
        """What an iteration takes, from a few."""
        seconds = []
        for _ in range(1 + PROBE_STEPS):
            seconds.append(self.timed(training.step)[0])
            budget.check()
        return sum(seconds[1:]) / PROBE_STEPS

    def timed(self, work: Callable[[], T]) -> Tuple[float, T]:
        """Seconds of a piece of work, and what it gave."""
        synchronize(self.device)
        start = self.clock()
        found = work()
        synchronize(self.device)
        return self.clock() - start, found

    def train(self, training: Training, iterations: int, budget: Budget, reserve: float) -> List[float]:
        """Trains up to so many iterations, or until no more than `reserve` seconds are left; seconds of each."""
        steps: List[float] = []
        while training.num_steps < iterations and (not steps or budget.left > reserve):
            steps.append(self.timed(training.step)[0])
        return steps

    # --------------------------------------------------------------------------------------------------- evaluation

    @torch.no_grad()
    def evaluate(self, model: Model, views: Sequence[int]) -> Dict[str, float]:
        """Means over held-out views; notes what a view takes, and the kept coarse field's error.

        Of a coarse model: PSNR in dB and SSIM. Of a stylised one: style and content loss, by the preset's targets.
        """
        model.eval()
        seconds, found = self.timed(lambda: [self._figures(model, view) for view in views])
        self.view_seconds[type(model)] = seconds / len(views)
        means = {name: sum(figures[name] for figures in found) / len(found) for name in found[0]}
        if model is self.coarse_model:
            self.own_error = root_mean_square(means["psnr"])
        return means

    def _figures(self, model: Model, view: int) -> Dict[str, float]:
        outputs = model.get_outputs_for_camera(self.camera(view))
        if isinstance(model, CoarseFewShotModel):
            figures = image_metrics(outputs["rgb"], self.photos[view])
            return {name: figures[name] for name in ("psnr", "ssim")}
        accumulation = None if model.background is None else outputs["accumulation"].squeeze(-1)
        content = self.targets.features(outputs["rgb_coarse"])
        losses = self.targets.losses(self.targets.view(outputs["rgb"], content, accumulation))
        return {f"{name}_loss": float(value) for name, value in losses.items()}

    def seconds_to_evaluate(self, model: Model, views: Sequence[int]) -> float:
        """What `evaluate` will take, by what it took before."""
        return len(views) * self.view_seconds.get(type(model), 0.0)

    def keep_coarse(self, model: CoarseFewShotModel) -> None:
        """Makes a coarse model the one that all other curves build on."""
        self.coarse_model = model
        self.coarse_state = {name: value.detach().clone() for name, value in model.state_dict().items()}

    def keep_style(self, model: HierStyleModel) -> None:
        """Makes a stylised model the one that is rendered."""
        self.style_model, self.is_stylised = model, True

    def model_to_render(self) -> HierStyleModel:
        """The stylised model, or where there is no painting one that only shows the coarse field.

        Raises:
            OutOfTimeError: no coarse field could be trained in the time there was.
        """
        if self.style_model is None:
            config = self.adapted_style_config()
            cells, coarse = config.pipeline.model.occupancy_resolution**3, self.coarse_config.pipeline.model
            # Finding the empty cells can't be stopped on the way.
            view_seconds = self.view_seconds.get(CoarseFewShotModel, 0.0)
            self.budget.check(cells * view_seconds / (self.pixels * coarse.num_eval_samples))
            model = self._setup_pipeline(config).model
            model.adopt_coarse(self.coarse_state)
            self.style_model = model
        return self.style_model.eval()

    def picture(self, outputs: Dict[str, Tensor]) -> Float[Tensor, "*pixels 3"]:
        """What is looked at of the outputs of `model_to_render`."""
        return outputs["rgb" if self.is_stylised else "rgb_coarse"]

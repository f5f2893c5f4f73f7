"""What curves are measured on: a scene with its photos, and what has been trained on it so far."""

import copy
import math
from pathlib import Path
from typing import Callable, Dict, List, Optional, Sequence, Tuple, TypeVar, Union

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from sparsestyle_ns.data.view_selection import evenly_spaced
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.metrics.image import image_metrics
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, HierStylePipelineConfig
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.pipelines.scene_views import SceneViews
from sparsestyle_ns.runs.coarse_run import check_scene, read_coarse_run
from sparsestyle_ns.studies.curves import Curve, root_mean_square
from sparsestyle_ns.studies.study import Study, flag_of, get_setting, with_setting
from sparsestyle_ns.studies.study_options import Group
from sparsestyle_ns.studies.time_budget import Budget, OutOfTimeError
from sparsestyle_ns.utils.machine import LoadWatch, synchronize

Model = Union[CoarseFewShotModel, HierStyleModel]
T = TypeVar("T")

HELD_OUT_VIEWS = 3
"""Held-out views that are measured at most; evenly spaced among all."""


def squeezed(config: SparseStyleTrainerConfig, iterations: int) -> SparseStyleTrainerConfig:
    """A copy of a method's config for another number of iterations, with as large a share of them of warm start."""
    config = copy.deepcopy(config)
    pipeline, share = config.pipeline, iterations / config.max_num_iterations
    if isinstance(pipeline, HierStylePipelineConfig) and pipeline.warm_start_steps:
        pipeline.warm_start_steps = max(1, round(pipeline.warm_start_steps * share))
    config.max_num_iterations = iterations
    return config


def setting_curve(
    config: SparseStyleTrainerConfig, place: str, group: Group, name: str, title: str, plots: Sequence[Tuple[str, str]]
) -> Curve:
    """A curve of the setting at a place in a preset; its first plot shows time and error."""
    return Curve(group, name, title, flag_of(place), str(get_setting(config, place)), *plots[0], plots)


class Workbench:
    """The scene, and what has been trained on it so far.

    Without a painting, what needs one is left out; without a coarse run, the one that is trained here is rendered. Each
    measurement is repeated for at most so many rounds.

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
        self.study, self.budget, self.rounds, self.watch = study, budget, rounds, LoadWatch()
        self.trains_coarse = coarse_run is None
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.coarse_config = study.config("coarse-fewshot")
        self.style_config = study.config("hier-style", style_image=style_image)
        self.manager: FewShotDataManager = self.coarse_config.pipeline.datamanager.setup(
            device=str(self.device), test_mode="test", world_size=1, local_rank=0
        )
        self.effects = decide(self.manager.scene, self.coarse_config.pipeline.effects)
        self.manager.set_effects(self.effects)
        settings: HierStylePipelineConfig = self.style_config.pipeline
        settings.feature_side = settings.feature_side or self.manager.photo_side  # numbers, to measure others beside
        settings.settle_resolution(self.manager.photo_side)
        self.eval_dataset = self.manager.eval_dataset
        self.views = list(evenly_spaced(len(self.eval_dataset), min(HELD_OUT_VIEWS, len(self.eval_dataset))))
        self.photos = {view: self.eval_dataset[view]["image"][..., :3].to(self.device) for view in self.views}
        self.scene_views: Optional[SceneViews] = None
        self.style = None if style_image is None else settings.load_style()
        self.targets: Optional[StyleTargets] = None
        if self.style is not None:
            self.targets = settings.targets_of(*self.style, self.device, self.manager.photo_side)
        self.coarse_model: Optional[CoarseFewShotModel] = None
        self.coarse_state: Optional[Dict[str, Tensor]] = None
        self.own_error: Optional[float] = None
        self.style_model: Optional[HierStyleModel] = None
        self.is_stylised = False
        self.view_seconds: Dict[type, float] = {}
        if coarse_run is not None:
            self._adopt_coarse_run(coarse_run)

    def _adopt_coarse_run(self, folder: Path) -> None:
        run = read_coarse_run(folder)
        check_scene(run, self.manager.record(self.effects))
        config = with_setting(self.coarse_config, "pipeline.model", run.config.pipeline.model)
        model = self._setup_pipeline(config).model
        model.load_state_dict(run.model_state())
        self.keep_coarse(model)
        self.evaluate(model, self.views)

    @property
    def size(self) -> Tuple[int, int]:
        """(height, width) of a view."""
        return tuple(self.photos[self.views[0]].shape[:2])

    def some_rays(self, count: int) -> RayBundle:
        """Rays of random pixels of the held-out views, the same each time."""
        height, width = self.size
        order = torch.randperm(len(self.views) * height * width, generator=torch.Generator().manual_seed(0))[:count]
        views = torch.tensor(self.views)[order // (height * width)]
        coords = torch.stack([order // width % height, order % width], dim=-1) + 0.5
        cameras = self.eval_dataset.cameras.to(self.device)
        rays = cameras.generate_rays(views[:, None].to(self.device), coords.to(self.device))
        rays.camera_indices = torch.zeros_like(rays.camera_indices)
        return rays

    def _setup_pipeline(self, config: SparseStyleTrainerConfig) -> CheckedPipeline:
        config.pipeline.decided = self.effects
        return config.pipeline.setup(device=str(self.device), test_mode="test", world_size=1, local_rank=0)

    def start(self, config: SparseStyleTrainerConfig, budget: Budget, seed: int = 0) -> Training:
        """Training with a method's config, its schedules as they are there; out of time before views are frozen."""
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
            pipeline.style = self.style
            if self.scene_views is None:
                self.scene_views = pipeline.freeze_views()
            pipeline.scene_views = self.scene_views

        return Training(config, self.device, self.coarse_state, share)

    def adapted_style_config(self) -> SparseStyleTrainerConfig:
        """Stage 2's preset with the shape of the coarse field that there is."""
        field = copy.deepcopy(self.coarse_to_render().config.coarse_field)
        return with_setting(self.style_config, "pipeline.model.coarse_field", field)

    def timed(self, work: Callable[[], T]) -> Tuple[float, T]:
        """Seconds of a piece of work, and what it gave."""
        synchronize(self.device)
        start = self.budget.clock()
        found = work()
        synchronize(self.device)
        return self.budget.clock() - start, found

    def train(self, training: Training, iterations: int, budget: Budget, views: Sequence[int] = ()) -> List[float]:
        """Trains up to so many iterations, or until there is no more time than for `evaluate`; seconds of each."""
        steps: List[float] = []
        reserve = len(views) * self.view_seconds.get(type(training.pipeline.model), 0.0)
        while training.num_steps < iterations and (not steps or budget.left > reserve):
            steps.append(self.timed(training.step)[0])
        return steps

    @torch.no_grad()
    def evaluate(self, model: Model, views: Sequence[int]) -> Dict[str, float]:
        """Means of PSNR (dB) and SSIM, or of a stylised model's losses by the preset's targets, over held-out views.

        Notes what a view takes, and the kept coarse field's error.
        """
        model.eval()
        seconds, found = self.timed(lambda: [self._figures(model, view) for view in views])
        self.view_seconds[type(model)] = seconds / len(views)
        means = {name: sum(figures[name] for figures in found) / len(found) for name in found[0]}
        if model is self.coarse_model:
            self.own_error = root_mean_square(means["psnr"])
        return means

    def _figures(self, model: Model, view: int) -> Dict[str, float]:
        self.manager.refine_cameras(model.refinement)
        outputs = model.get_outputs_for_camera(self.eval_dataset.cameras[view : view + 1].to(self.device))
        if isinstance(model, CoarseFewShotModel):
            figures = image_metrics(outputs["rgb"], self.photos[view])
            return {name: figures[name] for name in ("psnr", "ssim")}
        accumulation = None if model.background is None else outputs["accumulation"].squeeze(-1)
        content = self.targets.content(outputs["rgb_coarse"])
        losses = self.targets.losses(self.targets.view(outputs["rgb"], content, accumulation))
        return {f"{name}_loss": float(losses[name]) for name in ("style", "content")}

    def keep_coarse(self, model: CoarseFewShotModel) -> None:
        """Makes a coarse model the one that all other curves build on."""
        self.coarse_model = model
        self.coarse_state = {name: value.detach().clone() for name, value in model.state_dict().items()}

    def coarse_to_render(self) -> CoarseFewShotModel:
        """The coarse model that was kept, or an `OutOfTimeError` where there was no time to train one."""
        if self.coarse_model is None:
            raise OutOfTimeError
        self.coarse_model.finish_learning()
        return self.coarse_model.eval()

    def model_to_render(self) -> HierStyleModel:
        """The stylised model, or where there is no painting one that only shows the coarse field."""
        if self.style_model is None:
            config = self.adapted_style_config()
            cells, coarse = config.pipeline.model.occupancy_resolution**3, self.coarse_config.pipeline.model
            # Measuring its densities can't be stopped on the way.
            view_seconds = self.view_seconds.get(CoarseFewShotModel, 0.0)
            samples = coarse.num_samples if self.trains_coarse else coarse.num_eval_samples
            self.budget.check(cells * view_seconds / (math.prod(self.size) * samples))
            model = self._setup_pipeline(config).model
            model.adopt_coarse(self.coarse_state)
            self.style_model = model
        return self.style_model.eval()

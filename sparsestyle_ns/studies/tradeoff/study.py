"""What is measured: a scene, its photos, and runs of both stages on it."""

import contextlib
import copy
import gc
import math
import threading
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence, Tuple, Type

import psutil
import rich
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig, MultiStepSchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sparsestyle_ns.data.view_selection import evenly_spaced
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.metrics.image import image_metrics
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, HierStylePipelineConfig
from sparsestyle_ns.rendering.frozen_view import FrozenView
from sparsestyle_ns.runs.coarse_run import check_scene, read_coarse_run
from sparsestyle_ns.runs.scene_record import record_scene
from sparsestyle_ns.studies.tradeoff.axis import with_setting
from sparsestyle_ns.studies.tradeoff.budget import Budget, OutOfTimeError
from sparsestyle_ns.studies.tradeoff.pareto import root_mean_square
from sparsestyle_ns.utils.machine import LoadWatch, synchronize

HELD_OUT_VIEWS = 3
"""Held-out views that are measured at most; evenly spaced among all."""
EVALUATION_SHARE = 0.3
"""Part of a run's time that evaluating it may take; how many views are looked at follows from it."""
LOADING_SHARE = 0.05
"""Part of all time that evaluating a coarse run may take before anything is measured; else one view stands for all."""
PROBE_RAYS = 256
"""Rays from which the time of a view is estimated."""
PROBE_STEPS = 3
"""Iterations from which the time of one is estimated, after one that doesn't count."""


@dataclass
class Options:
    """What the command line says.

    Attributes:
        dataparser: the scene, as a dataparser's config.
        data: the scene's folder or file.
        output_dir: folder of the report.
        style_image: the painting; None leaves out what needs one.
        coarse_run: a coarse run to render; None: the one that the training axis trains.
        full: whether the full methods' settings are the presets, instead of the drafts'.
        max_image_side: longer side of the photos in pixels; None: the preset's.
        num_views, view_ids: the photos to train on, as for ns-train.
        vgg_weights, backbone: the feature network, as for ns-train.
        rounds: repetitions of each measurement at most.
        groups: the groups of axes to measure.
        overrides: settings of the presets to replace, by method and place; for tests and odd machines.
    """

    dataparser: Any
    data: Path
    output_dir: Path
    style_image: Optional[Path] = None
    coarse_run: Optional[Path] = None
    full: bool = False
    max_image_side: Optional[int] = None
    num_views: Optional[int] = None
    view_ids: Optional[Tuple[int, ...]] = None
    vgg_weights: Optional[Path] = None
    backbone: str = "auto"
    rounds: int = 3
    groups: Tuple[str, ...] = ()
    overrides: Dict[str, Dict[str, Any]] = field(default_factory=dict)


@dataclass
class SharedManager:
    """Stands for a data manager's config and gives one that is there already, so that photos are loaded once."""

    manager: Any

    def setup(self, **kwargs: Any) -> Any:
        """The data manager."""
        return self.manager


def settings_of_targets(config: HierStylePipelineConfig) -> Tuple[Any, ...]:
    """What the painting's features depend on, beside the painting and the network."""
    return config.feature_side, config.style_side, config.style_features


@dataclass
class Shared:
    """What runs of stage 2 on the same coarse field, photos and painting have in common.

    Attributes:
        frozen: the photos' views, by the address of their rays.
        targets: the painting's features, by the settings that they depend on.
        check: called before a view is frozen; raises `OutOfTimeError` where there is no time for it.
    """

    frozen: Dict[int, FrozenView] = field(default_factory=dict)
    targets: Dict[Tuple[Any, ...], StyleTargets] = field(default_factory=dict)
    check: Callable[[], None] = lambda: None

    def pipeline(self) -> Type[HierStylePipeline]:
        """A stage-2 pipeline that works out only what no run before it has."""
        shared = self

        class SharingPipeline(HierStylePipeline):
            """See `Shared.pipeline`."""

            def prepare_style(self) -> None:
                """Takes the painting's features from a run before, or makes them."""
                key = settings_of_targets(self.config)
                if key not in shared.targets:
                    super().prepare_style()
                    shared.targets[key] = self.targets
                self.targets = shared.targets[key]

            def _freeze(self, origins: Tensor, directions: Tensor, keep_bytes: float) -> FrozenView:
                photos = self.datamanager.pixels.origins
                if origins.untyped_storage().data_ptr() != photos.untyped_storage().data_ptr():
                    return super()._freeze(origins, directions, keep_bytes)  # a novel view's rays don't last
                key = origins.data_ptr()
                if key not in shared.frozen:
                    shared.check()
                    shared.frozen[key] = super()._freeze(origins, directions, keep_bytes)
                return shared.frozen[key]

        return SharingPipeline


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps nerfstudio's and the methods' lines and warnings from the terminal, where the progress bar is."""
    consoles = (CONSOLE, rich.get_console())
    before = [console.quiet for console in consoles]
    for console in consoles:
        console.quiet = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for console, was in zip(consoles, before, strict=True):
            console.quiet = was


def squeezed(config: TrainerConfig, iterations: int) -> TrainerConfig:
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
    if hasattr(pipeline, "content_steps"):
        pipeline.content_steps = scaled(pipeline.content_steps)
        pipeline.warm_start_steps = scaled(pipeline.warm_start_steps) if pipeline.warm_start_steps else 0
    return config


class PeakMemory:
    """The most memory that is taken inside of the `with`, in bytes: resident on a CPU, torch's own on a GPU."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.bytes = 0

    def __enter__(self) -> "PeakMemory":
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self.device.type == "cuda":
            self.bytes = torch.cuda.max_memory_allocated(self.device)
            return
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        process = psutil.Process()
        while True:
            self.bytes = max(self.bytes, process.memory_info().rss)
            if self._ended.wait(0.01):
                return


@dataclass
class Checkpoint:
    """Where a run is when it is evaluated.

    Attributes:
        iterations: done so far.
        seconds: that they took, without evaluation.
        busy: whether other processes kept the machine busy since the checkpoint before.
    """

    iterations: int
    seconds: float
    busy: bool


class Study:
    """The scene, and what has been trained on it so far.

    Args:
        options: of the command line.
        budget: all the time there is.

    Raises:
        InputError: scene, painting, feature network or coarse run can't be used.
    """

    def __init__(self, options: Options, budget: Budget) -> None:
        self.options = options
        self.budget = budget
        self.clock = budget.clock
        self.watch = LoadWatch()
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        suffix = "" if options.full else "-draft"
        self.coarse_config = self._preset(f"coarse-fewshot{suffix}")
        self.style_config = self._preset(f"hier-style{suffix}")
        pipeline = self.style_config.pipeline
        pipeline.style_image, pipeline.vgg_weights = options.style_image, options.vgg_weights
        pipeline.backbone = options.backbone
        self.manager: FewShotDataManager = self.coarse_config.pipeline.datamanager.setup(
            device=str(self.device), test_mode="test", world_size=1, local_rank=0
        )
        self.effects = decide(self.manager.scene, self.coarse_config.pipeline.effects)
        self.manager.set_effects(self.effects)
        self.eval_dataset = self.manager.eval_dataset
        count = min(HELD_OUT_VIEWS, len(self.eval_dataset))
        self.views = list(evenly_spaced(len(self.eval_dataset), count))
        self.photos = {view: self.eval_dataset[view]["image"][..., :3].to(self.device) for view in self.views}
        self.shared = Shared()
        self.targets: Optional[StyleTargets] = None
        if options.style_image is not None:
            self.targets = pipeline.load_targets(self.device)
            self.shared.targets[settings_of_targets(pipeline)] = self.targets
        self.coarse_state: Optional[Dict[str, Tensor]] = None
        self.coarse_model: Optional[CoarseFewShotModel] = None
        self.own_error: Optional[float] = None
        self.style_model: Optional[HierStyleModel] = None
        self.is_stylised = False
        self.coarse_view_seconds = self.style_view_seconds = 0.0
        if options.coarse_run is not None:
            self._adopt_coarse_run(options.coarse_run)

    def _preset(self, method: str) -> TrainerConfig:
        options = self.options
        config = copy.deepcopy(method_config(method))
        manager = config.pipeline.datamanager
        manager.data, manager.dataparser = options.data, copy.deepcopy(options.dataparser)
        manager.num_views, manager.view_ids = options.num_views, options.view_ids
        if options.max_image_side is not None:
            manager.max_image_side = options.max_image_side
        for path, value in options.overrides.get(method.removesuffix("-draft"), {}).items():
            config = with_setting(config, path, value)
        return config

    def _adopt_coarse_run(self, folder: Path) -> None:
        run = read_coarse_run(folder)
        check_scene(run, record_scene(self.options.data, self.manager.train_dataparser_outputs, self.effects))
        model = self._setup_pipeline(self._with_model(run.config.pipeline.model)).model
        model.load_state_dict(run.model_state())
        self.keep_coarse(model)
        self.evaluate_coarse(model, self.views[:1])
        if self.coarse_view_seconds * len(self.views) < LOADING_SHARE * self.budget.left:
            self.evaluate_coarse(model)

    def _with_model(self, model_config: Any) -> TrainerConfig:
        config = copy.deepcopy(self.coarse_config)
        config.pipeline.model = copy.deepcopy(model_config)
        return config

    # ------------------------------------------------------------------------------------------------------- scene

    @property
    def size(self) -> Tuple[int, int]:
        """(height, width) of a view."""
        return tuple(self.photos[self.views[0]].shape[:2])

    @property
    def pixels(self) -> int:
        """Pixels of a view."""
        return math.prod(self.size)

    def camera(self, view: int) -> Any:
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

    def collect_garbage(self) -> None:
        """Gives memory of runs before back; what was there before them needn't be searched, which takes most time."""
        gc.collect()
        gc.freeze()

    def _shared(self, config: TrainerConfig) -> SharedManager:
        manager = copy.copy(self.manager)
        manager.config = copy.copy(self.manager.config)
        wanted = config.pipeline.datamanager
        manager.config.train_num_rays_per_batch, manager.config.seed = wanted.train_num_rays_per_batch, wanted.seed
        return SharedManager(manager=manager)

    def _setup_pipeline(self, config: TrainerConfig) -> Any:
        config = copy.deepcopy(config)
        config.pipeline.datamanager, config.pipeline.decided = self._shared(config), self.effects
        return config.pipeline.setup(device=str(self.device), test_mode="test", world_size=1, local_rank=0)

    def start(self, config: TrainerConfig, budget: Budget, seed: int = 0) -> Training:
        """Training with a method's config, its schedules as they are there, on the shared photos.

        Raises:
            OutOfTimeError: the time was over before all views of stage 2 were frozen; those that were stay so.
        """
        torch.manual_seed(seed)
        self.shared.check = budget.check
        config = copy.deepcopy(config)
        if hasattr(config.pipeline.model, "seed"):
            config.pipeline.model.seed += seed
        config.pipeline.datamanager.seed += seed
        config.pipeline.datamanager, config.pipeline.decided = self._shared(config), self.effects
        state = None
        if isinstance(config.pipeline, HierStylePipelineConfig):
            state, config.pipeline._target = self.coarse_state, self.shared.pipeline()
        return Training(config, self.device, state)

    def adapted_style_config(self) -> TrainerConfig:
        """Stage 2's preset with the shape of the coarse field that there is."""
        assert self.coarse_model is not None
        config = copy.deepcopy(self.style_config)
        config.pipeline.model.coarse_field = copy.deepcopy(self.coarse_model.config.coarse_field)
        return config

    def step_seconds(self, training: Training, budget: Budget) -> float:
        """What an iteration takes, from a few."""
        seconds = []
        for _ in range(1 + PROBE_STEPS):
            seconds.append(self._timed(training.step))
            budget.check()
        return sum(seconds[1:]) / PROBE_STEPS

    def _timed(self, work: Callable[[], Any]) -> float:
        synchronize(self.device)
        start = self.clock()
        work()
        synchronize(self.device)
        return self.clock() - start

    def timed(self, work: Callable[[], Any]) -> Tuple[float, Any]:
        """Seconds of a piece of work, and what it gave."""
        found: List[Any] = []
        return self._timed(lambda: found.append(work())), found[0]

    def train(
        self,
        training: Training,
        stops: Sequence[int],
        budget: Budget,
        reserve: float,
        steps: Optional[List[float]] = None,
    ) -> Iterator[Checkpoint]:
        """Trains, and stops after some iterations to be looked at; the clock stands still meanwhile.

        Ends, after a last stop, when no more than `reserve` seconds are left.

        Args:
            stops: ascending numbers of iterations.
            reserve: seconds that looking takes.
            steps: takes the seconds of each iteration.
        """
        total = 0.0
        for stop in stops:
            is_over = False
            with self.watch:
                while training.num_steps < stop and not is_over:
                    seconds = self._timed(training.step)
                    total += seconds
                    if steps is not None:
                        steps.append(seconds)
                    is_over = budget.left <= reserve
            yield Checkpoint(training.num_steps, total, self.watch.busy)
            if is_over:
                raise OutOfTimeError

    # --------------------------------------------------------------------------------------------------- evaluation

    @torch.no_grad()
    def estimate_coarse_view(self, model: CoarseFewShotModel) -> None:
        """Estimates what a held-out view takes, from some of its rays."""
        model.eval()
        self.coarse_view_seconds = self._seconds_of_pixels(model.get_outputs)

    @torch.no_grad()
    def estimate_style_view(self, model: HierStyleModel) -> None:
        """The same for a stylised view and its losses."""
        assert self.targets is not None
        model.eval()
        photo = self.photos[self.views[0]]
        seconds, features = self.timed(lambda: self.targets.features(photo))
        losses, _ = self.timed(lambda: self.targets.losses(photo, features))
        self.style_view_seconds = self._seconds_of_pixels(model.get_outputs) + seconds + losses

    def _seconds_of_pixels(self, render: Callable[[RayBundle], Any]) -> float:
        rays = self.some_rays(PROBE_RAYS)
        render(rays)
        return self.timed(lambda: render(rays))[0] * self.pixels / len(rays)

    def stops_that_fit(self, budget: Budget, stops: Sequence[float], view_seconds: float) -> Sequence[float]:
        """The last of a run's stops, as many as there is time for to look at a view; at least one."""
        count = int(EVALUATION_SHARE * budget.left / max(view_seconds, 1e-9))
        return stops[-max(1, count) :]

    def views_that_fit(self, budget: Budget, stops: int, view_seconds: float) -> List[int]:
        """The held-out views to look at so many times in a run: as many as there is time for, at least one."""
        count = int(EVALUATION_SHARE * budget.left / max(stops * view_seconds, 1e-9))
        return self.views[: max(1, count)]

    @torch.no_grad()
    def evaluate_coarse(self, model: CoarseFewShotModel, views: Optional[Sequence[int]] = None) -> Dict[str, float]:
        """Mean PSNR in dB and SSIM of held-out views; notes what a view takes and the kept field's error."""
        model.eval()
        start, views = self.clock(), self.views if views is None else views
        found = [
            image_metrics(model.get_outputs_for_camera(self.camera(view))["rgb"], self.photos[view]) for view in views
        ]
        synchronize(self.device)
        self.coarse_view_seconds = (self.clock() - start) / len(views)
        means = {name: sum(one[name] for one in found) / len(found) for name in ("psnr", "ssim")}
        if model is self.coarse_model:
            self.own_error = root_mean_square(means["psnr"])
        return means

    @torch.no_grad()
    def evaluate_style(self, model: HierStyleModel, views: Optional[Sequence[int]] = None) -> Dict[str, float]:
        """Mean style and content loss of held-out views, by the preset's targets; notes what a view takes."""
        assert self.targets is not None
        model.eval()
        start, views, sums = self.clock(), self.views if views is None else views, torch.zeros(2)
        for view in views:
            outputs = model.get_outputs_for_camera(self.camera(view))
            accumulation = None if model.background is None else outputs["accumulation"].squeeze(-1)
            content = self.targets.features(outputs["rgb_coarse"])
            losses = self.targets.losses(outputs["rgb"], content, accumulation)
            sums += torch.stack(losses).cpu() / len(views)
        synchronize(self.device)
        self.style_view_seconds = (self.clock() - start) / len(views)
        return {"style_loss": float(sums[0]), "content_loss": float(sums[1])}

    def keep_coarse(self, model: CoarseFewShotModel) -> None:
        """Makes a coarse model the one that all other axes build on."""
        self.coarse_model = model
        self.coarse_state = {name: value.detach().clone() for name, value in model.state_dict().items()}

    def keep_style(self, model: HierStyleModel) -> None:
        """Makes a stylised model the one that is rendered."""
        self.style_model, self.is_stylised = model.eval(), True

    def model_to_render(self) -> HierStyleModel:
        """The stylised model, or where there is no painting one that only shows the coarse field.

        Raises:
            OutOfTimeError: no coarse field could be trained in the time there was.
        """
        if self.style_model is None:
            if self.coarse_state is None:
                raise OutOfTimeError
            config = self.adapted_style_config()
            cells, coarse = config.pipeline.model.occupancy_resolution**3, self.coarse_config.pipeline.model
            # Finding the empty cells can't be stopped on the way.
            self.budget.check(cells * self.coarse_view_seconds / (self.pixels * coarse.num_eval_samples))
            model = self._setup_pipeline(config).model
            model.adopt_coarse(self.coarse_state)
            self.style_model = model.eval()
        return self.style_model

    @property
    def picture(self) -> str:
        """The output of `model_to_render` to look at."""
        return "rgb" if self.is_stylised else "rgb_coarse"

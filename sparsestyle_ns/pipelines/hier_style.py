"""The pipeline of `hier-style`: every iteration renders one whole view and compares it with painting and photo."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Callable, Dict, List, Literal, NamedTuple, Optional, Tuple, Type, Union

import torch
import tyro
from jaxtyping import Float
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.base_model import ModelConfig
from torch import Tensor

from sparsestyle_ns.core.schedules import Level, coarse_to_fine, content_weight
from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.field_components.thinned_mlp import Thinning
from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.losses.coarse import reconstruction_loss
from sparsestyle_ns.losses.stylization import LOSSES, Losses, StyleTargets, default_weights
from sparsestyle_ns.models.hier_style import HierStyleModel, HierStyleModelConfig
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline, CheckedPipelineConfig
from sparsestyle_ns.pipelines.scene_views import ContentView, SceneViews
from sparsestyle_ns.style.backbone import Backbone
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.style.palette import PaletteTransfer
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import say

STROKE_SIZES = (0.5, 2.0)
"""The smallest and the largest."""
CELL_STEP = 16
"""Where the hash grid follows the views, its finest level has a multiple of so many cells along a side."""


@dataclass
class HierStylePipelineConfig(CheckedPipelineConfig):
    """Settings of stage 2."""

    _target: Type = field(default_factory=lambda: HierStylePipeline)
    model: ModelConfig = field(default_factory=HierStyleModelConfig)
    """The stylised field."""
    style_image: Annotated[Optional[Path], tyro.conf.arg(aliases=("--style-image",))] = None
    """The painting: a JPEG, PNG or WebP file."""
    coarse_run: Annotated[Optional[Path], tyro.conf.arg(aliases=("--coarse-run",))] = None
    """Folder or config.yml of the coarse-fewshot run to stylise. None: the newest finished one that matches the data
    and its settings, and where there is none it is trained first."""
    view_side: Union[int, Literal["photos"]] = 504
    """Longer side, in pixels, of the views that are stylised, where photos are larger; as many times more as strokes
    are finer than 1, and fewer as they are wider. photos: as large as these. Pictures are of any size all the same."""
    view_scales: Tuple[float, ...] = (0.25, 0.5, 1.0)
    """Sizes at which the views are stylised, one after another, as shares of `view_side`; the last is the one that
    counts, and iterations before it are quick."""
    scale_shares: Tuple[float, ...] = (0.6, 0.3, 0.1)
    """Shares of the iterations at these sizes."""
    stroke_size: Annotated[float, tyro.conf.arg(aliases=("--stroke-size",))] = 1.0
    """How wide strokes are, from 0.5 to 2: the feature network sees views and painting in this many times smaller
    pictures, where its patches are as many times wider, and the field learns nothing that is finer. 0.5 takes about
    four times the time and memory."""
    feature_side: Optional[int] = None
    """Longer side, in pixels, at which the network sees the largest views where strokes are of size 1. None: that of
    the views."""
    style_features: Optional[int] = None
    """Match with at most so many of the painting's feature vectors, drawn at random; None: all of them."""
    loss_weights: Dict[str, float] = field(default_factory=default_weights)
    """Weight of each loss, 0 or more; 0 is off. That of the content loss is λ0, which falls (Eq. 6)."""
    object_style: float = 4.0
    """How many times the style loss's weight counts for an object on a background, which keeps its shape by itself."""
    kept_structure: Annotated[float, tyro.conf.arg(aliases=("--kept-structure",))] = 0.65
    """The SSIM of brightness to its content picture that a view keeps at least, from 0 to 1, however strong the
    painting's patterns are; more keeps more of the scene, and less of the painting."""
    palette_transfer: PaletteTransfer = "transport"
    """How photos and, in the end, the stylised field get the painting's colours (`--pipeline.effects.palette`):
    transport gives them all of these, each as often as the painting has it; moments gives them its mean colour and
    covariance, as ARF does."""
    content_decay: float = 0.01
    """α, the share of the content loss's weight that is left in the end."""
    content_share: float = 0.6
    """T, the iterations in which it falls, as a share of those at a size of the views."""
    content_restart: float = 0.3
    """The share of the content loss's weight with which each size but the first begins."""
    warm_start_steps: int = 30
    """Steps, before the first iteration, in which c_f is fitted to whole photos; 0 is the paper's start from grey."""
    novel_views: int = 0
    """Views between the photos to stylise as well, with the coarse render as their content."""
    samples_per_chunk: int = 1 << 21
    """Samples rendered at once: memory is bounded by about half a KB for each. A view of fewer is rendered in one go;
    the chunks of a larger one are rendered a second time in the backward pass."""
    thinning: float = 1.0
    """Spares the residual field's backward pass samples with small gradients, as in stage 1; 0 keeps all samples."""
    seed: int = 42
    """Seed of what is spared; an iteration's choice depends on it and the iteration alone."""
    cache_gigabytes: Optional[float] = None
    """Memory for what never changes of the views; None: a quarter of what is free."""

    def load_style(self) -> Tuple[Painting, Backbone]:
        """The painting and the feature network, on the CPU; InputError where these or a setting can't be used."""
        if self.style_features is not None and self.style_features < 1:
            raise InputError(f"--pipeline.style-features is {self.style_features}; at least one vector is needed.")
        smallest, largest = STROKE_SIZES
        if not smallest <= self.stroke_size <= largest:
            raise InputError(f"--stroke-size is {self.stroke_size:g}; give a number from {smallest:g} to {largest:g}.")
        for name, weight in self.loss_weights.items():
            if name not in LOSSES:
                known = ", ".join(LOSSES)
                raise InputError(f"--pipeline.loss-weights names {name}, which is no loss; the losses are {known}.")
            if not 0.0 <= weight < math.inf:
                raise InputError(f"--pipeline.loss-weights.{name} is {weight}; give a finite number, 0 or more.")
        if isinstance(self.view_side, int) and self.view_side < 1:
            raise InputError(f"--pipeline.view-side is {self.view_side}; give a number of pixels, or photos.")
        if not 0.0 <= self.kept_structure <= 1.0:
            raise InputError(f"--kept-structure is {self.kept_structure:g}; give a number from 0 to 1.")
        if not 0.0 < self.object_style < math.inf:
            raise InputError(f"--pipeline.object-style is {self.object_style}; give a number above 0.")
        if not any(self.loss_weights.values()):
            raise InputError("--pipeline.loss-weights turns every loss off; give one of them a weight above 0.")
        if self.style_image is None:
            raise InputError("There is no style image: name a painting with --style-image FILE.")
        return Painting.read(self.style_image), self.load_backbone(torch.device("cpu"))

    def levels(self, iterations: int) -> Tuple[Level, ...]:
        """Which iterations are at which size of the views; InputError where the settings give none."""
        if not 0.0 < self.content_restart < math.inf:
            raise InputError(f"--pipeline.content-restart is {self.content_restart}; give a number above 0.")
        return coarse_to_fine(self.view_scales, self.scale_shares, iterations)

    def share_of_photos(self, scale: float, photo_side: int) -> float:
        """What views at one of the `view_scales` have of the longer side of their photos, at most 1."""
        reduced = min(1.0, self._largest_side(photo_side) / min(1.0, self.stroke_size) / photo_side)
        return scale * reduced / max(1.0, self.stroke_size)

    def settle_resolution(self, photo_side: int) -> None:
        """Replaces the model's `max_resolution` by what it stands for beside photos of a size, where it is None."""
        if self.model.max_resolution is None:
            side = photo_side * self.share_of_photos(1.0, photo_side)
            self.model.max_resolution = self._cells(side)

    def resolution_for(self, stroke_size: float, photo_side: int) -> int:
        """The `max_resolution` of a style with strokes of another size on this run's views, where that is settled.

        It is the run's own, but where strokes are wider at most that of views which are as many times smaller.
        """
        assert self.model.max_resolution is not None
        if stroke_size <= self.stroke_size:
            return self.model.max_resolution
        side = min(photo_side, self._largest_side(photo_side)) / stroke_size
        return min(self.model.max_resolution, self._cells(side))

    def _cells(self, side: float) -> int:
        return max(self.model.min_resolution, CELL_STEP * math.ceil(side / CELL_STEP))

    def side_at(self, scale: float, photo_side: int) -> int:
        """Longer side, in pixels, at which the network sees views at one of the `view_scales`, and the painting."""
        largest = self.feature_side or min(photo_side, self._largest_side(photo_side))
        return max(1, round(scale * largest / self.stroke_size))

    def _largest_side(self, photo_side: int) -> int:
        return photo_side if self.view_side == "photos" else self.view_side

    def targets_of(
        self, painting: Painting, backbone: Backbone, device: torch.device, photo_side: int, scale: float = 1.0
    ) -> StyleTargets:
        """A painting as the feature network sees it, for views at one of the `view_scales`, with these settings.

        The network moves to the device.
        """
        side = self.side_at(scale, photo_side)
        losses = [name for name, weight in self.loss_weights.items() if weight > 0]
        counted = self.style_features, losses, self.kept_structure
        return StyleTargets(backbone.to(device), painting.pixels.to(device), side, *counted)

    def weights_at(self, step: int, level: Level) -> Dict[str, float]:
        """The weight of each loss that is on, in an iteration; that of the content loss is λ(t) (Eq. 6).

        λ falls again at each size of the views, each time to λ0 α.
        """
        weights = {name: weight for name, weight in self.loss_weights.items() if weight > 0}
        if "content" in weights:
            start = 1.0 if level.first == 0 else max(self.content_restart, self.content_decay)
            fall = start * weights["content"], self.content_decay / start, self.content_share * level.length
            weights["content"] = content_weight(step - level.first, *fall)
        return weights


class StyleLevel(NamedTuple):
    """A painting and the views at one of their sizes."""

    schedule: Level
    targets: StyleTargets
    views: List[ContentView]


class StyleTask(NamedTuple):
    """A field that is on its way to a painting, and the views that it is stylised on, one an iteration."""

    style: StylisedField
    levels: List[StyleLevel]
    transfer: Optional[PaletteTransfer] = None
    """How the painting's palette is transferred, where it is."""

    def level(self, step: int) -> StyleLevel:
        """What counts in an iteration."""
        return next(level for level in reversed(self.levels) if step >= level.schedule.first)


class HierStylePipeline(CheckedPipeline):
    """Stage 2. What only training needs, the painting and the feature network, is loaded when training is set up."""

    config: HierStylePipelineConfig
    model: HierStyleModel
    style: Optional[Tuple[Painting, Backbone]] = None
    """Painting and network; given before training is set up by whoever has read them already."""
    targets: Optional[StyleTargets] = None
    """The painting, once training is set up, for the largest views."""
    scene_views: Optional[SceneViews] = None
    task: Optional[StyleTask] = None
    """What this run trains, once it is set up."""
    on_losses: Optional[Callable[[int, Losses], None]] = None
    """Told of each iteration and its losses, by a viewer that shows them."""

    def settle(self) -> None:
        """Fixes how fine the hash grid is, by the photos' size."""
        self.config.settle_resolution(self.datamanager.photo_side)

    def new_task(
        self,
        style: StylisedField,
        painting: Painting,
        backbone: Backbone,
        effects: Decisions,
        iterations: int,
        settings: Optional[HierStylePipelineConfig] = None,
    ) -> StyleTask:
        """A field and a painting for the scene's views, which are shared as far as they depend on no painting.

        `settings` say how the painting is looked at and what is kept of the views; left out, the pipeline's do.
        """
        schedule = self.config.levels(iterations)
        if self.scene_views is None:
            self.scene_views = self.freeze_views()
        targets = [self.targets_of(painting, backbone, level.scale, settings) for level in schedule]
        scales = [self._share_of_photos(level.scale) for level in schedule]
        by_scale = dict(zip(scales, targets, strict=True))
        transfer = (settings or self.config).palette_transfer if effects.on("palette") else None
        views = self.scene_views.for_painting(by_scale, transfer)
        return StyleTask(style, list(map(StyleLevel, schedule, targets, views)), transfer)

    def finish(self, task: StyleTask) -> None:
        """After a task's last iteration: where the palette is transferred, the field's colours are mapped to it.

        Losses of features and of whole distributions leave a field with tints that the painting doesn't have.
        """
        task.style.recoloring.reset()
        if task.transfer is not None:
            _, targets, views = task.levels[-1]
            palette = self.scene_views.last_palette(views, task.style, targets.style_picture, task.transfer)
            task.style.recoloring.adopt(palette)

    def targets_of(
        self,
        painting: Painting,
        backbone: Backbone,
        scale: float = 1.0,
        settings: Optional[HierStylePipelineConfig] = None,
    ) -> StyleTargets:
        """A painting as the feature network sees it, for views at one of the `view_scales`."""
        config = settings or self.config
        return config.targets_of(painting, backbone, self.device, self.datamanager.photo_side, scale)

    def freeze_views(self) -> SceneViews:
        """The scene's views, with all that depends on no style."""
        config = self.config
        sizes = config.novel_views, config.samples_per_chunk, config.cache_gigabytes
        scales = [self._share_of_photos(scale) for scale in config.view_scales]
        return SceneViews(self.model, self.datamanager, scales, *sizes)

    def _share_of_photos(self, scale: float) -> float:
        return self.config.share_of_photos(scale, self.datamanager.photo_side)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> List[TrainingCallback]:
        """Prepares the style and the views, as far as they aren't there already."""
        painting, backbone = self.style or self.config.load_style()
        self.announce(backbone)
        iterations = training_callback_attributes.trainer.config.max_num_iterations
        self.task = self.new_task(self.model.residual, painting, backbone, self.effects, iterations)
        self.targets = self.task.levels[-1].targets
        say(self.scene_views.report())
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        last = TrainingCallback(after, lambda step: self.finish(self.task), iters=(iterations - 1,))
        return [*super().get_training_callbacks(training_callback_attributes), last]

    def style_targets(self, style_image: Optional[Path] = None) -> Optional[StyleTargets]:
        """The painting to measure against, the run's own or another, where it is still there."""
        if self.targets is not None and style_image is None:
            return self.targets
        path, expected = style_image or self.config.style_image, self.datamanager.config.expected
        if path is None or not path.is_file():
            say(f"The painting {path} isn't there any more, so nothing is measured against it.")
            return None
        try:
            painting, backbone = replace(self.config, style_image=path).load_style()
        except InputError as error:
            if style_image is not None:  # which was asked for
                raise
            say(f"{error.fault}, so nothing is measured against {path}.")
            return None
        made_for = None if style_image is not None or expected is None else expected.record.painting
        if made_for not in (None, painting.digest):
            say(f"The painting {path} is another picture by now, so nothing is measured against it.")
            return None
        return self.targets_of(painting, backbone)

    def warm_start_loss(self, task: StyleTask, step: int) -> Dict[str, Float[Tensor, ""]]:
        """How far c_f, on the coarse geometry, is from the content picture of one photo; not in the paper.

        The features of VGG's third block hardly see colour; stylising from grey loses the palette.
        """
        view = task.levels[0].views[step % self.scene_views.num_photos]
        # A coarse field that is fine-tuned itself is fitted as a whole: it can't change colours with its geometry held.
        coarse_geometry = self.model.config.stylised_field == "residual"
        picture = self.scene_views.render(view, task.style, coarse_geometry)
        return {"reconstruction_loss": reconstruction_loss(picture, view.picture)}

    def losses(self, task: StyleTask, step: int) -> Tuple[Float[Tensor, "H W 3"], Losses]:
        """One whole view of a task, and its losses with their weights in this iteration (Eq. 5 and 6)."""
        schedule, targets, views = task.level(step)
        view = views[step % len(views)]
        task.style.recoloring.reset()  # of a finished field that learns on
        if isinstance(task.style, ResidualField):
            generator = torch.Generator(device=self.device).manual_seed(self.config.seed * 1_000_003 + step)
            task.style.thinning = Thinning(self.config.thinning, generator)
        image = self.scene_views.render(view, task.style)
        values = targets.losses(targets.view(image, view.content, view.accumulation, step))
        weights = self.config.weights_at(step, schedule)
        if self.model.background is not None and "style" in weights:
            weights["style"] *= self.config.object_style
        return image, Losses(values, weights)

    def get_train_loss_dict(self, step: int) -> Tuple[Dict[str, Tensor], Dict[str, Tensor], Dict[str, Any]]:
        """One whole view: λ(t) L_content, L_style, and other losses that are on (Eq. 5 and 6)."""
        assert self.task is not None
        image, losses = self.losses(self.task, step)
        if self.on_losses is not None:
            self.on_losses(step, losses)
        return {"rgb": image}, losses.terms(), losses.metrics()

    @torch.no_grad()
    def get_eval_loss_dict(self, step: int) -> Tuple[Dict[str, Tensor], Dict[str, Tensor], Dict[str, Any]]:
        """The losses of one held-out view, with its photo, as it is, as content."""
        assert self.targets is not None
        self.eval()
        camera, batch = self.datamanager.next_eval_image(step)
        outputs = self.model.get_outputs_for_camera(camera)
        content = self.targets.content(batch["image"][..., :3].to(self.device))
        accumulation = None if self.model.background is None else outputs["accumulation"].squeeze(-1)
        values = self.targets.losses(self.targets.view(outputs["rgb"], content, accumulation))
        self.train()
        return outputs, {f"{name}_loss": value for name, value in values.items()}, {}

"""The pipeline of `hier-style`: every iteration renders one whole view and compares it with painting and photo."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Dict, Iterator, List, Optional, Tuple, Type

import psutil
import torch
import tyro
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from sparsestyle_ns.core.camera_paths import at_poses, poses_between
from sparsestyle_ns.core.schedules import content_weight
from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.losses.reconstruction import reconstruction_loss
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.models.hier_style import HierStyleModel, HierStyleModelConfig
from sparsestyle_ns.pipelines.base import CheckedPipeline, CheckedPipelineConfig
from sparsestyle_ns.rendering.frozen_view import FrozenView
from sparsestyle_ns.rendering.render import accumulation_of, seen_behind
from sparsestyle_ns.style.color import apply_palette, color_moments, palette_transform
from sparsestyle_ns.style.painting import load_style_image
from sparsestyle_ns.style.vgg import VGGFeatures
from sparsestyle_ns.utils.distributed import average_gradients, gather_rays, num_processes, shard_rays
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import bar, say, track
from sparsestyle_ns.utils.skip_nonfinite import broken, step_if_finite
from sparsestyle_ns.viewer.panel import StylePanel


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
    feature_side: int = 504
    """Longer side, in pixels, at which the feature network sees rendered views."""
    style_side: Optional[int] = None
    """Longer side at which it sees the style image: smaller gives finer strokes. None: as feature_side."""
    style_features: Optional[int] = None
    """Match with at most so many of the painting's feature vectors, drawn at random; None: all of them."""
    content_weight: float = 10.0
    """λ0, the weight of the content loss at the start (Eq. 6)."""
    content_decay: float = 0.01
    """α, what is left of it in the end."""
    content_steps: int = 100
    """T, the iterations in which it falls."""
    warm_start_steps: int = 60
    """Steps, before the first iteration, in which c_f is fitted to whole photos; 0 is the paper's start from grey."""
    novel_views: int = 0
    """Views between the photos to stylise as well, with the coarse render as their content."""
    samples_per_chunk: int = 1 << 19
    """Samples rendered at once: memory is bounded by about 5 KB for each. A view of fewer is rendered in one go; the
    chunks of a larger one are rendered a second time in the backward pass."""
    cache_gigabytes: Optional[float] = None
    """Memory for what never changes of the views; None: a quarter of what is free."""

    def check_style(self) -> None:
        """Makes sure, before hours of training, that the style image and the feature network can be loaded.

        Raises:
            InputError: see `load_targets`.
        """
        self._load_style()

    def load_targets(self, device: torch.device) -> StyleTargets:
        """The painting as the feature network sees it.

        Raises:
            InputError: there is no style image or no weights, or they can't be read; style_features is below 1.
        """
        image, backbone = self._load_style()
        return self.targets_of(image.to(device), backbone.to(device))

    def _load_style(self) -> Tuple[Float[Tensor, "3 H W"], VGGFeatures]:
        if self.style_image is None:
            raise InputError("There is no style image: name a painting with --style-image FILE.")
        if self.style_features is not None and self.style_features < 1:
            raise InputError(f"--pipeline.style-features is {self.style_features}; at least one vector is needed.")
        return load_style_image(self.style_image), self.load_backbone(torch.device("cpu"))

    def targets_of(self, image: Float[Tensor, "3 H W"], backbone: VGGFeatures) -> StyleTargets:
        """A painting as a feature network on its device sees it, with these settings."""
        style_side = self.style_side or self.feature_side
        return StyleTargets(backbone, image, self.feature_side, style_side, self.style_features)


@dataclass
class SceneView:
    """A view that is stylised, as far as it depends on no style.

    Attributes:
        frozen: its rays, ready to render.
        picture: its photo at the mean exposure, or its coarse render.
        accumulation: how opaque the coarse field is in each pixel.
        features: the feature network's view of the picture, once a style has asked for it.
    """

    frozen: FrozenView
    picture: Float[Tensor, "H W 3"]
    accumulation: Float[Tensor, "H W"]
    features: Optional[Float[Tensor, "1 768 h w"]] = None


@dataclass
class ContentView:
    """A view that is stylised, and what it must stay like.

    Attributes:
        frozen: its rays, ready to render.
        picture: its photo or coarse render, in the painting's colours where the palette is transferred.
        features: the feature network's view of it.
        accumulation: how opaque the coarse field is in each pixel; None where there is no background behind it.
    """

    frozen: FrozenView
    picture: Float[Tensor, "H W 3"]
    features: Float[Tensor, "1 768 h w"]
    accumulation: Optional[Float[Tensor, "H W"]]


@dataclass
class StepLosses:
    """What an iteration minimises.

    Attributes:
        step: its number, from 0.
        content_weight: λ.
        content, style: L_content and L_style.
    """

    step: int
    content_weight: float
    content: Float[Tensor, ""]
    style: Float[Tensor, ""]

    def terms(self) -> Dict[str, Tensor]:
        """The two summands of L_total (Eq. 5)."""
        return {"content_loss": self.content_weight * self.content, "style_loss": self.style}

    def metrics(self) -> Dict[str, Any]:
        """Both losses, without their gradients, and λ."""
        return {"content": self.content.detach(), "style": self.style.detach(), "lambda": self.content_weight}


@dataclass
class StyleTask:
    """A field that is on its way to a painting.

    Attributes:
        style: the field.
        targets: the painting.
        views: what it is stylised on; in turn, one an iteration.
    """

    style: nn.Module
    targets: StyleTargets
    views: List[ContentView]


class HierStylePipeline(CheckedPipeline):
    """Stage 2. What only training needs, the painting and the feature network, is loaded when training is set up."""

    config: HierStylePipelineConfig
    model: HierStyleModel
    targets: Optional[StyleTargets] = None
    scene_views: Optional[List[SceneView]] = None
    views: List[ContentView]

    def make_panel(self) -> StylePanel:
        """See `CheckedPipeline.make_panel`."""
        return StylePanel(self)

    def task(self) -> StyleTask:
        """What this run trains."""
        assert self.targets is not None
        return StyleTask(self.model.residual, self.targets, self.views)

    def new_task(self, style: nn.Module, targets: StyleTargets, effects: Decisions) -> StyleTask:
        """Another field and painting for the same views; what of these depends on no painting is shared."""
        return StyleTask(style, targets, self.content_views(targets, effects))

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> List[TrainingCallback]:
        """Prepares the style, the views and, at the first iteration, the colours."""
        trainer = training_callback_attributes.trainer
        self.prepare_style()
        self.prepare_views()
        if trainer is not None and trainer._start_step == 0 and self.config.warm_start_steps > 0:
            self.warm_start(training_callback_attributes.optimizers.optimizers["fields"].param_groups[0]["lr"])
        return super().get_training_callbacks(training_callback_attributes)

    def painting(self) -> Optional[StyleTargets]:
        """See `CheckedPipeline.painting`."""
        if self.targets is not None:
            return self.targets
        path = self.config.style_image
        if path is None or not path.is_file():
            say(f"The painting {path} isn't there any more, so nothing is measured against it.")
            return None
        return self.config.load_targets(self.device)

    def prepare_style(self) -> None:
        """Loads the painting and the feature network."""
        self.targets = self.config.load_targets(self.device)
        self.announce(self.targets.backbone)

    @torch.no_grad()
    def prepare_views(self) -> None:
        """Freezes what never changes of each view, and computes its content features."""
        assert self.targets is not None
        self.scene_views = self._freeze_views()
        self.views = self.content_views(self.targets, self.effects)
        self._report_cache()

    @torch.no_grad()
    def content_views(self, targets: StyleTargets, effects: Decisions) -> List[ContentView]:
        """The views for one painting; what depends on none is worked out once and shared by all."""
        if self.scene_views is None:
            self.scene_views = self._freeze_views()
        pictures = [view.picture for view in self.scene_views]
        if effects.on("palette"):
            pictures = self._in_style_colors(pictures, targets)
        return [
            ContentView(
                view.frozen,
                picture,
                self._features(view, picture, targets),
                None if self.model.background is None else view.accumulation,
            )
            for view, picture in zip(self.scene_views, pictures, strict=True)
        ]

    def _features(self, view: SceneView, picture: Tensor, targets: StyleTargets) -> Tensor:
        """Content features; those of a view's own picture are the same for every painting."""
        if picture is not view.picture:
            return targets.features(picture)
        if view.features is None:
            view.features = targets.features(picture)
        return view.features

    def _freeze_views(self) -> List[SceneView]:
        keep_bytes = self._cache_bytes()
        pixels = self.datamanager.pixels
        views = []
        for index, (height, width) in enumerate(track(pixels.sizes, "Caching views")):
            rows = slice(pixels.starts[index], pixels.starts[index + 1])
            frozen = self._freeze(pixels.origins[rows], pixels.directions[rows], keep_bytes)
            keep_bytes -= frozen.kept_bytes
            accumulation = gather_rays(frozen.render(accumulation_of), height * width)
            picture = self._photo(index, pixels.colors[rows], accumulation).view(height, width, 3)
            views.append(SceneView(frozen, picture, accumulation.view(height, width)))
        for camera in track(self._novel_cameras(), "Caching novel views"):
            bundle = camera.generate_rays(camera_indices=0, keep_shape=True).to(self.device)
            rays = bundle.flatten()
            frozen = self._freeze(rays.origins, rays.directions, keep_bytes)
            keep_bytes -= frozen.kept_bytes
            with self.model.rendering("exact"):  # a viewer may restyle a run whose pictures are baked
                outputs = self.model.get_outputs_for_camera_ray_bundle(bundle)
            views.append(SceneView(frozen, outputs["rgb_coarse"], outputs["accumulation_coarse"].squeeze(-1)))
        return views

    def _photo(self, index: int, colors: Tensor, accumulation: Tensor) -> Tensor:
        """A photo's colours, at the mean exposure where photos have their own."""
        if self.model.exposure is None:
            return colors
        return self.model.exposure.undone(colors, seen_behind(accumulation, self.model.background), index)

    def _cache_bytes(self) -> float:
        if self.config.cache_gigabytes is not None:
            return self.config.cache_gigabytes * 2**30
        free = torch.cuda.mem_get_info()[0] if self.device.type == "cuda" else psutil.virtual_memory().available
        return free / 4 / num_processes()

    def _report_cache(self) -> None:
        kept = sum(view.frozen.kept_bytes for view in self.views)
        chunks = sum(view.frozen.num_chunks for view in self.views)
        whole = sum(view.frozen.is_kept for view in self.views)
        note = "" if whole == len(self.views) else "; the rest is computed again in each iteration"
        occupied = "" if self.model.occupancy is None else f", {self.model.occupancy.share:.0%} of space occupied"
        CONSOLE.print(
            f"{len(self.views)} views in {chunks} chunks{occupied}; {whole} views kept in {kept / 2**20:.0f} MiB{note}."
        )

    def _freeze(self, origins: Tensor, directions: Tensor, keep_bytes: float) -> FrozenView:
        """The rays of a view that this process renders."""
        origins, directions = shard_rays(origins), shard_rays(directions)
        return self.model.freeze_view(origins, directions, self.config.samples_per_chunk, keep_bytes)

    def _render(self, view: ContentView, style: nn.Module, coarse_geometry: bool = False) -> Float[Tensor, "H W 3"]:
        """The stylised picture of a view, of which each process renders its share of the rays."""
        own = view.frozen.render(lambda chunk: self.model.stylised(chunk, coarse_geometry, style).rgb)
        return gather_rays(own, view.picture[..., 0].numel()).view(view.picture.shape)

    def _novel_cameras(self) -> List[Cameras]:
        """Cameras half way, a third of the way … between neighbouring training views."""
        cameras = self.datamanager.train_dataset.cameras
        if self.config.novel_views == 0 or len(cameras) < 2:
            return []
        gaps = len(cameras) - 1
        steps = math.ceil(self.config.novel_views / gaps) + 1
        path = poses_between(cameras.camera_to_worlds.cpu(), gaps * steps + 1)
        between = [pose for place, pose in enumerate(path) if place % steps]
        return [at_poses(pose[None], cameras) for pose in between[: self.config.novel_views]]

    def _in_style_colors(self, pictures: List[Tensor], targets: StyleTargets) -> List[Tensor]:
        """Pictures with the painting's colours; where the scene is transparent the background stays as it is."""
        photos, weights = len(self.datamanager.pixels.sizes), [view.accumulation for view in self.scene_views]
        colors = torch.cat([picture.reshape(-1, 3) for picture in pictures[:photos]])
        weight = torch.cat([weight.reshape(-1) for weight in weights[:photos]])
        style = color_moments(targets.style_image.permute(1, 2, 0).reshape(-1, 3))
        matrix, offset = palette_transform(*color_moments(colors, weight), *style)
        transferred = [apply_palette(picture, matrix, offset, clamp=True) for picture in pictures]
        if self.model.background is None:
            return transferred
        return [
            torch.lerp(picture, changed, weight[..., None].clamp(0.0, 1.0))
            for picture, changed, weight in zip(pictures, transferred, weights, strict=True)
        ]

    def warm_start(self, learning_rate: float) -> None:
        """Warms this run's field up (see `warm_up`)."""
        with bar("Warm start", self.config.warm_start_steps) as warming:
            for _ in self.warm_up(self.task(), learning_rate):
                warming.advance()

    def warm_up(self, task: StyleTask, learning_rate: float) -> Iterator[int]:
        """Fits c_f, on the coarse geometry, to the content pictures of the photos; an iterator of its steps.

        A coarse field that is fine-tuned itself is fitted as a whole: its colours can't change with its geometry held.

        The features of VGG's third block hardly see colour; stylising from grey loses the palette. The paper doesn't do
        this.

        Args:
            learning_rate: Adam's; that of the iterations that follow.
        """
        photos = task.views[: len(self.datamanager.pixels.sizes)]
        coarse_geometry = self.model.config.stylised_field == "residual"
        parameters = list(task.style.parameters())
        optimizer = torch.optim.Adam(parameters, lr=learning_rate, fused=True)
        for step in range(self.config.warm_start_steps):
            view = photos[step % len(photos)]
            loss = reconstruction_loss(self._render(view, task.style, coarse_geometry), view.picture)
            optimizer.zero_grad()
            loss.backward()
            average_gradients(parameters)
            if step_if_finite(optimizer, broken(parameters)):
                optimizer.step()
            yield step
        optimizer.zero_grad()

    def step(self, task: StyleTask, step: int) -> Tuple[Tensor, StepLosses]:
        """One whole view of a task, and λ(t), L_content and L_style (Eq. 5 and 6)."""
        view = task.views[step % len(task.views)]
        image = self._render(view, task.style)
        style, content = task.targets.losses(image, view.features, view.accumulation)
        config = self.config
        weight = content_weight(step, config.content_weight, config.content_decay, config.content_steps)
        return image, StepLosses(step, weight, content, style)

    def get_train_loss_dict(self, step: int) -> Tuple[Dict[str, Tensor], Dict[str, Tensor], Dict[str, Any]]:
        """One whole view: λ(t) L_content and L_style (Eq. 5 and 6)."""
        image, losses = self.step(self.task(), step)
        self.panel.show_losses(losses)
        return {"rgb": image}, losses.terms(), losses.metrics()

    @torch.no_grad()
    def get_eval_loss_dict(self, step: int) -> Tuple[Dict[str, Tensor], Dict[str, Tensor], Dict[str, Any]]:
        """The same losses of one held-out view, with its photo, as it is, as content."""
        assert self.targets is not None
        self.eval()
        camera, batch = self.datamanager.next_eval_image(step)
        outputs = self.model.get_outputs_for_camera(camera)
        content = self.targets.features(batch["image"][..., :3].to(self.device))
        accumulation = None if self.model.background is None else outputs["accumulation"].squeeze(-1)
        style, content_loss = self.targets.losses(outputs["rgb"], content, accumulation)
        self.train()
        return outputs, {"content_loss": content_loss, "style_loss": style}, {}

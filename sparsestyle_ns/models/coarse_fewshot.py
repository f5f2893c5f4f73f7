"""`coarse-fewshot`: learns the coarse field of a scene from a few photos (stage 1)."""

from dataclasses import dataclass, field, replace
from typing import Any, Dict, List, Optional, Tuple, Type

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from torch import Tensor
from torch.nn import Parameter

from sparsestyle_ns.core.occupancy import DensityGrid, DensityVolume
from sparsestyle_ns.core.precision import autocast
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.core.schedules import ramp
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.core.volrend import distortion, effective_samples
from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.field_components.positional_encoding import revealed_levels
from sparsestyle_ns.field_components.thinned_mlp import Thinning
from sparsestyle_ns.losses.coarse import matched_depth_loss, near_density, reconstruction_loss
from sparsestyle_ns.metrics.image import image_metrics, psnr_of_error
from sparsestyle_ns.models.scene_model import SceneModel, SceneModelConfig
from sparsestyle_ns.rendering.few_samples import FewSamples
from sparsestyle_ns.rendering.render import (
    POINTS_PER_CALL,
    DenseRender,
    render_coarse,
    render_frozen,
    seen_behind,
    surface_distance,
)
from sparsestyle_ns.rendering.visible_samples import Marching
from sparsestyle_ns.utils.distributed import gather_rays, num_processes, shard_rays
from sparsestyle_ns.utils.errors import InputError


@dataclass
class CoarseFewShotModelConfig(SceneModelConfig):
    """Settings of stage 1."""

    _target: Type = field(default_factory=lambda: CoarseFewShotModel)
    num_samples: int = 24
    """Samples a ray in training."""
    early_samples: int = 12
    """The same in its first iterations, if fewer, where empty space is skipped: a blurred field needs no more."""
    early_iterations: float = 0.6
    """Share of all iterations, from 0 to 1, that are these first ones."""
    num_eval_samples: int = 6
    """Samples a ray in pictures of a trained field, where its weight is; while it learns, as many as in training."""
    volume_resolution: int = 128
    """Cells along a side of this volume."""
    num_bins: int = 64
    """Bins of the histogram that samples follow where empty space is skipped."""
    thinning: float = 2.0
    """Spares the backward pass samples with small gradients: of those below this many times the batch's mean, some are
    drawn, in proportion to their size, and count for more. 0 keeps all samples."""
    even_share: float = 0.4
    """Share of the samples, in (0, 1], that is spread evenly along a ray where empty space is skipped."""
    grid_resolution: int = 64
    """Cells along a side of the grid that remembers density."""
    distortion_weight: float = 0.015
    """Weight of the distortion loss, which gathers a ray's weight in one place; 0 is off, as in the paper."""
    distortion_start: float = 0.4
    """Share of the iterations after which the distortion loss sets in."""
    distortion_ramp: float = 0.3
    """Share of the iterations in which it then grows to its weight; 0 is at once."""
    matched_depth_weight: float = 0.02
    """Weight of the distance between matched points and where their rays end, where `matched_depth` is on."""
    occlusion_weight: float = 0.0
    """Weight of density close to the camera (FreeNeRF's occlusion loss); 0 is off."""
    occlusion_range: float = 0.1
    """Part of a ray, from its start, that counts as close for the occlusion loss."""
    frequency_reveal: float = 0.0
    """Share of the iterations in which the encoding's octaves are revealed one by one (FreeNeRF); 0 is off."""
    refinement_start: float = 0.25
    """Share of the iterations after which cameras are learned, where they are: a field that is fog yet would only push
    them about."""
    seed: int = 42
    """Seed of the jitter of samples; a step's jitter depends on it and the step alone."""


class CoarseFewShotModel(SceneModel):
    """The coarse field, trained on the reconstruction loss (Eq. 4) with regularisers that make it a surface."""

    config: CoarseFewShotModelConfig
    picture_names = ("rgb", "accumulation", "depth")

    def populate_modules(self) -> None:
        """Builds the field, and the grid that guides samples."""
        super().populate_modules()
        if not 0.0 < (share := self.config.even_share) <= 1.0:
            raise InputError(f"--pipeline.model.even-share is {share}; give a number above 0 and up to 1.")
        if not 0.0 <= (early := self.config.early_iterations) <= 1.0:
            raise InputError(f"--pipeline.model.early-iterations is {early}; give a number from 0 to 1.")
        for name in ("num_samples", "early_samples"):
            if (count := getattr(self.config, name)) < 1:
                raise InputError(f"--pipeline.model.{name.replace('_', '-')} is {count}; give 1 sample or more.")
        self.field = self.config.coarse_field.setup(self.effects.on("view_color"))
        self.build_grid(self.effects)
        self.step = 0
        self.num_iterations = 1
        self.learns = False
        # In a tuple: as a module of the model the volume would be part of its state.
        self._measured: Optional[Tuple[DensityVolume, List[Tuple[int, int]]]] = None

    def build_grid(self, effects: Decisions) -> None:
        """Makes the grid that guides samples, or takes it away, as is decided; a new one knows nothing yet."""
        self.grid = None
        if effects.on("empty_space"):
            self.grid = DensityGrid(self.config.grid_resolution).to(next(self.field.parameters()).device)

    def get_param_groups(self) -> Dict[str, List[Parameter]]:
        """The matrices of hidden layers, and all else; where they are learned, exposures with that, and cameras."""
        exposure = [] if self.exposure is None else list(self.exposure.parameters())
        matrices = self.field.hidden_matrices()
        names = {id(matrix) for matrix in matrices}
        rest = [parameter for parameter in self.field.parameters() if id(parameter) not in names]
        groups = {"fields": [*rest, *exposure], "hidden_layers": matrices}
        return groups if self.refinement is None else {**groups, "cameras": list(self.refinement.parameters())}

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> List[TrainingCallback]:
        """Tells the model the step before each iteration, and when it has learned all."""
        self.learns = True
        if training_callback_attributes.trainer is not None:
            self.num_iterations = training_callback_attributes.trainer.config.max_num_iterations
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.update_to_step),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], lambda step: self.finish_learning()),
        ]

    def finish_learning(self) -> None:
        """From now on pictures are those of a trained field."""
        self.learns, self._measured = False, None

    def update_to_step(self, step: int) -> None:
        """Sets what depends on the iteration: the jitter, the octaves that are revealed, and what is learned."""
        self.step = step
        reveal, levels = self.config.frequency_reveal * self.num_iterations, None
        if self.training and step < reveal:
            levels = revealed_levels(step / reveal, self.config.coarse_field.num_levels)
        self.field.position_encoding.level_weights = levels
        if self.refinement is not None:
            self.refinement.learns = step >= self.config.refinement_start * self.num_iterations

    @property
    def samples_now(self) -> int:
        """Samples a ray at this iteration."""
        config = self.config
        if self.grid is None or self.step >= config.early_iterations * self.num_iterations:
            return config.num_samples
        return min(config.early_samples, config.num_samples)

    def place_samples(self, segments: Segments, num_samples: int, generator: Optional[torch.Generator]) -> Tensor:
        """Borders of samples on rays: where the grid remembers density, or evenly without one."""
        if self.grid is None:
            return even_edges(len(segments.hit), num_samples, self.device, generator)
        return self.grid.place_samples(
            segments, num_samples, self.config.num_bins, self.space.unbounded, self.config.even_share, generator
        )

    def render(
        self, segments: Segments, directions: Tensor, edges: Tensor, thinning: Optional[Thinning] = None
    ) -> DenseRender:
        """Renders rays with the samples that `edges` bound."""
        background = self.background
        with autocast(self.device, self.config.precision):
            return render_coarse(self.field, segments, directions, edges, self.space.unbounded, background, thinning)

    @torch.no_grad()
    def marching(self) -> Marching:
        """Where the samples of the trained field lie; its densities are measured if they have changed."""
        versions = [(parameter.data_ptr(), parameter._version) for parameter in self.field.parameters()]
        if self._measured is None or versions != self._measured[1]:
            volume = DensityVolume(self.config.volume_resolution).to(self.device)
            volume.measure(lambda points: self.field.density_and_feature(points)[0], POINTS_PER_CALL)
            self._measured = volume, versions
        few = FewSamples(self._measured[0], self.config.num_eval_samples)
        return Marching(None, self.config.num_steps, self.space.unbounded, 0.0, few)

    def render_batch(self, segments: Segments, origins: Tensor, directions: Tensor) -> Tuple[DenseRender, Tensor]:
        """Renders the rays of a training step, each process its share; also returns the samples' borders."""
        generator = torch.Generator(device=self.device).manual_seed(self.config.seed * 1_000_003 + self.step)
        edges = self.place_samples(segments, self.samples_now, generator)
        thinning = Thinning(self.config.thinning, generator) if self.config.thinning > 0 else None
        if num_processes() == 1:
            return self.render(segments, directions, edges, thinning), edges
        segments = self.space.segments(shard_rays(origins), shard_rays(directions))
        own = self.render(segments, shard_rays(directions), shard_rays(edges), thinning)
        return DenseRender(**{name: gather_rays(part, len(edges)) for name, part in vars(own).items()}), edges

    def picture(self, rays: RayBundle) -> Dict[str, Tensor]:
        """What `get_outputs` gives outside of training."""
        segments, unbounded, background = self.shown(rays)
        with autocast(self.device, self.config.precision):
            if self.learns:
                edges = self.place_samples(segments, self.config.num_samples, None)
                render = render_coarse(self.field, segments, rays.directions, edges, unbounded, background)
            else:
                marching = replace(self.marching(), unbounded=unbounded)
                render = render_frozen(self.field, segments, rays.directions, marching, background)
        depth = surface_distance(segments, render.s)
        return {"rgb": render.rgb, "accumulation": render.accumulation, "depth": depth}

    def get_outputs(self, ray_bundle: RayBundle) -> Dict[str, Tensor]:
        """`rgb`, `accumulation`, and `depth` in world units; in training also what the losses need."""
        if not self.training:
            return self.picture(ray_bundle)
        segments = self.space.segments(ray_bundle.origins, ray_bundle.directions)
        render, edges = self.render_batch(segments, ray_bundle.origins, ray_bundle.directions)
        if self.grid is not None:
            self.grid.remember(render.positions, render.density)
        rgb = render.rgb
        if self.exposure is not None:
            behind = seen_behind(render.accumulation, self.background)
            rgb = self.exposure(rgb, behind, ray_bundle.camera_indices.squeeze(-1))
        known = ray_bundle.metadata.get("matched_distance")
        return ({} if known is None else {"matched_s": segments.at_distance(known)}) | {
            "rgb": rgb,
            "accumulation": render.accumulation,
            "edges": edges,
            "weights": render.weights,
            "density": render.density,
        }

    def get_metrics_dict(self, outputs: Dict[str, Tensor], batch: Dict[str, Any]) -> Dict[str, Tensor]:
        """PSNR of the batch, in dB, and effective samples a ray."""
        photo = batch["image"].to(self.device)
        error = reconstruction_loss(outputs["rgb"][: len(photo)].detach(), photo)
        metrics = {"psnr": psnr_of_error(error)}
        if "weights" in outputs:
            metrics["effective_samples"] = effective_samples(outputs["weights"].detach()).mean()
        return metrics

    def get_loss_dict(
        self, outputs: Dict[str, Tensor], batch: Dict[str, Any], metrics_dict: Optional[Dict[str, Tensor]] = None
    ) -> Dict[str, Tensor]:
        """The reconstruction loss (Eq. 4) and, in training, the regularisers that are on.

        The last rays of a training batch may lead to matched points; these have a depth and no colour.
        """
        photo = batch["image"].to(self.device)
        losses = {"reconstruction_loss": reconstruction_loss(outputs["rgb"][: len(photo)], photo)}
        if not self.training:
            return losses
        config = self.config
        if config.distortion_weight > 0:
            grown = ramp(self.step / self.num_iterations, config.distortion_start, config.distortion_ramp)
            weight = config.distortion_weight * grown
            losses["distortion_loss"] = weight * distortion(outputs["weights"], outputs["edges"]).mean()
        if "matched_s" in outputs:
            matched = (outputs[name][len(photo) :] for name in ("weights", "edges", "matched_s"))
            losses["matched_depth_loss"] = config.matched_depth_weight * matched_depth_loss(*matched)
        if config.occlusion_weight > 0:
            near = near_density(outputs["density"], outputs["edges"], config.occlusion_range)
            losses["occlusion_loss"] = config.occlusion_weight * near
        return losses

    def get_image_metrics_and_images(
        self, outputs: Dict[str, Tensor], batch: Dict[str, Tensor]
    ) -> Tuple[Dict[str, float], Dict[str, Tensor]]:
        """PSNR, SSIM and, where its weights exist, LPIPS of a rendered view; and the pictures side by side."""
        photo = batch["image"][..., :3].to(outputs["rgb"])
        images = {"img": torch.cat([photo, outputs["rgb"]], dim=1)}
        return image_metrics(outputs["rgb"], photo), images

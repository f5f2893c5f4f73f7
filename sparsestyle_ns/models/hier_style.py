"""`hier-style`: the coarse field, frozen, and the residual field that stylises it (stage 2)."""

from dataclasses import dataclass, field
from typing import Any, Dict, List, Optional, Tuple, Type

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor
from torch.nn import Parameter

from sparsestyle_ns.evaluation.image_metrics import image_metrics
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.models.coarse_fewshot import CoarseFieldConfig
from sparsestyle_ns.rendering.density_grid import Occupancy, march
from sparsestyle_ns.rendering.frozen_view import FrozenView, split_by_samples
from sparsestyle_ns.rendering.precision import Precision, autocast
from sparsestyle_ns.rendering.space import make_space
from sparsestyle_ns.rendering.volume import (
    POINTS_PER_CALL,
    FrozenSamples,
    PackedRender,
    freeze_samples,
    render_frozen_coarse,
    render_stylised,
)

RAYS_PER_CALL = 1 << 13
"""Rays that are marched at once; bounds the memory of the steps in empty space."""


@dataclass
class HierStyleModelConfig(ModelConfig):
    """Settings of the stylised field."""

    _target: Type = field(default_factory=lambda: HierStyleModel)
    enable_collider: bool = False
    """Unused: the space of the scene decides where rays start and end."""
    coarse_field: CoarseFieldConfig = field(default_factory=CoarseFieldConfig)
    """The coarse field; taken over from the coarse run."""
    hash_levels: int = 8
    """Levels of the hash grid (M)."""
    min_resolution: int = 128
    """Cells along the cube's side on the first level (N_min)."""
    max_resolution: int = 512
    """Cells along the cube's side on the last level (N_max)."""
    features_per_level: int = 4
    """Features of a cell's corner."""
    log2_table_size: int = 19
    """log2 of a level's table length."""
    hidden_layers: int = 2
    """Hidden layers of the residual field's MLP."""
    layer_width: int = 256
    """Units in a hidden layer."""
    residual_density: bool = True
    """Whether the residual field changes the geometry (Eq. 3); off, only the colour is learned."""
    residual_density_scale: float = 10.0
    """Unit of the residual density, per half side of the scene's cube."""
    num_steps: int = 128
    """Even steps along a ray; those in empty cells are skipped."""
    occupancy_resolution: int = 128
    """Cells along a side of the grid that says what is empty."""
    min_alpha: float = 0.03
    """Opacity over a cell's side, in (0, 1), below which the coarse field counts as empty there."""
    min_transmittance: float = 1e-3
    """Share of light left, in (0, 1), below which samples farther along the ray are dropped."""
    precision: Precision = "auto"
    """Number format of matrix products: auto is bfloat16 where the device multiplies it, else float32."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once outside of training."""


class HierStyleModel(Model):
    """(σ_f, c_f) on top of a frozen (σ_c, e_c, c_c). Its state holds all that rendering needs."""

    config: HierStyleModelConfig

    def populate_modules(self) -> None:
        """Builds both fields, the space, and the grid of empty cells."""
        super().populate_modules()
        metadata: Dict[str, Any] = self.kwargs["metadata"]
        config = self.config
        self.space = make_space(self.scene_box, metadata)
        self.field = config.coarse_field.setup().requires_grad_(False)
        grid = HashGrid(
            config.hash_levels,
            config.min_resolution,
            config.max_resolution,
            config.features_per_level,
            config.log2_table_size,
        )
        self.residual = ResidualField(
            grid,
            config.coarse_field.feature_dim,
            config.hidden_layers,
            config.layer_width,
            config.residual_density_scale,
            config.residual_density,
        )
        self.occupancy = Occupancy(config.occupancy_resolution)
        color = metadata["background_color"]
        self.register_buffer("background", None if color is None else torch.tensor(color), persistent=False)

    def get_param_groups(self) -> Dict[str, List[Parameter]]:
        """One group, `fields`: the residual field. The coarse field is frozen."""
        return {"fields": list(self.residual.parameters())}

    @torch.no_grad()
    def adopt_coarse(self, state: Dict[str, Tensor]) -> None:
        """Takes over a coarse model's field and space, and finds out which cells are empty.

        Args:
            state: the state of a `CoarseFewShotModel` with the same settings of the field and of the space.
        """
        for name in ("field", "space"):
            part = {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(name + ".")}
            getattr(self, name).load_state_dict(part, strict=True)
        self.field.to(self.device)
        with autocast(self.device, self.config.precision):
            self.occupancy.measure(
                lambda points: self.field.density_and_feature(points)[0], self.config.min_alpha, POINTS_PER_CALL
            )

    def freeze(self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]) -> FrozenSamples:
        """The samples of rays that can show, with the coarse field evaluated there."""
        with autocast(self.device, self.config.precision):
            return freeze_samples(
                self.field,
                self.residual,
                self.occupancy,
                self.space.segments(origins, directions),
                self.config.num_steps,
                self.space.unbounded,
                self.config.min_transmittance,
            )

    def freeze_view(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        samples_per_chunk: int,
        keep_bytes: float,
    ) -> FrozenView:
        """A view for whole-image steps, in chunks of at most `samples_per_chunk` samples (see `FrozenView`)."""
        counts = torch.cat([self._count_samples(*rays) for rays in _pairs(origins, directions, RAYS_PER_CALL)])
        runs = split_by_samples(counts, samples_per_chunk)
        return FrozenView(runs, lambda run: self.freeze(origins[run], directions[run]), keep_bytes)

    def _count_samples(self, origins: Tensor, directions: Tensor) -> Tensor:
        segments = self.space.segments(origins, directions)
        samples = march(segments, self.occupancy, self.config.num_steps, self.space.unbounded)
        return torch.bincount(samples.ray_indices, minlength=len(origins))

    def stylised(self, frozen: FrozenSamples, coarse_geometry: bool = False) -> PackedRender:
        """Renders σ_f, or with `coarse_geometry` σ_c, and c_f at frozen samples; differentiable."""
        with autocast(self.device, self.config.precision):
            return render_stylised(self.residual, frozen, self.background, coarse_geometry)

    def coarse(self, frozen: FrozenSamples, directions: Float[Tensor, "rays 3"]) -> PackedRender:
        """Renders σ_c and c_c at frozen samples."""
        with autocast(self.device, self.config.precision):
            return render_frozen_coarse(self.field, frozen, directions, self.background)

    def get_outputs(self, ray_bundle: RayBundle) -> Dict[str, Tensor]:
        """`rgb` (stylised), `rgb_coarse`, `accumulation`, and `depth` of the stylised geometry in world units."""
        frozen = self.freeze(ray_bundle.origins, ray_bundle.directions)
        fine = self.stylised(frozen)
        coarse = self.coarse(frozen, ray_bundle.directions)
        segments = self.space.segments(ray_bundle.origins, ray_bundle.directions)
        return {
            "rgb": fine.rgb,
            "rgb_coarse": coarse.rgb,
            "accumulation": fine.accumulation,
            "depth": segments.distance(fine.s.clamp(max=1.0 - 1e-4)),
        }

    def get_loss_dict(
        self, outputs: Dict[str, Tensor], batch: Dict[str, Any], metrics_dict: Optional[Dict[str, Tensor]] = None
    ) -> Dict[str, Tensor]:
        """Nothing: the losses are of whole views, and the pipeline has them."""
        return {}

    def get_image_metrics_and_images(
        self, outputs: Dict[str, Tensor], batch: Dict[str, Tensor]
    ) -> Tuple[Dict[str, float], Dict[str, Tensor]]:
        """How well the coarse render shows the photo, and how much of its structure the stylised one keeps (SSIM)."""
        photo = batch["image"][..., :3].to(outputs["rgb"])
        metrics = {f"coarse_{name}": value for name, value in image_metrics(outputs["rgb_coarse"], photo).items()}
        metrics["content_ssim"] = image_metrics(outputs["rgb"], photo)["ssim"]
        return metrics, {"img": torch.cat([photo, outputs["rgb_coarse"], outputs["rgb"]], dim=1)}


def _pairs(first: Tensor, second: Tensor, size: int) -> List[Tuple[Tensor, Tensor]]:
    return list(zip(first.split(size), second.split(size), strict=True))

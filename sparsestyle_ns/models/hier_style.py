"""`hier-style`: the coarse field, frozen, and the residual field that stylises it (stage 2)."""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Dict, Iterable, List, Optional, Tuple, Type

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor
from torch.nn import Parameter

from sparsestyle_ns.core.occupancy import DensityVolume, Occupancy
from sparsestyle_ns.core.precision import autocast
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.fields.fine import FineFieldConfig, FineTunedField, StylisedField
from sparsestyle_ns.metrics.image import image_metrics, structural_similarity
from sparsestyle_ns.models.scene_model import SceneModel, SceneModelConfig
from sparsestyle_ns.rendering import render
from sparsestyle_ns.rendering.baked import BakedCache, BakedVolume, shade_of
from sparsestyle_ns.rendering.few_samples import FewSamples
from sparsestyle_ns.rendering.frozen_view import FrozenView, equal_runs
from sparsestyle_ns.rendering.look import Display, Look, RenderMode
from sparsestyle_ns.rendering.mixing import Mix
from sparsestyle_ns.rendering.render import FrozenSamples, PackedRender, surface_distance
from sparsestyle_ns.rendering.visible_samples import Marching
from sparsestyle_ns.utils.device_sizes import sizes_for
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.numba_kernels import untraced
from sparsestyle_ns.utils.progress import bar

BAKED_RAYS = 1 << 17
"""Rays of a baked picture that are marched at once; a viewer can break it off in between."""


@dataclass
class HierStyleModelConfig(FineFieldConfig, SceneModelConfig):
    """Settings of both fields and of how they are rendered."""

    _target: Type = field(default_factory=lambda: HierStyleModel)
    num_samples: Optional[int] = 4
    """Samples a ray on which the stylised field learns, where the coarse field's weight is; None: every step that can
    show, as with a fine-tuned copy of the coarse field, whose weight moves."""
    num_eval_samples: Optional[int] = 4
    """The same in pictures; more of them show fewer ripples where colour changes along rays."""
    even_share: float = 0.2
    """Where residual density may add to the geometry, this share of all samples, in [0, 1), lies evenly besides."""
    occupancy_resolution: int = 128
    """Cells along a side of the grids that say what is empty, and how dense what isn't."""
    min_alpha: float = 0.03
    """Opacity over a cell's side, in (0, 1), below which the coarse field counts as empty there."""
    min_transmittance: float = 1e-3
    """Share of light left, in (0, 1), below which samples farther along the ray are dropped."""
    render_mode: RenderMode = "exact"
    """How pictures are made outside of training. exact evaluates the fields at every sample. baked reads them from a
    voxel grid that is filled where rays pass: the first picture of a place takes as long as an exact one, later ones a
    small part of that, on a CPU too. The viewer has a control for it; for ns-render, set `render_mode: baked` in the
    run's config.yml."""
    strength: float = 1.0
    """How much of the style pictures outside of training show: 0 is the coarse field, 1 the stylised one. The viewer
    has controls for this and the next; for ns-render, set them in the run's config.yml."""
    geometry_strength: float = 1.0
    """Share of the residual density in these pictures, from 0 to 1."""
    bake_steps: Optional[int] = 96
    """Even steps along a ray of baked pictures, 2 or more; None: as many as `num_steps`. On fern 128 are 0.1 dB nearer
    to the exact picture, on lego 1.8 dB (39.5), and take a third longer."""
    bake_resolution: int = 256
    """Cells along the cube's side in baked rendering. Each brick of 8³ that rays have been to takes 4 KiB: at most
    147 MB with 256, 482 MB with 384."""


class HierStyleModel(SceneModel):
    """(σ_f, c_f) on top of a frozen (σ_c, e_c, c_c). Its state holds all that rendering needs."""

    config: HierStyleModelConfig
    picture_names = ("rgb", "rgb_coarse", "accumulation", "depth", "accumulation_coarse", "depth_coarse")

    def populate_modules(self) -> None:
        """Builds both fields, and the grid that says what is empty."""
        super().populate_modules()
        effects, config = self.effects, self.config
        config.settle_encoding(self._built_for())
        self.field = config.coarse_field.setup(effects.on("view_color")).requires_grad_(False)
        self.residual = self.new_style()
        self.volume = DensityVolume(config.occupancy_resolution)
        self.occupancy = Occupancy(config.occupancy_resolution) if effects.on("empty_space") else None
        for part in (self.exposure, self.refinement):
            if part is not None:
                part.requires_grad_(False)
        for name in ("strength", "geometry_strength", "depth_cells"):
            if not 0.0 <= (value := getattr(config, name)) <= 1.0:
                flag = name.replace("_", "-")
                raise InputError(f"--pipeline.model.{flag} is {value}; give a number from 0 to 1.")
        for name in ("num_samples", "num_eval_samples"):
            if (count := getattr(config, name)) is not None and count < 1:
                flag = name.replace("_", "-")
                raise InputError(f"--pipeline.model.{flag} is {count}; give 1 or more, or None.")
        if config.bake_steps is not None and config.bake_steps < 2:
            raise InputError(f"--pipeline.model.bake-steps is {config.bake_steps}; give 2 or more, or None.")
        if not 0.0 <= config.even_share < 1.0:
            raise InputError(f"--pipeline.model.even-share is {config.even_share}; give a number from 0 to below 1.")
        self.display = Display(Look(config.render_mode, Mix(config.strength, config.geometry_strength)))
        self.baked = BakedCache(
            lambda style: self.bake(config.bake_resolution, style),
            lambda: [part for part in (self.field, self.space, self.occupancy) if part is not None],
        )

    def new_style(self, max_resolution: Optional[int] = None) -> StylisedField:
        """A field to be stylised, as it is before training, on the coarse field's device; its grid as fine as given."""
        effects = self.effects.on("residual_density"), self.effects.on("ndc")
        config = self.config if max_resolution is None else replace(self.config, max_resolution=max_resolution)
        new = config.new_field(self.field, *effects, self._built_for())
        return new.to(next(self.field.parameters()).device)

    def _built_for(self) -> torch.device:
        return torch.device(self.kwargs.get("device", "cpu"))

    @property
    def marching(self) -> Marching:
        """Where the samples of the frozen coarse field lie in pictures."""
        return self._marching(self.config.num_eval_samples)

    @property
    def baked_marching(self) -> Marching:
        """Where they lie in baked pictures."""
        return replace(self.marching, num_steps=self.config.bake_steps or self.config.num_steps)

    @property
    def learning(self) -> Marching:
        """Where they lie in the views that are stylised."""
        return self._marching(self.config.num_samples)

    def _marching(self, num_samples: Optional[int]) -> Marching:
        config = self.config
        few = None
        if num_samples is not None and config.stylised_field == "residual":
            even_share = config.even_share if self.effects.on("residual_density") else 0.0
            # The even ones come on top of those where the weight is.
            few = FewSamples(self.volume, math.ceil(num_samples / (1.0 - even_share)), even_share)
        return Marching(self.occupancy, config.num_steps, self.space.unbounded, config.min_transmittance, few)

    def get_param_groups(self) -> Dict[str, List[Parameter]]:
        """One group, `fields`: the field that is stylised. The coarse field is frozen."""
        return {"fields": list(self.residual.parameters())}

    @torch.no_grad()
    def adopt_coarse(self, state: Dict[str, Tensor]) -> None:
        """Takes over the state of a `CoarseFewShotModel` with these settings, and finds out which cells are empty."""
        for name in ("field", "space", "exposure", "refinement"):
            if getattr(self, name) is not None:
                part = {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(name + ".")}
                getattr(self, name).load_state_dict(part, strict=True)
        self.field.to(self.device)
        if isinstance(self.residual, FineTunedField):
            self.residual.field.load_state_dict(self.field.state_dict())
        cells = self.config.occupancy_resolution**3
        with autocast(self.device, self.config.precision), bar("Looking for surfaces", cells, unit="cells") as looking:

            def density(points: Tensor) -> Tensor:
                values = self.field.density_and_feature(points)[0]
                looking.advance(len(points))
                return values

            self.volume.measure(density, render.POINTS_PER_CALL)
        if self.occupancy is not None:
            self.occupancy.measure(self.volume, self.config.min_alpha)

    def freeze(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], marching: Optional[Marching] = None
    ) -> FrozenSamples:
        """`freeze_samples` of rays for this model's own style, by default those on which it learns."""
        most = sizes_for(self.device).marched_rays
        parts = zip(origins.split(most), directions.split(most), strict=True)
        return self._freeze((self.space.segments(*part) for part in parts), marching or self.learning)

    def _freeze(self, parts: Iterable[Segments], marching: Marching) -> FrozenSamples:
        with autocast(self.device, self.config.precision):
            frozen = [render.freeze_samples(self.field, self.residual, part, marching) for part in parts]
            return FrozenSamples.joined(frozen, self.residual)

    def freeze_view(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        samples_per_chunk: int,
        keep_bytes: float,
    ) -> FrozenView:
        """A view for whole-image steps, in chunks of at most `samples_per_chunk` samples (see `FrozenView`)."""
        runs = equal_runs(len(origins), samples_per_chunk // self.learning.most_samples)
        return FrozenView(runs, lambda run: self.freeze(origins[run], directions[run]), keep_bytes)

    def stylised(
        self, frozen: FrozenSamples, coarse_geometry: bool = False, style: Optional[StylisedField] = None
    ) -> PackedRender:
        """`render_stylised` of a style, by default the model's own."""
        with autocast(self.device, self.config.precision):
            return render.render_stylised(style or self.residual, frozen, self.background, coarse_geometry)

    def bake(self, resolution: int, style: Optional[StylisedField] = None) -> BakedVolume:
        """The fields with a style, by default the model's own, in a voxel grid that is filled as rays are rendered."""
        shade = shade_of(self.field, style or self.residual, self.space, self.config.precision)
        return BakedVolume(shade, resolution, self.device)

    @untraced
    def get_outputs(self, ray_bundle: RayBundle) -> Dict[str, Tensor]:
        """`rgb` (stylised), `accumulation`, `depth` in world units, and the same of the coarse field as `…_coarse`."""
        segments, unbounded, background = self.shown(ray_bundle)
        look = self.display.look
        styles, is_baked = look.styles or (self.residual,), look.mode == "baked" and not self.training
        marching = replace(self.baked_marching if is_baked else self.marching, unbounded=unbounded)
        if is_baked:
            fine, coarse = self.baked.render(styles, segments, marching, background, look.mix)
        else:
            most = sizes_for(self.device).marched_rays
            directions, starts = ray_bundle.directions, range(0, len(ray_bundle), most)
            parts = (self.shown(ray_bundle[start : start + most]).segments for start in starts)
            frozen = self._freeze(parts, marching)
            with autocast(self.device, self.config.precision):
                fine, coarse = render.render_mixed(self.field, styles, frozen, directions, background, look.mix)
        depth, depth_coarse = surface_distance(segments, torch.cat([fine.s, coarse.s], dim=-1)).split(1, dim=-1)
        return {
            "rgb": fine.rgb,
            "rgb_coarse": coarse.rgb,
            "accumulation": fine.accumulation,
            "depth": depth,
            "accumulation_coarse": coarse.accumulation,
            "depth_coarse": depth_coarse,
        }

    @torch.no_grad()
    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: RayBundle) -> Dict[str, Tensor]:
        """`get_outputs` of a picture, [H, W, channels] each; a baked one takes more rays at once than an exact one."""
        if self.display.look.mode != "baked" or self.training:
            return super().get_outputs_for_camera_ray_bundle(camera_ray_bundle)
        rays = camera_ray_bundle.to(self.device).flatten()
        parts = [self(rays[start : start + BAKED_RAYS]) for start in range(0, len(rays), BAKED_RAYS)]
        return {name: torch.cat([part[name] for part in parts]).view(*camera_ray_bundle.shape, -1) for name in parts[0]}

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
        metrics["content_ssim"] = structural_similarity(outputs["rgb"], photo)
        return metrics, {"img": torch.cat([photo, outputs["rgb_coarse"], outputs["rgb"]], dim=1)}

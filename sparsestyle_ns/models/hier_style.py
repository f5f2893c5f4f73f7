"""`hier-style`: the coarse field, frozen, and the residual field that stylises it (stage 2)."""

import contextlib
import threading
from dataclasses import dataclass, field, replace
from typing import Any, Callable, Dict, Iterator, List, Literal, Optional, Tuple, Type

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.models.base_model import ModelConfig
from torch import Tensor, nn
from torch.nn import Parameter

from sparsestyle_ns.core.occupancy import Occupancy, march
from sparsestyle_ns.core.precision import Precision, autocast
from sparsestyle_ns.core.spaces import ForwardFacingSpace, Segments
from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.field_components.point_encodings import FrequencyEncoding, NoEncoding, PointEncoding
from sparsestyle_ns.field_components.tiny_cuda_grid import TinyCudaGrid, has_tiny_cuda_nn
from sparsestyle_ns.fields.fine_tuned import FineTunedField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.metrics.image import image_metrics
from sparsestyle_ns.models.coarse_fewshot import CoarseFieldConfig
from sparsestyle_ns.models.scene_model import SceneModel
from sparsestyle_ns.rendering.baked import BakedVolume, Rays, render_baked
from sparsestyle_ns.rendering.frozen_view import FrozenView, split_by_samples
from sparsestyle_ns.rendering.mixing import STYLISED, Mix
from sparsestyle_ns.rendering.render import (
    POINTS_PER_CALL,
    FrozenSamples,
    PackedRender,
    freeze_samples,
    render_mixed,
    render_stylised,
    straight_color,
)
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import bar
from sparsestyle_ns.utils.untraced import untraced

RAYS_PER_CALL = 1 << 13
"""Rays that are marched at once; bounds the memory of the steps in empty space."""
RenderMode = Literal["exact", "baked"]
RENDER_MODES: Tuple[RenderMode, ...] = ("exact", "baked")
MOST_BAKED = 4
"""Styles whose baked volumes are kept, the latest that were shown."""
AHEAD = ((0.0, 0.0, -1.0),)
"""Where cameras of a forward-facing scene look."""
ALL_AROUND = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))


@dataclass
class HierStyleModelConfig(ModelConfig):
    """Settings of the stylised field."""

    _target: Type = field(default_factory=lambda: HierStyleModel)
    enable_collider: bool = False
    """Unused: the space of the scene decides where rays start and end."""
    coarse_field: CoarseFieldConfig = field(default_factory=CoarseFieldConfig)
    """The coarse field; taken over from the coarse run."""
    stylised_field: Literal["residual", "coarse"] = "residual"
    """What is stylised: the residual field on the frozen coarse one (Eq. 2 and 3), or a copy of the coarse field
    itself, fine-tuned as ARF does; then the settings of the residual field mean nothing."""
    fine_encoding: Literal["auto", "hash", "tiny-cuda-nn", "frequency", "none"] = "auto"
    """What the residual field sees of a position beside e_c: the hash grid ψ(x) with our kernels, or as tiny-cuda-nn
    has it, which auto takes on a GPU where that library is installed; sines and cosines of `frequency_levels` octaves;
    or nothing."""
    frequency_levels: int = 10
    """Octaves of the sines and cosines, where they take the hash grid's place."""
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
    residual_density_scale: float = 10.0
    """Unit of the residual density, per half side of the scene's cube."""
    num_steps: int = 128
    """Even steps along a ray; those in empty cells are skipped."""
    occupancy_resolution: int = 128
    """Cells along a side of the grid that says what is empty, where empty space is skipped."""
    min_alpha: float = 0.03
    """Opacity over a cell's side, in (0, 1), below which the coarse field counts as empty there."""
    min_transmittance: float = 1e-3
    """Share of light left, in (0, 1), below which samples farther along the ray are dropped."""
    precision: Precision = "auto"
    """Number format of matrix products: auto is bfloat16 where the device multiplies it, else float32; tf32 is for
    GPUs."""
    render_mode: RenderMode = "exact"
    """How pictures are made outside of training. baked keeps the fields in a voxel grid, filled where rays come by: a
    scene's first picture takes as long as an exact one, those from near by a small part of that, also on a CPU. The
    viewer has a control for it; for ns-render, write `render_mode: baked` into the run's config.yml."""
    strength: float = 1.0
    """From 0, the coarse field, to 1, the stylised one, in pictures made outside of training. The viewer has controls
    for this and the next; for ns-render, write them into the run's config.yml, as render_mode."""
    geometry_strength: float = 1.0
    """Share of the residual density, 0 to 1, that these pictures show."""
    bake_resolution: int = 256
    """Cells along the cube's side in baked rendering. Each brick of 8³ that rays have been to takes 4 KiB: at most
    147 MB with 256, 482 MB with 384."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once outside of training."""


@dataclass(frozen=True)
class Look:
    """How pictures are made, and of what.

    Attributes:
        mode: exact or baked.
        mix: how much of each field they show.
        styles: the stylised fields, one or two, on the model's device; None: the model's own.
    """

    mode: RenderMode
    mix: Mix
    styles: Optional[Tuple[nn.Module, ...]] = None


class HierStyleModel(SceneModel):
    """(σ_f, c_f) on top of a frozen (σ_c, e_c, c_c). Its state holds all that rendering needs."""

    config: HierStyleModelConfig

    def populate_modules(self) -> None:
        """Builds both fields, and the grid that says what is empty."""
        super().populate_modules()
        effects, config = self.effects, self.config
        if config.fine_encoding == "auto":  # kept in the config, so that a run is opened as what it was trained as
            is_there = has_tiny_cuda_nn(self._built_for(), config.features_per_level)
            config.fine_encoding = "tiny-cuda-nn" if is_there else "hash"
        self.field = config.coarse_field.setup(effects).requires_grad_(False)
        residual = config.stylised_field == "residual"
        self.residual = self._residual_field(effects) if residual else self._fine_tuned_field(effects)
        self.occupancy = Occupancy(config.occupancy_resolution) if effects.on("empty_space") else None
        if self.exposure is not None:
            self.exposure.requires_grad_(False)
        self.look = Look(config.render_mode, self._configured_mix())
        self.viewer_look: Callable[[], Optional[Look]] = lambda: None
        self._baked: Dict[nn.Module, Tuple[BakedVolume, List[Tensor]]] = {}
        self._baking = threading.Lock()  # volumes grow while they are rendered, and a viewer has several threads

    def _configured_mix(self) -> Mix:
        config = self.config
        for name in ("strength", "geometry_strength"):
            if not 0.0 <= getattr(config, name) <= 1.0:
                flag = name.replace("_", "-")
                raise InputError(f"--pipeline.model.{flag} is {getattr(config, name)}; give a number from 0 to 1.")
        return Mix(config.strength, config.geometry_strength)

    def new_style(self) -> nn.Module:
        """A field to be stylised, as it is before training, on the model's device."""
        if self.config.stylised_field == "residual":
            return self._residual_field(self.effects).to(self.device)
        style = self._fine_tuned_field(self.effects).to(self.device)
        style.field.load_state_dict(self.field.state_dict())
        return style

    def _residual_field(self, effects: Decisions) -> ResidualField:
        config = self.config
        return ResidualField(
            self._fine_encoding(),
            config.coarse_field.feature_dim,
            config.hidden_layers,
            config.layer_width,
            config.residual_density_scale,
            effects.on("residual_density"),
        )

    def _fine_encoding(self) -> PointEncoding:
        config = self.config
        if config.fine_encoding == "none":
            return NoEncoding()
        if config.fine_encoding == "frequency":
            return FrequencyEncoding(config.frequency_levels)
        shape = (
            config.hash_levels,
            config.min_resolution,
            config.max_resolution,
            config.features_per_level,
            config.log2_table_size,
        )
        if config.fine_encoding == "tiny-cuda-nn":
            return TinyCudaGrid(*shape, device=self._built_for())
        return HashGrid(*shape)

    def _built_for(self) -> torch.device:
        """The device that the pipeline names when it has the model made."""
        return torch.device(self.kwargs.get("device", "cpu"))

    def _fine_tuned_field(self, effects: Decisions) -> FineTunedField:
        return FineTunedField(self.config.coarse_field.setup(effects))

    def get_param_groups(self) -> Dict[str, List[Parameter]]:
        """One group, `fields`: the field that is stylised. The coarse field is frozen."""
        return {"fields": list(self.residual.parameters())}

    @torch.no_grad()
    def adopt_coarse(self, state: Dict[str, Tensor]) -> None:
        """Takes over a coarse model's field, space and exposures, and finds out which cells are empty.

        Args:
            state: the state of a `CoarseFewShotModel` with the same settings of the field and of the space.
        """
        for name in ("field", "space", "exposure"):
            if getattr(self, name) is None:
                continue
            part = {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(name + ".")}
            getattr(self, name).load_state_dict(part, strict=True)
        self.field.to(self.device)
        if isinstance(self.residual, FineTunedField):
            self.residual.field.load_state_dict(self.field.state_dict())
        if self.occupancy is None:
            return
        cells = self.config.occupancy_resolution**3
        with autocast(self.device, self.config.precision), bar("Finding empty space", cells, unit="cells") as finding:

            def density(points: Tensor) -> Tensor:
                values = self.field.density_and_feature(points)[0]
                finding.advance(len(points))
                return values

            self.occupancy.measure(density, self.config.min_alpha, POINTS_PER_CALL)

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

    def stylised(
        self, frozen: FrozenSamples, coarse_geometry: bool = False, style: Optional[nn.Module] = None
    ) -> PackedRender:
        """Renders σ_f, or with `coarse_geometry` σ_c, and c_f at frozen samples; differentiable.

        Args:
            style: the stylised field; None: the model's own.
        """
        with autocast(self.device, self.config.precision):
            return render_stylised(style or self.residual, frozen, self.background, coarse_geometry)

    def bake(self, resolution: int, style: Optional[nn.Module] = None) -> BakedVolume:
        """The fields as they are now, to be kept in a voxel grid; nothing is evaluated before rays are rendered.

        c_c, where it depends on the view direction, is that of a camera that looks straight ahead in a forward-facing
        scene, and elsewhere the mean over the directions of the axes; c_f and the densities depend on no direction.
        """
        seen_from = ALL_AROUND
        if self.field.direction_encoding is None or isinstance(self.space, ForwardFacingSpace):
            seen_from = AHEAD
        directions = torch.tensor(seen_from, device=self.device)
        residual = style or self.residual

        def shade(points: Tensor) -> Tensor:
            with autocast(self.device, self.config.precision):
                density, feature = self.field.density_and_feature(points)
                feature = feature.float()
                fine_density, fine_color = residual(residual.locate(points), feature, density)
                colors = [self.field.color(feature, direction.expand_as(points)) for direction in directions]
                color = torch.stack(colors).mean(dim=0)
            return torch.cat([density[:, None], fine_density[:, None], fine_color, color], dim=-1)

        return BakedVolume(shade, resolution, self.device)

    def kept_volume(self, style: nn.Module) -> Optional[BakedVolume]:
        """The baked volume of a style's next picture; None where that picture would start a new one, because it is the
        style's first, its weights have changed, or `MOST_BAKED` other styles were shown since the last."""
        return self._volume_of(style, self._state_of_weights(style))

    def _volume_of(self, style: nn.Module, state: List[Tensor]) -> Optional[BakedVolume]:
        volume, known = self._baked.get(style, (None, []))
        return volume if volume is not None and all(map(torch.equal, known, state)) else None

    def _current_volume(self, style: nn.Module) -> BakedVolume:
        """A style's baked volume, a new one whenever what it shows has changed since the last picture."""
        state = self._state_of_weights(style)
        volume = self._volume_of(style, state)
        if volume is None:
            volume = self.bake(self.config.bake_resolution, style)
        # The viewer may break a picture off between any two lines; here that loses nothing.
        self._baked = {
            **{each: kept for each, kept in self._baked.items() if each is not style},
            style: (volume, state),
        }
        for oldest in list(self._baked)[:-MOST_BAKED]:
            del self._baked[oldest]
        return volume

    def _state_of_weights(self, style: nn.Module) -> List[Tensor]:
        """What changes with every change of the weights that a style's pictures show, and is quick to compare.

        torch counts the changes of each tensor, but not those that fused optimisers make; these change every parameter
        of the residual MLP.
        """
        frozen = [part for part in (self.field, self.space, self.occupancy) if isinstance(part, nn.Module)]
        tensors = [tensor for part in (*frozen, style) for tensor in (*part.parameters(), *part.buffers())]
        versions = torch.tensor([(tensor.data_ptr(), tensor._version) for tensor in tensors])
        values = [parameter for name, parameter in style.named_parameters() if not name.startswith("grid")]
        return [versions, torch.cat([value.detach().flatten() for value in values])]

    def _render_baked(self, segments: Segments, styles: Tuple[nn.Module, ...], mix: Mix) -> Tuple[PackedRender, ...]:
        config = self.config
        rays = Rays(segments, self.occupancy, config.num_steps, self.space.unbounded, config.min_transmittance)
        with self._baking:
            first, second = (*map(self._current_volume, styles), None)[:2]
            return render_baked(first, rays, self.background, mix, second)

    def fill_baked(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], style: nn.Module
    ) -> None:
        """Works out what baked pictures of a style need along these rays, for later."""
        self._render_baked(self.space.segments(origins, directions), (style,), STYLISED)

    def _render_exact(self, ray_bundle: RayBundle, styles: Tuple[nn.Module, ...], mix: Mix) -> Tuple[PackedRender, ...]:
        frozen = self.freeze(ray_bundle.origins, ray_bundle.directions)
        with autocast(self.device, self.config.precision):
            return render_mixed(self.field, styles, frozen, ray_bundle.directions, self.background, mix)

    @untraced
    def get_outputs(self, ray_bundle: RayBundle) -> Dict[str, Tensor]:
        """`rgb` (stylised), `accumulation`, `depth` in world units, and the same of the coarse field as `…_coarse`."""
        segments = self.space.segments(ray_bundle.origins, ray_bundle.directions)
        look = self.viewer_look() or self.look
        styles = look.styles or (self.residual,)
        if look.mode == "baked" and not self.training:
            fine, coarse = self._render_baked(segments, styles, look.mix)
        else:
            fine, coarse = self._render_exact(ray_bundle, styles, look.mix)
        return {
            "rgb": fine.rgb,
            "rgb_coarse": coarse.rgb,
            "accumulation": fine.accumulation,
            "depth": segments.distance(fine.s.clamp(max=1.0 - 1e-4)),
            "accumulation_coarse": coarse.accumulation,
            "depth_coarse": segments.distance(coarse.s.clamp(max=1.0 - 1e-4)),
        }

    @contextlib.contextmanager
    def rendering(self, mode: RenderMode) -> Iterator[None]:
        """Within it, pictures are made in this mode, whatever the model's own is; those for the viewer as it says."""
        before, self.look = self.look, replace(self.look, mode=mode)
        try:
            yield
        finally:
            self.look = before

    def get_rgba_image(self, outputs: Dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Colour without background, and opacity, for `ns-export tsdf` and ns-render's output rgba.

        Opacity is the stylised geometry's, for `rgb_coarse` too.
        """
        color = straight_color(outputs[output_name], outputs["accumulation"], self.background)
        return torch.cat([color, outputs["accumulation"]], dim=-1)

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

"""Volume rendering of the fields: segments and fields in, pixels out."""

import itertools
from dataclasses import dataclass
from typing import Optional, Sequence, Tuple

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.core.occupancy import PackedSamples, interval_lengths
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.core.volrend import dense_weights, optical_depth, packed_sum, packed_weights
from sparsestyle_ns.field_components.hash_grid import GridLocation
from sparsestyle_ns.field_components.thinned_mlp import Thinning
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.rendering.few_samples import cut_into_stretches
from sparsestyle_ns.rendering.mixing import STYLISED, Appearance, Mix, mixed
from sparsestyle_ns.rendering.visible_samples import Marching, visible_samples

Background = Optional[Float[Tensor, "3"]]
"""The colour behind the scene; None where there is none, which shows as black."""
POINTS_PER_CALL = 1 << 17
"""Points at which a frozen field is evaluated at once; bounds the memory of its hidden layers."""
NO_WEIGHT = 1e-10
"""Rays with an accumulation of at most this have no surface and no colour."""


@dataclass
class PackedRender:
    """Pixels."""

    rgb: Float[Tensor, "rays 3"]
    """Background included."""
    accumulation: Float[Tensor, "rays 1"]
    """Σw, the share of the ray that is not background."""
    s: Float[Tensor, "rays 1"]
    """Where the ray's weight lies on average, in [0, 1]; 1 without weight."""


@dataclass
class DenseRender(PackedRender):
    """Pixels of the coarse field, with w, σ and the field coordinates of the samples that its losses are of."""

    weights: Float[Tensor, "rays samples"]
    density: Float[Tensor, "rays samples"]
    positions: Float[Tensor, "rays samples 3"]


def seen_behind(accumulation: Float[Tensor, "rays 1"], background: Background) -> Float[Tensor, "rays 3"]:
    """The part of rays' colours that is background; 0 where there is none."""
    return torch.zeros_like(accumulation).expand(-1, 3) if background is None else (1.0 - accumulation) * background


def over_background(
    rgb: Float[Tensor, "rays 3"], accumulation: Float[Tensor, "rays 1"], background: Background
) -> Float[Tensor, "rays 3"]:
    """Colour in front of a background colour; unchanged where there is none."""
    return rgb if background is None else rgb + (1.0 - accumulation) * background


def straight_color(
    rgb: Float[Tensor, "*batch 3"], accumulation: Float[Tensor, "*batch 1"], background: Background
) -> Float[Tensor, "*batch 3"]:
    """The scene's own colour, in [0, 1]: the inverse of `over_background`, and black where a ray has no weight."""
    own = rgb if background is None else rgb - (1.0 - accumulation) * background
    color = torch.where(accumulation > NO_WEIGHT, own / accumulation.clamp(min=NO_WEIGHT), 0.0)
    return color.clamp(0.0, 1.0)


def mean_position(weights: Float[Tensor, "rays samples"], s: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays 1"]:
    """Σ w s / Σ w; 1, the segment's end, where a ray has no weight."""
    return _mean((weights * s).sum(dim=-1, keepdim=True), weights.sum(dim=-1, keepdim=True))


def _mean(moment: Float[Tensor, "rays 1"], total: Float[Tensor, "rays 1"]) -> Float[Tensor, "rays 1"]:
    return torch.where(total > NO_WEIGHT, moment / total.clamp(min=NO_WEIGHT), 1.0)


def surface_distance(segments: Segments, s: Float[Tensor, "rays points"]) -> Float[Tensor, "rays points"]:
    """Depth pictures: distance of s from the camera, in world units; s = 1 may be infinitely far, so a bit less."""
    return segments.distance(s.clamp(max=1.0 - 1e-4))


def render_coarse(
    field: CoarseField,
    segments: Segments,
    directions: Float[Tensor, "rays 3"],
    edges: Float[Tensor, "rays edges"],
    unbounded: bool,
    background: Background,
    thinning: Optional[Thinning] = None,
) -> DenseRender:
    """Renders the coarse field with the samples that `edges` bound (Eq. 1; NeRF, Eq. 3)."""
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    positions = segments.positions(middle)
    density, feature = field.density_and_feature(positions, thinning)
    color = field.color(feature, directions[:, None].expand_as(positions))
    weights = dense_weights(optical_depth(density, interval_lengths(segments, edges, unbounded)))
    accumulation = weights.sum(dim=-1, keepdim=True)
    rgb = over_background((weights[..., None] * color).sum(dim=-2), accumulation, background)
    return DenseRender(rgb, accumulation, mean_position(weights, middle), weights, density, positions)


@dataclass
class FrozenSamples:
    """What the stylised field needs of a batch of rays and training doesn't change: samples, σ_c and e_c there.

    Where a sample stands for a stretch of its ray (`few_samples`), σ_c is the stretch's mean.
    """

    samples: PackedSamples
    density: Float[Tensor, "samples"]
    feature: Float[Tensor, "samples feature"]
    location: GridLocation
    num_rays: int

    @property
    def num_bytes(self) -> int:
        """Memory that keeping these samples takes."""
        return sum(part.nbytes for part in (*self.samples, self.density, self.feature)) + self.location.num_bytes

    @staticmethod
    def joined(parts: Sequence["FrozenSamples"], stylised: StylisedField) -> "FrozenSamples":
        """Batches of rays one after another."""
        if len(parts) == 1:
            return parts[0]
        firsts = itertools.accumulate((part.num_rays for part in parts[:-1]), initial=0)
        moved = [
            part.samples._replace(ray_indices=part.samples.ray_indices + first)
            for part, first in zip(parts, firsts, strict=True)
        ]
        samples = PackedSamples(*map(torch.cat, zip(*moved, strict=True)))
        density, feature = (torch.cat([getattr(part, name) for part in parts]) for name in ("density", "feature"))
        num_rays = sum(part.num_rays for part in parts)
        return FrozenSamples(samples, density, feature, stylised.locate(samples.positions), num_rays)


@torch.no_grad()
def freeze_samples(
    field: CoarseField, stylised: StylisedField, segments: Segments, marching: Marching
) -> FrozenSamples:
    """Finds the samples of a batch of rays that can show, and evaluates the frozen coarse field there."""
    samples, density, feature = frozen_field(field, segments, marching)
    return FrozenSamples(samples, density, feature, stylised.locate(samples.positions), len(segments.hit))


@torch.no_grad()
def frozen_field(
    field: CoarseField, segments: Segments, marching: Marching
) -> Tuple[PackedSamples, Float[Tensor, "samples"], Float[Tensor, "samples feature"]]:
    """The samples of a batch of rays, with σ_c and e_c: few, or every step that can show."""
    if marching.few is None:
        return visible_samples(field.density_and_feature, segments, marching)
    stretches = cut_into_stretches(segments, marching.few, marching.num_steps, marching.unbounded, marching.occupancy)
    density, feature = field.density_and_feature(stretches.samples.positions)
    return stretches.samples, stretches.density(marching.few.volume, density), feature


@torch.no_grad()
def render_frozen(
    field: CoarseField,
    segments: Segments,
    directions: Float[Tensor, "rays 3"],
    marching: Marching,
    background: Background,
) -> PackedRender:
    """The coarse field alone, which doesn't learn any more."""
    samples, density, feature = frozen_field(field, segments, marching)
    color = field.color(feature, directions[samples.ray_indices])
    return render_packed(samples, len(segments.hit), density, color, background)


def accumulation_of(frozen: FrozenSamples) -> Float[Tensor, "rays 1"]:
    """Σw of the coarse field on each ray."""
    depth = optical_depth(frozen.density, frozen.samples.lengths)
    weights = packed_weights(depth, frozen.samples.ray_indices, frozen.num_rays)
    return packed_sum(weights[:, None], frozen.samples.ray_indices, frozen.num_rays)


def render_packed(
    samples: PackedSamples,
    num_rays: int,
    density: Float[Tensor, "samples"],
    color: Float[Tensor, "samples 3"],
    background: Background,
) -> PackedRender:
    """Composites packed samples of known density and colour; the packed twin of `render_coarse`."""
    weights = packed_weights(optical_depth(density, samples.lengths), samples.ray_indices, num_rays)[:, None]
    values = torch.cat([color, torch.ones_like(weights), samples.s[:, None]], dim=-1)
    return composite(packed_sum(weights * values, samples.ray_indices, num_rays), background)


def composite(sums: Float[Tensor, "rays 5"], background: Background) -> PackedRender:
    """Pixels from a ray's sums of w times colour, of w, and of w times s."""
    rgb, accumulation, moment = sums.split([3, 1, 1], dim=-1)
    return PackedRender(over_background(rgb, accumulation, background), accumulation, _mean(moment, accumulation))


def render_stylised(
    stylised: StylisedField, frozen: FrozenSamples, background: Background, coarse_geometry: bool = False
) -> PackedRender:
    """Renders σ_f, or with `coarse_geometry` σ_c, and c_f (Eq. 2 and 3); differentiable in the stylised field."""
    density, color = stylised(frozen.location, frozen.feature, frozen.density)
    if coarse_geometry:
        density = frozen.density
    return render_packed(frozen.samples, frozen.num_rays, density, color, background)


@torch.no_grad()
def render_mixed(
    field: CoarseField,
    styles: Sequence[StylisedField],
    frozen: FrozenSamples,
    directions: Float[Tensor, "rays 3"],
    background: Background,
    mix: Mix = STYLISED,
) -> Tuple[PackedRender, PackedRender]:
    """The render of a mixture of the coarse field and of one or two styles, and the coarse one, at frozen samples."""
    coarse = Appearance(frozen.density, field.color(frozen.feature, directions[frozen.samples.ray_indices]))
    found = [Appearance(*style(frozen.location, frozen.feature, frozen.density)) for style in styles]
    render = render_packed(frozen.samples, frozen.num_rays, *mixed(coarse, found, mix), background)
    return render, render_packed(frozen.samples, frozen.num_rays, *coarse, background)

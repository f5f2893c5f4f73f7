"""Volume rendering of the two fields: segments and fields in, pixels out."""

from dataclasses import dataclass
from typing import List, Optional, Sequence, Tuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sparsestyle_ns.core.occupancy import Occupancy, PackedSamples, interval_lengths, march
from sparsestyle_ns.core.spaces import Segments
from sparsestyle_ns.core.volrend import (
    dense_weights,
    optical_depth,
    packed_sum,
    packed_weights,
)
from sparsestyle_ns.field_components.hash_grid import GridLocation
from sparsestyle_ns.field_components.thinned_mlp import Thinning
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.rendering.mixing import STYLISED, Appearance, Mix, mixed


@dataclass
class DenseRender:
    """What `render_coarse` finds on each ray.

    Attributes:
        rgb: colour, background included.
        accumulation: Σw, the share of the ray that is not background.
        s: where the ray's weight lies on average, in [0, 1].
        weights: w of each sample.
        density: σ of each sample.
        positions: field coordinates of each sample.
    """

    rgb: Float[Tensor, "rays 3"]
    accumulation: Float[Tensor, "rays 1"]
    s: Float[Tensor, "rays 1"]
    weights: Float[Tensor, "rays samples"]
    density: Float[Tensor, "rays samples"]
    positions: Float[Tensor, "rays samples 3"]


POINTS_PER_CALL = 1 << 17
"""Points at which a frozen field is evaluated at once; bounds the memory of its hidden layers."""
SAMPLES_PER_PASS = 6
"""Samples of a ray that are evaluated before looking whether it goes on."""


def seen_behind(
    accumulation: Float[Tensor, "rays 1"], background: Optional[Float[Tensor, "3"]]
) -> Float[Tensor, "rays 3"]:
    """The part of rays' colours that is background; 0 where there is none."""
    return torch.zeros_like(accumulation).expand(-1, 3) if background is None else (1.0 - accumulation) * background


def over_background(
    rgb: Float[Tensor, "rays 3"], accumulation: Float[Tensor, "rays 1"], background: Optional[Float[Tensor, "3"]]
) -> Float[Tensor, "rays 3"]:
    """Colour in front of a background colour; unchanged where there is none."""
    return rgb if background is None else rgb + (1.0 - accumulation) * background


def straight_color(
    rgb: Float[Tensor, "*batch 3"], accumulation: Float[Tensor, "*batch 1"], background: Optional[Float[Tensor, "3"]]
) -> Float[Tensor, "*batch 3"]:
    """The scene's own colour, in [0, 1], from a render in front of a background: the inverse of `over_background`.

    Black where a ray has no weight.
    """
    own = rgb if background is None else rgb - (1.0 - accumulation) * background
    return torch.where(accumulation > 1e-10, own / accumulation.clamp(min=1e-10), 0.0).clamp(0.0, 1.0)


def mean_position(weights: Float[Tensor, "rays samples"], s: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays 1"]:
    """Σ w s / Σ w; 1, the segment's end, where a ray has no weight."""
    total = weights.sum(dim=-1, keepdim=True)
    return torch.where(total > 1e-10, (weights * s).sum(dim=-1, keepdim=True) / total.clamp(min=1e-10), 1.0)


def render_coarse(
    field: CoarseField,
    segments: Segments,
    directions: Float[Tensor, "rays 3"],
    edges: Float[Tensor, "rays edges"],
    unbounded: bool,
    background: Optional[Float[Tensor, "3"]],
    thinning: Optional[Thinning] = None,
) -> DenseRender:
    """Renders the coarse field with the samples that `edges` bound (Eq. 1; NeRF, Eq. 3).

    Args:
        thinning: of the field's backward pass; None: all samples are in it.
    """
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    positions = segments.positions(middle)
    density, feature = field.density_and_feature(positions, thinning)
    color = field.color(feature, directions[:, None].expand_as(positions))
    weights = dense_weights(optical_depth(density, interval_lengths(segments, edges, unbounded)))
    accumulation = weights.sum(dim=-1, keepdim=True)
    rgb = (weights[..., None] * color).sum(dim=-2)
    return DenseRender(
        rgb=over_background(rgb, accumulation, background),
        accumulation=accumulation,
        s=mean_position(weights, middle),
        weights=weights,
        density=density,
        positions=positions,
    )


@dataclass
class FrozenSamples:
    """All that the residual field needs of a batch of rays and that training it doesn't change.

    Attributes:
        samples: where the samples are.
        density: σ_c there.
        feature: e_c there.
        location: where they lie in the hash grid.
        num_rays: of the batch.
    """

    samples: PackedSamples
    density: Float[Tensor, "samples"]
    feature: Float[Tensor, "samples feature"]
    location: GridLocation
    num_rays: int

    @property
    def num_bytes(self) -> int:
        """Memory that keeping these samples takes."""
        parts = [*self.samples, self.density, self.feature]
        return sum(part.numel() * part.element_size() for part in parts) + self.location.num_bytes


@torch.no_grad()
def freeze_samples(
    field: CoarseField,
    residual: ResidualField,
    occupancy: Optional[Occupancy],
    segments: Segments,
    num_steps: int,
    unbounded: bool,
    min_transmittance: float,
) -> FrozenSamples:
    """Finds the samples of a batch of rays that can show, and evaluates the frozen coarse field there."""
    samples, density, feature = visible_samples(field, occupancy, segments, num_steps, unbounded, min_transmittance)
    return FrozenSamples(samples, density, feature, residual.locate(samples.positions), len(segments.hit))


def visible_samples(
    field: CoarseField,
    occupancy: Optional[Occupancy],
    segments: Segments,
    num_steps: int,
    unbounded: bool,
    min_transmittance: float,
) -> Tuple[PackedSamples, Float[Tensor, "samples"], Float[Tensor, "samples feature"]]:
    """The samples of a batch of rays that can show, and σ_c and e_c there.

    Samples lie in occupied cells, where a grid says which are, and in front of them at least `min_transmittance` of the
    light is left.
    """
    samples = march(segments, occupancy, num_steps, unbounded)
    index, density, feature = evaluate_front_to_back(field, samples, len(segments.hit), min_transmittance)
    return samples.select(index), density, feature


def evaluate_front_to_back(
    field: CoarseField, samples: PackedSamples, num_rays: int, min_transmittance: float
) -> Tuple[Int[Tensor, "seen"], Float[Tensor, "seen"], Float[Tensor, "seen feature"]]:
    """σ_c and e_c of those packed samples in front of which more than `min_transmittance` of the light is left.

    A few samples of each ray are evaluated at a time, and none of a ray that has ended.

    The same samples come out each time, on a GPU too: a view that is frozen again in the backward pass has to have
    them. So depths aren't added up by threads that race, as `index_add_` and sums over all samples are there.

    Returns:
        Which samples these are, ascending, and σ_c and e_c there.
    """
    on_ray = samples.ray_indices
    counts = torch.bincount(on_ray, minlength=num_rays)
    rank = torch.arange(len(on_ray), device=on_ray.device) - (torch.cumsum(counts, dim=0) - counts)[on_ray]
    depth = samples.s.new_zeros(num_rays)
    found: List[Tuple[Tensor, Tensor, Tensor]] = []
    for first in range(0, max(1, int(counts.max())), SAMPLES_PER_PASS):
        goes_on = torch.exp(-depth) > min_transmittance
        in_pass = (rank >= first) & (rank < first + SAMPLES_PER_PASS) & goes_on[on_ray]
        index = in_pass.nonzero().squeeze(-1)
        density, feature = field.density_and_feature(samples.positions[index])
        place = on_ray[index], rank[index] - first
        depths = depth.new_zeros(num_rays, SAMPLES_PER_PASS)
        depths[place] = optical_depth(density, samples.lengths[index])
        behind = depth[:, None] + depths.cumsum(dim=1)
        in_front = torch.cat([depth[:, None], behind[:, :-1]], dim=1)
        seen = torch.exp(-in_front)[place] > min_transmittance
        depth = behind[:, -1]
        found.append((index[seen], density[seen], feature[seen].float()))
    index, density, feature = (torch.cat(parts) for parts in zip(*found, strict=True))
    order = torch.argsort(index)
    return index[order], density[order], feature[order]


def accumulation_of(frozen: FrozenSamples) -> Float[Tensor, "rays 1"]:
    """Σw of the coarse field on each ray."""
    depth = optical_depth(frozen.density, frozen.samples.lengths)
    weights = packed_weights(depth, frozen.samples.ray_indices, frozen.num_rays)
    return packed_sum(weights[:, None], frozen.samples.ray_indices, frozen.num_rays)


@dataclass
class PackedRender:
    """What `render_stylised` finds on each ray: colour with background, Σw, and where the weight lies on average."""

    rgb: Float[Tensor, "rays 3"]
    accumulation: Float[Tensor, "rays 1"]
    s: Float[Tensor, "rays 1"]


def render_packed(
    samples: PackedSamples,
    num_rays: int,
    density: Float[Tensor, "samples"],
    color: Float[Tensor, "samples 3"],
    background: Optional[Float[Tensor, "3"]],
) -> PackedRender:
    """Composites packed samples of known density and colour; the packed twin of `render_coarse`."""
    weights = packed_weights(optical_depth(density, samples.lengths), samples.ray_indices, num_rays)[:, None]
    values = torch.cat([color, torch.ones_like(weights), samples.s[:, None]], dim=-1)
    return composite(packed_sum(weights * values, samples.ray_indices, num_rays), background)


def composite(sums: Float[Tensor, "rays 5"], background: Optional[Float[Tensor, "3"]]) -> PackedRender:
    """Pixels from a ray's sums of w times colour, of w, and of w times s."""
    rgb, accumulation, moment = sums.split([3, 1, 1], dim=-1)
    s = torch.where(accumulation > 1e-10, moment / accumulation.clamp(min=1e-10), 1.0)
    return PackedRender(over_background(rgb, accumulation, background), accumulation, s)


def render_stylised(
    residual: ResidualField,
    frozen: FrozenSamples,
    background: Optional[Float[Tensor, "3"]],
    coarse_geometry: bool = False,
) -> PackedRender:
    """Renders σ_f and c_f (Eq. 2 and 3) at frozen samples; differentiable in the residual field.

    With `coarse_geometry`, σ_c takes the place of σ_f.
    """
    density, color = residual(frozen.location, frozen.feature, frozen.density)
    if coarse_geometry:
        density = frozen.density
    return render_packed(frozen.samples, frozen.num_rays, density, color, background)


@torch.no_grad()
def render_mixed(
    field: CoarseField,
    styles: Sequence[nn.Module],
    frozen: FrozenSamples,
    directions: Float[Tensor, "rays 3"],
    background: Optional[Float[Tensor, "3"]],
    mix: Mix = STYLISED,
) -> Tuple[PackedRender, PackedRender]:
    """The render of a mixture of the fields, by default the stylised one, and the coarse render, at frozen samples.

    Args:
        styles: one or two fields that give σ_f and c_f, as `ResidualField` does.
        mix: how much of each field counts.
    """
    coarse = Appearance(frozen.density, field.color(frozen.feature, directions[frozen.samples.ray_indices]))
    found = [Appearance(*style(frozen.location, frozen.feature, frozen.density)) for style in styles]
    render = render_packed(frozen.samples, frozen.num_rays, *mixed(coarse, found, mix), background)
    return render, render_packed(frozen.samples, frozen.num_rays, *coarse, background)

import math
from dataclasses import fields

import pytest
import reference
import torch
from nerfstudio.data.scene_box import SceneBox
from torch.utils._python_dispatch import TorchDispatchMode

from sparsestyle_ns.core.occupancy import DensityVolume, Occupancy
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace
from sparsestyle_ns.core.volrend import optical_depth, packed_transmittance
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.rendering.render import (
    accumulation_of,
    freeze_samples,
    mean_position,
    over_background,
    render_coarse,
    render_mixed,
    render_stylised,
)
from sparsestyle_ns.rendering.visible_samples import Marching

RAYS, STEPS, FEATURES = 14, 12, 4
WHITE = torch.ones(3)
SPACES = {
    "box": BoxSpace(SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))),
    "contracted": ContractedSpace(),
}


class BallField(CoarseField):
    """A coarse field that is truly empty outside a ball."""

    def density_and_feature(self, positions):
        density, feature = super().density_and_feature(positions)
        return density * (positions.norm(dim=-1) < 0.4), feature


@pytest.fixture
def coarse():
    torch.manual_seed(0)
    return CoarseField(num_levels=3, num_layers=2, layer_width=16, feature_dim=FEATURES, direction_levels=2)


@pytest.fixture
def ball():
    torch.manual_seed(0)
    return BallField(
        num_levels=3, num_layers=2, layer_width=16, feature_dim=FEATURES, direction_levels=2, density_bias=4.0
    )


@pytest.fixture
def residual():
    torch.manual_seed(1)
    field = ResidualField(HashGrid(2, 4, 8, 2, 8, init_scale=1.0), FEATURES, layer_width=16)
    torch.nn.init.normal_(field.density_head.weight)
    return field


@pytest.fixture
def rays():
    """Rays from a sphere about the cube; all but the last three go through it."""
    generator = torch.Generator().manual_seed(2)
    origins = 3 * torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=generator), dim=-1)
    aim = torch.rand(RAYS, 3, generator=generator) - 0.5
    aim[-3:] += 9
    return origins, torch.nn.functional.normalize(aim - origins, dim=-1)


def freeze(coarse, residual, rays, space="box", occupancy=None, min_transmittance=0.0):
    occupancy = Occupancy(4) if occupancy is None else occupancy
    space = SPACES[space]
    marching = Marching(occupancy, STEPS, space.unbounded, min_transmittance)
    return freeze_samples(coarse, residual, space.segments(*rays), marching)


def slow_render(space, rays, shade, background):
    """Colour, Σw and mean position of each ray; `shade` gives densities and colours of a ray's points."""
    segments = SPACES[space].segments(*rays)
    edges = torch.linspace(0, 1, STEPS + 1)
    s = (edges[1:] + edges[:-1]) / 2
    pixels = []
    for ray in range(RAYS):
        density, color = shade(segments.positions(s.expand(RAYS, -1))[ray], rays[1][ray].expand(STEPS, 3))
        lengths = segments.lengths(edges.expand(RAYS, -1))[ray].tolist()
        if SPACES[space].unbounded:
            lengths[-1] = 1e9
        if not segments.hit[ray]:
            lengths = [0.0] * STEPS
        depths = [d * length for d, length in zip(density.tolist(), lengths, strict=True)]
        color, opacity, mean = reference.pixel(depths, color.tolist(), s.tolist(), background or (0.0, 0.0, 0.0))
        pixels.append([*color, opacity, mean])
    return torch.tensor(pixels)


def assert_render(render, expected):
    """Compares colour, accumulation and mean position; float32 sums of a dozen numbers up to 1."""
    found = torch.cat([render.rgb, render.accumulation, render.s], dim=-1)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("background", [None, (1.0, 0.5, 0.0)])
@pytest.mark.parametrize("space", ["box", "contracted"])
@torch.no_grad()
def test_the_packed_stylised_view_is_the_slow_dense_one_when_everything_is_occupied(
    space, background, coarse, residual, rays
):
    def shade(points, _):
        density, feature = coarse.density_and_feature(points)
        hidden = residual.mlp(torch.cat([residual.grid(0.5 * points + 0.5), feature], dim=-1))
        # Eq. 3 with the negative sums cut off.
        density = (density + residual.density_head(hidden)[:, 0]).clamp(min=0)
        return density, torch.sigmoid(residual.color_head(hidden))

    render = render_stylised(
        residual, freeze(coarse, residual, rays, space), None if background is None else torch.tensor(background)
    )
    assert_render(render, slow_render(space, rays, shade, background))


@pytest.mark.parametrize("background", [None, (1.0, 0.5, 0.0)])
@pytest.mark.parametrize("space", ["box", "contracted"])
@torch.no_grad()
def test_the_coarse_view_is_the_slow_one_dense_and_packed(space, background, coarse, residual, rays):
    def shade(points, directions):
        density, feature = coarse.density_and_feature(points)
        return density, coarse.color(feature, directions)

    expected = slow_render(space, rays, shade, background)
    color = None if background is None else torch.tensor(background)
    segments = SPACES[space].segments(*rays)
    edges = even_edges(RAYS, STEPS, torch.device("cpu"))
    dense = render_coarse(coarse, segments, rays[1], edges, SPACES[space].unbounded, color)
    assert_render(dense, expected)
    torch.testing.assert_close(dense.weights.sum(dim=-1, keepdim=True), dense.accumulation)
    frozen = freeze(coarse, residual, rays, space)
    assert_render(render_mixed(coarse, [residual], frozen, rays[1], color)[1], expected)
    torch.testing.assert_close(accumulation_of(frozen), dense.accumulation)


def test_with_coarse_geometry_only_the_colour_is_stylised(coarse, residual, rays):
    frozen = freeze(coarse, residual, rays)
    stylised = render_stylised(residual, frozen, WHITE)
    colored = render_stylised(residual, frozen, WHITE, coarse_geometry=True)
    torch.testing.assert_close(colored.accumulation, accumulation_of(frozen))
    assert (stylised.accumulation - colored.accumulation).abs().max() > 0.01
    colored.rgb.sum().backward()
    assert not residual.density_head.weight.grad.any()  # both heads are one product
    assert residual.color_head.weight.grad.abs().sum() > 0


@torch.no_grad()
def test_skipping_cells_that_are_empty_does_not_change_the_picture(ball, residual, rays):
    residual.density_head = None
    occupancy = Occupancy(16)
    volume = DensityVolume(16)
    volume.measure(lambda points: ball.density_and_feature(points)[0], chunk=4096)
    occupancy.measure(volume, min_alpha=1e-3)
    assert 0 < occupancy.share < 0.5
    everything, skipped = freeze(ball, residual, rays), freeze(ball, residual, rays, occupancy=occupancy)
    assert 0 < len(skipped.density) < 0.7 * len(everything.density)
    pictures = (render_mixed(ball, [residual], frozen, rays[1], WHITE) for frozen in (everything, skipped))
    for one, other in zip(*pictures, strict=True):
        assert one.accumulation.max() > 0.5
        for field in fields(one):
            torch.testing.assert_close(getattr(other, field.name), getattr(one, field.name))


@torch.no_grad()
def test_dropping_samples_behind_a_surface_changes_a_picture_by_no_more_than_the_light_that_gets_there(
    coarse, residual, rays
):
    residual.density_head = None
    coarse.density_bias = 2.0
    whole, cut = freeze(coarse, residual, rays), freeze(coarse, residual, rays, min_transmittance=0.05)
    assert 0 < len(cut.density) < len(whole.density)
    difference = (render_stylised(residual, cut, None).rgb - render_stylised(residual, whole, None).rgb).abs().max()
    assert 0 < difference <= 0.05


@torch.no_grad()
@pytest.mark.parametrize("min_transmittance", [0.5, 0.05, 1e-3])
def test_stopping_rays_early_leaves_exactly_the_samples_that_light_reaches(coarse, residual, rays, min_transmittance):
    coarse.density_bias = 2.0
    whole = freeze(coarse, residual, rays)
    depth = optical_depth(whole.density, whole.samples.lengths)
    reached = packed_transmittance(depth, whole.samples.ray_indices, whole.num_rays) > min_transmittance
    early = freeze(coarse, residual, rays, min_transmittance=min_transmittance)
    assert torch.equal(early.samples.s, whole.samples.s[reached])
    assert torch.equal(early.samples.ray_indices, whole.samples.ray_indices[reached])
    torch.testing.assert_close(early.density, whole.density[reached])
    torch.testing.assert_close(early.feature, whole.feature[reached])


class RacingSums(TorchDispatchMode):
    """Notes sums that a GPU makes in no fixed order: atomic ones, and running ones over one long row."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
        name, first = str(function), arguments[0] if arguments else None
        atomic = any(word in name for word in ("index_add", "scatter_add"))
        running = "cumsum" in name and first.is_floating_point() and first.dim() == 1
        if atomic or running:
            self.found.append(name)
        return function(*arguments, **(keywords or {}))


def test_a_view_that_is_frozen_again_has_the_same_samples_on_a_gpu_too(coarse, residual, rays):
    """Else the backward pass of a chunk that wasn't kept would meet other shapes than the forward pass."""
    with RacingSums() as sums:
        freeze(coarse, residual, rays, "contracted", min_transmittance=0.05)
    assert sums.found == []
    with RacingSums() as sums:
        accumulation_of(freeze(coarse, residual, rays))
    assert sums.found  # what the watch is for does happen elsewhere


def test_no_gradient_reaches_the_frozen_field(coarse, residual, rays):
    render_stylised(residual, freeze(coarse, residual, rays), WHITE).rgb.sum().backward()
    assert all(parameter.grad is None for parameter in coarse.parameters())
    assert all(parameter.grad.abs().sum() > 0 for parameter in residual.parameters())


def test_an_unbounded_view_with_holes_has_gradients_of_ordinary_size(coarse, residual, rays):
    torch.nn.init.constant_(residual.density_head.bias, -20.0)
    render = render_stylised(residual, freeze(coarse, residual, rays, "contracted"), None)
    assert render.accumulation.max() == 0
    # Every σ_f is 0; the loss wants the picture brighter, and so every density larger.
    (1 - render.rgb).square().sum().backward()
    # A dozen samples on each of 14 rays, of lengths up to 2, and a squared error of at most 1.
    assert 0 < residual.density_head.bias.grad.abs().item() < 1e4


@pytest.mark.parametrize("background", [None, WHITE])
@pytest.mark.parametrize("learned", [True, False])
def test_a_view_without_any_sample_is_all_background(background, learned, coarse, residual, rays):
    origins, directions = rays
    with torch.set_grad_enabled(learned):
        render = render_stylised(residual, freeze(coarse, residual, (origins, -directions)), background)
    assert (render.rgb == (0 if background is None else 1)).all()
    assert (render.accumulation == 0).all()
    assert (render.s == 1).all()


def test_rays_past_the_scene_show_the_background_at_the_end_of_the_ray(coarse, residual, rays):
    background = torch.tensor([0.2, 0.4, 0.6])
    render = render_stylised(residual, freeze(coarse, residual, rays), background)
    torch.testing.assert_close(render.rgb[-3:], background.expand(3, -1))
    assert render.accumulation[-3:].tolist() == [[0], [0], [0]]
    assert render.s[-3:].tolist() == [[1], [1], [1]]


def test_a_background_shows_through_as_far_as_there_is_nothing_before_it():
    rgb, accumulation = torch.tensor([[0.1, 0.2, 0.3]]), torch.tensor([[0.75]])
    composite = over_background(rgb, accumulation, torch.tensor([1.0, 0.0, 0.5]))
    torch.testing.assert_close(composite, torch.tensor([[0.35, 0.2, 0.425]]))
    assert over_background(rgb, accumulation, None) is rgb


def test_the_mean_position_is_where_the_weight_lies():
    s = torch.tensor([[0.1, 0.5, 0.9]]).expand(3, -1)
    weights = torch.tensor([[0.0, 0.7, 0.0], [0.1, 0.0, 0.3], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(mean_position(weights, s), torch.tensor([[0.5], [0.7], [1.0]]))


@pytest.mark.parametrize("total", [1e-3, 1e-9, 1e-12, 1e-20])
def test_the_mean_position_of_the_thinnest_haze_is_not_at_the_camera(total):
    # Where its weight lies, or at the end of the ray as without any weight.
    s = mean_position(total * torch.tensor([[0.5, 0.5]]), torch.tensor([[0.6, 0.8]])).item()
    assert s == pytest.approx(0.7) or s == 1


def test_the_memory_of_frozen_samples_is_that_of_their_tensors(coarse, residual, rays):
    frozen = freeze(coarse, residual, rays)
    samples = 11 * STEPS
    assert frozen.num_rays == RAYS and len(frozen.density) == samples
    # Ray index (8 bytes), s, length, three coordinates in the cube and three in the hash grid, density and four
    # features (4 bytes each).
    assert frozen.num_bytes == samples * (8 + 4 * (1 + 1 + 3 + 3 + 1 + FEATURES))


def test_infinite_intervals_make_every_unbounded_ray_opaque(coarse, residual, rays):
    frozen = freeze(coarse, residual, rays, "contracted")
    assert (frozen.samples.lengths == math.inf).sum() == RAYS
    torch.testing.assert_close(accumulation_of(frozen), torch.ones(RAYS, 1))

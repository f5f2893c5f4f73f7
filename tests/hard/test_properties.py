"""What holds for every input of the public functions of rendering, encodings, losses and style, whatever its size.

Every public function of those packages has a property here, or is named with the reason why not;
`test_every_public_function_has_a_property` looks for those that were forgotten.
"""

import importlib
import inspect
import itertools
import math
import pkgutil

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
import torch
from conftest import decided
from hypothesis import assume, given
from hypothesis import strategies as st
from nerfstudio.data.scene_box import SceneBox
from PIL import Image
from reference import ndc_points
from torch.nn.functional import normalize

import sparsestyle_ns.core
import sparsestyle_ns.field_components
import sparsestyle_ns.losses
import sparsestyle_ns.rendering
import sparsestyle_ns.style
from sparsestyle_ns.core import feature_maps as maps_of
from sparsestyle_ns.core import ndc, precision, rotations, sampling, schedules, similarity, sliced, triangulation
from sparsestyle_ns.core import occupancy as density_grid
from sparsestyle_ns.core import spaces as space
from sparsestyle_ns.core import volrend as compositing
from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.effects.layouts import build_space
from sparsestyle_ns.field_components import (
    blocked_mlp,
    color_map,
    hash_grid,
    hash_grid_kernels,
    positional_encoding,
    thinned_mlp,
    tiny_cuda_grid,
)
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.losses import coarse as coarse_losses
from sparsestyle_ns.losses import content, nnfm, structure, style_index
from sparsestyle_ns.losses import stylization as targets
from sparsestyle_ns.rendering import baked, frozen_view, mixing, visible_samples
from sparsestyle_ns.rendering import render as volume
from sparsestyle_ns.style import backbones, color, palette
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.device_sizes import SIZES

PACKAGES = [
    sparsestyle_ns.core,
    sparsestyle_ns.rendering,
    sparsestyle_ns.field_components,
    sparsestyle_ns.losses,
    sparsestyle_ns.style,
]
COVERED = set()
ELSEWHERE = {
    "sparsestyle_ns.field_components.hash_grid_triton": "needs CUDA or Triton's interpreter: test_hash_grid.py",
    "sparsestyle_ns.rendering.baked_kernels.march_rays": "is what march_compiled calls",
    "sparsestyle_ns.core.camera_paths": "takes cameras of a scene: test_camera_paths.py and test_camera_geometry.py",
    "sparsestyle_ns.core.pinhole": "takes a camera: test_pinhole.py",
    "sparsestyle_ns.core.schedules": "test_schedules.py and test_hard_schedules.py",
    "sparsestyle_ns.losses.stylization.default_weights": "takes no input: test_stylization.py",
    "sparsestyle_ns.losses.style_index.check_style": "refuses, and returns nothing: test_nnfm.py",
    "sparsestyle_ns.style.backbones": "reads weight files: test_vgg.py",
    "sparsestyle_ns.field_components.tiny_cuda_grid.has_tiny_cuda_nn": "asks what is installed: test_hier_style.py",
    "sparsestyle_ns.rendering.few_samples_kernels.cut_rays": "is what cut_into_stretches calls on a CPU",
    "sparsestyle_ns.rendering.lines": "takes segments, and parts of kernels are compiled in them: test_lines.py",
    "sparsestyle_ns.rendering.few_samples": "takes a volume of a field's densities: test_few_samples.py",
    "sparsestyle_ns.rendering.render.frozen_field": "is what freeze_samples and render_frozen call",
    "sparsestyle_ns.rendering.render.render_frozen": "takes a volume of a field's densities: test_few_samples.py",
    "sparsestyle_ns.rendering.baked.clearance_of": "takes cells: test_baked.py",
    "sparsestyle_ns.rendering.baked.march_compiled": "is what render_baked calls on a CPU",
}
"""Modules and functions without a property of their own, and why."""

FLOATS = st.sampled_from([torch.float32, torch.float64])
ALL_FLOATS = st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64])
COUNTS = st.integers(1, 9)
SEEDS = st.integers(0, 2**31)


def covers(*functions):
    """Says which functions a property is of."""
    COVERED.update(f"{function.__module__}.{function.__name__}" for function in functions)
    return lambda test: test


def public_functions():
    for package in PACKAGES:
        for module_info in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
            if module_info.name in ELSEWHERE:
                continue
            module = importlib.import_module(module_info.name)
            for name, value in vars(module).items():
                function = getattr(value, "py_func", value)  # numba's dispatchers wrap theirs
                if inspect.isfunction(function) and function.__module__ == module.__name__ and name[0] != "_":
                    yield f"{module.__name__}.{name}"


def test_every_public_function_has_a_property():
    assert sorted(set(public_functions()) - COVERED - set(ELSEWHERE)) == []


@st.composite
def tensors(draw, shape, low=-30.0, high=30.0, signed=False, zeros=True, dtype=torch.float64):
    """Numbers whose logarithm to base 10 is even between `low` and `high`; some are 0."""
    generator = torch.Generator().manual_seed(draw(SEEDS))
    values = 10 ** (low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64))
    if zeros:
        values *= torch.rand(shape, generator=generator) > draw(st.sampled_from([0.0, 0.3, 1.0]))
    if signed:
        values *= torch.randint(0, 2, values.shape, generator=generator) * 2 - 1
    return values.to(dtype)


@st.composite
def unit_rays(draw):
    """Origins of up to 1e3 and directions of length 1, some along the axes."""
    count = draw(COUNTS)
    origins = draw(tensors((count, 3), -3, 3, signed=True, dtype=torch.float32))
    generator = torch.Generator().manual_seed(draw(SEEDS))
    directions = torch.randn(count, 3, generator=generator)
    directions = torch.where(torch.rand(count, 3, generator=generator) < 0.2, 0.0, directions)
    directions[directions.abs().amax(dim=-1) == 0] = torch.tensor([0.0, 0.0, -1.0])
    return origins, normalize(directions, dim=-1)


@st.composite
def spaces(draw):
    """A space and the scale of its world."""
    kind = draw(st.sampled_from(["ndc", "box", "contraction"]))
    scale = 10 ** draw(st.floats(-4, 4))
    aabb = torch.tensor([[-1.0, -0.7, -0.5], [0.8, 1.0, 0.6]])
    nearest = scale * 10 ** draw(st.floats(0, 1))
    ndc_map = NDC((1.5, 2.0), scale, (nearest, nearest * 10 ** draw(st.sampled_from([0, 1e-7, 0.5, 4]))))
    box = SceneBox(aabb=aabb if kind == "ndc" else scale * aabb)
    return build_space(decided(kind), box, ndc_map), scale


def packed_indices(draw, samples):
    """Ascending ray indices of packed samples, and the number of rays, some of which have none."""
    counts = draw(st.lists(st.integers(0, samples), min_size=1, max_size=5))
    return torch.arange(len(counts)).repeat_interleave(torch.tensor(counts)), len(counts)


# ---------------------------------------------------------------------------------------------------------------------
# rendering
# ---------------------------------------------------------------------------------------------------------------------


@covers(compositing.optical_depth, compositing.dense_weights)
@given(st.data(), COUNTS, st.integers(1, 200), ALL_FLOATS)
def test_weights_are_shares_of_the_light(data, num_rays, samples, dtype):
    density = data.draw(tensors((num_rays, samples), -30, 30, dtype=dtype)).requires_grad_()
    interval = data.draw(tensors((num_rays, samples), -8, 1, dtype=dtype))
    interval[data.draw(st.booleans()) * num_rays :, -1] = torch.inf
    depth = compositing.optical_depth(density, interval)
    weights = compositing.dense_weights(depth)
    assert (depth >= 0).all() and (depth <= compositing.MAX_OPTICAL_DEPTH).all()
    assert (weights >= 0).all() and weights.sum(dim=-1).max() <= 1 + 1e-6
    assert weights.shape == density.shape and weights.dtype == torch.promote_types(dtype, torch.float32)
    (gradient,) = torch.autograd.grad(weights.square().sum(), density)
    assert gradient.isfinite().all()


@covers(compositing.packed_transmittance, compositing.packed_weights, compositing.packed_sum, compositing.ray_borders)
@given(st.data(), st.integers(0, 60), ALL_FLOATS)
def test_packed_samples_are_the_dense_ones_of_each_ray(data, samples, dtype):
    ray_indices, num_rays = packed_indices(data.draw, samples)
    depth = data.draw(tensors((len(ray_indices),), -30, 1.9, dtype=dtype)).requires_grad_()
    light = compositing.packed_transmittance(depth, ray_indices, num_rays)
    weights = compositing.packed_weights(depth, ray_indices, num_rays)
    counts = torch.bincount(ray_indices, minlength=num_rays).tolist()
    assert compositing.ray_borders(ray_indices, num_rays).diff().tolist() == counts
    expected = torch.cat([compositing.dense_weights(ray) for ray in depth.split(counts)])
    torch.testing.assert_close(weights, expected, rtol=1e-4, atol=1e-7)
    assert (light >= 0).all() and (light <= 1 + 1e-6).all()
    sums = compositing.packed_sum(weights[:, None], ray_indices, num_rays)
    assert sums.shape == (num_rays, 1) and (sums <= 1 + 1e-6).all()
    (gradient,) = torch.autograd.grad(sums.sum(), depth)
    assert gradient.isfinite().all() and (gradient >= -1e-6).all()


@covers(compositing.effective_samples, compositing.distortion)
@given(st.data(), COUNTS, st.integers(1, 100), FLOATS)
def test_the_spread_of_weights_is_a_number_in_its_range(data, num_rays, samples, dtype):
    weights = data.draw(tensors((num_rays, samples), -35, 0, dtype=dtype))
    weights = weights / weights.sum(dim=-1, keepdim=True).clamp(min=1.0)
    edges = data.draw(tensors((num_rays, samples + 1), -9, 0, dtype=dtype)).sort(dim=-1).values
    weights.requires_grad_()
    counted, spread = compositing.effective_samples(weights), compositing.distortion(weights, edges)
    has_weight = weights.sum(dim=-1) > 0
    assert (counted[~has_weight] == 0).all() and (counted[has_weight] >= 1 - 1e-4).all()
    assert (counted <= samples * (1 + 1e-4)).all()
    assert (spread >= 0).all() and (spread <= 1 + 1e-5).all()
    for value in (counted, spread):
        (gradient,) = torch.autograd.grad(value.sum(), weights)
        assert gradient.isfinite().all() or value is counted


@covers(sampling.even_edges, sampling.sample_pdf)
@given(st.data(), COUNTS, st.integers(1, 300), st.integers(1, 300), st.booleans())
def test_borders_ascend_from_0_to_1(data, num_rays, bins, samples, jitter):
    generator = torch.Generator().manual_seed(data.draw(SEEDS)) if jitter else None
    even = sampling.even_edges(num_rays, bins, torch.device("cpu"), generator)
    masses = data.draw(tensors((num_rays, bins), -30, 30, dtype=torch.float32))
    masses[:, data.draw(st.integers(0, bins - 1))] += 1e-20
    for edges in (even, sampling.sample_pdf(even, masses, samples, generator)):
        assert (edges.diff(dim=-1) >= 0).all()
        assert (edges[:, 0] == 0).all() and (edges[:, -1] == 1).all()


@covers(ndc.ndc_rays, ndc.ndc_distance, ndc.ndc_parameter)
@given(st.data(), COUNTS, st.floats(1e-3, 1e3), FLOATS)
def test_points_of_a_ray_have_their_images_on_the_rays_image(data, count, near, dtype):
    origins = data.draw(tensors((count, 3), -3, 1, signed=True, dtype=dtype)) * near
    directions = data.draw(tensors((count, 3), -2, 2, signed=True, dtype=dtype))
    directions[:, 2] = -directions[:, 2].abs()
    origins.requires_grad_()
    start, extent, valid = ndc.ndc_rays(origins, directions, (1.5, 2.0), near)
    t = data.draw(tensors((count, 1), -3, 0, dtype=dtype)).clamp(max=0.9)
    distance = ndc.ndc_distance(t, origins, directions, near, max_distance=1e6 * near)
    images = ndc_points(origins + distance * directions, (1.5, 2.0), near)
    back = ndc.ndc_parameter(distance, origins, directions, near)
    for values in (start, extent, distance, images, back):
        assert values.isfinite().all()
    assert (back <= 1).all()
    (gradient,) = torch.autograd.grad(start.sum() + extent.sum() + distance.sum() + images.sum(), origins)
    assert gradient.isfinite().all()
    # Rounding of the largest coordinates of a point, seen from its depth.
    plain = valid & (directions[:, 2:].abs() * 10 > directions.abs().amax(dim=-1, keepdim=True))
    size = (
        1
        + images.detach().abs().amax(dim=-1, keepdim=True)
        + (origins.detach().abs() / near).amax(dim=-1, keepdim=True)
    )
    assert ((images - start - t * extent).abs() <= 1e-3 * size)[plain.squeeze(-1)].all()


@covers(space.spacing, space.inverse_spacing, space.contract, space.uncontract)
@given(st.data(), COUNTS, FLOATS)
def test_contraction_and_spacing_stay_in_their_ranges(data, count, dtype):
    points = data.draw(tensors((count, 3), -37, 38, signed=True, dtype=dtype)).requires_grad_()
    bent = space.contract(points)
    shown = points.abs().amax(dim=-1) < 0.01 * space.MAX_DISTANCE  # farther away digits are lost
    torch.testing.assert_close(space.uncontract(bent)[shown], points[shown], rtol=1e-3, atol=1e-6)
    assert space.uncontract(bent).abs().max() <= space.MAX_DISTANCE * (1 + 1e-6)
    (gradient,) = torch.autograd.grad(bent.sum(), points)
    assert bent.abs().max() <= 1 and gradient.isfinite().all()
    distances = points.detach().abs().flatten()
    spaced = space.spacing(distances)
    assert (spaced >= 0).all() and (spaced <= 1).all()
    near = distances < 100
    torch.testing.assert_close(space.inverse_spacing(spaced)[near], distances[near], rtol=1e-4, atol=0)
    assert space.inverse_spacing(spaced).max() <= space.MAX_DISTANCE * (1 + 1e-6)


@covers(space.intersect_box, density_grid.interval_lengths)
@given(st.data(), spaces(), unit_rays(), st.integers(1, 64))
def test_segments_are_numbers_in_any_space(data, scene, rays, samples):
    layout, scale = scene
    origins, directions = scale * rays[0], rays[1]
    segments = layout.segments(origins, directions)
    edges = sampling.even_edges(len(origins), samples, origins.device, torch.Generator().manual_seed(data.draw(SEEDS)))
    positions = segments.positions(edges)
    lengths = density_grid.interval_lengths(segments, edges, layout.unbounded)
    distance = segments.distance(edges[:, :1])
    assert positions.isfinite().all() and distance.isfinite().all()
    assert (lengths >= 0).all() and (lengths[~segments.hit] == 0).all()
    assert lengths[:, :-1].isfinite().all() and (lengths[:, -1].isinf() <= segments.hit).all()
    entry, leave, hit = space.intersect_box(origins, directions, -torch.ones(3), torch.ones(3), near=0.1)
    assert (leave >= entry).all() and (entry >= 0.1).all() and leave.isfinite().all()
    assert torch.equal(hit[:, None], leave > entry)


@covers(density_grid.grid_cells, density_grid.march)
@given(spaces(), unit_rays(), st.integers(1, 9), st.integers(1, 40))
def test_samples_lie_in_occupied_cells(scene, rays, resolution, steps):
    layout, scale = scene
    origins, directions = scale * rays[0], rays[1]
    segments = layout.segments(origins, directions)
    occupancy = density_grid.Occupancy(resolution)
    occupancy.occupied.copy_(
        torch.rand(resolution, resolution, resolution, generator=torch.Generator().manual_seed(0)) < 0.5
    )
    samples = density_grid.march(segments, occupancy, steps, layout.unbounded)
    cells = density_grid.grid_cells(samples.positions, resolution)
    assert (cells >= 0).all() and (cells < resolution).all()
    assert (samples.ray_indices.diff() >= 0).all() and segments.hit[samples.ray_indices].all()
    in_cells = occupancy.contains(samples.positions)
    assert (in_cells | samples.lengths.isinf()).all()
    assert (samples.lengths >= 0).all() and samples.positions.isfinite().all()


@covers(volume.over_background, volume.seen_behind, volume.straight_color, volume.mean_position, volume.composite)
@given(st.data(), COUNTS, st.integers(1, 50))
def test_pixels_of_weights_are_mixtures(data, num_rays, samples):
    depth = data.draw(tensors((num_rays, samples), -30, 2, dtype=torch.float32)).clamp(max=80)
    weights = compositing.dense_weights(depth)
    s = torch.linspace(0, 1, samples).expand(num_rays, -1)
    accumulation = weights.sum(dim=-1, keepdim=True)
    background = torch.rand(3, generator=torch.Generator().manual_seed(data.draw(SEEDS)))
    pixel = volume.over_background(accumulation * 0.5, accumulation, background)
    assert (pixel >= -1e-6).all() and (pixel <= 1 + 1e-6).all()
    torch.testing.assert_close(pixel - volume.seen_behind(accumulation, background), 0.5 * accumulation.expand(-1, 3))
    assert (volume.seen_behind(accumulation, None) == 0).all()
    half = accumulation.expand(-1, 3) * 0.5
    for behind in (background, None):
        own = volume.straight_color(volume.over_background(half, accumulation, behind), accumulation, behind)
        assert (own >= 0).all() and (own <= 1).all()
        shown = accumulation.expand(-1, 3) > 0.01
        torch.testing.assert_close(own[shown], torch.full_like(own, 0.5)[shown], rtol=0, atol=1e-4)
    mean = volume.mean_position(weights, s)
    assert (mean >= 0).all() and (mean <= 1 + 1e-5).all()
    sums = torch.cat([accumulation.expand(-1, 3) * 0.5, accumulation, (weights * s).sum(dim=-1, keepdim=True)], dim=-1)
    render = volume.composite(sums, background)
    torch.testing.assert_close(render.rgb, pixel)
    torch.testing.assert_close(render.s, mean, rtol=1e-5, atol=1e-5)


def tiny_fields(seed, bias):
    torch.manual_seed(seed)
    field = CoarseField(num_layers=1, layer_width=8, feature_dim=4, direction_levels=2, density_bias=bias)
    grid = hash_grid.HashGrid(2, 4, 8, 2, 6, init_scale=1.0)
    return field, ResidualField(grid, 4, 1, 8, density_scale=10.0)


@covers(
    volume.render_coarse,
    volume.freeze_samples,
    visible_samples.visible_samples,
    volume.accumulation_of,
    volume.render_packed,
    volume.render_stylised,
    volume.render_mixed,
    volume.surface_distance,
    baked.shade_of,
    precision.autocast,
    precision.multiplies_bfloat16,
    precision.multiplies_tf32,
)
@given(
    SEEDS,
    spaces(),
    unit_rays(),
    st.integers(1, 30),
    st.floats(-50, 1e9),
    st.sampled_from(["float32", "tf32", "bfloat16", "auto"]),
)
def test_renders_of_any_field_are_pictures(seed, scene, rays, steps, bias, number_format):
    layout, scale = scene
    origins, directions = scale * rays[0], rays[1]
    field, residual = tiny_fields(seed, bias)
    segments = layout.segments(origins, directions)
    background = torch.rand(3)
    assert precision.multiplies_bfloat16(origins.device) in (True, False)
    assert not precision.multiplies_tf32(origins.device)
    with precision.autocast(origins.device, number_format):
        edges = sampling.even_edges(len(origins), steps, origins.device)
        coarse = volume.render_coarse(field, segments, directions, edges, layout.unbounded, background)
        marching = visible_samples.Marching(density_grid.Occupancy(2), steps, layout.unbounded, 1e-3)
        frozen = volume.freeze_samples(field, residual, segments, marching)
        stylised = volume.render_stylised(residual, frozen, background)
        also, again = volume.render_mixed(field, [residual], frozen, directions, background)
    (coarse.rgb.square().sum() + stylised.rgb.square().sum()).backward()
    assert torch.equal(also.rgb, stylised.rgb)
    for render in (coarse, stylised, again):
        assert (render.rgb >= -1e-6).all() and (render.rgb <= 1 + 1e-5).all()
        assert (render.accumulation <= 1 + 1e-6).all() and (render.s >= 0).all() and (render.s <= 1 + 1e-5).all()
        depth = volume.surface_distance(segments, render.s)
        assert depth.isfinite().all() and (depth >= 0).all()
    with torch.no_grad():
        shaded = baked.shade_of(field, residual, layout, number_format)(2 * torch.rand(5, 3) - 1)
    assert (shaded >= 0).all() and (shaded[:, 2:] <= 1).all()
    torch.testing.assert_close(volume.accumulation_of(frozen), again.accumulation)
    # What lies behind 1e-3 of the light is left out; bfloat16 rounds logits at the samples of one render alone.
    if number_format in ("float32", "tf32"):
        torch.testing.assert_close(again.rgb, coarse.rgb, rtol=0, atol=2e-3)
    for parameter in [*field.parameters(), *residual.parameters()]:
        assert parameter.grad is None or parameter.grad.isfinite().all()


@covers(baked.encode, baked.decode)
@given(st.data(), COUNTS)
def test_codes_keep_densities_to_a_step_and_colours_to_half_a_byte(data, count):
    values = torch.cat([data.draw(tensors((count, 2), -30, 30)), torch.rand(count, 6).double()], dim=-1).float()
    decoded = baked.decode(baked.encode(values).float())
    density, found = values[:, :2].clamp(max=baked.MAX_DENSITY), decoded[:, :2]
    assert torch.equal(found > 0, density > 0)
    step = math.expm1(baked.DENSITY_STEP)
    assert ((found - density).abs() <= step * (density + baked.DENSITY_UNIT)).all()
    assert (decoded[:, 2:] - values[:, 2:]).abs().max() <= 0.5 / 255 + 1e-6


@covers(baked.render_baked, baked.march_in_torch)
@given(SEEDS, spaces(), unit_rays(), st.integers(1, 12), st.integers(1, 9))
def test_baked_renders_are_pictures(seed, scene, rays, steps, resolution):
    layout, scale = scene
    segments = layout.segments(scale * rays[0], rays[1])
    generator = torch.Generator().manual_seed(seed)
    logs = torch.randn(2, generator=generator)

    def shade(points):
        density = torch.exp(3 * logs + (4 * points).sin().sum(dim=-1, keepdim=True))
        return torch.cat([density, (points.repeat(1, 2) + 1) / 2], dim=-1)

    marching = visible_samples.Marching(density_grid.Occupancy(2), steps, layout.unbounded, 1e-3)
    device = torch.device("cpu")
    compiled = baked.render_baked([baked.BakedVolume(shade, resolution, device)], segments, marching, torch.ones(3))
    plain = baked.march_in_torch([baked.BakedVolume(shade, resolution, device)], segments, marching, torch.ones(3))
    for left, right in zip(compiled, plain, strict=True):
        assert (left.rgb >= -1e-6).all() and (left.rgb <= 1 + 1e-5).all()
        # A sample within rounding of a cell's border, or of 1e-3 of the light, may count in one of them alone.
        torch.testing.assert_close(left.accumulation, right.accumulation, rtol=0, atol=2e-3)


@covers(mixing.interpolate, mixing.mixed)
@given(SEEDS, COUNTS, st.floats(0, 1), st.floats(0, 1), st.floats(0, 1), st.floats(-10, 30))
def test_mixtures_of_fields_lie_between_them(seed, count, strength, geometry, blend, log_density):
    generator = torch.Generator().manual_seed(seed)
    densities = torch.rand(3, count, generator=generator) * 10.0**log_density
    colors = torch.rand(3, count, 3, generator=generator)
    coarse, *styles = map(mixing.Appearance, densities, colors)
    found = mixing.mixed(coarse, styles, mixing.Mix(strength, geometry, blend))
    for values, result in ((densities, found.density), (colors, found.color)):
        assert (result >= values.amin(dim=0) * (1 - 1e-5)).all() and (result <= values.amax(dim=0) * (1 + 1e-5)).all()


@covers(frozen_view.equal_runs)
@given(st.integers(0, 5000), st.integers(-5, 6000))
def test_runs_of_rays_are_all_rays_in_order(num_rays, limit):
    runs = frozen_view.equal_runs(num_rays, limit)
    rays = [ray for run in runs for ray in range(run.start, run.stop)]
    assert rays == list(range(num_rays))
    assert all(run.stop - run.start <= max(1, limit) for run in runs)


@covers(blocked_mlp.blocked_mlp)
@given(st.integers(0, 60), st.integers(1, 70), st.integers(0, 5), st.integers(0, 3), st.floats(0, 5), SEEDS)
def test_blocks_of_points_have_the_values_of_the_layers(count, block, width, depth, threshold, seed):
    torch.manual_seed(seed)
    sizes = [width + 2, *[7] * (depth + 1)]
    hidden = [torch.nn.Linear(*pair, dtype=torch.float64) for pair in itertools.pairwise(sizes)]
    heads = [torch.nn.Linear(7, channels, dtype=torch.float64) for channels in (3, 1)]
    inputs = [torch.randn(count, size, dtype=torch.float64) for size in (width, 2)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SIZES, "cpu", SIZES["cpu"]._replace(mlp_points=block))
        thinning = thinned_mlp.Thinning(threshold)
        found = blocked_mlp.blocked_mlp([inputs[0].requires_grad_(), inputs[1]], hidden, heads, thinning)
        (gradient,) = torch.autograd.grad(found.square().sum(), inputs[0])
    values = torch.cat(inputs, dim=-1)
    for layer in hidden:
        values = layer(values).relu()
    torch.testing.assert_close(found, torch.cat([head(values) for head in heads], dim=-1))
    assert gradient.shape == (count, width) and gradient.isfinite().all()


@covers(precision.at_least_float32, precision.without_autocast)
@given(ALL_FLOATS, COUNTS)
def test_full_precision_survives_autocast(dtype, count):
    values = torch.rand(count, count).to(dtype)
    full = precision.at_least_float32(values)
    assert full.dtype == torch.promote_types(dtype, torch.float32) and torch.equal(full.to(dtype), values)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert precision.without_autocast(torch.matmul)(full, full).dtype == full.dtype


# ---------------------------------------------------------------------------------------------------------------------
# encodings
# ---------------------------------------------------------------------------------------------------------------------


@covers(positional_encoding.positional_encoding, positional_encoding.revealed_levels)
@given(st.data(), COUNTS, st.integers(0, 12), ALL_FLOATS, st.floats(-1, 2))
def test_octaves_are_float64s_sines_and_cosines(data, count, levels, dtype, fraction):
    x = data.draw(tensors((count, 2), -30, 4, signed=True, dtype=dtype))
    encoded = positional_encoding.positional_encoding(x, levels)
    octaves = 2.0 ** torch.arange(levels, dtype=torch.float64)
    angles = x.double()[:, None] * octaves[:, None]
    expected = torch.cat([x.double(), torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(1)], dim=-1)
    torch.testing.assert_close(encoded.double(), expected, rtol=0, atol=1e-6)
    revealed = positional_encoding.revealed_levels(fraction, levels)
    assert (revealed >= 0).all() and (revealed <= 1).all() and (revealed.diff() <= 0).all()
    weighted = positional_encoding.positional_encoding(x, levels, revealed)
    assert (weighted.abs() <= encoded.abs()).all()


@covers(thinned_mlp.thin, thinned_mlp.thinned_mlp)
@given(st.data(), st.integers(0, 30), st.floats(0.01, 100.0), FLOATS, SEEDS)
def test_a_thinned_backward_pass_weights_points_up_and_stays_finite(data, count, threshold, dtype, seed):
    gradients = data.draw(tensors((count, 3), -30, 30, signed=True, dtype=dtype))
    thinning = thinned_mlp.Thinning(threshold, torch.Generator().manual_seed(seed))
    kept, weighted = thinned_mlp.thin(gradients, thinning)
    assert (kept.diff() > 0).all() and torch.isfinite(weighted).all()
    before, after = gradients[kept].double(), weighted.double()
    assert (after.abs() >= before.abs() * (1 - 1e-5)).all() and (after * before >= 0).all()
    # None counts for more than the limit, or than it did where it was above that.
    limit = threshold * gradients.double().norm(dim=-1).mean()
    assert (after.norm(dim=-1) <= torch.maximum(before.norm(dim=-1), limit) * (1 + 1e-5)).all()

    torch.manual_seed(seed)
    layer, head = torch.nn.Linear(4, 5, dtype=dtype), torch.nn.Linear(5, 3, dtype=dtype)
    inputs = data.draw(tensors((count, 4), -3, 3, signed=True, dtype=dtype))
    (output,) = thinned_mlp.thinned_mlp(inputs, [layer], [head], thinning)
    torch.testing.assert_close(output, head(torch.relu(layer(inputs))))
    (output.clamp(-1e3, 1e3).sum() * 1e-3).backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in (*layer.parameters(), *head.parameters()))


@covers(rotations.rotation_matrix)
@given(st.data(), COUNTS, FLOATS)
def test_a_turn_by_any_vector_is_a_rotation(data, count, dtype):
    vectors = data.draw(tensors((count, 3), -30, 6, signed=True, dtype=dtype)).requires_grad_()
    turns = rotations.rotation_matrix(vectors)
    unit = torch.eye(3, dtype=dtype).expand(count, 3, 3)
    # Angles of up to 1e6 radians have lost as many digits.
    tolerance = 1e-3 if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(turns @ turns.mT, unit, atol=tolerance, rtol=0)
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(count, dtype=dtype), atol=tolerance, rtol=0)
    turns.square().sum().backward()
    assert torch.isfinite(vectors.grad).all()


@covers(rotations.similarity_between)
@given(st.integers(1, 6), SEEDS, st.floats(1e-3, 1e3))
def test_a_similarity_between_any_cameras_is_one(count, seed, scale):
    generator = torch.Generator().manual_seed(seed)
    first, second = (
        torch.cat([rotations.rotation_matrix(vectors[..., 0]), scale * vectors[..., 1:]], dim=-1)
        for vectors in torch.randn(2, count, 3, 2, generator=generator, dtype=torch.float64)
    )
    found = rotations.similarity_between(first, second)
    assert found.scale > 0
    torch.testing.assert_close(found.rotation @ found.rotation.T, torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.det(found.rotation), torch.tensor(1.0, dtype=torch.float64))
    own = rotations.similarity_between(first, first).of_poses(first)
    torch.testing.assert_close(own, first, atol=1e-9 * scale, rtol=0)


@covers(triangulation.distances_to_meeting, triangulation.reprojection_errors)
@given(st.data(), COUNTS, FLOATS, SEEDS)
def test_errors_of_any_two_rays_are_angles_with_a_gradient(data, count, dtype, seed):
    generator = torch.Generator().manual_seed(seed)
    origins = data.draw(tensors((2, count, 3), -6, 6, signed=True, dtype=dtype)).requires_grad_()
    directions = normalize(torch.randn(2, count, 3, generator=generator, dtype=dtype), dim=-1).requires_grad_()
    distances = triangulation.distances_to_meeting(origins, directions)
    assert not distances.isnan().any()
    errors = triangulation.reprojection_errors(origins, directions, 0.0)
    assert ((errors >= 0) & (errors <= math.pi / 2 + 1e-6)).all()
    behind = (distances <= 0).any(dim=0)
    assert (errors[:, behind] == 0).all()
    errors.sum().backward()
    assert torch.isfinite(origins.grad).all() and torch.isfinite(directions.grad).all()


@covers(tiny_cuda_grid.growth_factor, tiny_cuda_grid.tiny_cuda_levels, tiny_cuda_grid.locate_tiny_cuda_corners)
@given(SEEDS, st.integers(1, 9), st.integers(1, 300), st.integers(1, 300), st.integers(3, 19))
def test_points_of_tiny_cuda_nns_grids_lie_in_their_levels_rows(seed, num_levels, first, second, log2_table_size):
    levels = tiny_cuda_grid.tiny_cuda_levels(num_levels, min(first, second), max(first, second), log2_table_size)
    assert len(levels) == num_levels
    assert all(level.first_row + level.num_rows == after.first_row for level, after in itertools.pairwise(levels))
    assert all(8 <= level.num_rows <= 2**log2_table_size and level.num_rows % 8 == 0 for level in levels)
    torch.manual_seed(seed)
    points = torch.cat([torch.rand(20, 3), torch.randint(0, 2, (4, 3)).float()])
    corners = tiny_cuda_grid.locate_tiny_cuda_corners(points, levels)
    starts = torch.tensor([level.first_row for level in levels])[:, None]
    ends = starts + torch.tensor([level.num_rows for level in levels])[:, None]
    assert ((corners.rows >= starts) & (corners.rows < ends)).all()
    assert (corners.weights >= 0).all()
    torch.testing.assert_close(corners.weights.sum(dim=-1), torch.ones(24, num_levels))


@covers(hash_grid.grid_resolutions)
@given(st.integers(1, 40), st.integers(1, 2**22), st.integers(1, 2**22))
def test_levels_grow_from_the_coarsest_to_the_finest(levels, first, second):
    lowest, highest = min(first, second), max(first, second)
    resolutions = hash_grid.grid_resolutions(levels, lowest, highest)
    assert len(resolutions) == levels and sorted(resolutions) == list(resolutions)
    assert resolutions[0] == lowest and (levels == 1 or resolutions[-1] == highest)


@covers(
    hash_grid.hash_corners,
    hash_grid.locate_corners,
    hash_grid.interpolate,
    hash_grid.fused_kernels,
    hash_grid_kernels.gather,
    hash_grid_kernels.scatter,
)
@given(st.data(), st.integers(0, 20), st.integers(1, 4), st.integers(1, 2**16), st.integers(0, 10), FLOATS)
def test_both_hash_grids_agree_and_stay_in_the_table(data, count, levels, highest, log2_size, dtype):
    features = data.draw(st.sampled_from([1, 4]))  # kernels are compiled for each length of a row
    resolutions = hash_grid.grid_resolutions(levels, 1, highest)
    size = 2**log2_size
    positions = data.draw(tensors((count, 3), -8, 0, dtype=dtype))
    table = data.draw(tensors((levels * size, features), -4, 4, signed=True, dtype=dtype)).requires_grad_()
    corners = hash_grid.locate_corners(positions, resolutions, size)
    assert (corners.rows >= 0).all() and (corners.rows < levels * size).all()
    torch.testing.assert_close(corners.weights.sum(dim=-1), torch.ones(count, levels, dtype=dtype))
    integers = (positions * highest).long()
    rows = hash_grid.hash_corners(integers, size)
    assert (rows >= 0).all() and (rows < size).all()
    encoded = hash_grid.interpolate(table, corners)
    kernels = hash_grid.fused_kernels(positions.device)
    by_level = table.detach().view(levels, size, features)
    gathered = kernels.gather(by_level, positions, resolutions)
    largest = table.detach().abs().max().item()
    tolerance = largest * (1e-5 if dtype == torch.float32 else 1e-12) + 1e-30
    torch.testing.assert_close(gathered, encoded.detach(), rtol=0, atol=tolerance)
    grad = torch.ones_like(encoded)
    (expected,) = torch.autograd.grad(encoded, table, grad)
    scattered = kernels.scatter(grad, positions, resolutions, by_level.shape)
    torch.testing.assert_close(scattered.view(table.shape), expected, rtol=1e-4, atol=1e-5)


# ---------------------------------------------------------------------------------------------------------------------
# losses
# ---------------------------------------------------------------------------------------------------------------------


@covers(nnfm.nearest_neighbors, nnfm.nnfm_loss, style_index.unit_vectors)
@given(st.data(), st.integers(1, 40), st.integers(1, 60), st.integers(1, 8), ALL_FLOATS, st.integers(1, 70))
def test_neighbours_are_the_most_similar(data, count, style_count, channels, dtype, chunk_size):
    largest = 4 if dtype == torch.float16 else 15
    features = data.draw(tensors((count, channels), -3, largest, signed=True, dtype=dtype)).requires_grad_()
    style = data.draw(tensors((style_count, channels), -3, largest, signed=True, dtype=dtype))
    index = style_index.StyleIndex(style, block_size=data.draw(COUNTS))
    directions = normalize(style.double(), dim=-1)
    similarities = normalize(features.detach().double(), dim=-1) @ directions.T
    for found in (nnfm.nearest_neighbors(features, style, chunk_size), index.nearest(features)):
        chosen = similarities.gather(1, found[:, None]).squeeze(1)
        assert (chosen >= similarities.amax(dim=1) - 1e-5).all()
    for target in (style, index):
        loss = nnfm.nnfm_loss(features, target)
        (gradient,) = torch.autograd.grad(loss, features)
        assert 0 <= loss <= 2 and gradient.isfinite().all()
        assert loss.item() == pytest.approx((1 - similarities.amax(dim=1)).mean().item(), abs=1e-5)


@covers(content.content_loss, coarse_losses.reconstruction_loss)
@given(st.data(), st.integers(1, 50), st.floats(-30, 30), FLOATS)
def test_squared_errors_are_relative_and_finite(data, count, size, dtype):
    features = data.draw(tensors((count, 3), -3, 3, dtype=dtype)).requires_grad_()
    target = data.draw(tensors((count, 3), -3, 3, dtype=dtype, zeros=False))
    scale = 10.0**size
    loss = content.content_loss(scale * features, scale * target)
    expected = (features - target).double().square().mean() / target.double().square().mean()
    torch.testing.assert_close(loss.double(), expected, rtol=1e-4, atol=1e-10)
    photo = target / target.max()
    error = coarse_losses.reconstruction_loss(features, photo)
    assert error >= 0 and coarse_losses.reconstruction_loss(photo, photo) == 0
    for value in (loss, error):
        (gradient,) = torch.autograd.grad(value, features, retain_graph=True)
        assert gradient.isfinite().all()


@covers(structure.structure_loss, similarity.masked_ssim)
@given(st.data(), st.integers(1, 20), st.integers(1, 20), st.floats(0, 1), ALL_FLOATS)
def test_structure_of_pictures_of_any_size_is_between_opposite_and_equal(data, height, width, kept, dtype):
    image = data.draw(tensors((height, width, 3), 0, 1, dtype=dtype)).requires_grad_()
    picture = data.draw(tensors((height, width, 3), 0, 1, dtype=dtype))
    covered = torch.rand(height, width, generator=torch.Generator().manual_seed(height)) > 0.5
    likeness = similarity.masked_ssim(image.detach().double(), picture.double(), torch.ones_like(covered))
    assert -1 - 1e-6 <= likeness <= 1 + 1e-6
    for mask in (None, covered):
        loss = structure.structure_loss(image, picture, kept, mask)
        (gradient,) = torch.autograd.grad(loss, image, retain_graph=True)
        assert 0 <= loss <= 1 + kept + 1e-4 and gradient.isfinite().all()
        assert structure.structure_loss(picture, picture, kept, mask) < 1e-3


@covers(coarse_losses.pooled_features, coarse_losses.semantic_loss)
@given(st.data(), COUNTS, st.integers(1, 9), st.integers(1, 9), ALL_FLOATS)
def test_embeddings_of_any_size_are_at_most_opposite(data, count, channels, places, dtype):
    low, high = (-4, 3) if dtype == torch.float16 else (-10, 15)
    features = data.draw(tensors((count, channels, places, 2), low, high, signed=True, dtype=dtype)).requires_grad_()
    targets = data.draw(tensors((count, channels), low, high, signed=True, dtype=dtype))
    loss = coarse_losses.semantic_loss(coarse_losses.pooled_features(features), targets)
    assert 0 <= loss <= 2 and loss.dtype in (torch.float32, torch.float64)
    (gradient,) = torch.autograd.grad(loss, features)
    assert gradient.isfinite().all()


@covers(coarse_losses.matched_depth_loss)
@given(st.data(), COUNTS, st.integers(1, 40))
def test_a_ray_is_at_most_its_length_away_from_a_matched_point(data, num_rays, samples):
    depth = data.draw(tensors((num_rays, samples), -30, 2, dtype=torch.float32)).clamp(max=80)
    weights = compositing.dense_weights(depth).requires_grad_()
    edges = sampling.even_edges(num_rays, samples, torch.device("cpu"))
    aim = torch.rand(num_rays, 1, generator=torch.Generator().manual_seed(data.draw(SEEDS)))
    loss = coarse_losses.matched_depth_loss(weights, edges, aim)
    assert -1e-6 <= loss <= 1 + 1e-5
    loss.backward()
    assert (weights.grad <= 0).all() and weights.grad.isfinite().all()


@covers(coarse_losses.near_density)
@given(st.data(), COUNTS, st.integers(1, 40), st.floats(0.001, 1))
def test_near_density_is_at_most_the_mean_density(data, num_rays, samples, reach):
    density = data.draw(tensors((num_rays, samples), -30, 6.5, dtype=torch.float32))
    edges = sampling.even_edges(num_rays, samples, torch.device("cpu"))
    near = coarse_losses.near_density(density, edges, reach)
    assert 0 <= near <= density.mean() * (1 + 1e-5)
    assert coarse_losses.near_density(density, edges, 1.0) == pytest.approx(density.mean().item(), rel=1e-5)


# ---------------------------------------------------------------------------------------------------------------------
# style
# ---------------------------------------------------------------------------------------------------------------------


@covers(color.color_moments, color.palette_transform, color_map.affine, color.gaussian_distance)
@given(st.data(), st.integers(1, 60), st.integers(1, 60), FLOATS)
def test_transferred_colours_have_the_styles_mean(data, count, style_count, dtype):
    colors = data.draw(tensors((count, 3), -12, 0, dtype=dtype))
    style = data.draw(tensors((style_count, 3), -12, 0, dtype=dtype))
    weights = data.draw(tensors((count,), -12, 0))
    assume(weights.sum() > 0)
    mean, covariance = color.color_moments(colors, weights)
    assert torch.linalg.eigvalsh(covariance).min() >= -1e-15
    matrix, offset = color.palette_transform(mean, covariance, *color.color_moments(style))
    transferred = color_map.affine(colors, matrix, offset)
    style_mean, style_covariance = color.color_moments(style)
    distance = color.gaussian_distance(mean, covariance, style_mean, style_covariance)
    back = color.gaussian_distance(style_mean, style_covariance, mean, covariance)
    assert (mean - style_mean).norm() - 1e-6 <= distance <= 3.0
    torch.testing.assert_close(distance, back, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(color.color_moments(transferred, weights)[0], style_mean, rtol=0, atol=1e-3)
    cut = color_map.ColorMap(matrix, offset)(colors)
    assert (cut >= 0).all() and (cut <= 1).all()


@covers(palette.palette_of, palette.transport, palette.smooth_table)
@given(st.data(), st.integers(1, 60), st.integers(1, 60), FLOATS, st.sampled_from(["transport", "moments"]))
def test_a_palette_gives_every_colour_another_that_can_be_shown(data, count, style_count, dtype, transfer):
    colors = data.draw(tensors((count, 3), -12, 0, dtype=dtype))
    style = data.draw(tensors((style_count, 3), -12, 0, dtype=dtype))
    weights = data.draw(tensors((count,), -12, 0))
    assume(weights.sum() > 0)
    own = palette.palette_of(colors, weights, style, transfer)
    mapped = own(colors)
    assert mapped.dtype == dtype and (mapped >= 0).all() and (mapped <= 1).all()
    carried = palette.transport(colors, style)
    assert carried.isfinite().all() and (carried.abs() <= 3.0).all()
    table = palette.smooth_table(colors, carried - colors)
    assert table.isfinite().all()


@given(
    arrays.arrays(
        st.sampled_from([np.uint8, np.uint16]),
        st.tuples(st.integers(8, 20), st.integers(8, 20)),
        elements=st.integers(0, 255),
    )
)
def test_pictures_are_read_as_they_were_written(tmp_path_factory, pixels):
    path = tmp_path_factory.mktemp("pictures") / "picture.png"
    Image.fromarray(pixels).save(path)
    read = Painting.read(path)
    assert read.pixels.dtype == torch.float32 and read.pixels.min() >= 0 and read.pixels.max() <= 1
    assert torch.equal(Painting.received(path.name, path.read_bytes()).pixels, read.pixels)
    expected = torch.from_numpy(pixels.astype(np.float32) / np.iinfo(pixels.dtype).max)
    torch.testing.assert_close(read.pixels, expected.expand(3, -1, -1))


@covers(sliced.random_directions, sliced.sliced_distance, sliced.quantiles)
@given(st.data(), st.integers(1, 60), st.integers(1, 60), st.integers(1, 8), st.integers(1, 9))
def test_distances_along_lines_are_finite_and_alike_both_ways(data, first, second, dimensions, lines):
    clouds = [data.draw(tensors((count, dimensions), -6, 3, signed=True)) for count in (first, second)]
    directions = sliced.random_directions(dimensions, lines, torch.Generator().manual_seed(0)).double()
    clouds[0].requires_grad_()
    distance = sliced.sliced_distance(*clouds, directions)
    (gradient,) = torch.autograd.grad(distance, clouds[0])
    assert distance >= 0 and distance.isfinite() and gradient.isfinite().all()
    torch.testing.assert_close(sliced.sliced_distance(clouds[1], clouds[0], directions), distance)
    spread = sliced.quantiles(clouds[1].sort(dim=0).values, first)
    assert (spread.diff(dim=0) >= 0).all() and spread.min() >= clouds[1].min() and spread.max() <= clouds[1].max()


@pytest.fixture(scope="module")
def backbone():
    return backbones.load_backbone("vgg16-shift-tolerant")


@covers(backbones.load_backbone, targets.fit_side, maps_of.feature_rows, maps_of.covered_rows, targets.sample_rows)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(8, 24), st.floats(0, 1), SEEDS)
def test_pictures_of_any_shape_have_features(backbone, height, width, side, contrast, seed):
    picture = contrast * torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(seed))
    picture.requires_grad_()
    fitted = targets.fit_side(picture, side, backbone.smallest_side)
    assert max(fitted.shape[-2:]) == side and min(fitted.shape[-2:]) >= 8
    maps = backbone(fitted)
    rows = maps_of.feature_rows(maps)
    accumulation = torch.rand(height, width, generator=torch.Generator().manual_seed(seed)) + contrast - 0.5
    assert 1 <= len(maps_of.covered_rows(maps, accumulation)) <= len(rows) == len(maps_of.covered_rows(maps, None))
    kept = targets.sample_rows(rows, max(1, len(rows) // 2))
    assert len(kept) == max(1, len(rows) // 2) and targets.sample_rows(rows, len(rows)) is rows
    assert rows.shape[1] == backbone.channels and (rows >= 0).all() and rows.isfinite().all()
    (gradient,) = torch.autograd.grad(rows.square().mean(), picture)
    assert gradient.isfinite().all()


# ---------------------------------------------------------------------------------------------------------------------
# schedules
# ---------------------------------------------------------------------------------------------------------------------


@given(st.integers(0, 10**12), st.floats(0, 1e6), st.floats(0, 1), st.integers(0, 10**9))
def test_content_weights_fall_from_the_first_to_the_last(step, initial, decay, duration):
    weight = schedules.content_weight(step, initial, decay, duration)
    assert initial * decay * (1 - 1e-12) <= weight <= initial
    assert schedules.content_weight(step + 1, initial, decay, duration) <= weight


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_ramps_are_shares(progress, start, length):
    share = schedules.ramp(progress, start, length)
    assert 0 <= share <= 1
    assert schedules.ramp(min(1.0, progress + 0.1), start, length) >= share

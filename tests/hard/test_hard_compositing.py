import math

import pytest
import torch
from hard.table import hard_case
from nerfstudio.data.scene_box import SceneBox

from sparsestyle_ns.core.occupancy import DensityGrid
from sparsestyle_ns.core.sampling import even_edges, sample_pdf
from sparsestyle_ns.core.spaces import BoxSpace
from sparsestyle_ns.core.volrend import (
    dense_weights,
    distortion,
    effective_samples,
    optical_depth,
    packed_transmittance,
    packed_weights,
)
from sparsestyle_ns.fields.coarse import CoarseField, activate_density
from sparsestyle_ns.rendering.render import over_background, render_coarse

INFINITY = math.inf
CUBE = BoxSpace(SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])))
MOST = 1 + 1e-6
"""What the weights of a ray may add up to."""


def exact_weights(density, interval):
    """Weights in float64 by the definition; the last interval may be infinite."""
    depth = torch.where(interval.isinf(), torch.where(density > 0, INFINITY, 0.0), density * interval.clamp(max=1e300))
    in_front = torch.cat([torch.zeros_like(depth[..., :1]), torch.cumsum(depth, dim=-1)[..., :-1]], dim=-1)
    return torch.exp(-in_front) * -torch.expm1(-depth)


def both_layouts(density, interval):
    """Weights of rays [rays, samples] in the dense and, reshaped, in the packed layout; each with its own graph."""
    rays, samples = density.shape
    depth, packed_depth = optical_depth(density, interval), optical_depth(density, interval).flatten()
    packed = packed_weights(packed_depth, torch.arange(rays).repeat_interleave(samples), rays)
    return dense_weights(depth), packed.view(rays, samples)


def of_all_magnitudes(shape, lowest, highest, seed=0):
    """Numbers between 10^lowest and 10^highest, evenly in their logarithm."""
    share = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return 10 ** (lowest + share * (highest - lowest))


@hard_case(
    "compositing",
    case="density 0 on a whole ray",
    could_go_wrong="0 / 0, or a gradient that is 0 too, so that nothing can ever appear there",
    must_hold="weights are 0, and the gradient of each by its density is the length of its interval",
)
def test_an_empty_ray_can_be_filled():
    density = torch.zeros(2, 5, requires_grad=True)
    interval = torch.rand(2, 5, generator=torch.Generator().manual_seed(0))
    for weights in both_layouts(density, interval):
        assert weights.tolist() == [[0] * 5] * 2
        (gradient,) = torch.autograd.grad(weights.sum(), density)
        torch.testing.assert_close(gradient, interval)


@hard_case(
    "compositing",
    case="density 1e-30",
    could_go_wrong="1 − exp(−τ) rounds to 0",
    must_hold="a weight is σ δ to seven digits",
)
def test_the_thinnest_fog_has_a_weight():
    for weights in both_layouts(torch.full((1, 4), 1e-30), torch.full((1, 4), 0.5)):
        torch.testing.assert_close(weights, torch.full((1, 4), 5e-31), rtol=1e-6, atol=0)


@hard_case(
    "compositing",
    case="densities 1e4, 1e10, 3e38 and infinite",
    could_go_wrong="σ δ overflows, and ∞ · 0 is not a number",
    must_hold="the first sample takes all light; weights and gradients are finite",
)
@pytest.mark.parametrize("density", [1e4, 1e10, 3e38, INFINITY])
def test_a_wall_takes_all_light(density):
    density = torch.full((1, 4), density, requires_grad=True)
    interval = torch.full((1, 4), 0.5, requires_grad=True)
    for weights in both_layouts(density, interval):
        torch.testing.assert_close(weights, torch.tensor([[1.0, 0, 0, 0]]), rtol=0, atol=1e-30)
        for gradient in torch.autograd.grad(weights.sum(), (density, interval)):
            assert gradient.isfinite().all()


@hard_case(
    "compositing",
    case="an infinite density in an interval of length 0",
    could_go_wrong="∞ · 0 is not a number, on each ray that misses the scene",
    must_hold="the weight is 0, and light goes on",
)
def test_nothing_fits_into_no_length():
    density = torch.tensor([[INFINITY, 3e38, 1.0]], requires_grad=True)
    interval = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
    for weights in both_layouts(density, interval):
        torch.testing.assert_close(weights, torch.tensor([[0, 0, -math.expm1(-2)]]))
        for gradient in torch.autograd.grad(weights.sum(), (density, interval)):
            assert gradient.isfinite().all()


@hard_case(
    "compositing",
    case="logits of ±1e4, ±3e38 and ±∞",
    could_go_wrong="exp overflows; softplus hands infinity on",
    must_hold="densities are finite and 0 or more, and so are the pixels and gradients made of them",
)
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_densities_of_extreme_logits_are_numbers(activation):
    logits = torch.tensor([[-INFINITY, -3e38, -1e4, 0.0, 1e4, 3e38, INFINITY]]).repeat(3, 1).requires_grad_()
    density = activate_density(logits, activation)
    assert density.isfinite().all() and (density >= 0).all()
    for length in (0.0, 1e-6, 1.0):
        for weights in both_layouts(density, torch.full_like(density, length)):
            (gradient,) = torch.autograd.grad(weights.sum(), logits, retain_graph=True)
            assert weights.isfinite().all() and gradient.isfinite().all()


@hard_case(
    "compositing",
    case="an opaque first sample",
    could_go_wrong="what it hides shines through, or gets gradients that are not numbers",
    must_hold="all behind it has weight 0 and gradient 0; the sum is 1",
)
def test_nothing_shows_behind_an_opaque_first_sample():
    depth = torch.tensor([[1e9, 0.0, 1e-30, 1.0, 1e9]], requires_grad=True)
    for weights in both_layouts(depth, torch.ones(1, 5)):
        torch.testing.assert_close(weights, torch.tensor([[1.0, 0, 0, 0, 0]]), rtol=0, atol=1e-30)
        (gradient,) = torch.autograd.grad((weights * torch.arange(5)).sum(), depth)
        assert gradient[0, 1:].abs().max() < 1e-30 and gradient.isfinite().all()


@hard_case(
    "compositing",
    case="20,000 samples on a ray",
    could_go_wrong="rounding errors of the running sum add up",
    must_hold="weights are float64's to six digits; their sum is 1 − exp(−Στ)",
)
@pytest.mark.parametrize("total", [1e-3, 1.0, 50.0])
def test_thousands_of_samples_are_composited_as_in_float64(total):
    density = of_all_magnitudes((2, 20_000), -3, 0)
    density *= total / density.sum(dim=-1, keepdim=True)
    expected = exact_weights(density, torch.ones_like(density))
    for weights in both_layouts(density.float(), torch.ones(2, 20_000)):
        # T's relative error is that of the sum in front, at most 50 here, half a unit in the last place.
        torch.testing.assert_close(weights.double(), expected, rtol=5e-6, atol=1e-12)
        torch.testing.assert_close(weights.double().sum(dim=-1), -torch.expm1(-density.sum(dim=-1)), rtol=1e-6, atol=0)


@hard_case(
    "compositing",
    case="intervals of length 0, one, some, and all of a ray",
    could_go_wrong="0 / 0 where samples coincide",
    must_hold="they have weight 0 and change nothing for the others",
)
def test_samples_without_length_do_not_matter():
    density = torch.tensor([[3.0, 1.0, 7.0, 2.0]], requires_grad=True)
    for zero in ([1], [0, 2], [0, 1, 2, 3]):
        interval = torch.full((1, 4), 0.3)
        interval[0, zero] = 0
        rest = [sample for sample in range(4) if sample not in zero]
        for weights, expected in zip(
            both_layouts(density, interval), both_layouts(density[:, rest], interval[:, rest]), strict=True
        ):
            assert weights[0, zero].tolist() == [0] * len(zero)
            torch.testing.assert_close(weights[:, rest], expected)
            (gradient,) = torch.autograd.grad(weights.sum(), density)
            assert gradient.isfinite().all() and gradient[0, zero].tolist() == [0] * len(zero)


@hard_case(
    "compositing",
    case="an infinite last interval with densities 0, 1e-38, 1 and ∞",
    could_go_wrong="0 · ∞ is not a number; the gradient by the density is infinite",
    must_hold="it takes all light that is left, or none at density 0; gradients are at most the cap of τ",
)
@pytest.mark.parametrize("density", [0.0, 1e-38, 1.0, INFINITY])
def test_an_infinite_interval_is_opaque_or_empty(density):
    densities = torch.tensor([[0.5, density]], requires_grad=True)
    for weights in both_layouts(densities, torch.tensor([[1.0, INFINITY]])):
        assert weights[0, 1].item() == pytest.approx(math.exp(-0.5) if density > 0 else 0.0)
        (gradient,) = torch.autograd.grad(weights[0, 1], densities)
        assert gradient.abs().max() <= 80


@hard_case(
    "compositing",
    case="transmittance that underflows",
    could_go_wrong="log or division by a T of 0",
    must_hold="weights fall to 0 and stay there; gradients are float64's",
)
def test_light_that_underflows_is_gone():
    density = torch.full((1, 300), 2.0, requires_grad=True)
    exact = torch.full((1, 300), 2.0, dtype=torch.float64, requires_grad=True)
    importance = torch.linspace(-1, 1, 300, dtype=torch.float64)
    (expected,) = torch.autograd.grad((importance * exact_weights(exact, torch.ones(1, 300).double())).sum(), exact)
    for weights in both_layouts(density, torch.ones(1, 300)):
        assert (weights[0, 60:] == 0).all() and weights.isfinite().all()
        (gradient,) = torch.autograd.grad((importance * weights).sum(), density)
        torch.testing.assert_close(gradient.double(), expected, rtol=1e-5, atol=1e-7)


@hard_case(
    "compositing",
    case="densities from 1e-12 to 1e4 on one ray",
    could_go_wrong="the gradient of a thin sample drowns in that of a dense one",
    must_hold="every gradient is float64's to five digits, or to 1e-6 of the ray's largest",
)
def test_gradients_are_those_of_float64():
    density = of_all_magnitudes((200, 32), -12, 4).float().double()
    interval = of_all_magnitudes((200, 32), -4, 0, seed=1).float().double()
    importance = torch.randn(200, 32, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    exact = density.clone().requires_grad_()
    (expected,) = torch.autograd.grad((importance * exact_weights(exact, interval)).sum(), exact)
    inputs = density.float().requires_grad_()
    for weights in both_layouts(inputs, interval.float()):
        (gradient,) = torch.autograd.grad((importance.float() * weights).sum(), inputs)
        # The packed layout's sums run over all rays in float64.
        allowed = 1e-5 * expected.abs() + 1e-6 * expected.abs().amax(dim=-1, keepdim=True) + 1e-13
        assert ((gradient.double() - expected).abs() <= allowed).all()


@hard_case(
    "compositing",
    case="a sample of optical depth 10 to 75",
    could_go_wrong="1 − exp(−τ) has the gradient 1 − (1 − exp(−τ)): no digit of it is left at 16, nothing at 17",
    must_hold="the gradient is exp(−τ) to five digits, so that a wall can open again",
)
@pytest.mark.parametrize("depth", [10.0, 16.0, 17.0, 30.0, 75.0])
def test_the_gradient_of_a_wall_is_not_0(depth):
    density = torch.tensor([[depth, 1.0]], requires_grad=True)
    for weights in both_layouts(density, torch.ones(1, 2)):
        (gradient,) = torch.autograd.grad(weights[0, 0], density)
        assert gradient[0, 0].item() == pytest.approx(math.exp(-depth), rel=1e-5)


@hard_case(
    "compositing",
    case="rays of any density and thousands of samples",
    could_go_wrong="weights add up to more than 1, and pixels get brighter than their brightest sample",
    must_hold="the sum is never above 1 + 1e-6, no weight below 0",
)
@pytest.mark.parametrize("samples", [1, 7, 64, 4000])
def test_weights_never_sum_to_more_than_1(samples):
    for highest in (-6, 0, 2, 6, 30):
        density = of_all_magnitudes((64, samples), highest - 8, highest, seed=samples).float()
        interval = torch.rand(64, samples, generator=torch.Generator().manual_seed(1)) * 2 / samples
        for weights in both_layouts(density, interval):
            assert (weights >= 0).all()
            assert weights.double().sum(dim=-1).max().item() <= MOST
            assert weights.sum(dim=-1).max().item() <= MOST


@hard_case(
    "compositing",
    case="opaque rays with a loss 1e6 times as large beside a thin one",
    could_go_wrong="the running sum over all rays of the packed layout loses the thin ray's gradient",
    must_hold="the thin ray's gradient is its own to five digits",
)
def test_rays_of_a_batch_do_not_disturb_each_other():
    depth = torch.cat([torch.full((100_000,), 79.0), torch.tensor([1e-3, 0.2, 1e-4])])
    ray_indices = torch.cat([torch.arange(100).repeat_interleave(1000), torch.full((3,), 100)])
    importance = torch.cat([torch.full((100_000,), 1e6), torch.tensor([1.0, -2.0, 3.0])])
    together = depth.clone().requires_grad_()
    (importance * packed_weights(together, ray_indices, 101)).sum().backward()
    alone = depth[-3:].clone().requires_grad_()
    (importance[-3:] * dense_weights(alone)).sum().backward()
    torch.testing.assert_close(together.grad[-3:], alone.grad, rtol=1e-5, atol=0)


@hard_case(
    "compositing",
    case="densities and depths in bfloat16 and float16",
    could_go_wrong="running sums keep three digits, or overflow at 65,504; weights add up to more than 1",
    must_hold="weights are float32's of the same numbers, and sum to at most 1 + 1e-6",
)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_densities_give_float32_weights(dtype):
    density = of_all_magnitudes((40, 2000), -4, 4).to(dtype)
    interval = torch.full((40, 2000), 0.01, dtype=dtype)
    expected = both_layouts(density.float(), interval.float())
    for weights, exact in zip(both_layouts(density, interval), expected, strict=True):
        torch.testing.assert_close(weights, exact)
        assert weights.sum(dim=-1).max().item() <= MOST
    depth = density[:, :50]
    torch.testing.assert_close(dense_weights(depth), dense_weights(depth.float()))
    rays = torch.arange(40).repeat_interleave(50)
    light = packed_transmittance(depth.flatten(), rays, 40)
    torch.testing.assert_close(light, packed_transmittance(depth.float().flatten(), rays, 40))


@hard_case(
    "compositing",
    case="a coarse field under bfloat16 and float16 autocast",
    could_go_wrong="half precision reaches the running sums, or an overflow the pixels",
    must_hold="pixels are float32's to 2%; sums of weights at most 1 + 1e-6; gradients finite",
)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_a_coarse_render_under_autocast_is_that_in_float32(dtype):
    torch.manual_seed(0)
    field = CoarseField(num_layers=2, layer_width=32, feature_dim=8, direction_levels=None, density_activation="exp")
    origins, directions = torch.rand(50, 3) - 0.5, torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    segments = CUBE.segments(origins, directions)
    arguments = (field, segments, directions, even_edges(50, 128, torch.device("cpu")), True, torch.ones(3))
    exact = render_coarse(*arguments)
    with torch.autocast("cpu", dtype=dtype):
        render = render_coarse(*arguments)
    torch.testing.assert_close(render.rgb, exact.rgb, rtol=0, atol=0.02)
    assert render.weights.dtype == torch.float32 and render.weights.sum(dim=-1).max().item() <= MOST
    render.rgb.square().mean().backward()
    assert all(parameter.grad.isfinite().all() for parameter in field.parameters())


@hard_case(
    "compositing",
    case="weights of 1e-25",
    could_go_wrong="their squares underflow, and the number of effective samples is 0",
    must_hold="n equal weights count as n, whatever they are",
)
@pytest.mark.parametrize("weight", [1e-37, 1e-25, 1e-10, 1.0])
def test_effective_samples_do_not_depend_on_the_size_of_weights(weight):
    weights = torch.tensor([[weight] * 5 + [0.0] * 3, [weight] + [0.0] * 7], requires_grad=True)
    counted = effective_samples(weights)
    torch.testing.assert_close(counted, torch.tensor([5.0, 1.0]))


@hard_case(
    "compositing",
    case="the distortion of a surface that thousands of samples cut into slices",
    could_go_wrong="differences of nearly equal sums: negative, or without a correct digit",
    must_hold="0 or more, and float64's to four digits, with its gradient",
)
@pytest.mark.parametrize("samples", [16, 1000, 10_000])
def test_the_distortion_of_a_thin_surface_is_exact(samples):
    edges = torch.linspace(0, 1, samples + 1, dtype=torch.float64).expand(4, -1)
    weights = of_all_magnitudes((4, samples), -30, -20)
    weights[:, -6:-3] = torch.tensor([0.3, 0.5, 0.2])
    exact = weights.clone().requires_grad_()
    inputs = weights.float().requires_grad_()
    found = distortion(inputs, edges.float())
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    heavy = exact[:, -6:-3, None] * exact[:, None, -6:-3] * (middle[:, -6:-3, None] - middle[:, None, -6:-3]).abs()
    expected = heavy.sum(dim=(1, 2)) + (exact.square() / samples).sum(dim=-1) / 3
    # Borders near 1 are float32 numbers, 6e-8 apart, which is what the slices' widths are good to.
    tolerance = 1e-4 + 2e-7 * samples
    assert (found >= 0).all()
    torch.testing.assert_close(found.double(), expected, rtol=tolerance, atol=0)
    (gradient,) = torch.autograd.grad(found.sum(), inputs)
    (exact_gradient,) = torch.autograd.grad(expected.sum(), exact)
    torch.testing.assert_close(
        gradient[:, -6:-3].double(), exact_gradient[:, -6:-3], rtol=tolerance, atol=1e-3 / samples
    )


@hard_case(
    "compositing",
    case="the distortion where all borders coincide",
    could_go_wrong="rounding gives a negative loss, which training then seeks",
    must_hold="0 or more for any weights",
)
def test_distortion_is_never_negative():
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(500, 200, generator=generator)
    weights /= weights.sum(dim=-1, keepdim=True)
    for spread in (0.0, 1e-7, 1e-6, 1e-3):
        edges = 0.9 + spread * torch.rand(500, 201, generator=generator).sort(dim=-1).values
        assert (distortion(weights, edges) >= 0).all()


@hard_case(
    "compositing",
    case="jittered borders of thousands of samples",
    could_go_wrong="neighbours that touch change places by rounding: an interval of negative length",
    must_hold="borders ascend from 0 to 1",
)
@pytest.mark.parametrize("samples", [1, 2, 24, 5000, 100_000])
def test_jittered_borders_ascend(samples):
    for seed in range(20):
        edges = even_edges(max(1, 4000 // samples), samples, torch.device("cpu"), torch.Generator().manual_seed(seed))
        assert (edges.diff(dim=-1) >= 0).all()
        assert edges[:, 0].tolist() == [0] * len(edges) and edges[:, -1].tolist() == [1] * len(edges)


@hard_case(
    "compositing",
    case="histograms with a single spike, masses of 1e-30, and thousands of bins",
    could_go_wrong="0 / 0 in the inverse of the distribution; borders that change places by rounding",
    must_hold="borders are finite and ascend from the first to the last",
)
@pytest.mark.parametrize("bins", [1, 64, 5000])
def test_borders_of_extreme_histograms_ascend(bins):
    spike = torch.full((1, bins), 1e-30)
    spike[0, bins // 2] = 1
    only = torch.zeros(1, bins)
    only[0, -1] = 1e-30
    histograms = torch.cat([spike, only, of_all_magnitudes((40, bins), -30, 0).float(), torch.full((1, bins), 1e30)])
    borders = 0.3 + 0.6 * even_edges(len(histograms), bins, torch.device("cpu"), torch.Generator().manual_seed(0))
    for generator in (None, torch.Generator().manual_seed(1)):
        edges = sample_pdf(borders, histograms, 200, generator)
        assert edges.isfinite().all() and (edges.diff(dim=-1) >= 0).all()
        assert torch.equal(edges[:, [0, -1]], borders[:, [0, -1]])


@hard_case(
    "compositing",
    case="a grid that has seen the densest of all densities",
    could_go_wrong="it remembers infinity for good, and ∞ · 0 puts samples nowhere",
    must_hold="samples are placed on rays that hit and miss, and the density is forgotten again",
)
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_a_grid_forgets_the_densest_density(activation):
    grid = DensityGrid(4)
    point = torch.tensor([[0.1, 0.1, 0.1]])
    grid.remember(point, activate_density(torch.tensor([INFINITY]), activation))
    rays = CUBE.segments(torch.tensor([[-3.0, 0.1, 0.1]] * 2), torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    assert rays.hit.tolist() == [True, False]
    for unbounded in (True, False):
        edges = grid.place_samples(rays, num_samples=8, num_bins=16, unbounded=unbounded, even_share=0.1)
        assert edges.isfinite().all() and (edges.diff(dim=-1) >= 0).all()
    for _ in range(200):
        grid.remember(point, torch.zeros(1))
    assert grid.density[grid.cells(point)].item() < 1e-3


@hard_case(
    "compositing",
    case="a sum of weights of 1 + 1e-6 over a background",
    could_go_wrong="1 − Σw is negative and takes light away",
    must_hold="the pixel is its colour to 1e-6 of the background",
)
def test_a_sum_barely_above_1_does_not_darken():
    rgb = torch.full((1, 3), 0.5)
    pixel = over_background(rgb, torch.tensor([[MOST]]), torch.ones(3))
    torch.testing.assert_close(pixel, rgb, rtol=0, atol=2e-6)

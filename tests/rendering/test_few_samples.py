"""A few samples a ray, against their twin: every step, with the field asked at each."""

import math
from dataclasses import replace

import pytest
import torch
from nerfstudio.data.scene_box import SceneBox
from test_baked import rays_of
from test_render import RacingSums

from sparsestyle_ns.core.occupancy import DensityVolume, Occupancy
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.rendering import few_samples
from sparsestyle_ns.rendering.few_samples import MOST_CORRECTION, FewSamples, Stretches, cut_into_stretches
from sparsestyle_ns.rendering.lines import lines_of
from sparsestyle_ns.rendering.render import (
    FrozenSamples,
    accumulation_of,
    freeze_samples,
    render_frozen,
    render_mixed,
    render_stylised,
)
from sparsestyle_ns.rendering.visible_samples import Marching

RAYS, STEPS = 60, 256
BACKGROUND = torch.tensor([1.0, 0.5, 0.0])
CUBE = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
SPACES = {
    "box": BoxSpace(CUBE),
    "contracted": ContractedSpace(),
    "ndc": ForwardFacingSpace(CUBE, (2.0, 2.0), near=1.0, depth_range=(1.5, 9.0)),
}
EACH_SPACE = pytest.mark.parametrize("space", SPACES)


class Scene:
    """A coarse field between thin air and opaque things, a volume of it, and a colourful residual field."""

    def __init__(self, with_density):
        torch.manual_seed(0)
        self.coarse = CoarseField(3, 2, layer_width=32, feature_dim=4, direction_levels=2, density_activation="exp")
        torch.nn.init.normal_(self.coarse.density_head.weight, std=4.0)
        self.coarse.requires_grad_(False)
        grid = HashGrid(2, 4, 8, 2, 8, init_scale=1.0)
        self.residual = ResidualField(grid, 4, layer_width=16, density_scale=10.0, with_density=with_density)
        torch.nn.init.normal_(self.residual.color_head.weight, std=3.0)
        if with_density:
            torch.nn.init.normal_(self.residual.density_head.weight)
        self.volume = DensityVolume(64)
        self.volume.measure(self.density, 1 << 17)

    def density(self, points):
        return self.coarse.density_and_feature(points)[0]

    def few(self, count):
        """Spread as the hierarchical model spreads them."""
        return FewSamples(self.volume, count, 0.0 if self.residual.density_head is None else 0.25)

    def freeze(self, space, few):
        segments = SPACES[space].segments(*rays_of(space, RAYS))
        marching = Marching(None, STEPS, SPACES[space].unbounded, 0.0, few)
        return freeze_samples(self.coarse, self.residual, segments, marching)

    def picture_and_gradient(self, space, few):
        """The stylised picture, and the gradient of its squared error for all parameters, one after another."""
        rgb = render_stylised(self.residual, self.freeze(space, few), BACKGROUND).rgb
        target = torch.rand(RAYS, 3, generator=torch.Generator().manual_seed(3))
        parts = torch.autograd.grad((rgb - target).square().sum(), list(self.residual.parameters()))
        return rgb.detach(), torch.cat([part.flatten() for part in parts])

    def errors(self, space, count):
        """The picture's PSNR against the twin's, and the gradient's error over its norm."""
        rgb, gradient = self.picture_and_gradient(space, self.few(count))
        expected, wanted = self.picture_and_gradient(space, None)
        assert expected.std(dim=0).mean() > 0.01  # there is something to see
        psnr = -10 * math.log10((rgb - expected).square().mean().item())
        return psnr, ((gradient - wanted).norm() / wanted.norm()).item()


@pytest.fixture(autouse=True, params=["compiled", "torch"])
def way(request, monkeypatch):
    """All that is said here holds for the kernel and for what other devices have."""
    if request.param == "torch":
        monkeypatch.setattr(few_samples, "lines_of", lambda *_: None)


@pytest.fixture(scope="module")
def scene():
    return Scene(with_density=False)


@pytest.fixture(scope="module")
def moving():
    """A scene whose geometry is stylised too."""
    return Scene(with_density=True)


@EACH_SPACE
def test_sixteen_samples_have_the_picture_and_the_gradient_of_256_steps(space, scene):
    psnr, error = scene.errors(space, 16)
    assert psnr > 50 and error < 0.01


@EACH_SPACE
def test_with_residual_density_the_error_falls_with_each_sample_down_to_none(space, moving):
    psnrs, errors = zip(*(moving.errors(space, count) for count in (4, 16, 64, 256)), strict=True)
    assert list(psnrs) == sorted(psnrs) and list(errors) == sorted(errors, reverse=True)
    # What is left is what the volume of 64 cells a side doesn't know, and samples beside the middles of the steps.
    assert psnrs[0] > 30 and psnrs[-1] > 75 and errors[-1] < 0.003


@EACH_SPACE
@pytest.mark.parametrize("count", [1, 2, 6])
def test_however_few_there_are_the_accumulation_is_kept(space, count, scene):
    expected = accumulation_of(scene.freeze(space, None))
    found = accumulation_of(scene.freeze(space, scene.few(count)))
    # Stretches below a ten-thousandth of the weight are left out.
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)


def test_a_coarse_picture_of_few_samples_is_nearly_that_of_all_steps_with_the_colours_of_its_directions(scene):
    segments, directions = SPACES["box"].segments(*rays_of("box", RAYS)), rays_of("box", RAYS)[1]
    marching = Marching(None, STEPS, False, 0.0, scene.few(8))
    found = render_frozen(scene.coarse, segments, directions, marching, BACKGROUND)
    (_, expected) = render_mixed(scene.coarse, [scene.residual], scene.freeze("box", None), directions, BACKGROUND)
    for name in ("rgb", "accumulation", "s"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), atol=0.01, rtol=0, msg=name)


@pytest.mark.parametrize("count", [1, 5, 40])
def test_no_ray_has_more_samples_than_asked_for_and_they_go_from_front_to_back(count, scene, moving):
    for each, space in ((scene, "box"), (moving, "contracted"), (moving, "ndc")):
        frozen, marching = each.freeze(space, each.few(count)), SPACES[space]
        most = Marching(None, STEPS, marching.unbounded, 0.0, each.few(count)).most_samples
        assert most == count + marching.unbounded
        counts = torch.bincount(frozen.samples.ray_indices, minlength=RAYS)
        assert 1 <= counts.max() <= most
        step = frozen.samples.ray_indices.diff()
        assert (step >= 0).all() and (frozen.samples.s.diff()[step == 0] >= 0).all()


def test_stretches_with_an_even_share_cover_the_whole_ray(moving):
    segments = SPACES["box"].segments(*rays_of("box", RAYS))
    samples, depth = cut_into_stretches(segments, moving.few(6), STEPS, unbounded=False)
    whole = segments.lengths(torch.tensor([[0.0, 1.0]]).expand(RAYS, -1))[:, 0]
    lengths = torch.zeros(RAYS).index_add(0, samples.ray_indices, samples.lengths)
    torch.testing.assert_close(lengths, whole, rtol=1e-4, atol=0)
    # A quarter of 6 stretches on the whole ray: none is longer than two thirds of it.
    assert (samples.lengths <= whole[samples.ray_indices] / 1.5 * 1.01).all()
    middles = (torch.arange(4096) + 0.5) / 4096
    expected = moving.volume.density(segments.positions(middles.expand(RAYS, -1))).mean(dim=-1) * whole
    torch.testing.assert_close(torch.zeros(RAYS).index_add(0, samples.ray_indices, depth), expected, rtol=0.03, atol=0)


# --- by hand: slabs across x, on one ray along x ----------------------------------------------------------------------


def along_x(y=0.01, rays=1):
    origins = torch.tensor([[-3.0, y, 0.01]]).expand(rays, -1)
    return SPACES["box"].segments(origins, torch.tensor([[1.0, 0.0, 0.0]]).expand(rays, -1))


def volume_of(density, resolution=64):
    volume = DensityVolume(resolution)
    volume.measure(density, 1 << 17)
    return volume


def test_samples_lie_where_the_weight_is():
    volume = volume_of(lambda points: torch.where((points[:, 0] > 0.2) & (points[:, 0] < 0.3), 50.0, 0.0))
    samples, _ = cut_into_stretches(along_x(), FewSamples(volume, 6), STEPS, unbounded=False)
    assert len(samples.s) >= 4
    # The slab, widened by a cell of the volume on either side.
    assert ((samples.positions[:, 0] > 0.2 - 2 / 64) & (samples.positions[:, 0] < 0.3 + 2 / 64)).all()


def test_one_sample_lies_where_half_of_the_weight_is_in_front_of_it():
    fog = volume_of(lambda points: torch.full((len(points),), 2.0))
    samples, depth = cut_into_stretches(along_x(), FewSamples(fog, 1), STEPS, unbounded=False)
    assert depth.tolist() == pytest.approx([4.0], rel=1e-4)  # 2, on the 2 from one side of the cube to the other
    assert samples.lengths.tolist() == pytest.approx([2.0])
    half = -math.log(0.5 * (1 + math.exp(-4.0))) / 2  # exp(−2x) = ½ (1 + exp(−4))
    assert samples.positions[0, 0].item() == pytest.approx(half - 1, abs=0.005)


@pytest.mark.parametrize("front", [0.5, 0.9, 1.386, 2.0, 3.0])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_no_sample_lies_between_two_surfaces(front, count):
    """There, no view would say what colour it has."""

    def sheets(points):
        x = points[:, 0]
        first, second = ((x - center).abs() < 0.1 for center in (-0.5, 0.5))
        return torch.where(first, front / 0.2, torch.where(second, 50.0, 0.0))

    samples, _ = cut_into_stretches(along_x(), FewSamples(volume_of(sheets), count), STEPS, unbounded=False)
    x = samples.positions[:, 0]
    assert ((x < 0.0) == (x < -0.4 + 2 / 64)).all() and ((x > 0.0) == (x > 0.4 - 2 / 64)).all(), x


def test_a_ray_whose_first_step_is_opaque_shows_that_step_alone():
    wall = volume_of(lambda points: torch.full((len(points),), 1e6))
    samples, depth = cut_into_stretches(along_x(), FewSamples(wall, 4), 32, unbounded=False)
    assert samples.s[0] < 1 / 32
    assert -math.expm1(-depth[0].item()) > 0.999 and depth.isfinite().all()
    # The even share finds its way behind the wall only where residual density may show there.
    assert len(samples.s) <= 4 and (samples.s < 1 / 32).any()


def test_rays_through_thin_air_have_no_samples_unless_density_may_be_added_there():
    air = volume_of(lambda points: torch.zeros(len(points)))
    assert len(cut_into_stretches(along_x(rays=3), FewSamples(air, 6), STEPS, unbounded=False).samples.s) == 0
    samples, _ = cut_into_stretches(along_x(rays=3), FewSamples(air, 6, 0.25), STEPS, unbounded=False)
    assert torch.bincount(samples.ray_indices).tolist() == [6, 6, 6]
    assert samples.s[:6].tolist() == pytest.approx([(2 * place + 1) / 12 for place in range(6)], abs=1e-4)


@pytest.mark.parametrize("even_share", [0.0, 0.25])
def test_rays_that_miss_have_no_samples(even_share):
    fog = volume_of(lambda points: torch.full((len(points),), 2.0))
    origins = torch.tensor([[-3.0, 0.0, 0.0], [-3.0, 9.0, 0.0], [-3.0, 0.5, 0.0]])
    segments = SPACES["box"].segments(origins, torch.tensor([[1.0, 0.0, 0.0]]).expand(3, -1))
    samples, _ = cut_into_stretches(segments, FewSamples(fog, 5, even_share), STEPS, unbounded=False)
    counts = torch.bincount(samples.ray_indices, minlength=3).tolist()
    assert counts[1] == 0 and counts[0] == counts[2] > 0
    assert (samples.positions[samples.ray_indices == 2, 1] == 0.5).all()
    nothing = SPACES["box"].segments(origins[1:2], torch.tensor([[1.0, 0.0, 0.0]]))
    assert len(cut_into_stretches(nothing, FewSamples(fog, 5, even_share), STEPS, unbounded=False).samples.s) == 0


def test_an_unbounded_space_has_its_endless_step_wherever_light_gets_there():
    thin, dense = (volume_of(lambda points, d=d: torch.full((len(points),), d)) for d in (0.0, 1e3))
    segments = ContractedSpace().segments(*rays_of("contracted", 7))
    samples, depth = cut_into_stretches(segments, FewSamples(thin, 5), 32, unbounded=True)
    assert samples.ray_indices.tolist() == list(range(7))
    assert samples.s.tolist() == pytest.approx([1 - 0.5 / 32] * 7)  # in the middle of the step, as in the twin
    assert samples.lengths.isinf().all() and (depth == 0).all()
    samples, _ = cut_into_stretches(segments, FewSamples(dense, 5), 32, unbounded=True)
    assert samples.lengths.isfinite().all()


def test_the_endless_step_has_the_fields_density_and_other_stretches_the_mean_that_the_volume_gives_corrected():
    volume = volume_of(lambda points: torch.full((len(points),), 2.0))
    segments = ContractedSpace().segments(*rays_of("contracted", 1))
    stretches = cut_into_stretches(segments, FewSamples(volume, 3, 0.25), STEPS, unbounded=True)
    found = stretches.density(volume, torch.full((len(stretches.depth),), 3.0))
    torch.testing.assert_close(found, torch.full_like(found, 3.0), rtol=1e-4, atol=0)


@pytest.mark.parametrize(("density", "factor"), [(1e9, MOST_CORRECTION), (0.0, 0.0), (3.0, 1.5)])
def test_a_volume_is_corrected_by_what_the_field_says_up_to_a_limit(density, factor):
    volume = volume_of(lambda points: torch.full((len(points),), 2.0))
    stretches = cut_into_stretches(along_x(), FewSamples(volume, 3), STEPS, unbounded=False)
    found = stretches.density(volume, torch.full((len(stretches.depth),), density))
    expected = factor * stretches.depth / stretches.samples.lengths
    torch.testing.assert_close(found, expected)


def test_a_stretch_without_length_makes_no_number_that_isnt_one():
    volume = volume_of(lambda points: torch.full((len(points),), 2.0), 4)
    samples, depth = cut_into_stretches(along_x(), FewSamples(volume, 2), STEPS, unbounded=False)
    none = Stretches(samples._replace(lengths=torch.zeros_like(samples.lengths)), torch.zeros_like(depth))
    assert none.density(volume, torch.ones(len(depth))).tolist() == [0.0] * len(depth)


# --- frozen again ----------------------------------------------------------------------------------------------------


@EACH_SPACE
def test_a_view_that_is_frozen_again_has_the_same_samples_on_a_gpu_too(space, scene, moving):
    for each in (scene, moving):
        first, second = (each.freeze(space, each.few(5)) for _ in range(2))
        for one, other in zip((*first.samples, first.density), (*second.samples, second.density), strict=True):
            assert torch.equal(one, other)
        with RacingSums() as sums:
            each.freeze(space, each.few(5))
        assert sums.found == []


def test_batches_that_are_joined_are_the_samples_of_all_rays_at_once(scene):
    rays = rays_of("box", RAYS)
    marching = Marching(None, STEPS, False, 0.0, scene.few(4))

    def freeze(part):
        segments = SPACES["box"].segments(*(each[part] for each in rays))
        return freeze_samples(scene.coarse, scene.residual, segments, marching)

    whole = freeze(slice(0, RAYS))
    parts = [freeze(slice(*ends)) for ends in ((0, 7), (7, 7), (7, 33), (33, RAYS))]
    joined = FrozenSamples.joined(parts, scene.residual)
    assert joined.num_rays == whole.num_rays == RAYS and joined.num_bytes == whole.num_bytes
    assert torch.equal(joined.samples.ray_indices, whole.samples.ray_indices)
    # Matrix products of other sizes may round otherwise.
    for name in ("density", "feature"):
        torch.testing.assert_close(getattr(joined, name), getattr(whole, name), rtol=1e-4, atol=1e-5)
    pictures = (render_stylised(scene.residual, frozen, BACKGROUND).rgb for frozen in (joined, whole))
    torch.testing.assert_close(*pictures, rtol=0, atol=1e-5)
    assert FrozenSamples.joined([whole], scene.residual) is whole


@pytest.mark.parametrize("count", [1, 4, 16])
@pytest.mark.parametrize("fields", ["scene", "moving"])
@EACH_SPACE
def test_the_kernel_cuts_rays_as_torch_does(space, fields, count, request, monkeypatch):
    few = request.getfixturevalue(fields).few(count)
    segments, unbounded = SPACES[space].segments(*rays_of(space, 300)), SPACES[space].unbounded
    found = []
    for form in (lines_of, lambda *_: None):
        monkeypatch.setattr(few_samples, "lines_of", form)
        found.append(cut_into_stretches(segments, few, STEPS, unbounded))
    (samples, depth), (expected, expected_depth) = found
    assert torch.equal(samples.ray_indices, expected.ray_indices)
    torch.testing.assert_close(samples.lengths, expected.lengths, atol=1e-4, rtol=0)
    torch.testing.assert_close(depth, expected_depth, atol=1e-3, rtol=1e-3)
    # Where hardly any weight lies, its middle is a matter of rounding.
    torch.testing.assert_close(samples.s, expected.s, atol=2e-3, rtol=0)
    assert (samples.s - expected.s).abs().median() < 1e-6


@EACH_SPACE
def test_the_kernel_passes_over_empty_cells_as_torch_does(space, scene, monkeypatch):
    occupancy = Occupancy(12)
    torch.manual_seed(1)
    occupancy.occupied.copy_(torch.rand(12, 12, 12) < 0.2)
    segments = SPACES[space].segments(*rays_of(space, 300))
    marching = Marching(occupancy, STEPS, SPACES[space].unbounded, 0.0, scene.few(8))

    def picture(marching):
        frozen = freeze_samples(scene.coarse, scene.residual, segments, marching)
        return render_stylised(scene.residual, frozen, BACKGROUND).rgb

    found = []
    for form in (lines_of, lambda *_: None):
        monkeypatch.setattr(few_samples, "lines_of", form)
        found.append(picture(marching))
    # A step within rounding of a cell's border may lie on either side of it.
    errors = (found[0] - found[1]).abs()
    assert errors.max() < 0.05
    assert errors.median() < 1e-5
    assert (picture(replace(marching, occupancy=None)) - found[0]).abs().mean() > 20 * errors.mean()

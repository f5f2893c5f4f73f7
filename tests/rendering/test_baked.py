import pytest
import torch
from nerfstudio.data.scene_box import SceneBox
from torch.nn.functional import normalize

from sparsestyle_ns.core.occupancy import Occupancy, march
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.rendering.baked import (
    DENSITY_STEP,
    DENSITY_UNIT,
    MAX_DENSITY,
    BakedVolume,
    clearance_of,
    decode,
    encode,
    march_in_torch,
    render_baked,
)
from sparsestyle_ns.rendering.baked_kernels import LOOKAHEAD
from sparsestyle_ns.rendering.render import render_packed
from sparsestyle_ns.rendering.visible_samples import SAMPLES_PER_PASS, Marching

STEPS = 24
CUBE = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
SPACES = {
    "box": BoxSpace(CUBE),
    "contracted": ContractedSpace(),
    "ndc": ForwardFacingSpace(CUBE, (2.0, 2.0), near=1.0, depth_range=(1.5, 9.0)),
}
WHITE = torch.ones(3)
MARCHES = [render_baked, march_in_torch]
"""On a CPU the first is compiled."""


def rays_of(space, count=60):
    """Origins and directions: from about the middle, but in a box from a sphere about it."""
    generator = torch.Generator().manual_seed(0)
    if space == "ndc":
        sideways = 0.4 * torch.rand(count, 2, generator=generator) - 0.2
        directions = torch.cat([sideways, -torch.ones(count, 1)], dim=-1)
        return 0.1 * torch.randn(count, 3, generator=generator), normalize(directions, dim=-1)
    distance = 0.2 if space == "contracted" else 3.0
    origins = distance * normalize(torch.randn(count, 3, generator=generator), dim=-1)
    aim = torch.rand(count, 3, generator=generator) - 0.5
    return origins, normalize(aim - origins, dim=-1)


def bundle(space, occupancy=None, min_transmittance=1e-3, rays=None):
    """Rays, and how they are marched."""
    segments = SPACES[space].segments(*(rays or rays_of(space)))
    return segments, Marching(occupancy or Occupancy(4), STEPS, SPACES[space].unbounded, min_transmittance)


def volume_of(shade, resolution=30):
    return BakedVolume(shade, resolution, torch.device("cpu"))


def exact(shade, segments, marching, background=None):
    """Both renders, with the fields asked at every sample."""
    samples = march(segments, marching.occupancy, marching.num_steps, marching.unbounded)
    density, stylised_density, stylised_color, color = shade(samples.positions).split([1, 1, 3, 3], dim=-1)
    count = len(segments.hit)
    return (
        render_packed(samples, count, stylised_density[:, 0], stylised_color, background),
        render_packed(samples, count, density[:, 0], color, background),
    )


def assert_renders(found, expected, tolerance):
    for one, other in zip(found, expected, strict=True):
        for name in ("rgb", "accumulation", "s"):
            torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=tolerance, rtol=0, msg=name)


def trilinear(points):
    """Colours and logarithms of densities that change along each axis by an amount that the other axes scale."""
    x, y, z = (0.5 * points + 0.5).clamp(0, 1).unbind(-1)
    ramps = torch.stack([x * y, z * (1 - x), y * z, 1 - x, x * y * z, (1 - y) * (1 - z)], dim=-1)
    logs = torch.stack([4 + 2 * x * z, 4 + 3 * y * (1 - z)], dim=-1)
    return torch.cat([DENSITY_UNIT * torch.expm1(logs), ramps], dim=-1)


@pytest.fixture
def fields():
    """σ_c, σ_f, c_f and c_c of two small random fields that are nowhere empty and not opaque."""
    torch.manual_seed(0)
    coarse = CoarseField(num_levels=3, num_layers=2, layer_width=16, feature_dim=4, direction_levels=None)
    residual = ResidualField(HashGrid(2, 4, 8, 2, 8, init_scale=1.0), 4, layer_width=16)
    torch.nn.init.normal_(residual.density_head.weight, std=0.05)
    torch.nn.init.normal_(residual.color_head.weight)

    @torch.no_grad()
    def shade(points):
        density, feature = coarse.density_and_feature(points)
        stylised_density, stylised_color = residual(residual.locate(points), feature, density)
        color = coarse.color(feature, points)
        return torch.cat([density[:, None], stylised_density[:, None], stylised_color, color], dim=-1)

    return shade


class Recorder:
    """A field of two constant densities and one grey, that remembers where it was asked."""

    def __init__(self, density=1.0, stylised_density=1.0):
        self.values = torch.tensor([density, stylised_density, *[0.5] * 6])
        self.calls = []

    def __call__(self, points):
        self.calls.append(points)
        return self.values.expand(len(points), 8)

    @property
    def points(self):
        return torch.cat(self.calls)


def test_a_code_is_at_most_half_a_step_off():
    torch.manual_seed(0)
    density = torch.cat([10.0 ** torch.linspace(-4, 5, 400), torch.zeros(1)])
    values = torch.cat([density[:, None].expand(-1, 2), torch.rand(401, 6)], dim=-1)
    found = decode(encode(values).float())
    logs, found_logs = (torch.log1p(part[:, :2] / DENSITY_UNIT) for part in (values, found))
    # Tiny densities are rounded up instead of away, by a whole step.
    torch.testing.assert_close(found_logs, logs, atol=1.001 * DENSITY_STEP, rtol=0)
    torch.testing.assert_close(found_logs[200:], logs[200:], atol=0.501 * DENSITY_STEP, rtol=0)
    torch.testing.assert_close(found[:, 2:], values[:, 2:], atol=0.501 / 255, rtol=0)


def test_nothing_stays_nothing_and_a_trace_stays_a_trace():
    values = torch.zeros(3, 8)
    values[1, :2], values[2, :2] = 1e-12, 1e12
    found = decode(encode(values).float())[:, 0].tolist()
    assert found[0] == 0
    assert 0 < found[1] < DENSITY_UNIT
    assert found[2] == pytest.approx(MAX_DENSITY, rel=1e-3)
    assert (encode(values)[:, 0] > 0).all()  # 0 stands for what isn't known yet


@pytest.mark.parametrize("march", MARCHES)
@pytest.mark.parametrize("background", [None, torch.tensor([1.0, 0.5, 0.0])])
@pytest.mark.parametrize("space", SPACES)
def test_a_field_whose_logarithm_is_trilinear_is_rendered_as_it_is(space, background, march):
    rays = bundle(space, min_transmittance=0.0)
    found = march([volume_of(trilinear, 10)], *rays, background)
    expected = exact(trilinear, *rays, background)
    assert expected[0].rgb.std() > 0.05
    # Half a byte of a colour, and of a density 3%, which a ray that is half opaque shows as 1%.
    assert_renders(found, expected, tolerance=0.012)


@pytest.mark.parametrize("space", SPACES)
def test_finer_voxels_come_closer_to_the_fields(space, fields):
    rays = bundle(space, min_transmittance=0.0)
    expected = exact(fields, *rays)
    errors = []
    for resolution in (2, 4, 8, 32):
        found = render_baked([volume_of(fields, resolution)], *rays, None)
        errors.append((found[0].rgb - expected[0].rgb).abs().mean().item())
    assert sorted(errors, reverse=True) == errors
    assert errors[-1] < min(0.004, 0.1 * errors[0])


@pytest.mark.parametrize("cells, share", [(6, 0.6), (40, 0.001)])
@pytest.mark.parametrize("min_transmittance", [0.0, 1e-3, 0.3])
@pytest.mark.parametrize("space", SPACES)
def test_the_compiled_march_is_the_one_in_torch(space, min_transmittance, cells, share, fields):
    occupancy = Occupancy(cells)
    torch.manual_seed(1)
    occupancy.occupied.copy_(torch.rand(cells, cells, cells) < share)
    rays = bundle(space, occupancy, min_transmittance)
    one, other = volume_of(fields), volume_of(fields)
    # The same codes, added up in another order.
    assert_renders(render_baked([one], *rays, WHITE), march_in_torch([other], *rays, WHITE), tolerance=2e-6)
    assert_renders(render_baked([other], *rays, WHITE), march_in_torch([one], *rays, WHITE), tolerance=2e-6)


def test_clearance_is_the_distance_to_the_nearest_occupied_cell_and_follows_the_cells():
    occupied = torch.zeros(21, 5, 4, dtype=torch.bool)
    occupied[1, 2, 0] = occupied[0, 4, 3] = True
    cells = torch.stack(torch.meshgrid(*map(torch.arange, occupied.shape), indexing="ij"), dim=-1)
    expected = (cells[..., None, :] - occupied.nonzero()).abs().amax(dim=-1).amin(dim=-1).clamp(max=16)
    assert torch.equal(clearance_of(occupied).long(), expected)

    volume, occupancy = volume_of(Recorder()), Occupancy(4)
    assert volume.clearance(occupancy).max() == 0
    assert volume.clearance(occupancy) is volume.clearance(occupancy)
    occupancy.occupied.zero_()
    assert volume.clearance(occupancy).min() == 16


@pytest.mark.parametrize("march", MARCHES)
def test_a_volume_filled_in_parts_is_the_one_filled_at_once(march, fields):
    volume, origins_directions = volume_of(fields), rays_of("box")
    parts = []
    for part in (slice(0, 7), slice(7, 30), slice(30, 60)):
        rays = bundle("box", rays=tuple(tensor[part] for tensor in origins_directions))
        parts.append(march([volume], *rays, None)[0].rgb)
    whole = march([volume_of(fields)], *bundle("box"), None)[0].rgb
    torch.testing.assert_close(torch.cat(parts), whole, atol=1e-6, rtol=0)


@pytest.mark.parametrize("march", MARCHES)
def test_a_voxel_is_evaluated_once(march):
    recorder = Recorder()
    volume = volume_of(recorder)
    first = march([volume], *bundle("box"), None)
    calls = len(recorder.calls)
    assert len(recorder.points.unique(dim=0)) == len(recorder.points)
    assert_renders(march([volume], *bundle("box"), None), first, tolerance=0)
    assert len(recorder.calls) == calls


@pytest.mark.parametrize("march", MARCHES)
def test_empty_cells_are_not_evaluated(march):
    occupancy = Occupancy(4)
    occupancy.occupied.zero_()
    occupancy.occupied[1, 2, 2] = True
    recorder = Recorder()
    found, _ = march([volume_of(recorder, 32)], *bundle("box", occupancy), None)
    assert found.accumulation.max() > 0.1
    # The cell reaches from −0.5 to 0 in x and from 0 to 0.5 in y and z, where voxels lie too: 9 along a side.
    low, high = torch.tensor([-0.5, 0.0, 0.0]), torch.tensor([0.0, 0.5, 0.5])
    assert (recorder.points >= low - 1e-6).all() and (recorder.points <= high + 1e-6).all()
    assert len(recorder.points) <= 9**3


@pytest.mark.parametrize("march", MARCHES)
def test_nothing_is_evaluated_far_behind_a_surface(march):
    rays = bundle("box", rays=(torch.tensor([[-3.0, 0.1, 0.1]]), torch.tensor([[1.0, 0.0, 0.0]])))
    recorder = Recorder(density=1e4, stylised_density=1e4)
    found, _ = march([volume_of(recorder)], *rays, None)
    assert found.accumulation.item() == pytest.approx(1)
    step, voxel = 2 / STEPS, 2 / 30
    assert recorder.points[:, 0].max() <= -1 + max(LOOKAHEAD, SAMPLES_PER_PASS) * step + voxel


@pytest.mark.parametrize("march", MARCHES)
def test_a_ray_ends_where_the_coarse_surface_is_opaque_as_in_the_exact_render(march):
    # Stylising has made the surface transparent; behind it no more samples count.
    rays = bundle("box", rays=(torch.tensor([[-3.0, 0.1, 0.1]]), torch.tensor([[1.0, 0.0, 0.0]])))
    (found, coarse) = march([volume_of(Recorder(density=1e4, stylised_density=1.0))], *rays, None)
    assert coarse.accumulation.item() == pytest.approx(1)
    one_sample = 1 - torch.exp(torch.tensor(-2 / STEPS))
    assert found.accumulation.item() == pytest.approx(one_sample.item(), rel=0.03)


@pytest.mark.parametrize("march", MARCHES)
@pytest.mark.parametrize("background", [None, torch.tensor([0.2, 0.4, 0.6])])
def test_rays_past_the_scene_show_the_background_and_evaluate_nothing(background, march):
    recorder = Recorder()
    origins, directions = rays_of("box")
    for render in march([volume_of(recorder)], *bundle("box", rays=(origins, -directions)), background):
        expected = torch.zeros(3) if background is None else background
        torch.testing.assert_close(render.rgb, expected.expand(60, 3))
        assert (render.accumulation == 0).all()
        assert (render.s == 1).all()
    assert recorder.calls == []


@pytest.mark.parametrize("march", MARCHES)
@pytest.mark.parametrize("space", ["ndc", "contracted"])
@pytest.mark.parametrize("density, opacity", [(1e-9, 1.0), (0.0, 0.0)])
def test_the_last_interval_goes_on_to_infinity(density, opacity, space, march):
    occupancy = Occupancy(4)
    occupancy.occupied.zero_()
    found, coarse = march([volume_of(Recorder(density, density))], *bundle(space, occupancy), None)
    assert found.accumulation.flatten().tolist() == pytest.approx([opacity] * 60)
    assert coarse.accumulation.flatten().tolist() == pytest.approx([opacity] * 60)
    assert found.s.flatten().tolist() == pytest.approx([1 - 0.5 / STEPS if opacity else 1.0] * 60)


@pytest.mark.parametrize("march", MARCHES)
def test_outside_of_the_cube_its_border_counts(march):
    # Straight ahead and far to the right of what NDC's box holds.
    rays = bundle("ndc", rays=(torch.tensor([[9.0, 0.0, 0.0]]), torch.tensor([[0.0, 0.0, -1.0]])))
    assert rays[0].positions(torch.tensor([[0.0]]))[0, 0, 0] > 2
    expected = exact(trilinear, *rays)  # which clamps positions
    assert_renders(march([volume_of(trilinear, 10)], *rays, None), expected, tolerance=0.012)


def test_a_ray_that_is_no_number_does_no_harm(fields):
    origins, directions = rays_of("box")
    origins[3], directions[5] = torch.nan, torch.nan
    found, _ = render_baked([volume_of(fields)], *bundle("box", rays=(origins, directions)), None)
    rest = torch.arange(60)[[index not in (3, 5) for index in range(60)]]
    whole, _ = render_baked([volume_of(fields)], *bundle("box"), None)
    assert torch.equal(found.rgb[rest], whole.rgb[rest])


def test_memory_grows_with_the_bricks_that_rays_have_met_up_to_the_whole_cube():
    volume = volume_of(Recorder(), resolution=31)
    assert volume.num_bytes == 4096 + 4 * 4**3
    volume.fill(torch.tensor([[0, 0, 0], [3, 5, 6]]))  # in one brick
    assert volume.num_bytes == 2 * 4096 + 4 * 4**3
    volume.fill(torch.tensor([[7, 7, 7]]))  # touches eight
    assert volume.num_bytes == 9 * 4096 + 4 * 4**3
    volume.fill(torch.cartesian_prod(*[torch.arange(31)] * 3))
    assert volume.num_bytes == (1 + 4**3) * 4096 + 4 * 4**3
    assert len(volume.shade.points) == 32**3


def test_a_picture_of_no_rays_is_empty(fields):
    rays = bundle("box", rays=(torch.zeros(0, 3), torch.zeros(0, 3)))
    assert render_baked([volume_of(fields)], *rays, None)[0].rgb.shape == (0, 3)


def test_a_volume_without_cells_is_refused():
    with pytest.raises(ValueError, match="bake_resolution"):
        volume_of(trilinear, 0)

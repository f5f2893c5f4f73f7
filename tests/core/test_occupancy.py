import math

import pytest
import reference
import torch
from nerfstudio.data.scene_box import SceneBox

from sparsestyle_ns.core.occupancy import (
    LEAST_DENSITY,
    DensityGrid,
    DensityVolume,
    Occupancy,
    PackedSamples,
    interval_lengths,
    march,
)
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace
from sparsestyle_ns.core.volrend import dense_weights, optical_depth

RAYS, STEPS = 30, 20
CUBE = BoxSpace(SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])))
"""A space whose field coordinates are world coordinates."""


def ball(points, radius=0.5):
    """Density of an opaque ball about the origin."""
    return 100.0 * (points.norm(dim=-1) < radius)


def measured(density, resolution, chunk=1000):
    """The volume of a density."""
    volume = DensityVolume(resolution)
    volume.measure(density, chunk)
    return volume


def along_x(rays=1):
    """Segments that cross the cube along x."""
    origins, directions = torch.tensor([[-3.0, 0.01, 0.01]]), torch.tensor([[1.0, 0.0, 0.0]])
    return CUBE.segments(origins.expand(rays, -1), directions.expand(rays, -1))


def slabs(resolution, layers):
    """A grid that is empty but for layers of cells across x, given by index and density."""
    grid = DensityGrid(resolution, initial=0.0)
    for layer, density in layers.items():
        grid.density.view(resolution, resolution, resolution)[layer] = density
    return grid


@pytest.fixture
def rays():
    """Rays from a sphere about the cube; two thirds of them to points in it."""
    generator = torch.Generator().manual_seed(0)
    origins = 3 * torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=generator), dim=-1)
    aim = torch.rand(RAYS, 3, generator=generator) * 1.6 - 0.8
    aim[20:] += 5
    return origins, torch.nn.functional.normalize(aim - origins, dim=-1)


def test_cells_of_points_worked_out_by_hand():
    points = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [0.1, -0.6, 0.9], [-0.01, 0.0, 0.5]])
    # With 4 cells a side, x = 0.1 lies in cell 2, −0.6 in cell 0, 0.9 in cell 3.
    assert DensityGrid(4).cells(points).tolist() == [0, 63, 2 * 16 + 0 * 4 + 3, 1 * 16 + 2 * 4 + 3]


def test_points_outside_belong_to_the_nearest_cell():
    points = torch.tensor([[-9.0, 0.1, 5.0], [-1.0 - 1e-6, 0.1, 1.0]])
    assert DensityGrid(4).cells(points).tolist() == [0 * 16 + 2 * 4 + 3] * 2


def test_a_cell_remembers_the_larger_of_what_it_sees_and_what_it_had_decayed():
    grid = DensityGrid(2, initial=10.0)
    positions = torch.tensor([[-0.5, -0.5, -0.5], [-0.4, -0.4, -0.4], [0.5, 0.5, 0.5]])
    grid.remember(positions, torch.tensor([3.0, 4.0, 20.0]), decay=0.8)
    # Cell 0 is seen twice but decays once; cell 7 grows; the cells that were not seen keep what they had.
    assert grid.density.tolist() == [8.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 20.0]
    for _ in range(20):
        grid.remember(positions[:2].view(1, 2, 3), torch.tensor([[3.0, 4.0]]), decay=0.8)
    assert grid.density[0] == 4


def test_remembering_takes_no_gradient():
    grid = DensityGrid(2)
    grid.remember(torch.zeros(1, 3), torch.tensor([5.0], requires_grad=True))
    assert not grid.density.requires_grad


def test_samples_gather_where_the_grid_is_dense():
    edges = slabs(16, {10: 50.0}).place_samples(along_x(), 100, 64, unbounded=False, even_share=0.2)[0]
    # Layer 10 is s in [10/16, 11/16], four bins; each bin is widened by one to either side.
    inside = ((edges >= 10 / 16 - 1 / 64 - 1e-6) & (edges <= 11 / 16 + 1 / 64 + 1e-6)).sum()
    # Four fifths of the mass, and the even share of six bins out of 64.
    assert inside >= 0.8 * 100


def test_the_bins_before_and_behind_a_surface_get_as_many_samples_as_its_own():
    edges = slabs(16, {10: 1e4}).place_samples(along_x(), 96, 16, unbounded=False, even_share=0.25)[0]
    # Three quarters of 96 samples for three bins, and one and a half for every bin from the even share.
    counts = torch.histc(0.5 * (edges[1:] + edges[:-1]), bins=16, min=0, max=1)
    assert counts[9:12].tolist() == pytest.approx([24 + 1.5] * 3, abs=1)


def test_what_is_hidden_gets_no_more_than_the_even_share():
    edges = slabs(16, {3: 1000.0, 12: 1000.0}).place_samples(along_x(), 100, 64, unbounded=False, even_share=0.2)[0]
    hidden = ((edges > 0.7) & (edges <= 0.9)).sum()
    assert hidden == pytest.approx(0.2 * 0.2 * 100, abs=2)


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("seed", [None, 0])
def test_samples_cover_the_whole_ray_in_order(unbounded, seed, rays):
    grid = DensityGrid(8)
    grid.density.copy_(torch.rand(512, generator=torch.Generator().manual_seed(1)) ** 8 * 100)
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    edges = grid.place_samples(CUBE.segments(*rays), 24, 48, unbounded, 0.3, generator)
    assert edges.shape == (RAYS, 25)
    assert (edges[:, 0] == 0).all() and (edges[:, -1] == 1).all()
    assert (edges.diff(dim=-1) >= -1e-7).all()
    # The even share alone has 0.3 · 24 = 7.2 samples on the ray, so that no gap is longer than a seventh of it. Jitter
    # makes a bin up to twice as wide, and a sample's part of the mass up to twice as large.
    assert edges.diff(dim=-1).max() <= (1 if seed is None else 4) / 7.2 + 1e-5


def test_an_empty_grid_spreads_samples_evenly():
    edges = slabs(8, {}).place_samples(along_x(2), 10, 64, unbounded=False, even_share=0.1)
    torch.testing.assert_close(edges, torch.linspace(0, 1, 11).expand(2, -1))


def test_placement_is_fixed_without_a_generator():
    grid = slabs(8, {4: 3.0})
    first, second = (grid.place_samples(along_x(), 10, 32, False, 0.2) for _ in range(2))
    assert torch.equal(first, second)
    jittered = grid.place_samples(along_x(), 10, 32, False, 0.2, torch.Generator().manual_seed(0))
    assert not torch.equal(first, jittered)


def test_the_last_interval_is_infinite_only_in_unbounded_spaces_and_on_rays_that_hit(rays):
    segments = CUBE.segments(*rays)
    edges = torch.linspace(0, 1, 5).expand(RAYS, -1)
    bounded, unbounded = (interval_lengths(segments, edges, kind) for kind in (False, True))
    torch.testing.assert_close(bounded, segments.lengths(edges))
    assert torch.equal(unbounded[:, :-1], bounded[:, :-1])
    assert torch.equal(unbounded[:, -1] == math.inf, segments.hit)
    assert (unbounded[~segments.hit] == 0).all()


@pytest.mark.parametrize("chunk", [1, 700, 10**9])
def test_measuring_marks_a_ball_and_the_cells_next_to_it(chunk):
    occupancy = Occupancy(12)
    occupancy.measure(measured(ball, 12, chunk), min_alpha=0.01)
    side, marked, near = 2 / 12, 0, 0
    for x in range(12):
        for y in range(12):
            for z in range(12):
                centers = [
                    math.dist((0, 0, 0), [(i + d + 0.5) * side - 1 for i, d in zip((x, y, z), step, strict=True)])
                    for step in torch.cartesian_prod(*[torch.tensor([-1, 0, 1])] * 3).tolist()
                ]
                assert occupancy.occupied[x, y, z].item() == (min(centers) < 0.5)
                marked += min(centers) < 0.5
                near += centers[13] < 0.5
    assert near < marked < 12**3
    assert occupancy.share == pytest.approx(marked / 12**3)


@pytest.mark.parametrize("factor, expected", [(0.98, 0.0), (1.02, 1.0)])
def test_a_cell_counts_from_the_asked_opacity_over_its_side(factor, expected):
    occupancy = Occupancy(4)
    density = -math.log(1 - 0.3) / (2 / 4)
    volume = measured(lambda points: torch.full((len(points),), factor * density), 4)
    occupancy.measure(volume, min_alpha=0.3)
    assert occupancy.share == expected


def centers(resolution):
    """The centres of the cells, [x, y, z, 3]."""
    axis = (torch.arange(resolution) + 0.5) * (2 / resolution) - 1
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)


def uneven(points):
    """A density that differs along all three axes, over several orders of magnitude."""
    return torch.exp(points @ torch.tensor([3.0, -2.0, 1.0]))


@pytest.mark.parametrize("chunk", [1, 30, 10**9])
def test_a_volume_has_the_densities_of_the_field_at_the_centres_of_its_cells(chunk):
    points = centers(5)
    volume = measured(uneven, 5, chunk)
    torch.testing.assert_close(volume.density(points), uneven(points))
    torch.testing.assert_close(volume.log_density, uneven(points).log())


def test_between_the_centres_the_logarithm_of_the_density_is_linear():
    volume = measured(uneven, 4)
    # Of `uneven` the logarithm itself is linear, so that no point within the outer centres is wrong.
    points = 1.5 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.75
    torch.testing.assert_close(volume.density(points), uneven(points))
    # Of two neighbours with 1 and 100 the middle is their geometric mean.
    volume = measured(lambda points: torch.where(points[:, 0] < 0, 1.0, 100.0), 2)
    assert volume.density(torch.tensor([[0.0, 0.1, 0.2], [-0.25, 0.0, 0.0]])).tolist() == pytest.approx([10, 10**0.5])


def test_outside_of_the_outer_centres_a_volume_goes_on_with_its_border():
    volume = measured(uneven, 4)
    points = torch.tensor([[5.0, 0.25, -0.25], [-9.0, -9.0, 9.0], [0.25, 1.0, -0.9]])
    torch.testing.assert_close(volume.density(points), uneven(points.clamp(-0.75, 0.75)))


def test_nothing_is_thinner_in_a_volume_than_what_shows_nowhere():
    volume = measured(lambda points: torch.zeros(len(points)), 3)
    assert volume.density(torch.zeros(2, 4, 3)).tolist() == [[pytest.approx(LEAST_DENSITY)] * 4] * 2


def test_before_measuring_all_cells_are_occupied():
    assert Occupancy(3).share == 1


def test_marching_keeps_exactly_the_samples_in_occupied_cells(rays):
    occupancy = Occupancy(10)
    occupancy.measure(measured(ball, 10), min_alpha=0.01)
    segments = CUBE.segments(*rays)
    samples = march(segments, occupancy, STEPS, unbounded=False)
    expected = []
    for ray in range(RAYS):
        near, far = segments.near[ray].item(), segments.far[ray].item()
        for step in range(STEPS):
            s = (step + 0.5) / STEPS
            position = [
                o + (near + s * (far - near)) * d for o, d in zip(*(part[ray].tolist() for part in rays), strict=True)
            ]
            if segments.hit[ray] and occupancy.occupied[reference.cell(position, 10)]:
                expected.append((ray, s, (far - near) / STEPS, *position))
    found = torch.cat([torch.stack(samples[:3], dim=-1), samples.positions], dim=-1)
    assert 0 < len(expected) < RAYS * STEPS / 2
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize("unbounded", [False, True])
def test_samples_are_ordered_by_ray_and_from_front_to_back(unbounded, rays):
    samples = march(CUBE.segments(*rays), Occupancy(4), STEPS, unbounded)
    ray_step = samples.ray_indices.diff()
    assert (ray_step >= 0).all()
    assert (samples.s.diff()[ray_step == 0] > 0).all()


def test_rays_that_miss_have_no_samples(rays):
    segments = CUBE.segments(*rays)
    assert 0 < segments.hit.sum() < RAYS
    for unbounded in (False, True):
        samples = march(segments, Occupancy(4), STEPS, unbounded)
        assert torch.equal(torch.bincount(samples.ray_indices, minlength=RAYS), STEPS * segments.hit)


def test_the_last_step_of_an_unbounded_space_is_kept_however_empty(rays):
    occupancy = Occupancy(4)
    occupancy.measure(measured(lambda points: torch.zeros(len(points)), 4), min_alpha=0.01)
    samples = march(ContractedSpace().segments(*rays), occupancy, STEPS, unbounded=True)
    assert samples.ray_indices.tolist() == list(range(RAYS))
    assert samples.s.tolist() == pytest.approx([1 - 0.5 / STEPS] * RAYS)
    assert (samples.lengths == math.inf).all()
    assert len(march(CUBE.segments(*rays), occupancy, STEPS, unbounded=False).s) == 0


def test_selecting_keeps_all_of_a_sample_together(rays):
    samples = march(CUBE.segments(*rays), Occupancy(4), STEPS, unbounded=False)
    keep = samples.s > 0.7
    chosen = samples.select(keep)
    assert isinstance(chosen, PackedSamples)
    for part, whole in zip(chosen, samples, strict=True):
        assert torch.equal(part, whole[keep])


def test_with_the_histogram_that_volume_rendering_gives_a_surface_holds_its_weight_on_few_samples():
    grid = slabs(16, {10: 200.0})
    segments = along_x()
    edges = grid.place_samples(segments, 40, 64, unbounded=False, even_share=0.1)
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    density = grid.density[grid.cells(segments.positions(middle))]
    weights = dense_weights(optical_depth(density, segments.lengths(edges)))
    # Rendered from these samples the mean lies at the slab's front, s = 10/16, to within a widened bin.
    assert ((weights * middle).sum() / weights.sum()).item() == pytest.approx(10 / 16, abs=1 / 64)

import math
import weakref

import pytest
import reference
import torch
from nerfstudio.field_components.encodings import HashEncoding
from torch.utils.checkpoint import checkpoint

from sparsestyle_ns.field_components.hash_grid import (
    HashGrid,
    grid_resolutions,
    hash_corners,
    interpolate,
    locate_corners,
)

POINTS = 50


@pytest.fixture
def points():
    return torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0))


def small_grid(**settings):
    """Two levels of 4 and 9 cells, three features, tables of 64 rows; values of the order of 1."""
    torch.manual_seed(1)
    settings = {"log2_table_size": 6, "features_per_level": 3, **settings}
    return HashGrid(num_levels=2, min_resolution=4, max_resolution=9, init_scale=1.0, **settings)


def roomy_grid(resolution=4):
    """One level whose corners all have a row of their own, and the rows of its (resolution + 1)³ corners."""
    grid = HashGrid(1, resolution, resolution, features_per_level=2, log2_table_size=16, init_scale=1.0)
    corners = torch.cartesian_prod(*[torch.arange(resolution + 2)] * 3)
    rows = hash_corners(corners, grid.table_size)
    assert len(rows.unique()) == len(rows)
    return grid, corners, rows


def test_the_papers_levels_grow_from_128_to_512_by_the_formula():
    growth = math.exp((math.log(512) - math.log(128)) / 7)
    expected = [128, *(math.floor(128 * growth**level) for level in range(1, 7)), 512]
    assert grid_resolutions(8, 128, 512) == tuple(expected) == (128, 156, 190, 231, 282, 344, 420, 512)


@pytest.mark.parametrize(
    "num_levels, lowest, highest", [(1, 16, 16), (2, 4, 9), (16, 16, 2048), (5, 7, 7), (4, 8, 1000)]
)
def test_the_first_and_the_last_level_have_the_asked_resolutions(num_levels, lowest, highest):
    resolutions = grid_resolutions(num_levels, lowest, highest)
    assert len(resolutions) == num_levels
    assert (resolutions[0], resolutions[-1]) == (lowest, highest)
    assert list(resolutions) == sorted(resolutions)


def test_the_defaults_are_the_papers():
    grid = HashGrid(log2_table_size=10)
    assert grid.resolutions == grid_resolutions(8, 128, 512)
    assert grid.get_out_dim() == 8 * 4
    assert HashGrid.__init__.__defaults__[:5] == (8, 128, 512, 4, 19)
    assert grid.table.shape == (8 * 2**10, 4)
    assert 0.9e-4 < grid.table.abs().max() <= 1e-4


def test_values_are_those_of_the_slow_sum_over_corners(points):
    grid = small_grid()
    table = grid.table.tolist()
    expected = [reference.hash_encoding(point, table, grid.resolutions, grid.table_size) for point in points.tolist()]
    # Python computes in float64; float32 loses 1e-6 of a cell in the weights of a position times 9.
    torch.testing.assert_close(grid(points), torch.tensor(expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize("num_levels, lowest, highest", [(8, 128, 512), (3, 4, 16)])
def test_values_are_those_of_nerfstudios_encoding_with_the_same_table(num_levels, lowest, highest, points):
    # The two share the hash, the order of levels and the layout of the table (level m's rows start at m·T); only the
    # order in which the corners are summed differs, so a table can be copied as it is.
    grid = HashGrid(num_levels, lowest, highest, features_per_level=4, log2_table_size=9, init_scale=1.0)
    other = HashEncoding(num_levels, lowest, highest, 9, 4, implementation="torch")
    assert other.scalings.tolist() == list(grid.resolutions)
    other.hash_table.data.copy_(grid.table.data)
    torch.testing.assert_close(grid(points), other(points), atol=1e-5, rtol=0)
    assert grid.get_out_dim() == other.get_out_dim()


def test_a_linear_function_is_reproduced(points):
    grid, corners, rows = roomy_grid()
    slope, offset = torch.tensor([[1.0, -2.0, 0.5], [3.0, 0.0, 1.0]]), torch.tensor([0.25, -1.0])
    grid.table.data[rows] = corners / 4 @ slope.T + offset
    torch.testing.assert_close(grid(points), points @ slope.T + offset, atol=1e-6, rtol=0)


def test_at_the_nodes_of_the_grid_the_value_is_the_tables_row():
    grid, corners, rows = roomy_grid()
    inside = (corners <= 4).all(dim=-1)
    torch.testing.assert_close(grid(corners[inside] / 4), grid.table[rows[inside]])


def test_weights_are_a_partition_of_one_and_rows_stay_on_their_level(points):
    corners = locate_corners(points, (4, 9), 64)
    assert corners.rows.shape == corners.weights.shape == (POINTS, 2, 8)
    assert (corners.weights >= 0).all()
    torch.testing.assert_close(corners.weights.sum(dim=-1), torch.ones(POINTS, 2))
    for level in range(2):
        rows = corners.rows[:, level]
        assert rows.min() >= 64 * level and rows.max() < 64 * (level + 1)


def test_there_is_no_jump_at_the_border_of_cells(points):
    grid = small_grid().double()
    on_border = points.double()
    on_border[:, 0] = torch.randint(1, 4, (POINTS,), generator=torch.Generator().manual_seed(2)) / 4
    step = torch.tensor([1e-9, 0.0, 0.0], dtype=torch.float64)
    before, after = (grid(on_border + side * step) for side in (-1, 1))
    # A table value is at most 1 and a level has at most 9 cells, so the slope is at most 18.
    assert (after - before).abs().max() <= 2e-9 * 18 + 1e-12


def test_points_outside_have_the_value_of_the_nearest_point_inside():
    grid = small_grid()
    outside = torch.tensor([[-0.5, 0.3, 1.7], [2.0, 2.0, 2.0], [-1e-9, 0.5, 0.5]])
    torch.testing.assert_close(grid(outside), grid(outside.clamp(0, 1)))


def test_locating_once_and_interpolating_is_the_same_as_asking_the_grid(points):
    grid = small_grid()
    assert torch.equal(grid.interpolate(grid.locate(points)), grid(points))
    assert torch.equal(grid(points.view(5, 10, 3)), grid(points).view(5, 10, -1))


@pytest.mark.parametrize("shape", [(0, 3), (4, 0, 3)])
def test_no_points_have_no_values(shape):
    grid = small_grid()
    values = grid(torch.zeros(shape))
    assert values.shape == (*shape[:-1], grid.get_out_dim())
    values.sum().backward()
    assert grid.table.grad.count_nonzero() == 0


def test_the_gradient_of_the_table_matches_finite_differences(points):
    grid = HashGrid(2, 2, 3, features_per_level=2, log2_table_size=3, init_scale=1.0).double()
    location = grid.locate(points[:6])

    def values(table):
        return torch.func.functional_call(grid, {"table": table}, (location.positions,))

    assert location.corners is None
    assert torch.autograd.gradcheck(values, (grid.table,))


def test_the_gradient_of_the_readable_form_matches_finite_differences(points):
    corners = locate_corners(points[:6].double(), (2, 3), 8)
    table = torch.randn(16, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda rows: interpolate(rows, corners), (table,))


@pytest.mark.parametrize("features", [1, 2, 4, 5])
@pytest.mark.parametrize("threads", [1, 3, 20])
def test_the_cpus_kernels_and_the_readable_form_agree_in_values_and_gradients(features, threads, points):
    grid = small_grid(features_per_level=features)
    importance = torch.randn(POINTS, grid.get_out_dim(), generator=torch.Generator().manual_seed(4))
    corners = locate_corners(points, grid.resolutions, grid.table_size)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        values = [grid(points), interpolate(grid.table, corners)]
        gradients = [torch.autograd.grad((importance * each).sum(), grid.table)[0] for each in values]
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(*values, atol=1e-6, rtol=1e-6)
    # A row that many corners share sums some tens of float32 numbers in another order.
    torch.testing.assert_close(*gradients, atol=1e-5, rtol=1e-5)


def test_without_kernels_the_readable_form_runs(monkeypatch, points):
    grid = small_grid()
    expected = grid(points)
    monkeypatch.setattr("sparsestyle_ns.field_components.hash_grid.fused_kernels", lambda device: None)
    assert grid.locate(points).corners is not None
    torch.testing.assert_close(grid(points), expected, atol=1e-6, rtol=1e-6)


def test_gradients_are_the_same_to_the_bit_whenever_they_are_computed(points):
    grid = small_grid()
    gradients = [torch.autograd.grad(grid(points).square().sum(), grid.table)[0] for _ in range(2)]
    assert torch.equal(*gradients)


def test_the_gradient_may_come_in_any_layout(points):
    grid = small_grid()
    importance = torch.randn(grid.get_out_dim(), POINTS).T
    strided, packed = (
        torch.autograd.grad((grid(points) * each).sum(), grid.table)[0]
        for each in (importance, importance.contiguous())
    )
    assert torch.equal(strided, packed)
    (broadcast,) = torch.autograd.grad(grid(points).sum(), grid.table)
    (written_out,) = torch.autograd.grad((grid(points) * torch.ones(POINTS, grid.get_out_dim())).sum(), grid.table)
    assert torch.equal(broadcast, written_out)


@pytest.mark.parametrize("with_kernels", [True, False])
def test_of_a_checkpointed_chunk_nothing_is_kept_until_the_backward_pass(with_kernels, monkeypatch, points):
    if not with_kernels:
        monkeypatch.setattr("sparsestyle_ns.field_components.hash_grid.fused_kernels", lambda device: None)
    grid, located = small_grid(), []

    def encode():
        location = grid.locate(points)
        located.extend(map(weakref.ref, (location.positions, *(location.corners or ()))))
        return grid.interpolate(location)

    encoded = checkpoint(encode, use_reentrant=False)
    assert len(located) == (1 if with_kernels else 3)
    assert all(reference() is None for reference in located)
    expected = torch.autograd.grad(grid(points).square().sum(), grid.table)[0]
    torch.testing.assert_close(torch.autograd.grad(encoded.square().sum(), grid.table)[0], expected)


def test_the_memory_of_a_location_counts_all_of_its_parts(points):
    location = small_grid().locate(points)
    assert location.num_bytes == POINTS * 3 * 4
    kept = location._replace(corners=locate_corners(points, (4, 9), 64))
    assert kept.num_bytes == POINTS * 3 * 4 + POINTS * 2 * 8 * (4 + 4)

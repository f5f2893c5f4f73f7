import math

import pytest
import reference
import torch
from hard.table import hard_case

from sparsestyle_ns.field_components.hash_grid import (
    HashGrid,
    grid_resolutions,
    hash_corners,
    interpolate,
    locate_corners,
)
from sparsestyle_ns.field_components.positional_encoding import positional_encoding, revealed_levels


def grid_of(resolution, log2_table_size=10, dtype=torch.float32):
    """A grid of one level with random rows."""
    torch.manual_seed(0)
    return HashGrid(1, resolution, resolution, 2, log2_table_size, init_scale=1.0).to(dtype)


@hard_case(
    "encodings",
    case="2^k x for x up to 1e6 and k up to 6",
    could_go_wrong="angles that are off by whole turns",
    must_hold="every value is float64's sine or cosine of the same float32 number, to 1e-6",
)
@pytest.mark.parametrize("size", [1.0, 1e2, 1e4, 1e6])
def test_octaves_of_large_coordinates_are_exact(size):
    x = size * torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    expected = torch.tensor([reference.positional_encoding(point, 7) for point in x.tolist()])
    torch.testing.assert_close(positional_encoding(x, 7)[:, 3:], expected[:, 3:], rtol=0, atol=1e-6)


@hard_case(
    "encodings",
    case="octaves up to 2^60",
    could_go_wrong="2^k is a rounded exponential, which is off by a whole turn at large x",
    must_hold="2^k is exact: values are float64's to 1e-6",
)
def test_frequencies_are_exact_powers_of_two():
    x = torch.tensor([[0.7, -1.0, 1 / 3]])
    expected = torch.tensor([reference.positional_encoding(point, 61) for point in x.tolist()])
    torch.testing.assert_close(positional_encoding(x, 61), expected, rtol=0, atol=1e-6)


@hard_case(
    "encodings",
    case="coordinates in bfloat16 and float16",
    could_go_wrong="2^k x overflows at 65,504, and the sine of infinity is not a number",
    must_hold="finite, and float32's of the same numbers",
)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_coordinates_are_encoded_as_in_float32(dtype):
    x = torch.tensor([[1e4, -60000.0, 0.3]]).to(dtype)
    assert torch.equal(positional_encoding(x, 10), positional_encoding(x.float(), 10))


@hard_case(
    "encodings",
    case="the gradient of the highest octaves",
    could_go_wrong="an error of the angle, times 2^k",
    must_hold="2^k cos(2^k x), float64's to six digits of 2^k",
)
def test_the_gradient_of_high_octaves_is_exact():
    x = torch.randn(200, 1, generator=torch.Generator().manual_seed(0), requires_grad=True)
    (gradient,) = torch.autograd.grad(positional_encoding(x, 16)[:, -2].sum(), x)
    expected = 2.0**15 * torch.cos(2.0**15 * x.detach().double())
    torch.testing.assert_close(gradient.double(), expected, rtol=0, atol=2.0**15 * 1e-6)


@hard_case(
    "encodings",
    case="octaves revealed by shares below 0, above 1 and of ∞",
    could_go_wrong="negative or infinite factors",
    must_hold="factors in [0, 1], none at 0 and below, all at 1 and above",
)
def test_revealed_octaves_have_factors_from_0_to_1():
    assert revealed_levels(-3.0, 5).tolist() == revealed_levels(0.0, 5).tolist() == [0] * 5
    assert revealed_levels(math.inf, 5).tolist() == revealed_levels(1.0, 5).tolist() == [1] * 5
    assert revealed_levels(1e-30, 5).tolist() == pytest.approx([5e-30, 0, 0, 0, 0])


@hard_case(
    "encodings",
    case="the highest level of the hash grid in float32",
    could_go_wrong="the place in a cell loses its digits; points get into the wrong cell",
    must_hold="ψ is float64's to N · 2^-24 cells, at N = 512 and at N = 2^16",
)
@pytest.mark.parametrize("resolution", [512, 2**16])
def test_the_finest_cells_are_interpolated_as_in_float64(resolution):
    grid, exact = grid_of(resolution), grid_of(resolution, dtype=torch.float64)
    x = torch.rand(2000, 3, generator=torch.Generator().manual_seed(1))
    # Half a unit in the last place of N x along each of three axes, and rows differ by up to 2.
    torch.testing.assert_close(grid(x).double(), exact(x.double()), rtol=0, atol=2 * 3 * resolution * 2.0**-24 + 1e-6)


@hard_case(
    "encodings",
    case="points exactly on cell borders, and one unit in the last place beside them",
    could_go_wrong="a jump from cell to cell",
    must_hold="ψ on the border is a table row; on both sides it is as near as the points are",
)
def test_the_grid_has_no_jumps_at_cell_borders():
    grid = grid_of(32)
    corners = torch.randint(1, 32, (300, 3), generator=torch.Generator().manual_seed(1))
    borders = corners.float() / 32
    torch.testing.assert_close(grid(borders), grid.table[hash_corners(corners, grid.table_size)], rtol=0, atol=1e-6)
    for towards in (0.0, 1.0):
        beside = torch.nextafter(borders, torch.tensor(towards))
        torch.testing.assert_close(grid(beside), grid(borders), rtol=0, atol=1e-4)


@hard_case(
    "encodings",
    case="points at 0, at 1, and outside, up to ±∞",
    could_go_wrong="rows past the end of the table; a negative cell",
    must_hold="ψ is that of the nearest point of the cube, in both implementations",
)
@pytest.mark.parametrize("size", [1e-7, 1.0, 1e10, 1e38, math.inf])
def test_points_outside_count_as_on_the_border(size):
    grid = grid_of(32)
    outside = torch.tensor([[-size, 0.3, 1 + size], [0.0, 1.0, -size], [1 + size] * 3])
    inside = outside.clamp(0, 1)
    torch.testing.assert_close(grid(outside), grid(inside), rtol=0, atol=0)
    readable = interpolate(grid.table, locate_corners(inside, grid.resolutions, grid.table_size))
    torch.testing.assert_close(grid(inside), readable)


@hard_case(
    "encodings",
    case="levels between any two resolutions",
    could_go_wrong="N_max comes out as N_max − 1 by rounding; levels that fall",
    must_hold="the first level has N_min, the last N_max, and none fewer cells than the one before",
)
def test_levels_run_from_the_coarsest_to_the_finest():
    for lowest, highest in [(1, 1), (1, 2), (16, 2**20), (3, 999_983), (128, 512), (127, 2**24 - 1)]:
        for levels in (1, 2, 8, 16, 40):
            resolutions = grid_resolutions(levels, lowest, highest)
            assert resolutions[0] == lowest and (levels == 1 or resolutions[-1] == highest)
            assert sorted(resolutions) == list(resolutions)


@hard_case(
    "encodings",
    case="corners of a grid of 2^20 cells",
    could_go_wrong="products of the hash overflow differently in int64, uint32 and the compiled kernel",
    must_hold="rows lie in the table, and both implementations agree",
)
def test_hashes_of_large_corners_agree():
    grid = grid_of(2**20, log2_table_size=12)
    x = torch.rand(500, 3, generator=torch.Generator().manual_seed(1))
    corners = locate_corners(x, grid.resolutions, grid.table_size)
    assert (corners.rows >= 0).all() and (corners.rows < grid.table_size).all()
    torch.testing.assert_close(grid(x), interpolate(grid.table, corners))

"""The hash grid's kernels for CUDA, without a GPU: run in Triton's interpreter, and compiled to machine code."""

import pytest
import torch
from interpreted_kernels import interpreted_kernels

from sparsestyle_ns.field_components import hash_grid, hash_grid_kernels
from sparsestyle_ns.field_components.hash_grid import HashGrid, interpolate, locate_corners

triton = pytest.importorskip("triton", reason="triton comes with torch for CUDA only")

BLOCK = 128
CARDS = {"sm_80": 80, "sm_90": 90, "sm_120": 120}


def places(count, dtype=torch.float32):
    """Points in the cube, among them its corners, borders of cells, and what is next to these."""
    special = torch.cartesian_prod(*[torch.tensor([0.0, 0.25, 1.0], dtype=dtype)] * 3)
    near = torch.nextafter(special, torch.full_like(special, 0.5))
    drawn = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=dtype)
    return torch.cat([special, near, drawn])[:count]


def both(points, table, resolutions):
    """Values, and gradients for the same weights of the values, by the kernels for CUDA and for the CPU."""
    found = []
    for kernels in (interpreted_kernels(), hash_grid_kernels):
        values = kernels.gather(table, points, resolutions)
        weights = torch.randn(values.shape, generator=torch.Generator().manual_seed(1), dtype=values.dtype)
        found.append((values, kernels.scatter(weights, points, resolutions, tuple(table.shape))))
    return zip(*found, strict=True)


@pytest.mark.parametrize("count", [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 44])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_points_has_the_values_and_gradients_that_the_cpus_kernels_give(count, dtype):
    table = torch.rand(2, 64, 3, generator=torch.Generator().manual_seed(2), dtype=dtype)
    (ours, theirs), (gradient, expected) = both(places(count, dtype), table, (4, 9))
    assert ours.dtype == dtype and ours.shape == (count, 6)
    tolerance = {torch.float32: 1e-5, torch.float64: 1e-12}[dtype]  # of sums of some hundred numbers, in another order
    torch.testing.assert_close(ours, theirs, atol=tolerance, rtol=tolerance)
    torch.testing.assert_close(gradient, expected, atol=tolerance, rtol=10 * tolerance)


@pytest.mark.parametrize("levels", [1, 3])
@pytest.mark.parametrize("features", [1, 2, 3, 4, 8])
@pytest.mark.parametrize("rows", [2, 1 << 10])
def test_any_shape_of_the_table_has_the_values_and_gradients_that_the_cpus_kernels_give(levels, features, rows):
    table = torch.rand(levels, rows, features, generator=torch.Generator().manual_seed(2))
    for ours, theirs in both(places(70), table, (4, 300, 2048)[:levels]):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)  # 12 bits say where in a cell a point is


@pytest.fixture
def grid(monkeypatch):
    monkeypatch.setattr(hash_grid, "fused_kernels", lambda device: interpreted_kernels())
    torch.manual_seed(0)
    return HashGrid(2, 4, 9, features_per_level=3, log2_table_size=6, init_scale=1.0)


def test_the_grid_learns_by_them_as_by_the_readable_form(grid):
    points = places(150)
    corners = locate_corners(points, grid.resolutions, grid.table_size)
    values = [grid(points), interpolate(grid.table, corners)]
    gradients = [torch.autograd.grad(each.square().sum(), grid.table)[0] for each in values]
    torch.testing.assert_close(*values, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(*gradients, atol=1e-4, rtol=1e-4)


def test_gradients_match_finite_differences_and_come_in_any_layout(grid):
    grid = grid.double()
    points = places(3, torch.float64)

    def values(table):
        return torch.func.functional_call(grid, {"table": table}, (points,))

    assert torch.autograd.gradcheck(values, (grid.table,), fast_mode=True)
    transposed = torch.randn(6, 3, dtype=torch.float64).T
    strided, packed = (
        torch.autograd.grad((grid(points) * each).sum(), grid.table)[0]
        for each in (transposed, transposed.contiguous())
    )
    assert torch.equal(strided, packed)


@pytest.mark.parametrize("power", range(0, 25))
def test_the_programs_cover_each_point_once_and_stay_within_cudas_limits(power):
    for count in {2**power - 1, 2**power, 2**power + 1} - {0}:
        blocks, levels = interpreted_kernels()._programs(count, levels=16)
        assert (blocks - 1) * BLOCK < count <= blocks * BLOCK
        assert blocks <= 2**31 - 1 and levels == 16 <= 65_535


def test_there_is_no_launch_without_points(monkeypatch):
    kernels = interpreted_kernels()
    monkeypatch.setattr(kernels, "_gather", None)  # it would be asked for a launch
    assert kernels.gather(torch.rand(2, 8, 4), torch.zeros(0, 3), (4, 9)).shape == (0, 8)


def compiled(name, card, features, kind="fp32", num_points="i32"):
    """Machine code of a kernel, as the just-in-time compiler makes it for the arguments of a launch."""
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from sparsestyle_ns.field_components import hash_grid_triton

    function = getattr(hash_grid_triton, name)
    padded = triton.next_power_of_2(features)
    constants = {"levels": 8, "table_size": 2**19, "features": features, "padded": padded, "block": BLOCK}
    if num_points == "constexpr":  # the compiler takes an argument of 1 for a constant
        constants["num_points"] = 1
    types = dict.fromkeys(function.arg_names[:4], f"*{kind}")
    types |= {"num_points": num_points} | dict.fromkeys(constants, "constexpr")
    source = ASTSource(fn=function, signature=types, constexprs=constants)
    return triton.compile(source, target=GPUTarget("cuda", CARDS[card], 32)).asm


@pytest.mark.parametrize("card", CARDS)
@pytest.mark.parametrize("name", ["_gather", "_scatter"])
def test_they_compile_for_a_card(name, card):
    code = compiled(name, card, features=4)
    assert code["cubin"] and f".target {card}" in code["ptx"]
    assert ".f64" not in code["ptx"], "a number was widened on its way, which costs half of the speed and more"
    assert ("atom" in code["ptx"] or "red.global" in code["ptx"]) == (name == "_scatter")


@pytest.mark.parametrize(
    "settings", [{"features": 3, "num_points": "constexpr"}, {"features": 1}, {"features": 4, "kind": "fp64"}]
)
def test_other_shapes_and_a_single_point_compile_too(settings):
    for name in ("_gather", "_scatter"):
        assert compiled(name, "sm_80", **settings)["cubin"]


def test_where_triton_is_missing_the_grid_falls_back_to_the_readable_form(monkeypatch):
    monkeypatch.setattr(hash_grid, "find_spec", lambda name: None)
    assert hash_grid.fused_kernels(torch.device("cuda")) is None
    assert hash_grid.fused_kernels(torch.device("cpu")) is hash_grid_kernels

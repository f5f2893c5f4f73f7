"""tiny-cuda-nn needs a GPU; here something with its interface takes its place, so all but its kernels is run."""

from types import SimpleNamespace

import pytest
import reference
import torch
from nerfstudio.field_components import encodings

from sparsestyle_ns.field_components.hash_grid import interpolate
from sparsestyle_ns.field_components.tiny_cuda_grid import (
    TinyCudaGrid,
    growth_factor,
    locate_tiny_cuda_corners,
    tiny_cuda_levels,
)
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.utils.errors import InputError

CPU, GPU = torch.device("cpu"), torch.device("cuda")
SHAPE = {"num_levels": 3, "min_resolution": 4, "max_resolution": 12, "features_per_level": 2, "log2_table_size": 9}


class HalfPrecisionGrid(torch.nn.Module):
    """As tinycudann.Encoding: its arguments, its table of one dimension, and features in half precision."""

    shift = 0.0

    def __init__(self, n_input_dims: int, encoding_config: dict) -> None:
        super().__init__()
        assert n_input_dims == 3 and encoding_config["otype"] == "HashGrid"
        levels, smallest = encoding_config["n_levels"], encoding_config["base_resolution"]
        largest = smallest * encoding_config["per_level_scale"] ** (levels - 1)
        self.levels = tiny_cuda_levels(levels, smallest, largest, encoding_config["log2_hashmap_size"])
        self.features = encoding_config["n_features_per_level"]
        rows = sum(level.num_rows for level in self.levels)
        self.params = torch.nn.Parameter(torch.randn(rows * self.features))

    def forward(self, positions: torch.Tensor) -> torch.Tensor:
        corners = locate_tiny_cuda_corners(positions + self.shift, self.levels)
        return interpolate(self.params.view(-1, self.features), corners).half()


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encodings, "TCNN_EXISTS", True)
    monkeypatch.setattr(encodings, "tcnn", SimpleNamespace(Encoding=HalfPrecisionGrid))


def points(count: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0))


def encode(grid: TinyCudaGrid, positions: torch.Tensor) -> torch.Tensor:
    return grid.interpolate(grid.locate(positions))


def test_in_torch_it_is_the_librarys_formula_on_levels_with_and_without_hashing() -> None:
    torch.manual_seed(0)
    grid = TinyCudaGrid(**SHAPE, device=CPU)
    assert [level.is_hashed for level in grid.levels] == [False, False, True]
    growth = growth_factor(3, 4, 12)
    params = grid.grid.params.tolist()
    positions = torch.cat([points(40), torch.tensor([[0.0, 1.0, 0.5], [1.0, 1.0, 1.0]])])
    expected = [reference.tiny_cuda_encoding(each, params, 3, 4, growth, 2, 2**9) for each in positions.tolist()]
    torch.testing.assert_close(encode(grid, positions), torch.tensor(expected), atol=1e-9, rtol=1e-4)


def test_the_papers_grid_is_hashed_on_every_level_and_a_drafts_coarse_levels_are_not() -> None:
    assert all(level.is_hashed for level in tiny_cuda_levels(8, 128, 512, 19))
    levels = tiny_cuda_levels(8, 32, 128, 19)
    assert [level.resolution for level in levels if not level.is_hashed] == [32, 40, 48, 58, 71]
    assert [level.num_rows for level in levels[:2]] == [32**3, 40**3] and levels[-1].num_rows == 2**19
    assert levels[1].first_row == 32**3


def test_the_library_gets_the_shape_of_the_grid_and_its_features_come_back_in_float32(library: None) -> None:
    grid = TinyCudaGrid(**SHAPE, device=GPU)
    assert grid.grid.levels == grid.levels
    encoded = encode(grid, points(7))
    assert (encoded.shape, encoded.dtype) == ((7, grid.get_out_dim()), torch.float32) == ((7, 6), torch.float32)
    outside = torch.tensor([[-0.5, 0.5, 2.0]])
    assert torch.equal(encode(grid, outside), encode(grid, outside.clamp(0, 1)))


def test_what_was_trained_with_the_library_opens_without_it(library: None) -> None:
    trained, here = TinyCudaGrid(**SHAPE, device=GPU), TinyCudaGrid(**SHAPE, device=CPU)
    here.load_state_dict(trained.state_dict())
    assert trained.with_library and not here.with_library
    torch.testing.assert_close(encode(here, points(50)), encode(trained, points(50)), atol=5e-3, rtol=1e-3)
    back = TinyCudaGrid(**SHAPE, device=GPU)
    back.load_state_dict(here.state_dict())
    assert torch.equal(encode(back, points(50)), encode(trained, points(50)))


def test_a_library_that_lays_its_table_out_otherwise_is_noticed_on_opening(
    library: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HalfPrecisionGrid, "shift", 0.02)
    state = TinyCudaGrid(**SHAPE, device=GPU).state_dict()
    with pytest.raises(InputError, match="gives other numbers here than it gave there; open the run on a machine"):
        TinyCudaGrid(**SHAPE, device=CPU).load_state_dict(state)


@pytest.mark.parametrize("device", [CPU, GPU])
def test_a_residual_field_learns_through_it(library: None, device: torch.device) -> None:
    torch.manual_seed(0)
    field = ResidualField(TinyCudaGrid(**SHAPE, device=device), feature_dim=3, layer_width=16)
    _, color = field(field.locate(2 * points(20) - 1), torch.ones(20, 3), torch.ones(20))
    color.square().mean().backward()
    gradient = field.grid.grid.params.grad
    assert gradient is not None and gradient.abs().sum() > 0

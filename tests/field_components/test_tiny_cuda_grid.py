"""tiny-cuda-nn needs a GPU; here something with its interface takes its place, so all but its kernels is run."""

from types import SimpleNamespace

import pytest
import torch
from nerfstudio.field_components import encodings

from sparsestyle_ns.errors import InputError
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.field_components.tiny_cuda_grid import TinyCudaGrid
from sparsestyle_ns.fields.residual import ResidualField


class HalfPrecisionGrid(torch.nn.Module):
    """As tinycudann.Encoding, as far as nerfstudio uses it: its arguments, and features in half precision."""

    def __init__(self, n_input_dims: int, encoding_config: dict) -> None:
        super().__init__()
        assert n_input_dims == 3 and encoding_config["otype"] == "HashGrid"
        levels, smallest = encoding_config["n_levels"], encoding_config["base_resolution"]
        self.grid = HashGrid(
            num_levels=levels,
            min_resolution=smallest,
            max_resolution=round(smallest * encoding_config["per_level_scale"] ** (levels - 1)),
            features_per_level=encoding_config["n_features_per_level"],
            log2_table_size=encoding_config["log2_hashmap_size"],
            init_scale=1.0,
        )

    def forward(self, positions: torch.Tensor) -> torch.Tensor:
        return self.grid(positions).half()


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encodings, "TCNN_EXISTS", True)
    monkeypatch.setattr(encodings, "tcnn", SimpleNamespace(Encoding=HalfPrecisionGrid))


def points(count: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0))


def test_the_library_gets_the_shape_of_the_grid_and_its_features_come_back_in_float32(library: None) -> None:
    grid = TinyCudaGrid(num_levels=3, min_resolution=4, max_resolution=16, features_per_level=2, log2_table_size=10)
    assert grid.encoding.tcnn_encoding.grid.resolutions == (4, 8, 16)
    encoded = grid.interpolate(grid.locate(points(7)))
    assert (encoded.shape, encoded.dtype) == ((7, grid.get_out_dim()), torch.float32) == ((7, 6), torch.float32)
    torch.testing.assert_close(encoded, grid.encoding.tcnn_encoding.grid(points(7)), atol=1e-3, rtol=1e-3)
    outside = torch.tensor([[-0.5, 0.5, 2.0]])
    assert torch.equal(grid.interpolate(grid.locate(outside)), grid.interpolate(grid.locate(outside.clamp(0, 1))))


def test_a_residual_field_learns_through_it(library: None) -> None:
    torch.manual_seed(0)
    grid = TinyCudaGrid(num_levels=2, min_resolution=4, max_resolution=8, features_per_level=2, log2_table_size=8)
    field = ResidualField(grid, feature_dim=3, layer_width=16)
    _, color = field(field.locate(2 * points(20) - 1), torch.ones(20, 3), torch.ones(20))
    color.square().mean().backward()
    table = grid.encoding.tcnn_encoding.grid.table
    assert table.grad is not None and table.grad.abs().sum() > 0


def test_without_the_library_a_sentence_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encodings, "TCNN_EXISTS", False)
    with pytest.raises(InputError, match="isn't installed here or finds no GPU; install it"):
        TinyCudaGrid(num_levels=2, min_resolution=4, max_resolution=8, features_per_level=2, log2_table_size=8)

import pytest
import reference
import torch

from sparsestyle_ns.field_components.positional_encoding import PositionalEncoding, positional_encoding, revealed_levels


@pytest.fixture
def points():
    return 2 * torch.rand(7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("num_levels", [0, 1, 4, 7])
def test_the_frequencies_are_powers_of_two_without_pi(num_levels, dim, points):
    expected = [reference.positional_encoding(point, num_levels) for point in points[:, :dim].tolist()]
    encoded = positional_encoding(points[:, :dim], num_levels)
    torch.testing.assert_close(encoded, torch.tensor(expected, dtype=torch.float64), atol=1e-13, rtol=0)


def test_the_order_is_x_then_the_sines_and_the_cosines_of_each_octave():
    x = torch.tensor([0.3, -0.7])
    expected = torch.cat([x, x.sin(), x.cos(), (2 * x).sin(), (2 * x).cos()])
    torch.testing.assert_close(positional_encoding(x, 2), expected)


def test_the_papers_seven_levels_make_45_numbers_of_a_point(points):
    encoding = PositionalEncoding(in_dim=3, num_levels=7)
    assert encoding.get_out_dim() == 45
    assert encoding(points).shape == (7, 45)
    assert not list(encoding.parameters())


def test_no_levels_leave_the_point_as_it_is(points):
    assert torch.equal(positional_encoding(points, 0), points)
    assert PositionalEncoding(in_dim=3, num_levels=0).get_out_dim() == 3


@pytest.mark.parametrize("batch", [(), (5,), (2, 3, 4)])
@pytest.mark.parametrize("num_levels", [1, 5])
def test_any_batch_shape_is_kept(batch, num_levels):
    x = torch.rand(*batch, 3, generator=torch.Generator().manual_seed(1))
    encoding = PositionalEncoding(in_dim=3, num_levels=num_levels)
    assert encoding(x).shape == (*batch, encoding.get_out_dim())
    torch.testing.assert_close(
        encoding(x).reshape(-1, encoding.get_out_dim()), positional_encoding(x.reshape(-1, 3), num_levels)
    )


@pytest.mark.parametrize("fraction, expected", [(0.0, [0, 0, 0, 0, 0]), (0.5, [1, 1, 0.5, 0, 0]), (1.0, [1] * 5)])
def test_octaves_are_revealed_one_after_another(fraction, expected):
    assert revealed_levels(fraction, 5).tolist() == expected


def test_a_weighted_octave_is_dimmed_and_the_point_itself_never(points):
    encoding = PositionalEncoding(in_dim=3, num_levels=4)
    full = encoding(points)
    encoding.level_weights = revealed_levels(0.375, 4)
    weights = torch.tensor([1.0] * 3 + [1.0] * 6 + [0.5] * 6 + [0.0] * 12, dtype=torch.float64)
    torch.testing.assert_close(encoding(points), full * weights)
    encoding.level_weights = revealed_levels(1.0, 4)
    assert torch.equal(encoding(points), full)


def test_gradients_match_finite_differences(points):
    weights = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: positional_encoding(x, 3, weights), (points[:2].requires_grad_(),))

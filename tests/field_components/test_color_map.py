import pytest
import torch

from sparsestyle_ns.field_components.color_map import TABLE_SIDE, ColorMap

MATRIX = torch.tensor([[0.5, 0.1, 0.0], [0.0, 0.8, 0.1], [0.2, 0.0, 0.6]])
OFFSET = torch.tensor([0.1, 0.0, 0.05])


def table(seed=0):
    return 0.1 * torch.randn(3, *3 * (TABLE_SIDE,), generator=torch.Generator().manual_seed(seed))


def colors(count=200):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(1))


def test_a_new_map_gives_back_the_very_colours():
    given = colors()
    assert ColorMap()(given) is given and ColorMap().is_neutral


def test_a_map_is_affine_and_its_table_is_read_between_eight_entries():
    own, given = ColorMap(MATRIX, OFFSET, table()), colors()
    for color, found in zip(given[:20], own(given)[:20], strict=True):
        affine = (MATRIX @ color + OFFSET).clamp(0, 1)
        place = affine * (TABLE_SIDE - 1)
        red, green, blue = (int(min(each, TABLE_SIDE - 2)) for each in place)
        expected = affine.clone()
        for step in range(8):
            r, g, b = red + (step & 1), green + (step >> 1 & 1), blue + (step >> 2 & 1)
            share = torch.prod(1 - (place - torch.tensor([r, g, b])).abs())
            expected += share * own.table[:, b, g, r]
        torch.testing.assert_close(found, expected.clamp(0, 1), atol=1e-5, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(3,), (0, 3), (2, 5, 3)])
def test_shape_and_dtype_stay(shape, dtype):
    given = torch.rand(shape, dtype=dtype)
    for own in (ColorMap(), ColorMap(MATRIX), ColorMap(MATRIX, OFFSET, table())):
        found = own(given)
        assert found.shape == shape and found.dtype == dtype
        assert ((found >= 0) & (found <= 1)).all()


def test_a_map_is_saved_adopted_and_reset():
    own, other, given = ColorMap(MATRIX, OFFSET, table()), ColorMap(), colors()
    other.load_state_dict(own.state_dict())
    torch.testing.assert_close(other(given), own(given))
    assert not other.is_neutral
    other.reset()
    assert other(given) is given
    other.adopt(own)
    torch.testing.assert_close(other(given), own(given))


def test_gradients_are_those_of_the_map():
    own = ColorMap(MATRIX, OFFSET, table()).double()
    # Away from where the table's cells meet.
    inner = ((0.2 + 0.6 * colors(6).double()) * 8).floor().add(0.5) / 8
    inputs = torch.linalg.solve(MATRIX.double(), (inner - OFFSET.double()).T).T.requires_grad_()
    assert torch.autograd.gradcheck(own, (inputs,))

import itertools

import pytest
import torch
from test_thinned_mlp import ALL, by_autograd, network, uneven_loss
from torch import nn
from torch.utils.checkpoint import checkpoint

from sparsestyle_ns.field_components.blocked_mlp import blocked_mlp
from sparsestyle_ns.field_components.thinned_mlp import Thinning, thin
from sparsestyle_ns.utils.device_sizes import SIZES

POINTS = 40


@pytest.fixture(params=[10**6, POINTS, 7, 1])
def block(request, monkeypatch):
    """Points at once: all, just all, several blocks of which the last is shorter, and one by one."""
    monkeypatch.setitem(SIZES, "cpu", SIZES["cpu"]._replace(mlp_points=request.param))


def two_inputs(count=POINTS, dtype=torch.float64):
    """Four numbers a point, of which the first three ask for a gradient, as the encoding does."""
    values = torch.randn(count, 4, dtype=dtype, generator=torch.Generator().manual_seed(1))
    return values[:, :3].clone().requires_grad_(), values[:, 3:].clone()


def parameters_of(*modules):
    return [parameter for each in modules for parameter in each.parameters()]


def plain(inputs, hidden, heads):
    return torch.cat(by_autograd(torch.cat(inputs, dim=-1), hidden, heads), dim=-1)


def gradients_of(output, inputs, hidden, heads):
    """Of the first input and of all parameters."""
    return torch.autograd.grad(uneven_loss([output]), [inputs[0], *parameters_of(hidden, heads)])


def test_values_and_gradients_are_those_of_the_layers_however_many_points_there_are_at_once(block):
    (hidden, heads), inputs = network(), two_inputs()
    found, expected = blocked_mlp(inputs, hidden, heads, ALL), plain(inputs, hidden, heads)
    assert found.shape == (POINTS, 4)
    torch.testing.assert_close(found, expected)
    pairs = zip(gradients_of(found, inputs, hidden, heads), gradients_of(expected, inputs, hidden, heads), strict=True)
    for value, wanted in pairs:
        assert wanted.abs().sum() > 0
        torch.testing.assert_close(value, wanted)


def test_gradients_are_those_of_finite_differences(monkeypatch):
    monkeypatch.setitem(SIZES, "cpu", SIZES["cpu"]._replace(mlp_points=4))
    (hidden, heads), inputs = network(), two_inputs(6)

    def outputs(first, *_):
        return blocked_mlp((first, inputs[1]), hidden, heads, ALL)

    assert torch.autograd.gradcheck(outputs, (inputs[0], *parameters_of(hidden, heads)))


@pytest.mark.parametrize("widths", [(), (5,), (5, 6, 7)])
def test_there_may_be_any_number_of_inputs_hidden_layers_and_heads(widths):
    torch.manual_seed(0)
    sizes = [6, 8, *widths]
    hidden = nn.ModuleList([nn.Linear(*pair, dtype=torch.float64) for pair in itertools.pairwise(sizes)])
    heads = nn.ModuleList([nn.Linear(sizes[-1], 2, dtype=torch.float64)])
    values = torch.randn(9, 6, dtype=torch.float64)
    for parts in ((6,), (1, 2, 3), (0, 6)):
        inputs = values.split(parts, dim=-1)
        torch.testing.assert_close(blocked_mlp(inputs, hidden, heads, ALL), plain(inputs, hidden, heads))


def test_no_points_have_no_values_and_gradients_of_0():
    (hidden, heads), inputs = network(), two_inputs(0)
    for thinning in (ALL, Thinning(2.0)):
        found = blocked_mlp(inputs, hidden, heads, thinning)
        assert found.shape == (0, 4)
        assert all((gradient == 0).all() for gradient in gradients_of(found, inputs, hidden, heads))


def test_where_the_first_input_asks_for_no_gradient_it_gets_none_and_the_layers_do():
    (hidden, heads), (first, second) = network(), two_inputs()
    found = blocked_mlp((first.detach(), second), hidden, heads, ALL)
    gradients = torch.autograd.grad(uneven_loss([found]), parameters_of(hidden, heads))
    expected = gradients_of(plain((first, second), hidden, heads), (first, second), hidden, heads)[1:]
    for value, wanted in zip(gradients, expected, strict=True):
        torch.testing.assert_close(value, wanted)


def test_it_can_be_computed_again_in_the_backward_pass_as_a_large_views_chunks_are():
    (hidden, heads), inputs = network(), two_inputs()
    for thinning in (ALL, Thinning(1e-9)):
        again = checkpoint(blocked_mlp, inputs, hidden, heads, thinning, use_reentrant=False)
        expected = blocked_mlp(inputs, hidden, heads, thinning)
        pairs = (gradients_of(each, inputs, hidden, heads) for each in (again, expected))
        for value, wanted in zip(*pairs, strict=True):
            torch.testing.assert_close(value, wanted)


def test_thinned_gradients_are_those_of_the_points_that_stay(block):
    (hidden, heads), inputs = network(), two_inputs()
    upstream = torch.randn(POINTS, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) ** 3
    wanted = [inputs[0], *parameters_of(hidden, heads)]
    found = blocked_mlp(inputs, hidden, heads, Thinning(2.0, torch.Generator().manual_seed(5)))
    torch.testing.assert_close(found, plain(inputs, hidden, heads))
    kept, weighted = thin(upstream, Thinning(2.0, torch.Generator().manual_seed(5)))
    assert 0 < len(kept) < POINTS
    expected = plain([each[kept] for each in inputs], hidden, heads)
    pairs = torch.autograd.grad(found, wanted, upstream), torch.autograd.grad(expected, wanted, weighted)
    for value, gradient in zip(*pairs, strict=True):
        torch.testing.assert_close(value, gradient)


def test_thinned_gradients_are_right_on_average():
    (hidden, heads), inputs = network(), two_inputs()
    generator = torch.Generator().manual_seed(0)

    def gradients(output):
        # A point that hardly matters may be in none of the runs, but together the points show whether it is right.
        first, *parameters = gradients_of(output, inputs, hidden, heads)
        return [first.sum(dim=0), *parameters]

    exact = gradients(plain(inputs, hidden, heads))
    runs = [gradients(blocked_mlp(inputs, hidden, heads, Thinning(2.0, generator))) for _ in range(400)]
    assert any((run[1] - exact[1]).abs().max() > 0.01 * exact[1].abs().max() for run in runs)
    for values, wanted in zip(zip(*runs, strict=True), exact, strict=True):
        mean, spread = torch.stack(values).mean(dim=0), torch.stack(values).std(dim=0)
        # The mean of 400 is off by a twentieth of one's spread.
        assert (mean - wanted).norm() <= 3 * spread.norm() / 20


def test_it_follows_autocast(block):
    (hidden, heads), inputs = network(torch.float32), two_inputs(dtype=torch.float32)
    exact = plain(inputs, hidden, heads)
    with torch.autocast("cpu", torch.bfloat16):
        found = blocked_mlp(inputs, hidden, heads, ALL)
    assert found.dtype == torch.bfloat16
    # bfloat16 has 8 bits: a rounding in each of four layers.
    torch.testing.assert_close(found.float(), exact, rtol=0.05, atol=0.02)
    pairs = (gradients_of(each, inputs, hidden, heads) for each in (found, exact))
    for value, wanted in zip(*pairs, strict=True):
        assert value.dtype == torch.float32
        assert (value - wanted).norm() < 0.05 * wanted.norm()


def test_another_input_that_wants_a_gradient_is_refused():
    (hidden, heads), (first, second) = network(), two_inputs()
    with pytest.raises(ValueError, match="only its first input a gradient"):
        blocked_mlp((first, second.requires_grad_()), hidden, heads, ALL)

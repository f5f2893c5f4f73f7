import pytest
import torch
from torch import nn

from sparsestyle_ns.field_components.thinned_mlp import MULTIPLE, Thinning, thin, thinned_mlp

ALL = Thinning(threshold=0.0)


def network(dtype=torch.float64, seed=0):
    """Three hidden layers and two heads."""
    torch.manual_seed(seed)
    hidden = [nn.Linear(wide, width, dtype=dtype) for wide, width in ((4, 7), (7, 6), (6, 5))]
    return nn.ModuleList(hidden), nn.ModuleList([nn.Linear(5, 1, dtype=dtype), nn.Linear(5, 3, dtype=dtype)])


def by_autograd(inputs, hidden, heads):
    """The readable form."""
    for layer in hidden:
        inputs = torch.relu(layer(inputs))
    return [head(inputs) for head in heads]


def points(count=40, dtype=torch.float64):
    return torch.randn(count, 4, dtype=dtype, generator=torch.Generator().manual_seed(1))


def uneven_loss(outputs):
    """A loss to which few points matter: the size of its gradients falls by e every four points."""
    share = torch.exp(-torch.arange(len(outputs[0]), dtype=outputs[0].dtype) / 4)[:, None]
    return sum((share * torch.sin(output)).sum() for output in outputs)


def gradients_of(outputs, *modules):
    parameters = [parameter for module in modules for parameter in module.parameters()]
    return torch.autograd.grad(uneven_loss(outputs), parameters)


@pytest.mark.parametrize("threshold", [0.0, 1.0, 5.0])
def test_values_are_those_of_the_layers(threshold):
    hidden, heads = network()
    found = thinned_mlp(points(), hidden, heads, Thinning(threshold))
    for value, expected in zip(found, by_autograd(points(), hidden, heads), strict=True):
        torch.testing.assert_close(value, expected)


def test_with_all_points_the_gradients_are_those_of_the_layers():
    hidden, heads = network()
    found = gradients_of(thinned_mlp(points(), hidden, heads, ALL), hidden, heads)
    expected = gradients_of(by_autograd(points(), hidden, heads), hidden, heads)
    for value, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(value, wanted)


def test_gradients_are_those_of_finite_differences():
    hidden, heads = network()
    parameters = [parameter for module in (hidden, heads) for parameter in module.parameters()]

    def outputs(*_):
        return thinned_mlp(points(6), hidden, heads, ALL)

    assert torch.autograd.gradcheck(outputs, parameters)


def test_thinned_gradients_are_those_of_the_points_that_stay():
    hidden, heads = network()
    upstream = torch.randn(40, 4, dtype=torch.float64) ** 3
    parameters = [parameter for module in (hidden, heads) for parameter in module.parameters()]
    thinning = Thinning(2.0, torch.Generator().manual_seed(5))
    found = torch.autograd.grad(torch.cat(thinned_mlp(points(), hidden, heads, thinning), dim=-1), parameters, upstream)
    kept, weighted = thin(upstream, Thinning(2.0, torch.Generator().manual_seed(5)))
    assert 0 < len(kept) < 40
    outputs = torch.cat(by_autograd(points()[kept], hidden, heads), dim=-1)
    for value, expected in zip(found, torch.autograd.grad(outputs, parameters, weighted), strict=True):
        torch.testing.assert_close(value, expected)


@pytest.mark.parametrize("threshold", [0.5, 1.0, 4.0])
def test_thinned_gradients_are_right_on_average(threshold):
    gradients = torch.randn(30, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) ** 3
    thinning, draws = Thinning(threshold, torch.Generator().manual_seed(4)), 10_000
    total = torch.zeros_like(gradients)
    for _ in range(draws):
        total.index_add_(0, *thin(gradients, thinning))
    sizes = gradients.norm(dim=-1, keepdim=True)
    chance = (sizes / (threshold * sizes.mean())).clamp(max=1.0)
    assert (chance < 1).any()
    # A kept gradient g / p has variance g² (1 / p − 1); five standard errors.
    standard_error = (gradients.square() * (1 / chance - 1) / draws).sqrt()
    assert ((total / draws - gradients).abs() <= 5 * standard_error + 1e-9).all()


def test_large_gradients_always_stay_and_small_ones_in_proportion():
    gradients = torch.cat([torch.full((100, 1), 10.0), torch.full((10_000, 1), 0.1)])  # mean 0.198
    kept, weighted = thin(gradients, Thinning(1.0, torch.Generator().manual_seed(0)))
    assert len(kept) % MULTIPLE == 0  # filled up, by the last one without a gradient
    kept, weighted = (part[: (weighted > 0).sum()] for part in (kept, weighted))
    assert kept[:100].tolist() == list(range(100)) and (kept.diff() > 0).all()
    assert (weighted[:100] == 10.0).all()
    # 0.1 / 0.198 of the others stay, each with the gradient 0.198.
    assert len(kept) - 100 == pytest.approx(10_000 * 0.1 / 0.198, rel=0.05)
    torch.testing.assert_close(weighted[100:], torch.full((len(kept) - 100, 1), gradients.mean().item()))


def test_more_is_left_out_with_a_higher_threshold():
    gradients = torch.rand(1000, 3) ** 4
    counts = [len(thin(gradients, Thinning(threshold))[0]) for threshold in (0.1, 1.0, 3.0, 10.0)]
    assert counts == sorted(counts, reverse=True) and counts[-1] < 200 < 800 < counts[0]


@pytest.mark.parametrize("bad", [torch.inf, torch.nan])
def test_a_gradient_that_is_no_number_is_not_hidden(bad):
    gradients = torch.full((50, 2), 1.0)
    gradients[7, 1] = bad
    assert not torch.isfinite(thin(gradients, Thinning(2.0))[1]).all()


def test_no_gradient_at_all_is_none_after_thinning():
    hidden, heads = network()
    loss = sum((0.0 * output).sum() for output in thinned_mlp(points(), hidden, heads, Thinning(2.0)))
    loss.backward()
    assert all((parameter.grad == 0).all() for parameter in hidden.parameters())


def test_the_generator_decides_what_stays():
    gradients = torch.rand(500, 1)
    first, again, other = (
        thin(gradients, Thinning(3.0, torch.Generator().manual_seed(seed)))[0].tolist() for seed in (0, 0, 1)
    )
    assert first == again != other


def test_it_follows_autocast():
    hidden, heads = network(torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        found = thinned_mlp(points(dtype=torch.float32), hidden, heads, ALL)
        expected = by_autograd(points(dtype=torch.float32), hidden, heads)
    for value, wanted in zip(found, expected, strict=True):
        assert value.dtype == torch.bfloat16
        torch.testing.assert_close(value, wanted)
    for gradient in gradients_of(found, hidden, heads):
        assert gradient.dtype == torch.float32


def test_inputs_that_want_a_gradient_get_that_of_the_layers():
    hidden, heads = network()
    found, expected = (
        torch.autograd.grad(uneven_loss(run(inputs)), inputs)[0]
        for inputs, run in (
            (points().requires_grad_(), lambda inputs: thinned_mlp(inputs, hidden, heads, ALL)),
            (points().requires_grad_(), lambda inputs: by_autograd(inputs, hidden, heads)),
        )
    )
    torch.testing.assert_close(found, expected)


def test_inputs_of_points_that_stay_get_their_gradient_weighted_up_and_others_none():
    hidden, heads = network()
    inputs = points(3000).requires_grad_()  # so many that those that stay are filled up to a multiple

    def loss(outputs):
        """To which points matter more or less, but none next to nothing."""
        share = torch.linspace(0.05, 1.0, len(inputs), dtype=inputs.dtype)[:, None]
        return sum((share * torch.sin(output)).sum() for output in outputs)

    outputs = by_autograd(inputs, hidden, heads)
    (exact,) = torch.autograd.grad(loss(outputs), inputs, retain_graph=True)
    of_outputs = torch.cat(torch.autograd.grad(loss(outputs), outputs), dim=-1)
    kept, weighted = thin(of_outputs, Thinning(2.0, torch.Generator().manual_seed(7)))
    assert len(kept) % MULTIPLE == 0 and len(kept.unique()) < len(kept)
    weights = torch.zeros(len(inputs), dtype=inputs.dtype)
    weights.index_add_(0, kept, weighted.norm(dim=-1) / of_outputs[kept].norm(dim=-1))
    found = thinned_mlp(inputs, hidden, heads, Thinning(2.0, torch.Generator().manual_seed(7)))
    torch.testing.assert_close(torch.autograd.grad(loss(found), inputs)[0], weights[:, None] * exact)

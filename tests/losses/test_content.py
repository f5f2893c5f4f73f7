import pytest
import reference
import torch

from sparsestyle_ns.losses.content import content_loss


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("shape", [(5,), (7, 12), (2, 12, 3, 4)])
def test_it_is_the_squared_error_over_the_targets_own_square(shape, generator):
    features, target = torch.rand(2, *shape, generator=generator, dtype=torch.float64)
    assert content_loss(features, target).item() == pytest.approx(reference.content_loss(features, target), rel=1e-12)


def test_the_examples_of_its_docstring_hold():
    assert content_loss(torch.tensor([3.0, 0.0]), torch.tensor([0.0, 4.0])).item() == 1.5625


def test_it_is_0_for_equal_features_and_1_for_vanished_ones(generator):
    target = torch.rand(4, 8, generator=generator)
    assert content_loss(target.clone(), target).item() == 0
    assert content_loss(torch.zeros_like(target), target).item() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("scale", [1e-3, 40.0])
def test_it_does_not_depend_on_the_scale_of_the_network(scale, generator):
    features, target = torch.rand(2, 4, 8, generator=generator, dtype=torch.float64)
    expected = content_loss(features, target).item()
    assert content_loss(scale * features, scale * target).item() == pytest.approx(expected, rel=1e-12)


def test_a_target_of_zeros_gives_the_plain_squared_error_and_a_finite_gradient():
    features = torch.tensor([1.0, 3.0], requires_grad=True)
    loss = content_loss(features, torch.zeros(2))
    loss.backward()
    assert loss.item() == 5
    assert features.grad.tolist() == [1, 3]


def test_the_gradient_is_exact_and_reaches_the_features_only(generator):
    features, target = torch.rand(2, 3, 5, generator=generator, dtype=torch.float64).unbind()
    target.requires_grad_()
    assert torch.autograd.gradcheck(lambda f: content_loss(f, target), (features.requires_grad_(),))
    content_loss(features, target).backward()
    assert features.grad is not None
    assert target.grad is None


def test_shapes_that_would_only_broadcast_are_refused():
    with pytest.raises(ValueError, match=r"features are \(2, 3\) and the target \(1, 3\)"):
        content_loss(torch.zeros(2, 3), torch.zeros(1, 3))

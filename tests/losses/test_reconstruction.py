import pytest
import torch

from sparsestyle_ns.losses.reconstruction import reconstruction_loss


def test_the_loss_of_two_pixels_worked_out_by_hand():
    rendered = torch.tensor([[0.5, 0.0, 1.0], [0.2, 0.2, 0.2]])
    photo = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.2, 0.5]])
    assert reconstruction_loss(rendered, photo).item() == pytest.approx((0.25 + 1 + 0.09) / 6)


@pytest.mark.parametrize("batch", [(1,), (5,), (2, 3, 4)])
def test_it_is_the_mean_squared_error_whatever_the_shape(batch):
    generator = torch.Generator().manual_seed(0)
    rendered, photo = (torch.rand(*batch, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    pairs = list(zip(rendered.flatten().tolist(), photo.flatten().tolist(), strict=True))
    expected = sum((r - p) ** 2 for r, p in pairs) / len(pairs)
    assert reconstruction_loss(rendered, photo).item() == pytest.approx(expected, rel=1e-12)


def test_a_perfect_picture_costs_nothing():
    photo = torch.rand(4, 3, generator=torch.Generator().manual_seed(1))
    assert reconstruction_loss(photo, photo) == 0


def test_the_gradient_matches_finite_differences():
    generator = torch.Generator().manual_seed(2)
    rendered, photo = (torch.rand(4, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(lambda r: reconstruction_loss(r, photo), (rendered.requires_grad_(),))

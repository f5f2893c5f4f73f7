"""The losses of whole distributions: the painting's colours and textures, in the painting's shares."""

import pytest
import torch

from sparsestyle_ns.losses import sliced
from sparsestyle_ns.losses.sliced import ColorLoss, TextureLoss
from sparsestyle_ns.losses.stylization_loss import PaintingFeatures, StylizedView


def painting(height: int = 12, width: int = 16) -> PaintingFeatures:
    torch.manual_seed(0)
    return PaintingFeatures(torch.rand(3, height, width), torch.rand(60, 8))


def view(colors: torch.Tensor, features: torch.Tensor, step: int = 0) -> StylizedView:
    return StylizedView(colors[None], colors[None], features, features, colors, step=step)


def test_a_view_of_the_paintings_own_colours_and_textures_wherever_they_are_costs_nothing():
    given = painting()
    colors = given.image.flatten(1).T.flip(0)
    same = view(colors, 7.0 * given.rows.flip(0))
    assert ColorLoss(given)(same) == pytest.approx(0.0, abs=1e-10)
    assert TextureLoss(given)(same) == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize("step", [0, 5])
def test_a_view_of_the_mean_colour_alone_costs_about_1(step):
    given = painting(40, 40)
    colors = given.image.flatten(1).mean(dim=1).expand(900, 3)
    assert ColorLoss(given)(view(colors, given.rows, step)) == pytest.approx(1.0, rel=0.1)


def test_one_texture_alone_costs_more_than_all_of_the_paintings_however_well_it_matches():
    given = painting()
    one = given.rows[:1].expand(60, 8)
    assert TextureLoss(given)(view(given.image.flatten(1).T, one)) > 0.5


def test_another_share_of_the_same_colours_costs_something():
    torch.manual_seed(0)
    half = torch.tensor([[1.0, 0, 0], [0, 0, 1.0]]).repeat_interleave(50, dim=0)
    loss = ColorLoss(PaintingFeatures(half.T.reshape(3, 10, 10), torch.rand(60, 8)))
    assert loss(view(half, torch.rand(9, 8))) == pytest.approx(0.0, abs=1e-10)
    assert loss(view(half[25:75].repeat(2, 1), torch.rand(9, 8))) == pytest.approx(0.0, abs=1e-10)
    assert loss(view(half[40:], torch.rand(9, 8))) > 0.1


def test_lines_and_points_are_drawn_anew_in_each_iteration_and_the_same_in_the_same(monkeypatch):
    monkeypatch.setattr(sliced, "MOST_COMPARED", 40)
    given = painting()
    torch.manual_seed(1)
    colors, features = torch.rand(200, 3), torch.rand(70, 8)
    for kind in (ColorLoss, TextureLoss):
        values = [float(kind(given)(view(colors, features, step))) for step in (3, 3, 4)]
        assert values[0] == values[1] != values[2]


def test_gradients_match_finite_differences():
    given = painting()
    torch.manual_seed(2)
    colors = torch.rand(20, 3, dtype=torch.float64, requires_grad=True)
    features = torch.rand(20, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: ColorLoss(given)(view(c, features)), colors)
    assert torch.autograd.gradcheck(lambda f: TextureLoss(given)(view(colors, f)), features)


def test_a_painting_of_one_colour_and_one_texture_gives_finite_losses_and_gradients():
    loss = ColorLoss(PaintingFeatures(torch.full((3, 8, 8), 0.5), torch.rand(1, 8).expand(30, 8)))
    textures = TextureLoss(PaintingFeatures(torch.full((3, 8, 8), 0.5), torch.rand(1, 8).expand(30, 8)))
    colors, features = torch.rand(20, 3).requires_grad_(), torch.zeros(20, 8).requires_grad_()
    total = loss(view(colors, features)) + textures(view(colors, features))
    total.backward()
    assert total.isfinite() and colors.grad.isfinite().all() and features.grad.isfinite().all()

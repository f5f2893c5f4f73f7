import inspect

import pytest
import torch
from torch import nn

from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.residual import ResidualField, fine_density

POINTS, FEATURES = 30, 5


def residual_field(**settings):
    torch.manual_seed(0)
    grid = HashGrid(2, 4, 8, features_per_level=2, log2_table_size=8, init_scale=1.0)
    return ResidualField(grid, FEATURES, **settings)


@pytest.fixture
def frozen():
    """Points of the cube, and e_c and σ_c there."""
    generator = torch.Generator().manual_seed(1)
    points = 2 * torch.rand(POINTS, 3, generator=generator) - 1
    return points, torch.randn(POINTS, FEATURES, generator=generator), 50 * torch.rand(POINTS, generator=generator)


def test_the_fine_density_is_the_sum_and_never_negative():
    residual, coarse = torch.tensor([1.5, -1.0, -2.0, -3.0, 0.0]), torch.tensor([2.0, 2.0, 2.0, 2.0, 0.0])
    assert fine_density(residual, coarse).tolist() == [3.5, 1.0, 0.0, 0.0, 0.0]


def test_a_negative_sum_passes_only_the_gradient_that_raises_it():
    residual = torch.tensor([2.0, 2.0, -3.0, -3.0], requires_grad=True)
    # A gradient below 0 asks for a larger density, one above 0 for a smaller.
    fine_density(residual, torch.ones(4)).backward(torch.tensor([-0.5, 0.7, -0.5, 0.7]))
    assert residual.grad.tolist() == pytest.approx([-0.5, 0.7, -0.5, 0.0])


def test_the_gradient_matches_finite_differences_where_the_sum_is_positive():
    residual = torch.tensor([0.5, -1.0, 7.0], dtype=torch.float64, requires_grad=True)
    coarse = torch.tensor([0.1, 1.5, 0.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(fine_density, (residual, coarse))


@pytest.mark.parametrize("start", [-100.0, -1e4])
def test_what_was_removed_comes_back_when_the_loss_asks_for_it(start):
    residual = torch.tensor([start], requires_grad=True)
    optimizer = torch.optim.Adam([residual], lr=-start / 100)
    for _ in range(1000):
        optimizer.zero_grad()
        (fine_density(residual, torch.tensor([2.0])) - 5.0).square().sum().backward()
        optimizer.step()
    # The target is 5, of which the coarse field has 2; Adam's last steps are a small part of its rate.
    assert residual.item() == pytest.approx(3.0, abs=0.05)


def test_what_shall_be_removed_stops_at_nothing_and_goes_no_deeper():
    residual = torch.tensor([1.0], requires_grad=True)
    for _ in range(100):
        (gradient,) = torch.autograd.grad(fine_density(residual, torch.tensor([2.0])).sum(), residual)
        residual = (residual - 0.3 * gradient).detach().requires_grad_()
    assert fine_density(residual, torch.tensor([2.0])).item() == 0
    assert -2.3 <= residual.item() <= -2.0


@pytest.mark.parametrize("density_scale", [1.0, 10.0])
def test_stylising_starts_from_exactly_the_coarse_geometry(density_scale, frozen):
    field = residual_field(density_scale=density_scale)
    points, feature, coarse = frozen
    density, color = field(field.locate(points), feature, coarse)
    assert torch.equal(density, coarse)
    assert color.shape == (POINTS, 3) and ((color > 0) & (color < 1)).all()


def test_the_residual_density_is_learned_from_the_start(frozen):
    field = residual_field()
    points, feature, coarse = frozen
    field(field.locate(points), feature, coarse)[0].sum().backward()
    assert field.density_head.weight.grad.abs().sum() > 0
    assert field.density_head.bias.grad.item() == POINTS


def test_density_is_the_scaled_output_added_to_the_coarse_one(frozen):
    field = residual_field(density_scale=7.0)
    nn.init.normal_(field.density_head.weight)
    points, feature, coarse = frozen
    density, color = field(field.locate(points), feature, coarse)
    hidden = field.mlp(torch.cat([field.grid((points + 1) / 2), feature], dim=-1))
    expected = 7.0 * field.density_head(hidden)[:, 0] + coarse
    assert (expected < 0).any() and (expected > 0).any()
    torch.testing.assert_close(density, expected.clamp(min=0))
    torch.testing.assert_close(color, field.color_head(hidden).sigmoid())


def test_without_residual_density_there_is_no_head_and_the_coarse_density_is_passed_on(frozen):
    field = residual_field(with_density=False)
    assert not any("density" in name for name, _ in field.named_parameters())
    points, feature, coarse = frozen
    assert field(field.locate(points), feature, coarse)[0] is coarse


def test_the_view_direction_is_not_an_input():
    # ψ(x) comes by the location, e_c by the feature, and σ_c for Eq. 3; nothing else goes in.
    assert list(inspect.signature(ResidualField.forward).parameters) == [
        "self",
        "location",
        "feature",
        "coarse_density",
    ]


def test_by_default_it_is_the_papers_network():
    field = residual_field()
    linear = [layer for layer in field.mlp.modules() if isinstance(layer, nn.Linear)]
    assert [(layer.in_features, layer.out_features) for layer in linear] == [(2 * 2 + FEATURES, 256), (256, 256)]
    assert isinstance(field.mlp.out_activation, nn.ReLU)
    assert field.color_head.in_features == field.density_head.in_features == 256


def test_the_cube_of_field_coordinates_is_the_unit_cube_of_the_grid(frozen):
    field = residual_field()
    location, expected = field.locate(frozen[0]), field.grid.locate((frozen[0] + 1) / 2)
    assert torch.equal(location.positions, expected.positions)


def test_an_axis_that_is_stretched_has_so_many_times_its_cells(frozen):
    points, feature, density = frozen
    field, squeezed = residual_field(), residual_field(stretch=(1.0, 1.0, 0.25))
    moved = points * torch.tensor([1.0, 1.0, 0.25])
    torch.testing.assert_close(
        squeezed(squeezed.locate(points), feature, density), field(field.locate(moved), feature, density)
    )
    flat = residual_field(stretch=(1.0, 1.0, 0.0))
    deeper = points * torch.tensor([1.0, 1.0, -0.5])
    colors = [flat(flat.locate(each), feature, density)[1] for each in (points, deeper)]
    torch.testing.assert_close(*colors, rtol=0.0, atol=0.0)

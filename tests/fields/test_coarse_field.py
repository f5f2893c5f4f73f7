import pytest
import torch
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from torch import nn

from sparsestyle_ns.fields.coarse import CoarseField, activate_density


def small_field(**settings):
    torch.manual_seed(0)
    return CoarseField(**{"num_levels": 4, "num_layers": 3, "layer_width": 24, "feature_dim": 5, **settings})


def random_points(*batch, seed=1):
    """Points of the cube and unit directions."""
    generator = torch.Generator().manual_seed(seed)
    points = 2 * torch.rand(*batch, 3, generator=generator) - 1
    return points, nn.functional.normalize(torch.randn(*batch, 3, generator=generator), dim=-1)


def num_parameters(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize("batch", [(), (7,), (0,), (4, 6)])
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_a_point_has_a_density_a_feature_and_a_colour(batch, activation):
    field = small_field(density_activation=activation)
    points, directions = random_points(*batch)
    density, feature = field.density_and_feature(points)
    color = field.color(feature, directions)
    assert density.shape == batch and feature.shape == (*batch, 5) and color.shape == (*batch, 3)
    assert (density >= 0).all()
    assert ((color >= 0) & (color <= 1)).all()


def test_by_default_it_is_the_papers_network():
    field = CoarseField()
    linear = [layer for layer in field.trunk.modules() if isinstance(layer, nn.Linear)]
    # Seven octaves: 3 · (1 + 2 · 7) = 45 inputs; then six hidden layers of 256.
    assert [(layer.in_features, layer.out_features) for layer in linear] == [(45, 256), *[(256, 256)] * 5]
    assert num_parameters(field.trunk) == 45 * 256 + 5 * 256 * 256 + 6 * 256
    assert num_parameters(field.density_head) == 257
    assert num_parameters(field.feature_head) == 257 * 64


def test_density_and_feature_are_read_from_hidden_units_that_are_not_negative():
    field = small_field()
    points, _ = random_points(20)
    hidden = field.trunk(field.position_encoding(points))
    assert (hidden >= 0).all()
    density, feature = field.density_and_feature(points)
    torch.testing.assert_close(density, nn.functional.softplus(field.density_head(hidden)[:, 0]))
    torch.testing.assert_close(feature, field.feature_head(hidden))


def test_density_and_feature_do_not_depend_on_the_direction_but_the_colour_does():
    field = small_field(direction_levels=2)
    points, directions = random_points(20)
    _, feature = field.density_and_feature(points)
    assert (field.color(feature, directions) - field.color(feature, -directions)).abs().max() > 1e-3


def test_without_a_direction_encoding_the_colour_is_the_same_from_all_sides_and_nothing_is_learned_for_it():
    without, with_direction = small_field(direction_levels=None), small_field(direction_levels=2)
    points, directions = random_points(20)
    _, feature = without.density_and_feature(points)
    assert torch.equal(without.color(feature, directions), without.color(feature, -directions))
    assert without.direction_encoding is None
    # 3 · (1 + 2 · 2) inputs fewer for the 12 units of the colour head's hidden layer.
    assert num_parameters(with_direction) - num_parameters(without) == 15 * 12


def test_it_answers_as_a_nerfstudio_field():
    field = small_field()
    origins, directions = random_points(4, 6)
    starts = torch.rand(4, 6, 1, generator=torch.Generator().manual_seed(2))
    frustums = Frustums(origins, directions, starts, starts + 0.5, pixel_area=torch.ones(4, 6, 1))
    samples = RaySamples(frustums)
    expected_density, expected_feature = field.density_and_feature(origins + (starts + 0.25) * directions)
    density, feature = field.get_density(samples)
    torch.testing.assert_close(density, expected_density[..., None])
    torch.testing.assert_close(feature, expected_feature)
    outputs = field(samples)
    torch.testing.assert_close(outputs[FieldHeadNames.DENSITY], density)
    torch.testing.assert_close(outputs[FieldHeadNames.RGB], field.color(expected_feature, directions))


def test_a_bias_moves_the_density_before_its_activation():
    points, _ = random_points(20)
    plain, thin = (small_field(density_bias=bias).density_and_feature(points)[0] for bias in (0.0, -5.0))
    # softplus(x) = log(1 + e^x), so e^σ − 1 is smaller by e^−5.
    torch.testing.assert_close(thin.expm1(), plain.expm1() * torch.tensor(-5.0).exp(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_density_is_finite_and_not_negative_for_any_number(activation, dtype):
    raw = torch.tensor([-1e9, -100.0, 0.0, 15.0, 100.0, 1e9], dtype=dtype)
    density = activate_density(raw, activation)
    assert density.isfinite().all() and (density >= 0).all()
    assert (density.diff() >= 0).all()


def test_the_exponential_is_capped_at_e_to_the_15():
    density = activate_density(torch.tensor([0.0, 1.0, 15.0, 16.0]), "exp")
    torch.testing.assert_close(density, torch.tensor([0.0, 1.0, 15.0, 15.0]).exp())


def test_every_parameter_learns_from_density_and_colour():
    field = small_field()
    points, directions = random_points(50)
    density, feature = field.density_and_feature(points)
    (density.sum() + field.color(feature, directions).square().sum()).backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in field.parameters())

import torch

from sparsestyle_ns.rendering.mixing import STYLISED, Appearance, Mix, interpolate, mixed

GENERATOR = torch.Generator().manual_seed(0)


def appearance():
    return Appearance(10 * torch.rand(20, generator=GENERATOR), torch.rand(20, 3, generator=GENERATOR))


COARSE, FIRST, SECOND = appearance(), appearance(), appearance()


def test_the_ends_of_an_interpolation_are_the_tensors_themselves():
    assert interpolate(COARSE.color, FIRST.color, 0.0) is COARSE.color
    assert interpolate(COARSE.color, FIRST.color, 1.0) is FIRST.color


def test_by_default_a_picture_shows_the_first_style():
    found = mixed(COARSE, [FIRST, SECOND], STYLISED)
    assert found.density is FIRST.density and found.color is FIRST.color


def test_a_mixture_is_the_formula_sample_by_sample():
    s, g, b = 0.7, 0.6, 0.2
    found = mixed(COARSE, [FIRST, SECOND], Mix(s, g, b))
    for i in range(20):
        style_density = (1 - b) * FIRST.density[i] + b * SECOND.density[i]
        style_color = (1 - b) * FIRST.color[i] + b * SECOND.color[i]
        torch.testing.assert_close(found.density[i], (1 - s * g) * COARSE.density[i] + s * g * style_density)
        torch.testing.assert_close(found.color[i], (1 - s) * COARSE.color[i] + s * style_color)


def test_geometry_strength_alone_leaves_the_colour_as_it_is():
    found = mixed(COARSE, [FIRST], Mix(geometry=0.0))
    assert found.density is COARSE.density and found.color is FIRST.color

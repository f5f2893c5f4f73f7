import numpy as np
import pytest
import reference
import torch

from sparsestyle_ns.core.sliced import random_directions, sliced_distance
from sparsestyle_ns.field_components.color_map import ColorMap, affine
from sparsestyle_ns.style import palette
from sparsestyle_ns.style.color import color_moments, palette_transform
from sparsestyle_ns.style.palette import palette_of, smooth_table, transport
from sparsestyle_ns.utils.errors import InputError

WHITE, BLUE, YELLOW = [0.9, 0.9, 0.9], [0.1, 0.2, 0.7], [0.9, 0.8, 0.1]
GREEN, BROWN, GREY = [0.2, 0.5, 0.2], [0.5, 0.3, 0.1], [0.5, 0.5, 0.5]


def patches(*colors, count=300, spread=0.02):
    """As many colours near each of these."""
    generator = torch.Generator().manual_seed(0)
    near = torch.tensor(colors).repeat_interleave(count, dim=0)
    return (near + spread * torch.randn(near.shape, generator=generator)).clamp(0, 1)


def mapped(colors, style, transfer="transport", weights=None):
    weights = torch.ones(len(colors)) if weights is None else weights
    return palette_of(colors, weights, style, transfer)(colors)


def distance(first, second):
    directions = random_directions(3, 64, torch.Generator().manual_seed(0))
    return float(sliced_distance(first, second, directions)) ** 0.5


def test_a_round_of_transport_is_order_along_the_axes_of_a_rotation(monkeypatch):
    monkeypatch.setattr(palette, "ROUNDS", 1)
    points, target = torch.rand(2, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    drawn = torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = reference.carried_in_order(points.numpy(), target.numpy(), torch.linalg.qr(drawn).Q.numpy())
    np.testing.assert_allclose(transport(points, target), expected, atol=1e-12)


def test_transport_carries_a_cloud_into_another_of_any_shape_and_size():
    ring = torch.linspace(0, 6.28, 700)
    ring = torch.stack([0.5 + 0.4 * ring.cos(), 0.5 + 0.4 * ring.sin(), 0.2 + 0.05 * ring], dim=-1)
    points = patches(GREEN, BROWN)
    assert distance(points, ring) > 0.3
    assert distance(transport(points, ring), ring) < 0.01


def test_the_table_is_the_least_squares_one(monkeypatch):
    monkeypatch.setattr(palette, "TABLE_SIDE", 4)
    generator = torch.Generator().manual_seed(0)
    colors, offsets = torch.rand(2, 60, 3, dtype=torch.float64, generator=generator)
    colors[0], colors[1] = 0.0, 1.0
    found = smooth_table(colors, offsets)
    expected = reference.smooth_table(colors.numpy(), offsets.numpy(), 4, palette.SMOOTHNESS, palette._LEAST)
    np.testing.assert_allclose(found.permute(3, 2, 1, 0), expected, rtol=1e-5, atol=1e-7)


def test_the_table_is_read_where_its_colours_are():
    """Offsets that are a straight function of the colour are met nearly everywhere, between the colours as well."""
    colors = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0))
    slope = torch.tensor([[0.1, 0.0, -0.1], [0.0, 0.05, 0.1], [0.02, -0.1, 0.0]])
    own = ColorMap(torch.eye(3), torch.zeros(3), smooth_table(colors, colors @ slope))
    others = 0.2 + 0.6 * torch.rand(4, 25, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(own(others), others + others @ slope, atol=0.01, rtol=0)


def test_a_scene_of_three_colours_takes_the_two_of_a_painting():
    """Mean and covariance alone leave a third one, which the painting doesn't have."""
    scene, painting = patches(GREEN, BROWN, GREY), patches(BLUE, YELLOW, count=450)
    nearest = {
        transfer: torch.cdist(mapped(scene, painting, transfer), torch.tensor([BLUE, YELLOW])).min(dim=1).values
        for transfer in ("moments", "transport")
    }
    assert nearest["moments"].median() > 0.15
    assert nearest["transport"].median() < 0.06
    assert distance(mapped(scene, painting), painting) < 0.5 * distance(mapped(scene, painting, "moments"), painting)


def test_the_noise_of_a_flat_wall_stays_noise():
    wall, things = patches(GREY, count=900, spread=1 / 255), patches(GREEN, BROWN, WHITE)
    scene, style = torch.cat([wall, things]), patches(BLUE, YELLOW, WHITE)
    affine = palette_of(scene, torch.ones(len(scene)), style, "moments")(scene)
    assert transport(affine, style)[: len(wall)].std(dim=0).max() > 0.3
    assert mapped(scene, style)[: len(wall)].std(dim=0).max() < 0.1


def test_a_scene_of_one_colour_takes_the_mean_of_the_painting():
    style = patches(BLUE, YELLOW, WHITE)
    result = mapped(torch.full((50, 3), 0.4), style)
    torch.testing.assert_close(result, style.mean(dim=0).expand(50, 3), atol=5e-3, rtol=0)


def test_what_has_no_weight_doesnt_count():
    scene, sky, painting = patches(GREEN, BROWN), patches(WHITE), patches(BLUE, YELLOW)
    weights = torch.cat([torch.ones(len(scene)), torch.zeros(len(sky))])
    both = palette_of(torch.cat([scene, sky]), weights, painting, "transport")
    torch.testing.assert_close(both(scene), mapped(scene, painting), atol=0.05, rtol=0)


def test_moments_are_the_affine_map_cut_to_what_can_be_shown():
    scene, painting = patches(GREEN, BROWN), patches(BLUE, YELLOW)
    expected = affine(scene, *palette_transform(*color_moments(scene), *color_moments(painting))).clamp(0, 1)
    torch.testing.assert_close(mapped(scene, painting, "moments"), expected)


def test_a_palette_keeps_shape_and_dtype():
    own = palette_of(patches(GREEN, BROWN), torch.ones(600), patches(BLUE), "transport")
    for shape in ((3,), (0, 3), (2, 5, 3)):
        for dtype in (torch.float32, torch.float64):
            result = own(torch.rand(shape, dtype=dtype))
            assert result.shape == shape and result.dtype == dtype
            assert ((result >= 0) & (result <= 1)).all()


@pytest.mark.parametrize("transfer", ["moments", "transport"])
def test_a_scene_without_a_colour_that_counts_is_refused(transfer):
    with pytest.raises(InputError, match="no colour to take a palette from"):
        palette_of(torch.rand(5, 3), torch.zeros(5), torch.rand(5, 3), transfer)

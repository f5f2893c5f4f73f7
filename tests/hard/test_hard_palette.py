import pytest
import torch
from hard.table import hard_case

from sparsestyle_ns.field_components.color_map import affine
from sparsestyle_ns.style.color import SMALLEST_SPREAD, color_moments, palette_transform
from sparsestyle_ns.utils.errors import InputError


def colors_of(seed, count=500):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=generator) @ torch.rand(3, 3, generator=generator) / 3


def transferred(content, style, weights=None):
    return affine(content, *palette_transform(*color_moments(content, weights), *color_moments(style)))


@hard_case(
    "palette",
    case="photos whose colours lie on a line or in a plane",
    could_go_wrong="the inverse of a singular covariance turns rounding errors into paint",
    must_hold="finite colours with the style's mean, and no more variance in any direction than the style has",
)
@pytest.mark.parametrize("rank", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 1e-7])
def test_singular_covariances_make_no_colour_up(rank, noise):
    generator = torch.Generator().manual_seed(0)
    content = 0.5 + 0.2 * torch.randn(800, rank, generator=generator) @ torch.randn(rank, 3, generator=generator)
    content += noise * torch.randn(800, 3, generator=generator)
    style = colors_of(1)
    result = transferred(content, style)
    mean, covariance = color_moments(style)
    assert result.isfinite().all()
    torch.testing.assert_close(result.double().mean(dim=0), mean, rtol=0, atol=1e-4)
    variances = torch.linalg.eigvalsh(color_moments(result)[1])
    assert variances.max() <= torch.linalg.eigvalsh(covariance).max() * (1 + 1e-3)
    assert (variances < 1e-6).sum() >= 3 - rank


@hard_case(
    "palette",
    case="photos of one colour: black, grey, white",
    could_go_wrong="division by a spread of 0",
    must_hold="every pixel is the style's mean colour",
)
@pytest.mark.parametrize("value", [0.0, 1 / 3, 1.0])
def test_photos_of_one_colour_take_the_mean_of_the_style(value):
    style = colors_of(1)
    result = transferred(torch.full((50, 3), value), style)
    torch.testing.assert_close(result, style.mean(dim=0).expand(50, 3), rtol=0, atol=1e-5)


@hard_case(
    "palette",
    case="a style of one colour",
    could_go_wrong="the root of a covariance with eigenvalues of −1e-17",
    must_hold="every pixel is that colour",
)
@pytest.mark.parametrize("value", [0.0, 1 / 3, 1.0])
def test_a_style_of_one_colour_is_taken_whole(value):
    result = transferred(colors_of(0), torch.full((50, 3), value))
    torch.testing.assert_close(result, torch.full((500, 3), value), rtol=0, atol=1e-5)


@hard_case(
    "palette",
    case="a single pixel, as photo and as style",
    could_go_wrong="a covariance divided by n − 1 = 0",
    must_hold="the covariance is 0; the style's colour",
)
def test_one_pixel_has_no_spread():
    pixel = torch.tensor([[0.2, 0.4, 0.9]])
    assert color_moments(pixel)[1].abs().max() == 0
    torch.testing.assert_close(transferred(pixel.flip(1), pixel), pixel)


@hard_case(
    "palette",
    case="alpha: all transparent, one pixel opaque, weights of 1e-30",
    could_go_wrong="division by a weight of 0; tiny weights that round to nothing",
    must_hold="no weight is refused in one sentence; otherwise only the size of weights to each other matters",
)
def test_transparent_pixels_do_not_count():
    colors = colors_of(0)
    with pytest.raises(InputError, match="no colour to take a palette from"):
        color_moments(colors, torch.zeros(500))
    one = torch.zeros(500)
    one[7] = 1e-30
    mean, covariance = color_moments(colors, one)
    torch.testing.assert_close(mean.float(), colors[7])
    assert covariance.abs().max() < 1e-15
    weights = torch.rand(500, generator=torch.Generator().manual_seed(1))
    for left, right in zip(color_moments(colors, 1e-30 * weights), color_moments(colors, weights), strict=True):
        torch.testing.assert_close(left, right)


@hard_case(
    "palette",
    case="a million pixels that differ in the eighth digit",
    could_go_wrong="mean square minus squared mean cancels: a negative variance",
    must_hold="the variance is that of the differences, to three digits",
)
def test_tiny_variances_do_not_cancel():
    values = 1 - 2.0**-24 * (torch.arange(1 << 20) % 2)
    _, covariance = color_moments(values[:, None].expand(-1, 3))
    torch.testing.assert_close(covariance, torch.full((3, 3), 2.0**-50, dtype=torch.float64), rtol=1e-3, atol=0)


@hard_case(
    "palette",
    case="a spread just above and just below what counts as a rounding error",
    could_go_wrong="a jump of the gain, so that one pixel more or less changes the picture",
    must_hold="the gain is continuous, and largest there",
)
def test_the_gain_does_not_jump():
    style = color_moments(colors_of(1))
    gains = [
        torch.linalg.matrix_norm(
            palette_transform(torch.zeros(3), (factor * SMALLEST_SPREAD) ** 2 * torch.eye(3).double(), *style)[0], 2
        )
        for factor in (0.5, 1 - 1e-9, 1 + 1e-9, 2.0)
    ]
    torch.testing.assert_close(gains[1], gains[2], rtol=1e-8, atol=0)
    assert gains[0] < gains[1] and gains[3] < gains[2]

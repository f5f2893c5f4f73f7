import numpy as np
import pytest
import reference
import torch

from sparsestyle_ns.field_components.color_map import affine
from sparsestyle_ns.style.color import SMALLEST_SPREAD, color_moments, gaussian_distance, palette_transform
from sparsestyle_ns.utils.errors import InputError


def correlated_colors(seed, count=500, dtype=torch.float64):
    """Colours whose channels depend on each other, as those of real pictures do."""
    generator = torch.Generator().manual_seed(seed)
    mixing = torch.rand(3, 3, generator=generator, dtype=torch.float64)
    colors = torch.rand(count, 3, generator=generator, dtype=torch.float64) @ mixing
    return (colors / colors.max()).to(dtype)


def test_moments_are_the_weighted_mean_and_covariance():
    colors = correlated_colors(0, count=40)
    weights = torch.rand(40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mean, covariance = color_moments(colors, weights)
    expected_mean, expected_covariance = reference.color_moments(colors, weights)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-12)
    np.testing.assert_allclose(covariance, expected_covariance, rtol=1e-10)


def test_a_weight_of_2_counts_a_colour_twice_and_a_weight_of_0_not_at_all():
    colors = correlated_colors(0, count=3)
    weighted = color_moments(colors, torch.tensor([2.0, 1.0, 0.0]))
    counted = color_moments(colors[[0, 0, 1]])
    for left, right in zip(weighted, counted, strict=True):
        torch.testing.assert_close(left, right)


def test_moments_take_images_of_any_shape_and_are_computed_in_float64():
    image = correlated_colors(0, count=48, dtype=torch.float32)
    mean, covariance = color_moments(image.reshape(2, 4, 6, 3), torch.ones(2, 4, 6))
    assert mean.dtype == covariance.dtype == torch.float64
    torch.testing.assert_close((mean, covariance), color_moments(image))


@pytest.mark.parametrize(("colors", "weights"), [(torch.zeros(0, 3), None), (torch.ones(2, 3), torch.zeros(2))])
def test_moments_of_nothing_are_refused(colors, weights):
    with pytest.raises(InputError, match="no colour to take a palette from: give an image"):
        color_moments(colors, weights)


def test_the_transform_is_the_style_root_times_the_inverse_content_root():
    moments = [*color_moments(correlated_colors(0)), *color_moments(correlated_colors(1))]
    matrix, offset = palette_transform(*moments)
    expected_matrix, expected_offset = reference.palette_transform(*(m.numpy() for m in moments))
    np.testing.assert_allclose(matrix, expected_matrix, rtol=1e-9)
    np.testing.assert_allclose(offset, expected_offset, rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_transferred_colours_have_the_styles_mean_and_covariance(seed):
    content, style = correlated_colors(seed), correlated_colors(seed + 100)
    transferred = affine(content, *palette_transform(*color_moments(content), *color_moments(style)))
    torch.testing.assert_close(color_moments(transferred), color_moments(style), rtol=0, atol=1e-6)


def test_a_picture_in_the_styles_own_colours_stays_as_it_is():
    colors = correlated_colors(3)
    moments = color_moments(colors)
    torch.testing.assert_close(affine(colors, *palette_transform(*moments, *moments)), colors)


def grey_colors(noise):
    generator = torch.Generator().manual_seed(2)
    grey = torch.rand(1000, 1, generator=generator, dtype=torch.float64).expand(-1, 3)
    return grey + noise * torch.randn(1000, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("noise", [0.0, 1e-9, 1e-4])
def test_rounding_errors_of_a_grey_photograph_are_not_blown_up_into_colour(noise):
    content, style = grey_colors(noise), correlated_colors(1)
    transferred = affine(content, *palette_transform(*color_moments(content), *color_moments(style)))
    _, covariance = color_moments(transferred)
    mean, style_covariance = color_moments(style)
    variances = torch.linalg.eigvalsh(covariance)
    # One direction of variance remains one. The others are less than noise / SMALLEST_SPREAD of the style's.
    assert variances[2] > 1e-3
    assert variances[:2].max() <= style_covariance.trace() * (noise / SMALLEST_SPREAD) ** 2 + 1e-12
    torch.testing.assert_close(transferred.mean(dim=0), mean)


@pytest.mark.parametrize("spread", [0.0, 1e-12, 1e-6, 1e-3, SMALLEST_SPREAD, 1e-2])
def test_the_gain_is_bounded_however_little_the_content_varies(spread):
    style_mean, style_covariance = color_moments(correlated_colors(1))
    content_covariance = spread**2 * torch.eye(3, dtype=torch.float64)
    matrix, offset = palette_transform(torch.full((3,), 0.5), content_covariance, style_mean, style_covariance)
    largest_spread = torch.linalg.eigvalsh(style_covariance)[2].sqrt()
    assert torch.linalg.matrix_norm(matrix, 2) <= largest_spread / SMALLEST_SPREAD * (1 + 1e-9)
    assert matrix.isfinite().all() and offset.isfinite().all()


def test_a_picture_of_one_colour_takes_the_mean_of_the_style_and_a_style_of_one_colour_is_taken_whole():
    one_color, many_colors = torch.full((10, 3), 0.3), correlated_colors(1)
    for content, style in [(one_color, many_colors), (many_colors, one_color)]:
        transferred = affine(content, *palette_transform(*color_moments(content), *color_moments(style)))
        torch.testing.assert_close(transferred, style.mean(dim=0).to(content).expand_as(content))


def test_the_transform_is_continuous_where_exact_gain_ends():
    style = color_moments(correlated_colors(1))
    mean = torch.zeros(3, dtype=torch.float64)
    below, above = (
        palette_transform(mean, (factor * SMALLEST_SPREAD) ** 2 * torch.eye(3), *style)[0]
        for factor in (1 - 1e-7, 1 + 1e-7)
    )
    torch.testing.assert_close(below, above, rtol=1e-5, atol=1e-5)


def test_colours_keep_their_shape_and_dtype():
    colors = torch.tensor([[[0.0, 0.5, 1.0]]])
    matrix, offset = 2 * torch.eye(3, dtype=torch.float64), torch.tensor([-0.5, 0.0, 0.0], dtype=torch.float64)
    assert affine(colors, matrix, offset).tolist() == [[[-0.5, 1.0, 2.0]]]
    assert affine(colors, matrix, offset).dtype == torch.float32


def test_transferred_colours_pass_an_exact_gradient():
    content = correlated_colors(0, count=4).requires_grad_()
    transform = palette_transform(*color_moments(correlated_colors(0)), *color_moments(correlated_colors(1)))
    assert torch.autograd.gradcheck(lambda colors: affine(colors, *transform), (content,))


def test_the_distance_of_two_palettes_is_that_of_their_means_and_of_their_spreads():
    mean, covariance = torch.zeros(3), torch.diag(torch.tensor([0.04, 0.01, 0.09]))
    shifted = gaussian_distance(mean, covariance, mean + torch.tensor([0.3, 0.0, 0.4]), covariance)
    assert shifted.item() == pytest.approx(0.5)
    # Along shared axes it is the distance of the standard deviations: (0.2, 0.1, 0.3) and twice that.
    spread = gaussian_distance(mean, covariance, mean, 4 * covariance)
    assert spread.item() == pytest.approx((0.04 + 0.01 + 0.09) ** 0.5)
    turned = color_moments(correlated_colors(3))
    assert gaussian_distance(*turned, *turned).item() == pytest.approx(0, abs=1e-6)

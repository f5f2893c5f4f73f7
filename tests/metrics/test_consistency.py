"""Short- and long-range consistency: what the numbers are where they are known."""

import pytest
import torch
from test_warping import FOCAL, HEIGHT, SHIFT, WIDTH, plane, surface, with_square
from torchmetrics.functional import structural_similarity_index_measure

from sparsestyle_ns.metrics.consistency import PathGeometry, masked_distance, masked_rmse, masked_ssim, pair_consistency
from sparsestyle_ns.metrics.image import lpips_metric
from sparsestyle_ns.metrics.warping import Correspondence, Surface, correspond, pixel_centers


def noise(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def everything(height: int, width: int) -> Correspondence:
    picture = torch.zeros(height, width)
    return Correspondence(pixel_centers(height, width, picture), torch.ones(height, width, dtype=torch.bool))


def test_a_perfect_warp_scores_0_and_1_and_0() -> None:
    wide = noise(HEIGHT, WIDTH + 3)
    correspondence = correspond(surface(0.0, plane()), surface(SHIFT, plane()))
    # The wall moves 3 pixels to the left.
    values = pair_consistency(wide[:, :WIDTH], wide[:, 3:], correspondence)
    assert values["rmse"] == pytest.approx(0.0, abs=1e-5)
    assert values["ssim"] == pytest.approx(1.0, abs=1e-4)


def test_perceptual_distances_of_a_perfect_warp_are_0_and_of_another_picture_are_not() -> None:
    picture = noise(32, 40)
    values = pair_consistency(picture, picture, everything(32, 40))
    assert values["st_lpips"] == pytest.approx(0.0, abs=1e-6)
    assert ("lpips" in values) == (lpips_metric((32, 40)) is not None)
    assert pair_consistency(picture, noise(32, 40, seed=1), everything(32, 40))["st_lpips"] > 1e-3


def test_a_texture_that_sticks_to_the_screen_scores_what_it_should_have_moved() -> None:
    # A ramp of 0.02 a pixel that stays where it is while the wall moves by 3 pixels: 0.06 everywhere.
    ramp = (0.02 * torch.arange(WIDTH)).expand(HEIGHT, WIDTH)[..., None].expand(-1, -1, 3)
    correspondence = correspond(surface(0.0, plane()), surface(SHIFT, plane()))
    assert pair_consistency(ramp, ramp, correspondence)["rmse"] == pytest.approx(0.06, abs=1e-5)


def test_rmse_counts_visible_pixels_alone() -> None:
    first, second = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    second[0, 0], second[0, 1], second[1, 1] = 0.3, 0.1, 9.0
    visible = torch.tensor([[True, True], [False, False]])
    assert float(masked_rmse(first, second, visible)) == pytest.approx(((0.09 + 0.01) / 2) ** 0.5)


def test_what_is_occluded_or_read_by_no_pixel_has_no_say() -> None:
    depth = with_square(slice(12, 20)), with_square(slice(6, 14))
    correspondence = correspond(surface(0.0, depth[0]), surface(SHIFT, depth[1]))
    first, second = noise(HEIGHT, WIDTH), noise(HEIGHT, WIDTH, seed=1)
    before = pair_consistency(first, second, correspondence)
    changed = torch.where(correspondence.visible[..., None], first, noise(HEIGHT, WIDTH, seed=2))
    assert not torch.equal(changed, first)
    assert pair_consistency(changed, second, correspondence) == pytest.approx(before)


def test_a_perceptual_distance_is_a_mean_over_what_is_visible() -> None:
    visible = torch.zeros(4, 8, dtype=torch.bool)
    visible[:, :2] = True
    seen = []

    def metric(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        seen.extend([first, second])
        return (first - second).abs().mean()

    first, second = noise(4, 8), noise(4, 8, seed=1)
    expected = float((first - second)[:, :2].abs().mean())
    assert masked_distance(metric, first, second, visible) == pytest.approx(expected)
    assert all(picture.shape == (1, 3, 4, 8) and not picture[..., 2:].any() for picture in seen)


def test_ssim_of_whole_pictures_is_torchmetrics_away_from_the_border() -> None:
    first = noise(40, 48)
    second = (first + 0.2 * noise(40, 48, seed=1)).clamp(0, 1)
    batch = (picture.permute(2, 0, 1)[None] for picture in (first, second))
    _, full = structural_similarity_index_measure(*batch, data_range=1.0, return_full_image=True)
    inside = torch.zeros(40, 48, dtype=torch.bool)
    inside[20, 24] = True
    whole = torch.ones_like(inside)
    for row, column in ((20, 24), (8, 30), (30, 9)):
        # Windows there lie inside the picture, so that all of it counts; seen through one pixel's worth of the mean.
        window = slice(row - 5, row + 6), slice(column - 5, column + 6)
        at_pixel = masked_ssim_at(first[window], second[window])
        assert at_pixel == pytest.approx(float(full[0, :, row, column].mean()), abs=1e-4)
    assert float(masked_ssim(first, second, whole)) == pytest.approx(float(full.mean()), abs=0.02)


def masked_ssim_at(first: torch.Tensor, second: torch.Tensor) -> float:
    """SSIM of the middle of an 11 × 11 window, by its definition."""
    offsets = torch.arange(-5.0, 6.0)
    profile = torch.exp(-0.5 * (offsets / 1.5).square())
    weights = torch.outer(profile, profile)
    weights = (weights / weights.sum())[..., None]
    mean_x, mean_y = (weights * first).sum((0, 1)), (weights * second).sum((0, 1))
    var_x = (weights * (first - mean_x).square()).sum((0, 1))
    var_y = (weights * (second - mean_y).square()).sum((0, 1))
    both = (weights * (first - mean_x) * (second - mean_y)).sum((0, 1))
    top = (2 * mean_x * mean_y + 1e-4) * (2 * both + 9e-4)
    return float((top / ((mean_x.square() + mean_y.square() + 1e-4) * (var_x + var_y + 9e-4))).mean())


def test_ssim_of_a_masked_picture_is_that_of_the_visible_part_cut_out() -> None:
    first, second = noise(20, 30), noise(20, 30, seed=1)
    visible = torch.zeros(20, 30, dtype=torch.bool)
    visible[4:15, 6:25] = True
    part = slice(4, 15), slice(6, 25)
    alone = masked_ssim(first[part], second[part], visible[part])
    torch.testing.assert_close(masked_ssim(first, second, visible), alone)


def test_views_that_share_nothing_have_no_consistency() -> None:
    nothing = Correspondence(torch.zeros(8, 8, 2), torch.zeros(8, 8, dtype=torch.bool))
    assert pair_consistency(noise(8, 8), noise(8, 8), nothing) == {}


def test_a_path_is_measured_between_neighbours_and_seven_frames_apart() -> None:
    # A camera that goes 1 pixel of parallax a frame, past a wall with a ramp that sticks to the screen.
    step = 4.0 / FOCAL
    path: list[Surface] = [surface(step * t, plane()) for t in range(16)]
    ramp = (0.01 * torch.arange(WIDTH)).expand(HEIGHT, WIDTH)[..., None].expand(-1, -1, 3)
    geometry = PathGeometry(path)
    assert {name: len(pairs) for name, pairs in geometry.pairs.items()} == {"short": 15, "long": 9}
    values = geometry.consistency([ramp] * 16)
    assert values["short_rmse"] == pytest.approx(0.01, abs=1e-5)
    assert values["long_rmse"] == pytest.approx(0.07, abs=1e-5)
    assert geometry.visible_share("short") == pytest.approx((WIDTH - 1) / WIDTH)
    assert geometry.visible_share("long") == pytest.approx((WIDTH - 7) / WIDTH)

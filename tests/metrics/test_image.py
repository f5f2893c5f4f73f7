import math

import pytest
import torch
from torchvision.models import alexnet

from sparsestyle_ns.metrics import image as module
from sparsestyle_ns.metrics.image import ALEXNET_FILE, image_metrics, lpips_metric, psnr, st_lpips_metric


@pytest.fixture
def photo():
    return torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def without_lpips(monkeypatch):
    monkeypatch.setattr(module, "lpips_metric", lambda size: None)
    monkeypatch.setattr(module, "st_lpips_metric", lambda size: None)


@pytest.mark.parametrize("error, decibels", [(1.0, 0), (0.1, 20), (0.01, 40)])
def test_psnr_of_an_even_error_is_20_decibels_a_digit(error, decibels):
    assert psnr(torch.full((4, 5, 3), error), torch.zeros(4, 5, 3)) == pytest.approx(decibels, abs=1e-4)


def test_psnr_is_that_of_the_mean_squared_error(photo):
    image = photo.flip(0)
    pairs = zip(image.flatten().tolist(), photo.flatten().tolist(), strict=True)
    expected = -10 * math.log10(sum((i - p) ** 2 for i, p in pairs) / photo.numel())
    # The mean of 2304 float32 numbers.
    assert psnr(image, photo) == pytest.approx(expected, abs=1e-4)


def test_an_identical_picture_has_the_best_of_all_numbers(photo, without_lpips):
    assert image_metrics(photo, photo) == {"psnr": math.inf, "ssim": pytest.approx(1.0)}


def test_the_worse_the_noise_the_worse_the_numbers(photo, without_lpips):
    noise = torch.randn(photo.shape, generator=torch.Generator().manual_seed(1))
    weak, strong = (image_metrics(photo + scale * noise, photo) for scale in (0.05, 0.3))
    assert weak["psnr"] > strong["psnr"] and 1 > weak["ssim"] > strong["ssim"]


def test_ssim_of_two_even_pictures_is_the_likeness_of_their_brightness(without_lpips):
    # Without variance SSIM is (2 μ_x μ_y + c) / (μ_x² + μ_y² + c) with c = 0.01².
    image, photo = torch.full((24, 24, 3), 0.4), torch.full((24, 24, 3), 0.6)
    expected = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    # The variances, 0, are differences of float32 squares next to a constant of 9e-4.
    assert image_metrics(image, photo)["ssim"] == pytest.approx(expected, abs=1e-3)


def test_a_rendered_picture_is_clipped_to_what_a_screen_shows_and_may_carry_a_gradient(photo, without_lpips):
    image = (photo + 0.4 * photo.roll(1, dims=0)).requires_grad_()
    metrics = image_metrics(image, photo)
    assert metrics == image_metrics(image.clamp(0, 1), photo)
    assert metrics["psnr"] > psnr(image, photo)
    assert all(isinstance(value, float) for value in metrics.values())


def test_lpips_is_reported_where_it_can_be_computed(photo, monkeypatch):
    seen = []

    def metric(image, reference):
        seen.append((image, reference))
        return torch.tensor(0.25)

    monkeypatch.setattr(module, "lpips_metric", lambda size: metric)
    image = photo.flip(1)
    assert image_metrics(image, photo)["lpips"] == 0.25
    assert torch.equal(seen[0][0][0], image.permute(2, 0, 1)) and torch.equal(seen[0][1][0], photo.permute(2, 0, 1))


def test_without_its_weights_lpips_is_left_out_and_nothing_is_downloaded(photo, monkeypatch, tmp_path):
    def download(*_, **__):
        raise AssertionError("the network was asked")

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", download)
    assert lpips_metric((64, 64)) is None
    assert image_metrics(photo, photo).keys() == {"psnr", "ssim", "st_lpips"}
    assert ALEXNET_FILE.startswith("alexnet")


def test_lpips_is_torchmetrics_with_the_weights_in_the_cache_and_of_pictures_that_are_large_enough(
    monkeypatch, tmp_path
):
    torch.manual_seed(0)
    state = alexnet(weights=None).state_dict()
    for name, value in state.items():
        if name.startswith("classifier"):  # LPIPS doesn't use it, and it is most of the file
            state[name] = torch.zeros(1).expand(value.shape)
    (tmp_path / "checkpoints").mkdir()
    torch.save(state, tmp_path / "checkpoints" / ALEXNET_FILE)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert lpips_metric((30, 500)) is None
    picture = torch.rand(1, 3, 31, 31)
    assert lpips_metric((31, 31))(picture, picture) == 0 < lpips_metric((31, 31))(picture, 1 - picture)


def test_st_lpips_is_what_its_authors_code_gives():
    # By stlpips_pytorch.stlpips.LPIPS(net="alex", variant="shift_tolerant") 0.0.2 with normalize=True.
    generator = torch.Generator().manual_seed(0)
    for size, expected in (((24, 32), 0.0037791768), ((40, 64), 0.0027447660), ((94, 126), 0.0021828124)):
        first = torch.rand(1, 3, *size, generator=generator)
        second = (first + 0.2 * torch.rand(1, 3, *size, generator=generator)).clamp(0, 1)
        assert float(st_lpips_metric(size)(first, second)) == pytest.approx(expected, rel=1e-4)


def test_pictures_too_small_for_st_lpips_go_without():
    assert st_lpips_metric((23, 500)) is None
    assert st_lpips_metric((24, 24))(torch.rand(1, 3, 24, 24), torch.rand(1, 3, 24, 24)) > 0

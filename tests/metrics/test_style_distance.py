"""Distances of pictures to a painting that nobody trains on."""

import math

import pytest
import torch

from sparsestyle_ns.metrics.style_distance import StyleDistance


@pytest.fixture
def painting() -> torch.Tensor:
    """Stripes and patches of a few colours, 3 × 64 × 80."""
    generator = torch.Generator().manual_seed(0)
    palette = torch.rand(5, 3, generator=generator)
    patches = palette[torch.randint(0, 5, (8, 10), generator=generator)]
    return patches.repeat_interleave(8, 0).repeat_interleave(8, 1).permute(2, 0, 1)


def test_a_painting_is_itself(painting):
    figures = StyleDistance(painting).figures(painting.permute(1, 2, 0))
    assert figures["color_distance"] == figures["texture_distance"] == 0.0
    assert figures["colors_used"] == pytest.approx(1.0)


def test_shuffled_pixels_have_its_colors_and_not_its_texture(painting):
    pixels = painting.flatten(1).T
    shuffled = pixels[torch.randperm(len(pixels), generator=torch.Generator().manual_seed(1))].view(64, 80, 3)
    figures = StyleDistance(painting).figures(shuffled)
    assert figures["color_distance"] < 1e-6 and figures["colors_used"] == pytest.approx(1.0)
    assert figures["texture_distance"] > 0.2


def test_mirrored_it_keeps_its_texture_and_darkened_it_loses_its_colors(painting):
    measure, picture = StyleDistance(painting), painting.permute(1, 2, 0)
    mirrored, darker = measure.figures(picture.flip(1)), measure.figures(picture - 0.2)
    assert mirrored["color_distance"] < 1e-6
    assert mirrored["texture_distance"] < 0.5 * measure.figures(torch.rand(64, 80, 3))["texture_distance"]
    assert darker["color_distance"] > 0.1 and darker["colors_used"] < 0.7


def test_of_one_color_a_picture_uses_one(painting):
    color = painting[:, 0, 0]
    share = (painting == color[:, None, None]).all(dim=0).float().mean().item()
    used = StyleDistance(painting).figures(color.expand(64, 80, 3))["colors_used"]
    assert used == pytest.approx(share)


def test_only_what_covers_the_picture_counts(painting):
    measure, picture = StyleDistance(painting), painting.permute(1, 2, 0).clone()
    accumulation = torch.ones(64, 80)
    picture[:, 40:], accumulation[:, 40:] = 1.0, 0.0
    covered, whole = measure.figures(picture, accumulation), measure.figures(picture)
    assert covered["color_distance"] < 0.5 * whole["color_distance"]
    assert covered["texture_distance"] < whole["texture_distance"]


def test_without_weights_textures_are_left_out(painting, monkeypatch):
    monkeypatch.setattr("sparsestyle_ns.metrics.style_distance.st_lpips_metric", lambda size: None)
    assert set(StyleDistance(painting).figures(painting.permute(1, 2, 0))) == {"color_distance", "colors_used"}


def test_paintings_of_one_color_and_tiny_pictures_have_figures(painting):
    plain = StyleDistance(torch.full((3, 64, 80), 0.5)).figures(painting.permute(1, 2, 0))
    assert all(math.isfinite(value) for value in plain.values()) and plain["texture_distance"] > 0
    tiny = StyleDistance(painting).figures(torch.rand(20, 80, 3))
    assert set(tiny) == {"color_distance", "colors_used"}

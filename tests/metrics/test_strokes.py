"""The width of strokes in pictures of known ones."""

import math

import pytest
import torch

from sparsestyle_ns.metrics.strokes import stroke_width


def waves(half: float, angle: float = 0.0, height: int = 240, width: int = 360) -> torch.Tensor:
    """Stripes of so many bright and so many dark pixels, across a direction."""
    y, x = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    brightness = 0.5 + 0.4 * torch.sin(math.pi / half * (x * math.cos(angle) + y * math.sin(angle)))
    return brightness[..., None].expand(-1, -1, 3)


@pytest.mark.parametrize("angle", [0.0, 0.5, math.pi / 2])
@pytest.mark.parametrize("half", [3.0, 6.0, 9.0])
def test_waves_are_as_wide_as_half_their_length(half, angle):
    assert stroke_width(waves(half, angle)) == pytest.approx(half, rel=0.08)


def test_a_large_shape_under_the_strokes_changes_little():
    shape = torch.linspace(0.1, 0.9, 360)[None, :, None]
    assert stroke_width(0.5 * waves(5.0) + 0.5 * shape) == pytest.approx(stroke_width(waves(5.0)), rel=0.05)


def test_enlarging_widens_strokes():
    noise = torch.rand(3, 120, 180, generator=torch.Generator().manual_seed(0))
    twice = torch.nn.functional.interpolate(noise[None], scale_factor=2, mode="bicubic")[0]
    assert stroke_width(twice.permute(1, 2, 0)) > 1.6 * stroke_width(noise.permute(1, 2, 0))


def test_a_flat_picture_has_none():
    assert stroke_width(torch.full((20, 30, 3), 0.3)) == 0.0


@pytest.mark.parametrize("height, width", [(2, 2), (3, 200), (200, 2)])
def test_the_smallest_pictures_have_a_finite_width(height, width):
    assert math.isfinite(stroke_width(torch.rand(height, width, 3)))

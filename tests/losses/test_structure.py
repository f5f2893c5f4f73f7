import pytest
import reference
import torch
from torch import Tensor

from sparsestyle_ns.losses.structure import structure_loss


def pictures(height: int = 14, width: int = 17, seed: int = 0) -> Tensor:
    """Two pictures that share some structure, in float64."""
    first, noise = torch.rand(2, height, width, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.stack([first, torch.lerp(first, noise, 0.5)])


@pytest.mark.parametrize("kept", [0.3, 0.6, 1.0])
def test_it_is_what_is_missing_of_the_structure_to_keep(kept: float) -> None:
    first, second = pictures()
    expected = max(0.0, kept - reference.brightness_ssim(first, second))
    assert structure_loss(first, second, kept).item() == pytest.approx(expected, abs=1e-9)


def test_a_view_that_keeps_enough_pays_nothing() -> None:
    first, second = pictures()
    ssim = 1.0 - structure_loss(first, second, kept=1.0).item()
    assert 0.2 < ssim < 0.9
    first.requires_grad_()
    loss = structure_loss(first, second, kept=ssim - 0.01)
    assert loss == 0
    assert not torch.autograd.grad(loss, first)[0].any()
    assert structure_loss(first, second, kept=ssim + 0.01).item() == pytest.approx(0.01)


def test_its_gradient_is_right_and_reaches_the_view_alone() -> None:
    first, second = pictures(12, 13)
    covered = torch.rand(12, 13, generator=torch.Generator().manual_seed(1)) > 0.3
    first.requires_grad_()
    assert torch.autograd.gradcheck(lambda image: structure_loss(image, second, 1.0, covered), first)
    second.requires_grad_()
    (gradient,) = torch.autograd.grad(structure_loss(first, second, 1.0), second, allow_unused=True)
    assert gradient is None


def test_colours_of_the_same_brightness_lose_nothing() -> None:
    grey = pictures()[0].mean(dim=-1, keepdim=True).expand(-1, -1, 3)
    weights = torch.tensor([0.2989, 0.587, 0.114], dtype=torch.float64)  # of ITU-R BT.601
    tint = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    tint = tint - (tint * weights).sum() / weights.sum()
    assert structure_loss(grey + tint, grey, kept=1.0) < 1e-6


def test_what_the_scene_doesnt_cover_counts_for_nothing() -> None:
    first, second = pictures()
    covered = torch.zeros(14, 17, dtype=torch.bool)
    covered[:, :9] = True
    other = first.clone()
    other[:, 9:] = 0.0
    loss = structure_loss(first, second, 1.0, covered)
    torch.testing.assert_close(structure_loss(other, second, 1.0, covered), loss)
    nowhere = structure_loss(first, second, 1.0, torch.zeros_like(covered))
    torch.testing.assert_close(nowhere, structure_loss(first, second, 1.0))

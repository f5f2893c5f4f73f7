import pytest
import torch
from reference import semantic_loss as slow_semantic_loss

from sparsestyle_ns.losses.semantic import pooled_features, semantic_loss


def maps(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_it_is_one_less_the_cosine_of_the_maps_means():
    renders, photos = maps(3, 5, 4, 6), maps(3, 5, 2, 7, seed=1)
    expected = [slow_semantic_loss(a.tolist(), b.tolist()) for a, b in zip(renders, photos, strict=True)]
    found = semantic_loss(pooled_features(renders), pooled_features(photos))
    assert found.item() == pytest.approx(sum(expected) / 3, rel=1e-12)


def test_a_picture_that_shows_the_same_elsewhere_costs_nothing_and_brightness_does_not_count():
    renders = maps(2, 5, 4, 6).clamp(min=0)
    photos = 3 * renders.roll((1, 2), dims=(2, 3))
    assert semantic_loss(pooled_features(renders), pooled_features(photos)).item() == pytest.approx(0.0, abs=1e-12)


def test_the_gradient_matches_finite_differences_and_photos_get_none():
    renders, photos = maps(2, 4, 3, 2).requires_grad_(), pooled_features(maps(2, 4, 3, 2, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(lambda r: semantic_loss(pooled_features(r), photos), (renders,))
    semantic_loss(pooled_features(renders), photos).backward()
    assert photos.grad is None

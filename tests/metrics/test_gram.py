import pytest
import torch

from sparsestyle_ns.metrics.image import gram_distance, gram_matrix


def features(count: int, seed: int) -> torch.Tensor:
    return torch.rand(count, 5, generator=torch.Generator().manual_seed(seed))


def test_the_gram_matrix_is_the_mean_product_of_channels() -> None:
    rows = features(7, 0)
    expected = sum(torch.outer(row, row) for row in rows) / 7
    torch.testing.assert_close(gram_matrix(rows), expected)


def test_the_same_features_in_another_order_are_at_no_distance() -> None:
    rows = features(50, 0)
    shuffled = rows[torch.randperm(50, generator=torch.Generator().manual_seed(1))]
    assert float(gram_distance(gram_matrix(shuffled), gram_matrix(rows))) == pytest.approx(0.0, abs=1e-10)


def test_features_that_have_vanished_are_at_distance_1_whatever_the_networks_scale() -> None:
    style = gram_matrix(features(50, 0))
    assert float(gram_distance(torch.zeros_like(style), style)) == pytest.approx(1.0)
    other = gram_matrix(features(50, 1))
    assert float(gram_distance(9 * other, 9 * style)) == pytest.approx(float(gram_distance(other, style)), rel=1e-5)

import pytest
import reference
import torch

from sparsestyle_ns.losses.nnfm import nearest_neighbors, nnfm_loss


@pytest.fixture
def features():
    return torch.randn(23, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.fixture
def style_features():
    return torch.randn(17, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def test_neighbours_and_loss_of_three_vectors_worked_out_by_hand():
    features = torch.tensor([[2.0, 0.0], [3.0, 3.0], [0.0, 0.1]])
    style_features = torch.tensor([[0.0, 9.0], [1.0, 0.0]])
    assert nearest_neighbors(features, style_features).tolist() == [1, 0, 0]
    # Cosines 1, 1/√2 and 1.
    assert nnfm_loss(features, style_features).item() == pytest.approx((1 - 0.5**0.5) / 3)


def test_neighbours_are_those_of_the_slow_search(features, style_features):
    assert nearest_neighbors(features, style_features).tolist() == reference.nearest_neighbors(features, style_features)


@pytest.mark.parametrize("chunk_size", [1, 4, 17, 22, 23, 1000])
def test_the_size_of_the_chunks_changes_no_neighbour(chunk_size, features, style_features):
    expected = nearest_neighbors(features, style_features)
    assert torch.equal(nearest_neighbors(features, style_features, chunk_size), expected)


@pytest.mark.parametrize("chunk_size", [1, 2, 1000])
def test_of_equally_similar_style_features_the_first_is_taken(chunk_size):
    style_features = torch.tensor([[0.0, 1.0], [1.0, 0.0], [2.0, 0.0], [5.0, 0.0]])
    assert nearest_neighbors(torch.tensor([[1.0, 0.0]]), style_features, chunk_size).tolist() == [1]


def test_no_more_than_a_chunk_of_similarities_is_ever_held(features, style_features):
    class LargestProduct(torch.utils._python_dispatch.TorchDispatchMode):
        entries = 0

        def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
            result = operation(*args, **(kwargs or {}))
            if operation is torch.ops.aten.mm.default:
                self.entries = max(self.entries, result.numel())
            return result

    with LargestProduct() as product:
        nearest_neighbors(features, style_features, chunk_size=4)
    assert product.entries == 16


def test_length_does_not_matter_only_direction(features, style_features):
    scales = torch.linspace(0.01, 100, len(style_features), dtype=torch.float64)[:, None]
    assert torch.equal(
        nearest_neighbors(features, scales * style_features), nearest_neighbors(features, style_features)
    )
    assert nnfm_loss(7 * features, scales * style_features).item() == pytest.approx(
        nnfm_loss(features, style_features).item(), rel=1e-12
    )


def test_the_loss_is_the_mean_cosine_distance_to_the_nearest(features, style_features):
    expected = reference.nnfm_loss(features, style_features)
    assert nnfm_loss(features, style_features, chunk_size=5).item() == pytest.approx(expected, rel=1e-12)


def test_known_neighbours_are_used_as_they_are(features, style_features):
    searched = nnfm_loss(features, style_features)
    assert nnfm_loss(features, style_features, nearest_neighbors(features, style_features)) == searched
    wrong = torch.zeros(len(features), dtype=torch.long)
    expected = sum(1 - reference.cosine(f, style_features[0].tolist()) for f in features.tolist()) / len(features)
    assert nnfm_loss(features, style_features, wrong).item() == pytest.approx(expected, rel=1e-12)


def test_features_that_are_all_in_the_style_cost_nothing(style_features):
    assert nnfm_loss(3 * style_features[[2, 2, 5]], style_features).item() == pytest.approx(0, abs=1e-12)


def test_the_gradient_is_exact_and_reaches_the_features_only(features, style_features):
    style_features.requires_grad_()
    assert torch.autograd.gradcheck(lambda f: nnfm_loss(f, style_features), (features[:4].requires_grad_(),))
    features.requires_grad_()
    nnfm_loss(features, style_features).backward()
    assert features.grad.abs().sum() > 0
    assert style_features.grad is None


def test_zero_vectors_count_as_cosine_0_and_get_no_gradient(style_features):
    features = torch.stack([torch.zeros(6), torch.ones(6), torch.full((6,), 1e-30)]).double().requires_grad_()
    loss = nnfm_loss(features, style_features)
    loss.backward()
    nearest_to_ones = max(reference.cosine([1.0] * 6, style) for style in style_features.tolist())
    assert loss.item() == pytest.approx((1 + 1 + 1 - nearest_to_ones) / 3)
    assert features.grad[[0, 2]].count_nonzero() == 0
    assert features.grad.isfinite().all()


def test_a_style_of_zero_vectors_gives_the_loss_of_no_likeness(features):
    features.requires_grad_()
    loss = nnfm_loss(features, torch.zeros(3, 6, dtype=torch.float64))
    loss.backward()
    assert loss.item() == 1
    assert features.grad.count_nonzero() == 0


def test_a_style_without_features_is_refused(features):
    with pytest.raises(ValueError, match="no style feature to match"):
        nearest_neighbors(features, torch.zeros(0, 6))

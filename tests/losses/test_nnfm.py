import pytest
import reference
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sparsestyle_ns.losses import style_index
from sparsestyle_ns.losses.nnfm import nearest_neighbors, nnfm_loss
from sparsestyle_ns.losses.style_index import StyleIndex
from sparsestyle_ns.utils.device_sizes import SIZES


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
    class LargestProduct(TorchDispatchMode):
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
    assert nnfm_loss(features, style_features).item() == pytest.approx(expected, rel=1e-12)


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


# ---------------------------------------------------------------------------------------------------------------------
# StyleIndex
# ---------------------------------------------------------------------------------------------------------------------


CHANNELS = 40
"""More than the directions of the coarse bounds, so that something is left over."""


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_vectors():
    return normal(50, CHANNELS), normal(150, CHANNELS, seed=1)


def clustered_vectors():
    centres = normal(9, CHANNELS)
    features = centres.repeat(6, 1) + 0.1 * normal(54, CHANNELS, seed=1)
    return features, centres.repeat_interleave(16, dim=0) + 0.1 * normal(144, CHANNELS, seed=2)


def nearly_parallel_vectors():
    """Styles that bfloat16, with its 8 bits, couldn't tell apart."""
    return normal(30, CHANNELS), 1 + 1e-4 * normal(150, CHANNELS, seed=1)


def tied_vectors():
    """Vectors of which many are equally similar: four entries of ±1 each, so that no cosine is rounded."""
    vectors = torch.zeros(200, CHANNELS, dtype=torch.float64)
    places = torch.rand(200, 12, generator=torch.Generator().manual_seed(0)).argsort(dim=1)[:, :4]
    vectors.scatter_(1, places, normal(200, 4).sign())
    return vectors[:50], vectors[50:]


def repeated_vectors():
    distinct = normal(5, CHANNELS)
    return normal(30, CHANNELS, seed=1), distinct[torch.arange(150) * 7 % 11 % 5]


def zero_vectors():
    features, style_features = random_vectors()
    features[::3] = 0
    style_features[::2] = 0
    return features, style_features


def equal_vectors():
    return normal(20, CHANNELS), torch.ones(100, CHANNELS, dtype=torch.float64)


KINDS = [
    random_vectors,
    clustered_vectors,
    nearly_parallel_vectors,
    tied_vectors,
    repeated_vectors,
    zero_vectors,
    equal_vectors,
]


@pytest.mark.parametrize("block_size", [None, 1, 5])
@pytest.mark.parametrize("vectors", KINDS)
def test_an_index_finds_the_neighbours_of_the_slow_search(vectors, block_size):
    features, style_features = vectors()
    style = StyleIndex(style_features, block_size)
    assert style.nearest(features).tolist() == reference.nearest_neighbors(features, style_features)


@pytest.mark.parametrize("vectors", KINDS)
def test_in_float32_no_style_vector_is_more_similar_than_the_one_found(vectors):
    features, style_features = (rows.float() for rows in vectors())
    nearest = nearest_neighbors(features, StyleIndex(style_features, block_size=4))
    cosines = torch.nn.functional.cosine_similarity(features.double()[:, None], style_features.double(), dim=-1)
    # 40 products of numbers below 1, each rounded, are off by far less.
    torch.testing.assert_close(cosines.gather(1, nearest[:, None])[:, 0], cosines.amax(dim=1), rtol=0, atol=1e-6)


def test_one_style_vector_is_everyones_neighbour():
    assert StyleIndex(torch.ones(1, 3)).nearest(torch.rand(4, 3)).tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("channels", [1, 2, 130])
def test_an_index_serves_any_number_of_channels(channels):
    features, style_features = normal(40, channels), normal(60, channels, seed=1)
    found = StyleIndex(style_features, block_size=3).nearest(features)
    assert found.tolist() == reference.nearest_neighbors(features, style_features)


def test_an_index_knows_equal_directions_once_and_by_their_first_row():
    _, style_features = repeated_vectors()
    # Powers of two change the length of a vector and not one digit of its direction.
    style = StyleIndex(style_features * 2.0 ** (torch.arange(150) % 60 - 30)[:, None], block_size=2)
    firsts = [style_features.tolist().index(row) for row in style_features.unique(dim=0).tolist()]
    assert style.rows.unique().tolist() == sorted(firsts)


def test_an_index_gives_the_direction_of_each_row(style_features):
    style_features = torch.cat([style_features, 3 * style_features[:4], torch.zeros(1, 6)])
    rows = torch.tensor([21, 20, 0, 17, 3, 3, 16])
    directions = StyleIndex(style_features, block_size=2).directions_of(rows)
    lengths = style_features.norm(dim=1, keepdim=True).clamp_min(1e-30)
    torch.testing.assert_close(directions, (style_features / lengths)[rows])


def test_loss_and_gradient_with_an_index_are_those_with_the_vectors(features, style_features):
    style, gradients = StyleIndex(style_features, block_size=4), []
    for known in (None, nearest_neighbors(features, style_features), torch.arange(23) % 17):
        losses = [nnfm_loss(rows, source, known) for source in (style, style_features) for rows in [features.clone()]]
        torch.testing.assert_close(*losses)
    for source in (style, style_features):
        rows = features.clone().requires_grad_()
        nnfm_loss(rows, source).backward()
        gradients.append(rows.grad)
    torch.testing.assert_close(*gradients)
    assert torch.autograd.gradcheck(lambda rows: nnfm_loss(rows, style), (features[:4].requires_grad_(),))


class Operations(TorchDispatchMode):
    """Counts what is computed: entries of the largest tensor, and of all products of whole vectors."""

    def __init__(self, channels):
        super().__init__()
        self.channels, self.largest, self.compared = channels, 0, 0

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        result = operation(*args, **(kwargs or {}))
        self.largest = max([self.largest, *(t.numel() for t in tree_leaves(result) if isinstance(t, torch.Tensor))])
        if operation is torch.ops.aten.mm.default and args[0].shape[1] == self.channels == args[1].shape[0]:
            self.compared += result.numel() if args[1].stride(0) == 1 else 0
        return result


def test_an_index_compares_similar_features_with_few_of_the_style():
    features, style_features = clustered_vectors()
    style = StyleIndex(style_features, block_size=16)
    with Operations(CHANNELS) as operations:
        style.nearest(features)
    # 16 of each feature's 144 would be the least.
    assert operations.compared < 0.3 * len(features) * len(style_features)


def test_the_search_of_an_index_fills_no_tensor_larger_than_the_features(monkeypatch):
    features, style_features = random_vectors()
    style = StyleIndex(style_features, block_size=4)
    expected = style.nearest(features)
    monkeypatch.setattr(style_index, "TABLE_SIZE", 64)
    monkeypatch.setitem(SIZES, "cpu", SIZES["cpu"]._replace(bounded_vectors=6))
    with Operations(CHANNELS) as operations:
        found = style.nearest(features)
    assert torch.equal(found, expected)
    assert operations.largest == features.numel()


@pytest.mark.parametrize("count", [1, 23, 127])
def test_products_of_outlines_are_never_below_those_of_the_vectors(count):
    # Vectors all but inside the basis, and some of them equal: nothing but rounding is left to be covered.
    inside = normal(200, count) @ normal(count, 768, seed=1) + 1e-6 * normal(200, 768, seed=2)
    directions = style_index.unit_vectors(torch.cat([inside, inside[:50] * 3]).float())
    basis = style_index._principal_axes(directions)[:, :count].contiguous()
    outlines = style_index._outline(directions, basis)
    exact = directions.double() @ directions.double().T
    bounds = outlines @ outlines.T
    assert (bounds >= exact).all()
    assert (bounds - exact).mean() < 0.01


@pytest.mark.parametrize("block_size", [1, 2, 7, 1000])
@pytest.mark.parametrize("count", [1, 2, 9, 100, 129])
def test_blocks_hold_each_row_and_no_more_rows_than_asked_for(count, block_size):
    blocks = style_index._similar_blocks(normal(count, 3), block_size)
    assert blocks.shape[1] <= block_size
    assert blocks.unique().tolist() == list(range(count))
    assert (blocks.flatten().bincount()[:-1] == 1).all()
    assert (blocks.diff(dim=1) >= 0).all()


def test_blocks_hold_what_is_alike():
    centres = torch.tensor([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0], [9.0, 9.0]])
    points = centres.repeat(5, 1) + 0.1 * normal(20, 2).float()
    assert sorted((blocks % 4).tolist() for blocks in style_index._similar_blocks(points, 5)) == [
        [k] * 5 for k in range(4)
    ]


def test_an_index_of_no_features_is_refused():
    with pytest.raises(ValueError, match="no style feature to match"):
        StyleIndex(torch.zeros(0, 6))

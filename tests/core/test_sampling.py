import pytest
import reference
import torch

from sparsestyle_ns.core.sampling import even_edges, sample_pdf

CPU = torch.device("cpu")


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def histogram(rays=6, bins=9):
    """Random masses on random borders."""
    edges = torch.rand(rays, bins + 1, generator=generator(1)).sort(dim=-1).values
    return edges, torch.rand(rays, bins, generator=generator(2)) ** 3


def test_even_borders_lie_a_step_apart():
    assert even_edges(2, 4, CPU).tolist() == [[0.0, 0.25, 0.5, 0.75, 1.0]] * 2


@pytest.mark.parametrize("num_samples", [1, 2, 64])
def test_jitter_keeps_the_order_the_ends_and_half_a_step(num_samples):
    even, jittered = even_edges(200, num_samples, CPU), even_edges(200, num_samples, CPU, generator())
    assert jittered.shape == (200, num_samples + 1)
    assert (jittered.diff(dim=-1) >= 0).all()
    assert (jittered[:, 0] == 0).all() and (jittered[:, -1] == 1).all()
    # Borders are float32 numbers up to 1, good to 6e-8.
    assert (jittered - even).abs().max() <= 0.5 / num_samples + 1e-7


def test_jitter_differs_from_ray_to_ray_and_reaches_all_of_its_range():
    offsets = 8 * (even_edges(2000, 8, CPU, generator()) - even_edges(2000, 8, CPU))[:, 1:-1]
    assert offsets.min() < -0.49 and offsets.max() > 0.49
    # The mean of 14000 uniform numbers in ±½ has a deviation of 0.0025.
    assert offsets.mean().abs() < 0.01
    assert len(offsets[:, 0].unique()) > 1900


@pytest.mark.parametrize("num_samples", [1, 2, 5, 40])
def test_borders_cut_the_histogram_into_parts_of_equal_mass(num_samples):
    edges, weights = histogram()
    expected = [
        [reference.inverse_cdf(ray_edges, ray_weights, i / num_samples) for i in range(1, num_samples)]
        for ray_edges, ray_weights in zip(edges.tolist(), weights.tolist(), strict=True)
    ]
    result = sample_pdf(edges, weights, num_samples)
    # The running sum in float32 is good to about 1e-6 of the mass, and steep parts turn that into 1e-5 of a border.
    torch.testing.assert_close(result[:, 1:-1], torch.tensor(expected).view(6, num_samples - 1), atol=2e-5, rtol=0)


def test_a_histogram_worked_out_by_hand():
    edges, weights = torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[1.0, 3.0]])
    # A quarter of the mass lies left of 0.5, and the other three quarters share its right evenly.
    result = sample_pdf(edges, weights, 4)
    torch.testing.assert_close(result, torch.tensor([[0.0, 0.5, 2 / 3, 5 / 6, 1.0]]))


def test_most_samples_go_where_the_mass_is():
    edges, weights = even_edges(1, 10, CPU), torch.full((1, 10), 0.01)
    weights[0, 6] = 0.91
    result = sample_pdf(edges, weights, 100)[0]
    inside = (result >= 0.6 - 1e-6) & (result <= 0.7 + 1e-6)
    assert inside.sum() == 91 + 1  # both borders of 91 samples, up to the one border that rounding may cost


@pytest.mark.parametrize("seed", [None, 0])
def test_borders_ascend_from_the_start_of_the_histogram_to_its_end(seed):
    edges, weights = histogram(rays=300)
    weights[weights < 0.2] = 0
    weights[:, 4] = 1
    result = sample_pdf(edges, weights, 33, None if seed is None else generator(seed))
    assert torch.equal(result[:, 0], edges[:, 0]) and torch.equal(result[:, -1], edges[:, -1])
    # Two borders at the joint of two bins may be computed from either side, with the rounding of float32.
    assert (result.diff(dim=-1) >= -1e-7).all()


def test_bins_without_mass_hold_no_border():
    edges, weights = even_edges(1, 5, CPU), torch.tensor([[0.0, 1.0, 0.0, 1.0, 0.0]])
    inner = sample_pdf(edges, weights, 10, generator())[0, 1:-1]
    assert (((inner > 0.2 - 1e-6) & (inner < 0.4 + 1e-6)) | ((inner > 0.6 - 1e-6) & (inner < 0.8 + 1e-6))).all()


def test_the_size_of_the_mass_does_not_matter():
    edges, weights = histogram()
    expected = sample_pdf(edges, weights, 12)
    torch.testing.assert_close(sample_pdf(edges, 1e-6 * weights, 12), expected, atol=2e-5, rtol=0)


def test_borders_are_random_only_with_a_generator():
    edges, weights = histogram()
    assert torch.equal(sample_pdf(edges, weights, 12), sample_pdf(edges, weights, 12))
    first, again, other = (sample_pdf(edges, weights, 12, generator(seed)) for seed in (5, 5, 6))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(even_edges(4, 8, CPU, generator(5)), even_edges(4, 8, CPU, generator(5)))

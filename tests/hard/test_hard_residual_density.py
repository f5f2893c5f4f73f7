import pytest
import torch
from hard.table import hard_case

from sparsestyle_ns.core.volrend import dense_weights, optical_depth
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.residual import ResidualField, fine_density

LENGTH = 0.1


def weights_of(residual, coarse):
    """Weights of rays with even intervals."""
    return dense_weights(optical_depth(fine_density(residual, coarse), torch.full_like(coarse, LENGTH)))


@hard_case(
    "sigma_f",
    case="σ' ≪ −σ_c everywhere",
    could_go_wrong="a clamp with gradient 0: what was removed never comes back",
    must_hold="density 0, no weight anywhere, and the gradient of each sample is that of the plain sum",
)
@pytest.mark.parametrize("removed", [1e2, 1e6, 1e30])
def test_a_scene_that_was_removed_as_a_whole_keeps_its_gradient(removed):
    residual = torch.full((2, 6), -removed, requires_grad=True)
    weights = weights_of(residual, torch.full((2, 6), 5.0))
    assert weights.tolist() == [[0] * 6] * 2
    (gradient,) = torch.autograd.grad(-weights.sum(), residual)
    torch.testing.assert_close(gradient, torch.full((2, 6), -LENGTH))


@hard_case(
    "sigma_f",
    case="σ' ≪ −σ_c at some samples",
    could_go_wrong="negative optical depths that make light of nothing",
    must_hold="density 0 there, the exact sum elsewhere; weights sum to at most 1",
)
def test_removed_samples_leave_the_others_as_they_are():
    generator = torch.Generator().manual_seed(0)
    coarse = 10 * torch.rand(50, 20, generator=generator)
    residual = torch.randn(50, 20, generator=generator)
    removed = torch.rand(50, 20, generator=generator) < 0.3
    residual[removed] = -1e8
    density = fine_density(residual, coarse)
    assert (density[removed] == 0).all()
    assert torch.equal(density[~removed], (residual + coarse)[~removed].clamp(min=0))
    assert weights_of(residual, coarse).sum(dim=-1).max().item() <= 1 + 1e-6


@hard_case(
    "sigma_f",
    case="σ' ≪ −σ_c at one sample, in front of a wall",
    could_go_wrong="gradients that ask for less of it push it down without end, or those for more don't reach it",
    must_hold="it gets no gradient that asks for less density, and all of one that asks for more",
)
def test_one_removed_sample_is_only_called_back():
    coarse = torch.tensor([[1.0, 5.0, 1e4]])
    residual = torch.tensor([[0.0, -1e3, 0.0]], requires_grad=True)
    weights = weights_of(residual, coarse)
    (less,) = torch.autograd.grad(weights[0, 1], residual, retain_graph=True)
    (more,) = torch.autograd.grad(-weights[0, 1], residual)
    assert less[0, 1] == 0
    torch.testing.assert_close(more[0, 1].item(), -LENGTH * torch.exp(torch.tensor(-LENGTH)).item())


@hard_case(
    "sigma_f",
    case="σ' = −σ_c exactly",
    could_go_wrong="the kink has no gradient",
    must_hold="density 0 with the plain sum's gradient in either direction",
)
@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_kink_has_a_gradient(direction):
    residual = torch.tensor([-3.0], requires_grad=True)
    density = fine_density(residual, torch.tensor([3.0]))
    (gradient,) = torch.autograd.grad(direction * density.sum(), residual)
    assert density.item() == 0 and gradient.item() == direction


@hard_case(
    "sigma_f",
    case="σ' of ±1e30 and ±3e38",
    could_go_wrong="overflow to infinity, and not a number where an interval has no length",
    must_hold="weights and gradients are finite",
)
def test_residual_densities_of_any_size_give_finite_weights():
    residual = torch.tensor([[3e38, 1e30, -1e30, -3e38]]).repeat(2, 1).requires_grad_()
    coarse = torch.full((2, 4), 3e6)
    for length in (0.0, 1e-6, 1.0, torch.inf):
        density = fine_density(residual, coarse)
        weights = dense_weights(optical_depth(density, torch.full_like(coarse, length)))
        for sign in (-1, 1):
            (gradient,) = torch.autograd.grad(sign * weights.sum(), residual, retain_graph=True)
            assert weights.isfinite().all() and gradient.isfinite().all()


@hard_case(
    "sigma_f",
    case="recovery of a residual field that has removed the whole scene",
    could_go_wrong="training can't leave an empty scene",
    must_hold="within 200 steps of Adam the picture has what it asks for",
)
def test_a_residual_field_brings_a_removed_scene_back():
    torch.manual_seed(0)
    field = ResidualField(
        HashGrid(num_levels=2, min_resolution=4, max_resolution=8, log2_table_size=8), 4, 1, 16, density_scale=10.0
    )
    torch.nn.init.constant_(field.density_head.bias, -3.5)
    location, feature = field.locate(torch.rand(40, 3) * 2 - 1), torch.randn(40, 4)
    coarse = torch.full((40,), 30.0)
    optimizer = torch.optim.Adam(field.parameters(), lr=5e-3)

    def opacity():
        density, _ = field(location, feature, coarse)
        return dense_weights(optical_depth(density.view(5, 8), torch.full((5, 8), LENGTH))).sum(dim=-1)

    assert opacity().tolist() == [0] * 5
    for _ in range(200):
        loss = (opacity() - 0.7).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    torch.testing.assert_close(opacity(), torch.full((5,), 0.7), rtol=0, atol=0.05)


@hard_case(
    "sigma_f",
    case="a residual field under bfloat16 and float16 autocast, its colours near 0 and 1",
    could_go_wrong="a sigmoid that rounds to 1 has gradient 0: the colour is stuck",
    must_hold="colours at logits of ±8 keep float32's gradient to 5%; densities are float32",
)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("logit", [-8.0, 8.0])
def test_saturated_colours_can_come_back_under_autocast(dtype, logit):
    torch.manual_seed(0)
    field = ResidualField(HashGrid(num_levels=2, min_resolution=4, max_resolution=8, log2_table_size=8), 4, 1, 16)
    torch.nn.init.zeros_(field.color_head.weight)
    torch.nn.init.constant_(field.color_head.bias, logit)
    location, feature, coarse = field.locate(torch.rand(10, 3)), torch.randn(10, 4), torch.full((10,), 30.0)
    gradients = []
    for enabled in (False, True):
        with torch.autocast("cpu", dtype=dtype, enabled=enabled):
            density, color = field(location, feature, coarse)
        assert density.dtype == color.dtype == torch.float32
        (gradient,) = torch.autograd.grad(color.sum(), field.color_head.bias)
        gradients.append(gradient)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=0.05, atol=0)

"""Muon against singular value decomposition, torch's own Muon, and what it must do without."""

import copy

import pytest
import torch
from torch import nn

from sparsestyle_ns.engine import muon
from sparsestyle_ns.engine.muon import Muon, nearly_orthogonal


@pytest.fixture(params=["float32", "bfloat16"])
def number_format(request, monkeypatch):
    monkeypatch.setattr(muon, "multiplies_bfloat16", lambda device: request.param == "bfloat16")
    return request.param


@pytest.mark.parametrize("shape", [(1, 4, 4), (3, 8, 8), (2, 3, 7), (2, 7, 3)])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e6])
def test_singular_vectors_stay_and_singular_values_come_near_1(shape, size, number_format):
    generator = torch.Generator().manual_seed(0)
    left, _, right = torch.linalg.svd(torch.randn(shape, generator=generator), full_matrices=False)
    values = torch.linspace(0.1, 1.0, min(shape[1:])).expand(shape[0], -1)
    found = nearly_orthogonal(size * (left * values[:, None]) @ right)
    seen = left.mT @ found @ right.mT  # diagonal where the vectors are the same
    diagonal = seen.diagonal(dim1=1, dim2=2)
    assert ((diagonal > 0.6) & (diagonal < 1.3)).all()
    off = seen - torch.diag_embed(diagonal)
    assert off.abs().max() < (1e-4 if number_format == "float32" else 0.05)


def test_nothing_has_no_direction(number_format):
    assert (nearly_orthogonal(torch.zeros(2, 3, 4)) == 0).all()


def test_steps_are_those_of_torchs_muon_to_bfloat16s_digits(number_format):
    generator = torch.Generator().manual_seed(0)
    shapes = [(6, 6), (4, 8), (6, 6), (9, 3)]
    ours = [nn.Parameter(torch.randn(shape, generator=generator)) for shape in shapes]
    theirs, start = copy.deepcopy(ours), copy.deepcopy(ours)
    settings = {"lr": 0.02, "momentum": 0.9, "weight_decay": 0.1, "eps": 1e-7}
    optimizers = Muon(ours, **settings), torch.optim.Muon(theirs, **settings)
    for _ in range(4):
        for one, other in zip(ours, theirs, strict=True):
            one.grad = torch.randn(one.shape, generator=generator)
            other.grad = one.grad.clone()
        for each in optimizers:
            each.step()
    for one, other, before in zip(ours, theirs, start, strict=True):
        assert (one - other).norm() < 0.05 * (other - before).norm()


def test_a_matrix_without_a_gradient_stays_and_the_others_dont_wait_for_it():
    still, moving = (nn.Parameter(torch.eye(3)) for _ in range(2))
    moving.grad = torch.rand(3, 3)
    Muon([still, moving]).step()
    assert torch.equal(still, torch.eye(3))
    assert not torch.equal(moving, torch.eye(3))


def test_a_state_goes_on_where_it_was_saved():
    def run(interrupted: bool) -> torch.Tensor:
        parameter, generator = nn.Parameter(torch.eye(4)), torch.Generator().manual_seed(0)
        optimizer = Muon([parameter])
        for step in range(4):
            if step == 2 and interrupted:
                saved, optimizer = optimizer.state_dict(), Muon([parameter])
                optimizer.load_state_dict(saved)
            parameter.grad = torch.rand(4, 4, generator=generator)
            optimizer.step()
        return parameter.detach()

    assert torch.equal(run(True), run(False))


def test_a_cpu_without_bfloat16_multiplies_in_float32(monkeypatch):
    seen = []
    monkeypatch.setattr(muon, "multiplies_bfloat16", lambda device: False)
    monkeypatch.setattr(
        torch, "baddbmm", lambda *args, real=torch.baddbmm, **rest: seen.append(args[0]) or real(*args, **rest)
    )
    nearly_orthogonal(torch.rand(1, 3, 3))
    assert {each.dtype for each in seen} == {torch.float32}

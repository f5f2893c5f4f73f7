import torch

from sparsestyle_ns.fields.coarse import in_chunks
from sparsestyle_ns.utils.device_sizes import SIZES


def counted(calls):
    def function(points, values):
        calls.append(len(points))
        return points.sum(dim=-1), points * values[:, None]

    return function


def test_pieces_give_what_all_at_once_gives(monkeypatch):
    monkeypatch.setitem(SIZES, "cpu", SIZES["cpu"]._replace(mlp_points=4))
    points, values, calls = torch.rand(11, 3), torch.rand(11), []
    with torch.no_grad():
        results = in_chunks(counted(calls), points, values)
    assert calls == [4, 4, 3]
    assert torch.equal(results[0], points.sum(dim=-1))
    assert torch.equal(results[1], points * values[:, None])


def test_with_gradients_and_for_few_points_there_is_one_call(monkeypatch):
    monkeypatch.setitem(SIZES, "cpu", SIZES["cpu"]._replace(mlp_points=4))
    calls = []
    in_chunks(counted(calls), torch.rand(11, 3), torch.rand(11))
    with torch.no_grad():
        in_chunks(counted(calls), torch.rand(4, 3), torch.rand(4))
        in_chunks(counted(calls), torch.rand(0, 3), torch.rand(0))
    assert calls == [11, 4, 0]

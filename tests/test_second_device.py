"""The second device finds each kind of mistake, and lets through what CUDA does."""

import copy
import threading

import pytest
import torch
import torch.nn.functional as F
from second_device import DeviceError, SecondDevice
from torch import nn
from torch.utils.checkpoint import checkpoint


@pytest.fixture
def device():
    with SecondDevice() as second:
        yield second


def there(*shape):
    return torch.rand(shape, device="cuda")


def test_what_is_made_there_stays_there_through_views_gradients_and_optimisers(device):
    layer = nn.Linear(3, 2).to("cuda")
    optimizer = torch.optim.Adam(layer.parameters(), fused=True)
    with torch.autocast("cuda", dtype=torch.bfloat16):
        value = layer(there(4, 3))
    assert value.dtype == torch.bfloat16
    value[1:].T.float().square().mean().backward()
    optimizer.step()
    found = [value, layer.weight.grad, *optimizer.state[layer.weight].values(), value[0].new_zeros(2)]
    assert {str(each.device) for each in found} == {"cuda:0"}
    assert {str(each.device) for each in (value.cpu(), torch.zeros(2), copy.deepcopy(value.detach().cpu()))} == {"cpu"}
    assert copy.deepcopy(layer).weight.is_cuda
    assert device.mistakes == []


class Forgetful(nn.Module):
    """A module with a tensor that `.to` doesn't know of."""

    def __init__(self):
        super().__init__()
        self.scale = torch.ones(3)

    def forward(self, x):
        return x * self.scale


class OnTheCPUInBackward(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, grad):
        return grad * torch.ones(3)


def keeps_state_on_the_cpu():
    parameter = nn.Parameter(there(3))
    optimizer = torch.optim.Adam([parameter])
    parameter.grad = there(3)
    optimizer.state[parameter] = {"step": torch.zeros(()), "exp_avg": torch.zeros(3), "exp_avg_sq": torch.zeros(3)}
    optimizer.step()


def keeps_a_gradient_on_the_cpu():
    parameter = nn.Parameter(there(3))
    parameter.grad = torch.ones(3)
    torch.optim.Adam([parameter], fused=True).step()


def loads_to_the_cpu(folder):
    torch.save({"table": there(3)}, folder / "state.pt")
    state = torch.load(folder / "state.pt", map_location="cpu", weights_only=True)
    return there(3) + state["table"]


def forgets_the_second_time():
    scales = iter([there(3), torch.ones(3)])
    x = there(3).requires_grad_()
    checkpoint(lambda each: (each * next(scales)).sin(), x, use_reentrant=False).sum().backward()


MISTAKES = {
    "a tensor made on the default device": lambda: there(3) + torch.ones(3),
    "in place, on what is on the CPU": lambda: torch.ones(3).add_(there(3)),
    "in place, on a number of the CPU": lambda: torch.ones(()).add_(there()),
    "two numbers of the CPU": lambda: torch.addcmul(there(3), torch.ones(()), torch.ones(())),
    "a module's tensor that isn't a buffer": lambda: Forgetful().to("cuda")(there(3)),
    "a module that wasn't moved": lambda: nn.Linear(3, 2)(there(3)),
    "joined with what is on the CPU": lambda: torch.cat([there(1), torch.ones(1)]),
    "joined with a number of the CPU": lambda: torch.stack([there(), torch.ones(())]),
    "a generator of the CPU": lambda: torch.rand(3, device="cuda", generator=torch.Generator()),
    "a generator of the GPU for the CPU": lambda: torch.rand(3, generator=torch.Generator(device="cuda")),
    "a generator of the CPU, in place": lambda: there(3).uniform_(generator=torch.Generator()),
    "a mask of the GPU for the CPU": lambda: torch.ones(3)[there(3) > 0.5],
    "indices of the GPU for the CPU": lambda: torch.ones(3)[torch.zeros(2, dtype=torch.long, device="cuda")],
    "indices of the CPU where CUDA takes none": lambda: there(3).gather(0, torch.zeros(2, dtype=torch.long)),
    "rows added by indices of the CPU": lambda: there(3).index_add(0, torch.zeros(2, dtype=torch.long), there(2)),
    "values of the CPU put into places": lambda: there(3).index_put_((torch.tensor([0, 1]),), torch.ones(2)),
    "sorted numbers of the CPU": lambda: torch.searchsorted(torch.arange(3.0), there(2)),
    "numpy": lambda: there(3).numpy(),
    "an optimiser's state": keeps_state_on_the_cpu,
    "a gradient": keeps_a_gradient_on_the_cpu,
    "in a backward pass": lambda: OnTheCPUInBackward.apply(there(3).requires_grad_()).sum().backward(),
    "in a backward pass by grad": lambda: torch.autograd.grad(
        OnTheCPUInBackward.apply(x := there(3).requires_grad_()).sum(), x
    ),
    "where a checkpointed part is worked out again": forgets_the_second_time,
}


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda name: name.replace(" ", "-"))
def test_a_mistake_is_found(device, mistake):
    with pytest.raises(DeviceError):
        MISTAKES[mistake]()
    assert device.mistakes


def test_a_mistake_in_a_thread_of_its_own_is_found(device):
    def work():
        with pytest.raises(DeviceError):
            there(3) + torch.ones(3)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert len(device.mistakes) == 1


def test_a_checkpoint_says_where_its_tensors_were(device, tmp_path):
    with pytest.raises(DeviceError):
        loads_to_the_cpu(tmp_path)
    assert torch.load(tmp_path / "state.pt", weights_only=True)["table"].is_cuda
    assert torch.load(tmp_path / "state.pt", map_location="cuda", weights_only=True)["table"].is_cuda


def test_an_operator_without_a_kernel_for_cuda_is_refused(device):
    if torch.version.cuda is None:
        pytest.skip("this torch is built without CUDA, so it can't say which operators have kernels")
    with pytest.raises(DeviceError, match="has no kernel of"):
        torch.ops.aten.mkldnn_max_pool2d(there(1, 1, 4, 4), [2, 2])


@pytest.mark.parametrize(
    "allowed",
    [
        lambda: there(3) * torch.ones(()),
        lambda: there(3) + 2.0,
        lambda: torch.where(there(3) > 0.5, torch.ones(()), there(3)),
        lambda: there(3)[torch.tensor([0, 2])],
        lambda: there(3).masked_fill(there(3) > 0.5, torch.zeros(())),
        lambda: there(3).copy_(torch.ones(3)),
        lambda: there(3).to(torch.float64).cpu().to("cuda"),
        lambda: there(3).index_put_((torch.tensor([0, 1]),), torch.ones(())),
        lambda: torch.rand(3, device="cuda", generator=torch.Generator(device="cuda").manual_seed(0)),
        lambda: F.pad(there(3), (1, 1)).split([2, 3]),
    ],
)
def test_what_cuda_allows_is_allowed(device, allowed):
    result = allowed()
    assert all(each.is_cuda for each in ([result] if isinstance(result, torch.Tensor) else result))
    assert device.mistakes == []


def test_gradients_of_parts_that_nothing_asked_for_are_made_there(device):
    x = there(4, 2).requires_grad_()
    x.split(1, dim=1)[0].sum().backward()
    assert x.grad.is_cuda


@pytest.mark.parametrize(
    "kind, ask",
    [
        ("item", lambda x: float(x.sum())),
        ("item", lambda x: bool((x > 0).all())),
        ("tolist", lambda x: x.tolist()),
        ("nonzero", lambda x: (x > 0.5).nonzero()),
        ("boolean mask", lambda x: x[x > 0.5]),
        ("unique", lambda x: x.unique()),
        ("bincount", lambda x: x.long().bincount()),
        ("copy to the cpu", lambda x: x.cpu()),
        ("copy from the cpu", lambda x: torch.ones(3).to(x.device)),
        ("copy from the cpu", lambda x: x[torch.tensor([0])]),
        ("copy from the cpu", lambda x: torch.tensor([1.0, 2.0], device=x.device)),
        ("copy from the cpu", lambda x: x.copy_(torch.ones(3))),
        ("copy on the way", lambda x: torch.ones(3).to(x.device, non_blocking=True)),
    ],
)
def test_what_waits_for_a_gpu_is_counted_where_it_is_asked_for(device, kind, ask):
    ask(there(3))
    ((wait, count),) = device.waits.items()
    assert (wait.kind, count) == (kind, 1) and wait.place.startswith("test_second_device.py:")


@pytest.mark.parametrize("work", [lambda x: x.sum(), lambda x: x.__setitem__(x > 0.5, 0.0), lambda x: x.sort()])
def test_what_waits_for_nothing_isnt_counted(device, work):
    work(there(3))
    assert not device.waits


def test_the_most_memory_at_once_is_counted(device):
    for _ in range(3):
        kept = torch.zeros(1 << 20, device="cuda")  # 4 MiB each
        _ = (kept + 1.0).sum() + torch.ones(1 << 20).sum().to("cuda")
    assert device.peak_bytes == 2 * (4 << 20)  # the former is there while the next is made; the CPU's don't count


def test_outside_nothing_is_changed():
    with SecondDevice():
        pass
    assert SecondDevice.active is None and not torch.ones(1).is_cuda
    assert torch.autocast.__module__ == "torch.amp.autocast_mode" and torch.Generator is torch._C.Generator

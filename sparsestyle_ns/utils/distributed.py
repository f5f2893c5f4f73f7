"""Several processes that train one model together, `--machine.num-devices N`.

All see the same batch or view. Each renders its share of the rays; pixels are gathered, and gradients averaged before
each step. nerfstudio's DistributedDataParallel would average those of `forward` only, which hier-style doesn't call.
"""

import os
import signal
import sys
from typing import Any, Callable, Iterable, TypeVar

import torch
import torch.distributed as dist
from jaxtyping import Float, Shaped
from nerfstudio.utils import comms
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn
from torch.multiprocessing.spawn import ProcessExitedException

from sparsestyle_ns.utils.interrupts import end_on_ctrl_c

T = TypeVar("T")


def num_processes() -> int:
    """How many processes train together."""
    return comms.get_world_size()


def shard_rays(rows: Shaped[Tensor, "rows ..."]) -> Shaped[Tensor, "own ..."]:
    """The rows that this process works on: every N-th, so that each has as much of sky and of things."""
    return rows if num_processes() == 1 else rows[comms.get_rank() :: num_processes()]


def gather_rays(own: Float[Tensor, "own ..."], num_rows: int) -> Float[Tensor, "rows ..."]:
    """All rows, from what became of each process's rows of `shard_rays`; differentiable in this process's own."""
    return own if num_processes() == 1 else _GatherRays.apply(own, num_rows)


class _GatherRays(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, own: Tensor, num_rows: int) -> Tensor:
        longest = -(-num_rows // num_processes())  # a collective needs shares of one length
        padded = own.new_zeros(longest, *own.shape[1:])
        padded[: len(own)] = own
        shares = [torch.empty_like(padded) for _ in range(num_processes())]
        dist.all_gather(shares, padded)
        return torch.stack(shares, dim=1).flatten(0, 1)[:num_rows]

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        # N-fold: the mean over the processes is the gradient of the whole.
        return num_processes() * shard_rays(grad), None


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replaces gradients by their means over all processes, the same bits in each."""
    if num_processes() == 1:
        return
    for parameter in parameters:
        if parameter.grad is None:  # none of this process's rays came by, but another's may have
            parameter.grad = torch.zeros_like(parameter)
        dist.all_reduce(parameter.grad)
        parameter.grad /= num_processes()


def share_state(module: nn.Module) -> None:
    """Gives every process the first one's parameters and buffers."""
    if num_processes() == 1:
        return
    with torch.no_grad():
        for tensor in module.state_dict().values():
            dist.broadcast(tensor.view(torch.uint8) if tensor.dtype == torch.bool else tensor, src=0)


def from_first_process(value: T) -> T:
    """The first process's value, in every process."""
    if num_processes() == 1:
        return value
    values = [value]
    dist.broadcast_object_list(values, src=0)
    return values[0]


def any_process(condition: bool, device: torch.device) -> bool:
    """Whether a condition holds in any process; all get the same answer."""
    if num_processes() == 1:
        return condition
    flag = torch.tensor(int(condition), device=device)
    dist.all_reduce(flag, op=dist.ReduceOp.MAX)
    return bool(flag)


def prepare_launch() -> None:
    """Has nerfstudio 1.1.5's `ns-train` start several processes as it should.

    It asserts that there is CUDA, also where they are to run on the CPU; shows a traceback where a process has ended
    with a sentence; and kills its processes on Ctrl-C before they can save.
    """
    script = sys.modules.get("nerfstudio.scripts.train")
    if script is None or script.launch.__module__ == __name__:
        return
    nerfstudio_launch, nerfstudio_worker = script.launch, script._distributed_worker

    def launch(**settings: Any) -> None:
        if settings["num_devices_per_machine"] * settings["num_machines"] == 1:
            return nerfstudio_launch(**settings)
        former = signal.signal(signal.SIGINT, signal.SIG_IGN)  # each process handles Ctrl-C itself
        script._distributed_worker = _work_on_cpu if settings["device_type"] == "cpu" else _work_on_gpu
        try:
            nerfstudio_launch(**settings)
        except ProcessExitedException as error:
            raise SystemExit(error.exit_code) from None
        finally:
            script._distributed_worker = nerfstudio_worker
            signal.signal(signal.SIGINT, former)

    script.launch = launch


def _handle_ctrl_c() -> None:
    """Undoes what the process that waits for this one has set for itself."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    end_on_ctrl_c()


def _work_on_gpu(*settings: Any) -> None:
    """What one of the processes does: nerfstudio's `_distributed_worker`."""
    from nerfstudio.scripts.train import _distributed_worker

    _handle_ctrl_c()
    _distributed_worker(*settings)


def _work_on_cpu(
    local_rank: int, main: Callable[..., None], world_size: int, per_machine: int, machine: int, url: str, *rest: Any
) -> None:
    """What one of the processes does: nerfstudio's `_distributed_worker`, without CUDA."""
    config, timeout, _ = rest
    _handle_ctrl_c()
    rank = machine * per_machine + local_rank
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(max(1, (os.cpu_count() or 1) // per_machine))
    CONSOLE.quiet = rank > 0  # one of them tells
    dist.init_process_group("gloo", init_method=url, world_size=world_size, rank=rank, timeout=timeout)
    main(local_rank, world_size, config, rank)
    dist.destroy_process_group()

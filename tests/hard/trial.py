"""Training in processes of their own, which can be killed at a chosen moment.

They are forked from a server that has imported everything once and runs no threads.
"""

import io
import os
import signal
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Callable, List, Optional

CONTEXT = get_context("forkserver")
CONTEXT.set_forkserver_preload(["hard.trial", "conftest", "nerfstudio.scripts.train", "sparsestyle_ns.engine.trainer"])


def start(target: Callable[..., None], log: Path, *arguments: Any) -> BaseProcess:
    """Starts `target(*arguments)` in a new process that writes what it prints into a file."""
    process = CONTEXT.Process(target=_run, args=(target, log, arguments))
    process.start()
    return process


def _run(target: Callable[..., None], log: Path, arguments: Any) -> None:
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    target(*arguments)


def train(command: List[str], threads: int = 1, moment: Optional[str] = None) -> None:
    """`ns_train` with the arguments `command`, killed at a moment: one of `MOMENTS`."""
    import torch
    from conftest import ns_train

    torch.set_num_threads(threads)
    if moment is not None:
        MOMENTS[moment]()
    method, data, outputs, *flags = command
    ns_train(method, Path(data), Path(outputs), *flags)


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _after_iteration(last: int) -> Callable[[], None]:
    """Killed when an iteration's step is taken, and not saved."""

    def arm() -> None:
        from sparsestyle_ns.engine.trainer import SparseStyleTrainer

        iterate = SparseStyleTrainer.train_iteration

        def killed(trainer: Any, step: int) -> Any:
            result = iterate(trainer, step)
            if step == last:
                die()
            return result

        SparseStyleTrainer.train_iteration = killed

    return arm


def _half_way_through_the_second_checkpoint() -> None:
    import torch

    save, saved = torch.save, []

    def half(state: Any, file: Any, **settings: Any) -> None:
        saved.append(str(getattr(file, "name", "")).endswith("checkpoint.unfinished"))  # yaml saves tensors too
        if not saved[-1] or sum(saved) < 2:
            return save(state, file, **settings)
        whole = io.BytesIO()
        save(state, whole)
        file.write(whole.getvalue()[: len(whole.getvalue()) // 2])
        file.flush()
        die()

    torch.save = half


def _before_the_second_checkpoint_has_its_name() -> None:
    replace, replaced = os.replace, []

    def killed(source: Any, target: Any) -> None:
        if str(target).endswith(".ckpt"):
            replaced.append(target)
        if len(replaced) == 2:
            die()
        replace(source, target)

    os.replace = killed


def _before_the_former_checkpoint_is_deleted() -> None:
    unlink = Path.unlink

    def killed(path: Path, missing_ok: bool = False) -> None:
        if path.suffix == ".ckpt":
            die()
        unlink(path, missing_ok)

    Path.unlink = killed


MOMENTS = {
    "in the first iteration": _after_iteration(0),
    "between two checkpoints": _after_iteration(5),
    "after the last iteration": _after_iteration(9),
    "half way through the second checkpoint": _half_way_through_the_second_checkpoint,
    "before the second checkpoint has its name": _before_the_second_checkpoint_has_its_name,
    "before the former checkpoint is deleted": _before_the_former_checkpoint_is_deleted,
}

"""Checkpoints in nerfstudio's layout, with notes on what made them: written whole and finite, found, and read."""

import re
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional, TypedDict

import numpy as np
import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.amp import GradScaler
from torch.utils._pytree import tree_map_only

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole

CHECKPOINT_FOLDER = "nerfstudio_models"
"""Where a run's folder has them."""


class CheckpointNotes(TypedDict, total=False):
    """What a checkpoint says beside the state: numbers and words only, and nothing of what isn't known."""

    effects: List[Dict[str, Any]]
    """`Decisions.records` of the scene."""
    scene: Dict[str, Any]
    """The `SceneRecord` of the photos that it was trained on, as a dictionary."""
    backbone: Dict[str, str]
    """Name, source and sha256 of the feature network that took part."""
    coarse_run: str
    """Folder of the run that a stylised run builds on."""
    coarse_field: Dict[str, Any]
    """Settings of the coarse field in a stylised run."""
    fine_encoding: str
    """What the residual field sees of a position."""
    max_resolution: int
    """Cells along a side of the finest level of its hash grid."""


def checkpoint_step(path: Path) -> int:
    """The iteration in a checkpoint's name, step-000000123.ckpt."""
    return int(path.stem.split("-")[1])


def checkpoint_path(folder: Path, step: int) -> Path:
    """Where the checkpoint of an iteration is in a folder of checkpoints."""
    return folder / f"step-{step:09d}.ckpt"


def newest_checkpoint(folder: Path) -> Optional[Path]:
    """The checkpoint of the last iteration in a folder, whatever else is in it; None where there is none."""
    checkpoints = (path for path in folder.glob("step-*.ckpt") if re.fullmatch(r"step-\d+", path.stem))
    return max(checkpoints, key=checkpoint_step, default=None)


def load_checkpoint(path: Path, mmap: bool = False) -> Dict[str, Any]:
    """What is in a checkpoint, with its tensors on the CPU; InputError where it can't be read.

    With `mmap` they stay in the file until they are used, so that no time is lost where only that is asked.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except Exception as error:  # a damaged archive can fail in many ways
        raise InputError(
            f"The checkpoint {path} can't be read, it may have been cut short in copying: copy it again, or delete it "
            "and go on from an earlier one."
        ) from error
    if not isinstance(state, dict) or not {"step", "pipeline"} <= state.keys():
        raise InputError(f"{path} is no checkpoint of a run: name a step-….ckpt that ns-train made.")
    return state


def write_checkpoint(
    path: Path,
    step: int,
    pipeline: Mapping[str, Tensor],
    optimizers: Optimizers,
    notes: CheckpointNotes,
    scaler: Optional[GradScaler] = None,
) -> None:
    """Writes a checkpoint of a pipeline's state after iteration `step` that nerfstudio can load, whole or not at all.

    Raises:
        InputError: a number in the state isn't finite.
        OSError, RuntimeError: it can't be written; torch's writer makes the second of some of the first.
    """
    for name, tensor in pipeline.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise InputError(
                f"Iteration {step + 1} isn't saved, because {name} isn't finite in it",
                "go on from an earlier checkpoint with a lower learning rate, --optimizers.fields.optimizer.lr",
            )
    state = {
        "step": step,
        "pipeline": dict(pipeline),
        "optimizers": {name: part.state_dict() for name, part in optimizers.optimizers.items()},
        "schedulers": {name: part.state_dict() for name, part in optimizers.schedulers.items()},
        "scalers": (scaler or GradScaler(enabled=False)).state_dict(),
        **notes,
    }
    # nerfstudio's exponential schedulers leave numpy's numbers, which torch refuses to load (`weights_only`).
    plain = tree_map_only(np.generic, lambda number: number.item(), state)
    unfinished = path.parents[1] / "checkpoint.unfinished"  # nerfstudio takes every file beside `path` for a checkpoint
    write_whole(path, lambda file: torch.save(plain, file), unfinished)

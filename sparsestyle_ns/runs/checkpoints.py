"""Checkpoints: written whole and finite, found, and read.

nerfstudio's layout: a run's folder nerfstudio_models has step-000000123.ckpt, with the iteration and the state of
pipeline, optimisers and schedulers; here also notes on what made it.
"""

import copy
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional

import numpy as np
import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.amp import GradScaler

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole


@dataclass
class CheckpointNotes:
    """What a checkpoint says beside the state: numbers and words only.

    Attributes:
        effects: the decisions about the scene's effects, as `Decisions.records` gives them.
        backbone: which feature network took part, if one did: name, source and sha256.
        coarse_run: folder of the coarse run that a stylised run builds on.
        coarse_field: settings of the coarse field in a stylised run.
        fine_encoding: what the residual field sees of a position.
    """

    effects: List[Dict[str, Any]] = field(default_factory=list)
    backbone: Optional[Dict[str, str]] = None
    coarse_run: Optional[str] = None
    coarse_field: Optional[Dict[str, Any]] = None
    fine_encoding: Optional[str] = None

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> "CheckpointNotes":
        """The notes in a checkpoint's content."""
        return cls(**{name: state[name] for name in cls.__dataclass_fields__ if name in state})

    def entries(self) -> Dict[str, Any]:
        """What is written; nothing of what isn't known."""
        return {name: value for name, value in asdict(self).items() if value is not None}


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


def load_checkpoint(path: Path) -> Dict[str, Any]:
    """What is in a checkpoint, with its tensors on the CPU.

    Raises:
        InputError: it can't be read.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
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
    unfinished: Optional[Path] = None,
) -> None:
    """Writes a checkpoint that nerfstudio can load, whole or not at all.

    Args:
        path: of the checkpoint.
        step: the last iteration that was done.
        pipeline: the pipeline's state.
        optimizers: with their schedulers.
        notes: what made it.
        scaler: of gradients; None: one that is off.
        unfinished: where the file stands until it is whole. nerfstudio takes every file in the folder of checkpoints
            for one.

    Raises:
        InputError: a number in the state isn't finite.
        OSError, RuntimeError: it can't be written; torch's writer makes the second of some of the first.
    """
    for name, tensor in pipeline.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise InputError(
                f"Iteration {step + 1} isn't saved, because {name} isn't finite in it; go on from an earlier "
                "checkpoint with a lower learning rate, --optimizers.fields.optimizer.lr."
            )
    state = {
        "step": step,
        "pipeline": dict(pipeline),
        "optimizers": {name: part.state_dict() for name, part in optimizers.optimizers.items()},
        "schedulers": {name: part.state_dict() for name, part in optimizers.schedulers.items()},
        "scalers": (scaler or GradScaler(enabled=False)).state_dict(),
        **notes.entries(),
    }
    write_whole(path, lambda file: torch.save(without_numpy_scalars(state), file), unfinished)


def without_numpy_scalars(value: Any) -> Any:
    """The same nested value with Python numbers for numpy's, which torch refuses to load (`weights_only`).

    nerfstudio's exponential schedulers leave them in the state of scheduler and optimiser.
    """
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        plain = copy.copy(value)  # keeps the kind of dictionary: a MultiStepLR's milestones are a Counter
        for key, item in value.items():
            plain[key] = without_numpy_scalars(item)
        return plain
    if isinstance(value, (list, tuple)):
        return type(value)(without_numpy_scalars(item) for item in value)
    return value

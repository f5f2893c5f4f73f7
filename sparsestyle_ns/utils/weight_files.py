"""Weight files: where they lie, and what is read from them."""

import importlib.util
from pathlib import Path
from typing import Any, Dict, Optional, Tuple

import torch
from torch import Tensor


def hub_file(name: str) -> Path:
    """Where the torch hub cache has a weight file, or would."""
    return Path(torch.hub.get_dir()) / "checkpoints" / name


def shift_tolerant_file(name: str) -> Optional[Path]:
    """A weight file inside the package stlpips-pytorch, of which no code is run; None where there is none."""
    package = importlib.util.find_spec("stlpips_pytorch")
    folders = package.submodule_search_locations if package else None
    path = Path(folders[0]) / "weights" / "vST0.0" / name if folders else None
    return path if path and path.is_file() else None


def read_state(path: Path) -> Dict[str, Any]:
    """A file's state dict, on the CPU; a `ValueError` that completes "it is …" where it is damaged or no state dict."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    # A file that is no checkpoint surfaces as any of a dozen errors from the middle of torch and pickle.
    except Exception as error:
        raise ValueError("damaged or not a PyTorch state dict") from error
    if not isinstance(state, dict):
        raise ValueError("no weight file, as it holds no state dict")
    return state


def check_tensor(state: Dict[str, Any], key: str, shape: Tuple[int, ...]) -> Tensor:
    """The tensor under this name; a `ValueError` that says so where it is missing, of another shape, or not finite."""
    value = state.get(key)
    if not isinstance(value, Tensor):
        raise ValueError(f"{key} is missing")
    if value.shape != shape:
        raise ValueError(f"{key} has the shape {tuple(value.shape)} instead of {tuple(shape)}")
    if not value.isfinite().all():
        raise ValueError(f"{key} has values that are not finite")
    return value

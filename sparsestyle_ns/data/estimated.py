"""What a scene says of cameras that were estimated from its photos alone, as `sparsestyle prepare` writes it.

Its `transforms.json` has `"poses_estimated": true`. In a forward-facing scene that file lies beside `poses_bounds.npy`,
which has no place for a lens's distortion.
"""

import json
from pathlib import Path
from typing import Any, Dict, Optional, Sequence

import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_utils import get_distortion_params
from torch import Tensor

TRANSFORMS = "transforms.json"
POSES_ESTIMATED = "poses_estimated"
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def estimated_cameras(folder: Path) -> Optional[Dict[str, Any]]:
    """The content of a scene's `transforms.json` if that says that its poses are estimated, else None."""
    try:
        content = json.loads((folder / TRANSFORMS).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):  # of a file that a scene's dataparser needs, that one complains
        return None
    return content if isinstance(content, dict) and content.get(POSES_ESTIMATED) is True else None


def estimated_distortion(folder: Path, names: Sequence[str]) -> Optional[Float[Tensor, "photos 6"]]:
    """nerfstudio's distortion parameters of photos by their file names; None where the scene has none for them all."""
    content = estimated_cameras(folder)
    if content is None:
        return None
    frames = {Path(frame["file_path"]).name: {**content, **frame} for frame in content["frames"]}
    if any(name not in frames for name in names):
        return None
    lenses = [{key: float(frames[name].get(key, 0.0)) for key in DISTORTION} for name in names]
    found = torch.stack([get_distortion_params(**lens) for lens in lenses])
    return found if found.any() else None

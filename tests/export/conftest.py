"""A run with something to see in it."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sparsestyle_ns.coarse_run import newest_checkpoint


@pytest.fixture(scope="session")
def patterned_run(runs: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stylised run, which a few iterations left grey all over, with weights that make shapes and colours."""
    folder = tmp_path_factory.mktemp("outputs") / "scene" / "hier-style" / "run"
    shutil.copytree(runs.style, folder)
    path = newest_checkpoint(folder / "nerfstudio_models")
    state = torch.load(path, weights_only=True)
    generator = torch.Generator().manual_seed(0)
    for name, value in state["pipeline"].items():
        if name.startswith(("_model.field.trunk", "_model.field.feature_head", "_model.residual")) and "weight" in name:
            value.copy_(torch.randn(value.shape, generator=generator) * (2.0 / value.shape[1]) ** 0.5)
        if name == "_model.field.trunk.layers.0.weight":
            value[:, 3:] *= 0.4 ** torch.arange(value.shape[1] - 3).div(6, rounding_mode="floor")
        if name == "_model.field.density_head.weight":
            value.copy_(3.0 * torch.randn(value.shape, generator=generator))
        if name == "_model.residual.color_head.weight":
            value *= 6.0
    torch.save(state, path)
    return folder

"""Finding and reading the coarse run that a stylised run builds on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Callable, Dict, Iterable, List, Optional

import torch
import yaml
from jaxtyping import Float
from nerfstudio.engine.trainer import TrainerConfig
from torch import Tensor

from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.runs.checkpoints import checkpoint_step, load_checkpoint, newest_checkpoint
from sparsestyle_ns.runs.run_folder import COARSE_METHOD
from sparsestyle_ns.runs.scene_record import FILE_NAME, SceneRecord
from sparsestyle_ns.utils.errors import InputError


@dataclass
class CoarseRun:
    """A coarse-fewshot run on disk.

    Attributes:
        folder: the run's folder.
        config: its config.yml.
        checkpoint: its newest checkpoint.
    """

    folder: Path
    config: TrainerConfig
    checkpoint: Path

    @property
    def is_finished(self) -> bool:
        """Whether the newest checkpoint is that of the last iteration."""
        return checkpoint_step(self.checkpoint) + 1 >= self.config.max_num_iterations

    def in_words(self) -> str:
        """Where it is, and how far where it isn't finished."""
        if self.is_finished:
            return str(self.folder)
        done, total = checkpoint_step(self.checkpoint) + 1, self.config.max_num_iterations
        return f"{self.folder}, which isn't finished ({done} of {total} iterations)"

    def model_state(self) -> Dict[str, Tensor]:
        """The state of the run's model."""
        return under(load_checkpoint(self.checkpoint)["pipeline"], "_model.")

    def density(self, effects: Decisions) -> Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points"]]:
        """σ_c at field coordinates, as a function; `effects` are those that the run was made with."""
        with torch.random.fork_rng(devices=[]):  # what is made after it starts as it would without
            field = self.config.pipeline.model.coarse_field.setup(effects.on("view_color")).requires_grad_(False)
        field.load_state_dict(under(self.model_state(), "field."))
        return lambda points: field.density_and_feature(points)[0]


def under(state: Dict[str, Tensor], prefix: str) -> Dict[str, Tensor]:
    """The entries whose names begin with a prefix, without it."""
    return {key[len(prefix) :]: value for key, value in state.items() if key.startswith(prefix)}


def read_coarse_run(path: Path) -> CoarseRun:
    """Reads a run given by its folder or its config.yml.

    Raises:
        InputError: it isn't there, isn't a coarse-fewshot run, or has no checkpoint.
    """
    folder = path.parent if path.name == "config.yml" else path
    config_path = folder / "config.yml"
    if not config_path.is_file():
        raise InputError(
            f"--coarse-run {path} has no config.yml; name the folder of a coarse-fewshot run, "
            "such as outputs/fern/coarse-fewshot/2026-01-31_120000."
        )
    try:
        config = yaml.load(config_path.read_text(), Loader=yaml.Loader)
    except Exception as error:  # yaml builds arbitrary objects, so anything can go wrong in it
        raise InputError(f"--coarse-run: {config_path} can't be read ({error}).") from error
    if not isinstance(config, TrainerConfig) or not config.method_name.startswith(COARSE_METHOD):
        method = getattr(config, "method_name", "no nerfstudio run")
        raise InputError(f"--coarse-run {folder} is {method}; a coarse-fewshot run is needed.")
    checkpoint = newest_checkpoint(folder / config.relative_model_dir)
    if checkpoint is None:
        raise InputError(f"--coarse-run {folder} has no checkpoint; train it, or name another run.")
    return CoarseRun(folder, config, checkpoint)


def check_scene(run: CoarseRun, scene: SceneRecord) -> None:
    """Makes sure that a coarse run is of a scene.

    Raises:
        InputError: it is of another.
    """
    difference = scene.difference(SceneRecord.load(run.folder))
    if difference is not None:
        raise InputError(
            f"--coarse-run {run.folder} doesn't fit {scene.data} with views {scene.view_ids}: {difference}; "
            "name a run of this scene, or leave --coarse-run out."
        )


def find_coarse_run(output_dir: Path, methods: Iterable[str], scene: SceneRecord) -> Optional[CoarseRun]:
    """The newest finished run of a scene among the runs of some methods below an output folder; None without one."""
    found: List[CoarseRun] = []
    for method in methods:
        for record in output_dir.glob(f"*/{method}/*/{FILE_NAME}"):
            try:
                run = read_coarse_run(record.parent)
                fits = scene.difference(SceneRecord.load(run.folder)) is None
            except InputError:  # a damaged or unfinished neighbour is no reason to stop
                continue
            if fits and run.is_finished:
                found.append(run)
    return max(found, key=lambda run: run.checkpoint.stat().st_mtime, default=None)

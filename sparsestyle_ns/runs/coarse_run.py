"""Finding and reading the coarse run that a stylised run builds on."""

from pathlib import Path
from typing import Callable, Dict, Iterable, List, NamedTuple, Optional

import torch
from jaxtyping import Float
from nerfstudio.engine.trainer import TrainerConfig
from torch import Tensor

from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.runs.checkpoints import checkpoint_step, load_checkpoint, newest_checkpoint
from sparsestyle_ns.runs.run_folder import COARSE_METHOD, find_config, read_config
from sparsestyle_ns.runs.scene_record import RECORD_FILE, SceneRecord
from sparsestyle_ns.utils.errors import InputError


class CoarseRun(NamedTuple):
    """A coarse-fewshot run on disk, with its newest checkpoint."""

    folder: Path
    config: TrainerConfig
    checkpoint: Path

    @property
    def is_finished(self) -> bool:
        """Whether all iterations are done."""
        return checkpoint_step(self.checkpoint) + 1 >= self.config.max_num_iterations

    def in_words(self) -> str:
        """Where it is, and how far where it isn't finished."""
        if self.is_finished:
            return str(self.folder)
        done, total = checkpoint_step(self.checkpoint) + 1, self.config.max_num_iterations
        return f"{self.folder}, which isn't finished ({done} of {total} iterations)"

    def model_state(self) -> Dict[str, Tensor]:
        """The state of the run's model."""
        return _under(load_checkpoint(self.checkpoint)["pipeline"], "_model.")

    def density(self, effects: Decisions) -> Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points"]]:
        """σ_c at field coordinates, as a function; `effects` are those that the run was made with."""
        with torch.random.fork_rng(devices=[]):  # what is made after it starts as it would without
            field = self.config.pipeline.model.coarse_field.setup(effects.on("view_color")).requires_grad_(False)
        field.load_state_dict(_under(self.model_state(), "field."))
        return lambda points: field.density_and_feature(points)[0]


def _under(state: Dict[str, Tensor], prefix: str) -> Dict[str, Tensor]:
    """The entries whose names begin with a prefix, without it."""
    return {key[len(prefix) :]: value for key, value in state.items() if key.startswith(prefix)}


def read_coarse_run(path: Path) -> CoarseRun:
    """Reads a run by its folder or its config.yml; InputError where it is no coarse-fewshot run with a checkpoint."""
    folder = find_config(path, COARSE_METHOD).parent
    config = read_config(folder)
    checkpoint = newest_checkpoint(folder / config.relative_model_dir)
    if checkpoint is None:
        raise InputError(f"--coarse-run {folder} has no checkpoint; train it, or name another run.")
    return CoarseRun(folder, config, checkpoint)


def check_scene(run: CoarseRun, scene: SceneRecord) -> None:
    """Raises an InputError where a coarse run is of another scene."""
    difference = scene.difference(SceneRecord.load(run.folder))
    if difference is not None:
        raise InputError(
            f"--coarse-run {run.folder} doesn't fit {scene.data} with views {scene.view_ids}: {difference}; "
            "name a run of this scene, or leave --coarse-run out."
        )


def find_coarse_run(output_dir: Path, methods: Iterable[str], scene: SceneRecord) -> Optional[CoarseRun]:
    """The newest finished run of a scene among the runs of some methods below an output folder; None without one."""
    found: List[CoarseRun] = []
    for record in (path for method in methods for path in output_dir.glob(f"*/{method}/*/{RECORD_FILE}")):
        try:
            run = read_coarse_run(record.parent)
            check_scene(run, scene)
        except InputError:  # a damaged, unfinished or other neighbour is no reason to stop
            continue
        if run.is_finished:
            found.append(run)
    return max(found, key=lambda run: run.checkpoint.stat().st_mtime, default=None)

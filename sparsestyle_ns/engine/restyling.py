"""Another style for a scene whose coarse field is there: the iterations of `ns-train hier-style`, beside a viewer.

What depends on no painting is shared and only read, so that no lock is held while the new field learns.
"""

import copy
import functools
import shutil
import tempfile
import time
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import ContextManager, Dict, Iterator, Mapping, NamedTuple, Optional, Tuple

import torch
import yaml
from torch import Tensor, nn

from sparsestyle_ns.effects.registry import decide_again
from sparsestyle_ns.engine.schedules import over_iterations
from sparsestyle_ns.engine.style_trainer import style_notes
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig, run_notes
from sparsestyle_ns.engine.training import check_skipped, training_step, warm_start
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, StyleTask
from sparsestyle_ns.runs.checkpoints import CheckpointNotes, checkpoint_path, write_checkpoint
from sparsestyle_ns.runs.run_folder import read_config
from sparsestyle_ns.runs.scene_record import SceneRecord, save_thumbnail
from sparsestyle_ns.style.backbone import Backbone
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.distributed import num_processes
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import safe_file_name, write_whole
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers

SEED = 42
"""Of a new field's weights; nerfstudio's own."""
PAINTING_FOLDER = "style_image"
"""Of a run's folder, where its painting lies under the name that it came with: no name can be that of another file."""


class Progress(NamedTuple):
    """How far a restyling is."""

    words: str
    done: float = 0.0
    """The share of all its steps, in [0, 1]."""
    seconds_left: Optional[float] = None
    """A guess; None before the first iteration."""
    losses: Optional[Dict[str, float]] = None
    """Those of the last iteration by name, not weighted, and `lambda` (Eq. 6); None before the first."""


class Workshop:
    """What all restylings of a scene have in common, whose run is in a folder.

    The lock is held while something changes that other threads may use: the random numbers' state. InputError where
    several processes train together.
    """

    def __init__(self, pipeline: HierStylePipeline, folder: Path, lock: ContextManager) -> None:
        if num_processes() > 1:
            raise InputError("Several processes train this scene together; restyle it in ns-viewer, once it is saved.")
        self.pipeline, self.folder, self.lock = pipeline, folder, lock

    @functools.cached_property
    def backbone(self) -> Backbone:
        """The feature network that the pipeline has, else one with the weights that it would take."""
        pipeline = self.pipeline
        return pipeline.targets.backbone if pipeline.targets else pipeline.config.load_backbone(pipeline.device)

    def new_field(self, max_resolution: int) -> nn.Module:
        """A field as it is before training, the same each time."""
        device = torch.device(self.pipeline.device)
        with self.lock, torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(SEED)
            return self.pipeline.model.new_style(max_resolution)


class Restyling:
    """One restyling, in steps: `for progress in restyling: …`, then `field` (σ_f and c_f) is the new style.

    Without a number of iterations, as many as the run had; InputError for less than one. `own` are settings of the
    pipeline that this style has of its own, such as `stroke_size` and `kept_structure`.
    """

    def __init__(
        self,
        workshop: Workshop,
        image: Painting,
        iterations: Optional[int] = None,
        own: Optional[Mapping[str, float]] = None,
    ) -> None:
        self.workshop, self.pipeline, self.image = workshop, workshop.pipeline, image
        self.config: SparseStyleTrainerConfig = read_config(workshop.folder)  # as it is by now
        self.iterations = self.config.max_num_iterations if iterations is None else iterations
        self.own = dict(own or {})
        if self.iterations < 1:
            raise InputError(f"A style needs at least 1 iteration, and {self.iterations} were asked for.")
        self._painting = Path(PAINTING_FOLDER) / safe_file_name(self.image.name, "painting")
        settings, photo_side = self.pipeline.config, self.pipeline.datamanager.photo_side
        self.max_resolution = settings.resolution_for(self.own.get("stroke_size", settings.stroke_size), photo_side)
        self.field = workshop.new_field(self.max_resolution)
        optimizers = over_iterations(self.config.optimizers, self.iterations)
        self.optimizers = FiniteOptimizers(optimizers, {"fields": list(self.field.parameters())})

    def __iter__(self) -> Iterator[Progress]:
        yield Progress(f"Looking at {self.image.name}")
        pipeline, total = self.pipeline, self.iterations
        scene = replace(pipeline.datamanager.scene, style_image=self.image.pixels)
        self.effects = decide_again(pipeline.effects, "palette", scene)  # what depends on the painting
        if pipeline.scene_views is None:
            yield Progress("Preparing the views, which the next style won't need")
        of_style = self.field, self.image, self.workshop.backbone, self.effects
        task = pipeline.new_task(*of_style, total, replace(pipeline.config, **self.own))
        warm_up = pipeline.config.warm_start_steps
        for step in warm_start(pipeline, task, self.optimizers):
            yield Progress(f"Warm start, step {step + 1} of {warm_up}", (step + 1) / (warm_up + total))
        began = time.monotonic()
        for step in range(total):
            losses = self._step(task, step)
            left = (time.monotonic() - began) / (step + 1) * (total - step - 1)
            done = (warm_up + step + 1) / (warm_up + total)
            yield Progress(f"Iteration {step + 1} of {total}", done, left, losses)
        pipeline.finish(task)
        self.field.requires_grad_(False)

    def _step(self, task: StyleTask, step: int) -> Dict[str, float]:
        """One iteration, as the trainer makes it."""

        def compute_losses() -> Tuple[Dict[str, Tensor], Dict[str, Tensor | float]]:
            _, losses = self.pipeline.losses(task, step)
            return losses.terms(), losses.metrics()

        *_, metrics = training_step(self.optimizers, compute_losses, step)
        advice = "try another image, or a lower learning rate in the run's config.yml."
        check_skipped(self.optimizers, self.config.max_skipped_steps, step, advice)
        return {name: float(value) for name, value in metrics.items()}

    def save(self) -> Path:
        """Saves the style as a run of its own beside the one in the viewer; returns its folder.

        It is there as a whole or not at all. OSError or RuntimeError where it can't be written.
        """
        runs = self.workshop.folder.parent
        hidden = Path(tempfile.mkdtemp(prefix=".restyling-", dir=runs))
        try:
            new = hidden / "run"  # not `hidden` itself, which nobody else may read
            self._write_contents(new)
            while (folder := runs / datetime.now().strftime("%Y-%m-%d_%H%M%S")).exists():  # as nerfstudio names them
                time.sleep(0.1)  # until the second is over in which another run began
            config = copy.deepcopy(self.config)
            config.timestamp, config.max_num_iterations = folder.name, self.iterations
            config.load_dir = config.load_step = config.load_checkpoint = None
            model = replace(config.pipeline.model, max_resolution=self.max_resolution)
            config.pipeline = replace(config.pipeline, **self.own, model=model)
            config.pipeline.style_image, config.pipeline.decided = folder.resolve() / self._painting, self.effects
            write_whole(new / "config.yml", yaml.dump(config))
            if (record := self._record()) is not None:
                record.save(new, folder)
            return new.rename(folder)
        finally:
            shutil.rmtree(hidden, ignore_errors=True)

    def _write_contents(self, new: Path) -> None:
        """Writes a run but for its config."""
        write_whole(new / self._painting, self.image.data)
        save_thumbnail(new, self.image)
        transforms = self.workshop.folder / "dataparser_transforms.json"
        if transforms.is_file():
            shutil.copy(transforms, new / transforms.name)
        self.effects.save(new)
        own = {f"_model.residual.{name}": value for name, value in self.field.state_dict().items()}
        path = checkpoint_path(new / self.config.relative_model_dir, self.iterations - 1)
        state = {**self.pipeline.state_dict(), **own}
        write_checkpoint(path, self.iterations - 1, state, self.optimizers, self.notes())

    def notes(self) -> CheckpointNotes:
        """What its checkpoint says beside the state."""
        notes = run_notes(self.effects, self._record())
        notes = style_notes(self.pipeline, notes, asdict(self.workshop.backbone.description))
        return {**notes, "max_resolution": self.max_resolution}

    def _record(self) -> Optional[SceneRecord]:
        """What is known of the scene, with this painting."""
        try:
            return replace(SceneRecord.load(self.workshop.folder), painting=self.image.digest)
        except InputError:
            return None

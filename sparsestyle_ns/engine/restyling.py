"""Another style for a scene whose coarse field is there: the iterations of `ns-train hier-style`, beside a viewer.

What is frozen is shared: the views' rays with the coarse field evaluated along them, photos, the features of those
whose colours stay, and the feature network. New are a field, the painting's features, and pictures in its colours. The
model and what is trained or shown meanwhile are only read, so that no lock is held while the field learns.
"""

import copy
import shutil
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import ContextManager, Dict, Iterator, Optional

import torch
import yaml
from torch import Tensor, nn

from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.effects.registry import decide_again
from sparsestyle_ns.engine.style_trainer import HierStyleTrainerConfig
from sparsestyle_ns.engine.training_step import check_skipped, training_step, warm_start
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, StyleInputs, StyleTask
from sparsestyle_ns.runs.checkpoints import CheckpointNotes, checkpoint_path, write_checkpoint
from sparsestyle_ns.runs.scene_record import FILE_NAME as SCENE_RECORD
from sparsestyle_ns.runs.thumbnail import save_thumbnail
from sparsestyle_ns.style.backbone import Backbone
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.distributed import num_processes
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.names import safe_file_name
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers

SEED = 42
"""Of a new field's weights; nerfstudio's own."""
RESIDUAL = "_model.residual."
"""What the names of a stylised field's tensors start with in a checkpoint."""
BESIDE_CHECKPOINTS = (SCENE_RECORD, "dataparser_transforms.json")
"""Files of a run that say nothing of the style."""
PAINTING_FOLDER = "style_image"
"""Of a run's folder, where its painting lies under the name that it came with: no name can be that of another file."""


@dataclass(frozen=True)
class Progress:
    """How far a restyling is.

    Attributes:
        words: what it is doing.
        done: the share of all its steps that are done, in [0, 1].
        seconds_left: a guess; None before the first iteration.
        losses: those of the last iteration by name, not weighted, and `lambda` (Eq. 6); None before the first.
    """

    words: str
    done: float = 0.0
    seconds_left: Optional[float] = None
    losses: Optional[Dict[str, float]] = None


class Workshop:
    """What all restylings of a scene have in common.

    Args:
        pipeline: of the scene.
        folder: of its run.
        lock: held while something changes that other threads may use: the random numbers' state.

    Raises:
        InputError: several processes train together.
    """

    def __init__(self, pipeline: HierStylePipeline, folder: Path, lock: ContextManager) -> None:
        if num_processes() > 1:
            raise InputError("Several processes train this scene together; restyle it in ns-viewer, once it is saved.")
        self.pipeline, self.folder, self.lock = pipeline, folder, lock
        self._backbone: Optional[Backbone] = None

    def config(self) -> HierStyleTrainerConfig:
        """The run's config, with the optimiser, the schedule and the number of iterations.

        Raises:
            InputError: it isn't there or can't be read.
        """
        path = self.folder / "config.yml"
        try:
            return yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.Loader)
        except Exception as error:  # yaml builds arbitrary objects, so anything can go wrong in it
            raise InputError(f"{path} can't be read ({error}); restyling takes the run's settings from it.") from error

    def backbone(self) -> Backbone:
        """The feature network that the pipeline has, else one with the weights that it would take."""
        if self.pipeline.targets is not None:
            return self.pipeline.targets.backbone
        if self._backbone is None:
            settings = self.pipeline.config
            self._backbone = settings.load_backbone(self.pipeline.device)
        return self._backbone

    def new_field(self) -> nn.Module:
        """A field as it is before training, the same each time."""
        device = torch.device(self.pipeline.device)
        with self.lock, torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(SEED)
            return self.pipeline.model.new_style()


class Restyling:
    """One restyling, in steps: `for progress in restyling: …`, then `field` is the new style.

    Args:
        workshop: of the scene.
        image: the painting.
        iterations: how many; None: as many as the run had.

    Attributes:
        field: σ_f and c_f; final once the iterator has ended.

    Raises:
        InputError: there are fewer iterations than one.
    """

    def __init__(self, workshop: Workshop, image: Painting, iterations: Optional[int] = None) -> None:
        self.workshop, self.pipeline, self.image = workshop, workshop.pipeline, image
        self.config = workshop.config()
        self.iterations = self.config.max_num_iterations if iterations is None else iterations
        if self.iterations < 1:
            raise InputError(f"A style needs at least 1 iteration, and {self.iterations} were asked for.")
        self.field = workshop.new_field()
        self.optimizers = FiniteOptimizers(self.config.optimizers.copy(), {"fields": list(self.field.parameters())})

    def __iter__(self) -> Iterator[Progress]:
        yield Progress(f"Looking at {self.image.name}")
        backbone = self.workshop.backbone()
        targets = self.pipeline.config.targets_of(StyleInputs(self.image, backbone), self.pipeline.device)
        self.effects = self._decide()
        if self.pipeline.scene_views is None:
            yield Progress("Preparing the views, which the next style won't need")
        task = self.pipeline.new_task(self.field, targets, self.effects)
        warm_up, total = self.pipeline.config.warm_start_steps, self.iterations
        rate = self.config.optimizers["fields"]["optimizer"].lr
        for step in warm_start(self.pipeline, task, rate):
            yield Progress(f"Warm start, step {step + 1} of {warm_up}", (step + 1) / (warm_up + total))
        began = time.monotonic()
        for step in range(total):
            losses = self._step(task, step)
            left = (time.monotonic() - began) / (step + 1) * (total - step - 1)
            done = (warm_up + step + 1) / (warm_up + total)
            yield Progress(f"Iteration {step + 1} of {total}", done, left, losses)
        self.field.requires_grad_(False)

    def _decide(self) -> Decisions:
        """The scene's effects, with that which depends on the painting decided anew."""
        scene = replace(self.pipeline.datamanager.scene, style_image=self.image.pixels)
        return decide_again(self.pipeline.effects, "palette", scene)

    def _step(self, task: StyleTask, step: int) -> Dict[str, float]:
        """One iteration, as the trainer makes it."""
        metrics: Dict[str, Tensor | float] = {}

        def compute_losses(step: int) -> Dict[str, Tensor]:
            _, losses = self.pipeline.losses(task, step)
            metrics.update(losses.metrics())
            return losses.terms()

        training_step(self.optimizers, compute_losses, step)
        advice = "try another image, or a lower learning rate in the run's config.yml."
        check_skipped(self.optimizers, self.config.max_skipped_steps, "The restyling stopped", advice)
        return {name: float(value) for name, value in metrics.items()}

    def save(self) -> Path:
        """Saves the style as a run of its own beside the one in the viewer, for ns-render, ns-viewer and the rest.

        The run is there as a whole or not at all: it is made in a hidden folder, which goes when something fails.

        Returns:
            The new run's folder.

        Raises:
            OSError, RuntimeError: it can't be written; torch's writer makes the second of some of the first.
        """
        runs = self.workshop.folder.parent
        hidden = Path(tempfile.mkdtemp(prefix=".restyling-", dir=runs))
        try:
            new = hidden / "run"  # not `hidden` itself, which nobody else may read
            new.mkdir()
            painting = self._write_contents(new)
            while True:
                folder = runs / datetime.now().strftime("%Y-%m-%d_%H%M%S")  # as nerfstudio names them
                self._write_config(new, folder.resolve(), painting)
                try:
                    return new.rename(folder)
                except OSError:
                    if not folder.exists():
                        raise
                    time.sleep(0.1)  # until the second is over in which another run began
        finally:
            shutil.rmtree(hidden, ignore_errors=True)

    def _write_contents(self, new: Path) -> Path:
        """Writes a run but for its config; returns where in it the painting lies."""

        painting = Path(PAINTING_FOLDER) / safe_file_name(self.image.name, "painting")
        write_whole(new / painting, self.image.data)
        save_thumbnail(new, self.image)
        for name in BESIDE_CHECKPOINTS:
            if (self.workshop.folder / name).is_file():
                shutil.copy(self.workshop.folder / name, new / name)
        self.effects.save(new)
        step = self.iterations - 1
        path = checkpoint_path(new / self.config.relative_model_dir, step)
        write_checkpoint(path, step, self._state(), self.optimizers, self.notes())
        return painting

    def _write_config(self, new: Path, folder: Path, painting: Path) -> None:
        """Writes the config of a run that will lie in `folder`."""
        config = copy.deepcopy(self.config)
        config.timestamp, config.max_num_iterations = folder.name, self.iterations
        config.load_dir = config.load_step = config.load_checkpoint = None
        config.pipeline.style_image, config.pipeline.decided = folder / painting, self.effects
        write_whole(new / "config.yml", yaml.dump(config))

    def _state(self) -> Dict[str, Tensor]:
        """The pipeline's state, with the new field in place of the run's own."""
        state = {name: value for name, value in self.pipeline.state_dict().items() if not name.startswith(RESIDUAL)}
        return {**state, **{RESIDUAL + name: value for name, value in self.field.state_dict().items()}}

    def notes(self) -> CheckpointNotes:
        """What its checkpoint says beside the state."""
        settings = self.config.pipeline
        return CheckpointNotes(
            effects=self.effects.records(),
            backbone=asdict(self.workshop.backbone().description),
            coarse_run=str(settings.coarse_run),
            coarse_field=asdict(settings.model.coarse_field),
            fine_encoding=settings.model.fine_encoding,
        )

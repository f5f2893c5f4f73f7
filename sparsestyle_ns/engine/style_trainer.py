"""The trainer of stage 2: finds or trains the coarse run first."""

import copy
import shlex
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Callable, Dict, List, Literal, Optional, Type

import torch
import tyro
from nerfstudio.utils import comms, writer
from nerfstudio.utils.rich_utils import CONSOLE

from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.hints import scene_arguments
from sparsestyle_ns.engine.trainer import SparseStyleTrainer, SparseStyleTrainerConfig
from sparsestyle_ns.engine.training import warm_start
from sparsestyle_ns.field_components.tiny_cuda_grid import has_tiny_cuda_nn
from sparsestyle_ns.fields.coarse import CoarseFieldConfig
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, HierStylePipelineConfig
from sparsestyle_ns.runs.checkpoints import CheckpointNotes
from sparsestyle_ns.runs.coarse_run import CoarseRun, check_scene, find_coarse_run, read_coarse_run
from sparsestyle_ns.runs.run_folder import COARSE_METHOD
from sparsestyle_ns.runs.scene_record import SceneRecord, save_thumbnail
from sparsestyle_ns.utils.distributed import from_first_process
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error
from sparsestyle_ns.utils.interrupts import stop
from sparsestyle_ns.utils.machine import release_memory
from sparsestyle_ns.utils.progress import bar

PHOTO_SETTINGS = ("data", "dataparser", "num_views", "view_ids", "max_image_side", "seed", "camera_res_scale_factor")
"""Of the data manager: what both stages of a scene have in common."""
RUN_SETTINGS = ("data", "output_dir", "experiment_name", "project_name", "machine", "logging")
"""Of the trainer: the same."""


def style_notes(pipeline: HierStylePipeline, notes: CheckpointNotes, backbone: Dict[str, str]) -> CheckpointNotes:
    """The notes of a checkpoint with what a style that is made with this network has beside those of every run."""
    return {
        **notes,
        "backbone": backbone,
        "coarse_run": str(pipeline.config.coarse_run),
        "coarse_field": asdict(pipeline.config.model.coarse_field),
        "fine_encoding": pipeline.model.config.fine_encoding,
        "max_resolution": pipeline.model.config.max_resolution,
    }


@dataclass
class HierStyleTrainerConfig(SparseStyleTrainerConfig):
    """Settings of a run of stage 2."""

    _target: Type = field(default_factory=lambda: HierStyleTrainer)
    coarse_method: tyro.conf.Suppress[Optional[Callable[[], SparseStyleTrainerConfig]]] = None
    """Makes the config of stage 1, to train where there is no coarse run; a module's function, named in config.yml."""


class HierStyleTrainer(SparseStyleTrainer):
    """Trains a stylised field."""

    config: HierStyleTrainerConfig
    stage = "Stage 2"
    pipeline: HierStylePipeline
    _coarse_run: Optional[CoarseRun] = None
    """Of a new run."""
    _description: Dict[str, str]
    """Of the feature network; in a run that is gone on with, how it was found when that began."""

    @exit_on_input_error
    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Reads the painting and the network, makes sure of a coarse run, and sets up the stylised run."""
        pipeline: HierStylePipelineConfig = copy.deepcopy(self.config.pipeline)
        for name in ("style_image", "vgg_weights"):  # the run may be measured from another folder
            path: Optional[Path] = getattr(pipeline, name)
            setattr(pipeline, name, None if path is None else path.expanduser().resolve())
        before: CheckpointNotes = self.resumed or {}
        if "coarse_field" in before:  # not in a coarse run's; loading that says what is wrong
            _adopt_notes(pipeline, before)
        self._painting, self._backbone = pipeline.load_style()
        self._description = asdict(self._backbone.description)
        pipeline.backbone = self._description["name"]
        if before.get("backbone", {}).get("sha256") == self._description["sha256"]:
            self._description = before["backbone"]
        self._check_painting(before)
        if self.resumed is None:
            self._begin(pipeline)
        self.config = replace(self.config, pipeline=pipeline)
        super().setup(test_mode)
        release_memory()
        if comms.is_main_process():
            with self.config.saving():
                save_thumbnail(self.base_dir, self._painting)
        if self._start_step == 0:
            with bar("Warm start", pipeline.warm_start_steps) as warming:
                for _ in warm_start(self.pipeline, self.pipeline.task, self.optimizers):
                    warming.advance()

    def _check_painting(self, before: CheckpointNotes) -> None:
        """Raises an InputError where a run would go on with another painting."""
        made_for = before.get("scene", {}).get("painting")
        if made_for not in (None, self._painting.digest):
            raise InputError(
                f"The style image {self._painting.name} isn't the one that the checkpoint "
                f"{self.config.resumed_checkpoint()} was made with; name that one, or begin anew."
            )

    def completed(self, record: SceneRecord) -> SceneRecord:
        """With the painting."""
        return replace(record, painting=self._painting.digest)

    def _begin(self, pipeline: HierStylePipelineConfig) -> None:
        """Finds the coarse run of a new run, and decides what is simulated: as there, the rest by its field."""
        rows = pipeline.model.features_per_level
        if pipeline.model.fine_encoding == "tiny-cuda-nn" and not has_tiny_cuda_nn(torch.device(self.device), rows):
            raise InputError(
                "--pipeline.model.fine-encoding is tiny-cuda-nn, which isn't installed here, finds no GPU, or has no "
                f"rows of {rows} features (but of 1, 2, 4 and 8); leave it out: the hash grid has kernels of its own."
            )
        manager: FewShotDataManager = pipeline.datamanager.setup(device="cpu", test_mode="inference")
        scene = manager.scene
        decided = decide(scene, pipeline.effects)
        run = self._coarse_run = self._find_coarse(manager, decided)
        pipeline.coarse_run = run.folder.resolve()
        pipeline.model.coarse_field = copy.deepcopy(run.config.pipeline.model.coarse_field)
        scene.coarse_density, scene.style_image = run.density(decided), self._painting.pixels
        pipeline.decided = decide(scene, pipeline.effects, decided)

    def notes(self) -> CheckpointNotes:
        """See `style_notes`."""
        return style_notes(self.pipeline, super().notes(), self._description)

    def _load_checkpoint(self) -> None:
        super()._load_checkpoint()
        self.pipeline.style = self._painting, self._backbone
        if self._coarse_run is not None:
            self.pipeline.model.adopt_coarse(self._coarse_run.model_state())

    def _find_coarse(self, manager: FewShotDataManager, decided: Decisions) -> CoarseRun:
        """The coarse run that was asked for, else the newest that fits, else a new one, trained here and now."""
        scene = manager.record(decided)
        asked = self.config.pipeline.coarse_run
        if asked is not None:
            run = read_coarse_run(asked)
            check_scene(run, scene)
            CONSOLE.print(f"Stylising the coarse run {run.in_words()}.", soft_wrap=True)
            return run
        assert self.config.coarse_method is not None
        config = self.config.coarse_method()
        own = config.method_name
        methods = {own, COARSE_METHOD} if own.endswith("-draft") else {own}
        found = from_first_process(find_coarse_run(self.config.output_dir, methods, scene))
        if found is not None:
            CONSOLE.print(f"Stylising the newest coarse run of this scene, {found.folder}.")
            return found
        CONSOLE.print("There is no finished coarse run of this scene and these views; training one first.")
        return self._train_coarse(config, decided)

    def _train_coarse(self, config: SparseStyleTrainerConfig, decided: Decisions) -> CoarseRun:
        ours = self.config
        for name in PHOTO_SETTINGS:
            setattr(config.pipeline.datamanager, name, copy.deepcopy(getattr(ours.pipeline.datamanager, name)))
        config.pipeline.effects, config.pipeline.decided = ours.pipeline.effects, decided
        for name in RUN_SETTINGS:
            setattr(config, name, getattr(ours, name))
        config.vis = "tensorboard"
        config.viewer.quit_on_train_completion = True
        config.set_timestamp()
        config.timestamp = from_first_process(config.timestamp)
        if self.local_rank == 0:
            config.save_config()
        trainer = config.setup(local_rank=self.local_rank, world_size=self.world_size)
        trainer.setup()
        if not trainer.train_to_end():
            if trainer.step + 1 == config.max_num_iterations:
                stop("Stopped by Ctrl-C; the coarse run is finished, and this command, run again, stylises it.")
            resume = ["ns-train", config.method_name, "--load-dir", str(trainer.checkpoint_dir)]
            stop(
                "The coarse run was interrupted, so there is nothing to stylise yet; finish it with "
                f"{shlex.join([*resume, *scene_arguments(config)])} and run this command again."
            )
        for state in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, writer.GLOBAL_BUFFER):
            state.clear()
        from_first_process(None)  # the others wait here until it has saved
        folder = trainer.base_dir
        del trainer
        release_memory()  # its fields, optimisers and photos would be there during all of stage 2
        return read_coarse_run(folder)

    def next_command(self) -> List[str]:
        """Looking at it."""
        return ["sparsestyle", "gallery", str(self.base_dir)]


def _adopt_notes(pipeline: HierStylePipelineConfig, notes: CheckpointNotes) -> None:
    """Takes from the run that is resumed what was found out when it began: what its settings stood for."""
    # Not from its config.yml: that may be this command's own by now, where training goes on in the same folder.
    pipeline.model.coarse_field = CoarseFieldConfig(**notes["coarse_field"])
    pipeline.coarse_run = Path(notes["coarse_run"])
    if pipeline.model.fine_encoding == "auto":
        pipeline.model.fine_encoding = notes["fine_encoding"]
    if pipeline.model.max_resolution is None:
        pipeline.model.max_resolution = notes["max_resolution"]
    if pipeline.backbone == "auto" and pipeline.vgg_weights is None:
        pipeline.backbone = notes["backbone"]["name"]

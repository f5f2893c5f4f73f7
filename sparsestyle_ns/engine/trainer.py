"""nerfstudio's trainer, made to keep what it has: whole checkpoints, also on Ctrl-C, and resuming where it stopped."""

import copy
import shlex
import signal
import warnings
from abc import ABC, abstractmethod
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Dict, List, Literal, Optional, Tuple, Type

import numpy as np
import torch
import yaml
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread, check_viewer_enabled
from nerfstudio.utils.rich_utils import CONSOLE

from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.hints import finish, ns_train_style, resume_command, scene_arguments
from sparsestyle_ns.engine.previews import preview_steps, render_preview, save_preview
from sparsestyle_ns.field_components.tiny_cuda_grid import has_tiny_cuda_nn
from sparsestyle_ns.models.coarse_fewshot import CoarseFieldConfig
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager
from sparsestyle_ns.runs.coarse_run import (
    CoarseRun,
    check_scene,
    find_coarse_run,
    load_checkpoint,
    newest_checkpoint,
    read_coarse_run,
)
from sparsestyle_ns.runs.scene_record import record_scene
from sparsestyle_ns.style.painting import load_style_image
from sparsestyle_ns.utils.distributed import any_process, from_first_process, prepare_launch, share_state
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import bar, say
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers
from sparsestyle_ns.viewer.styles import StyleImage, save_thumbnail

STEPS_PER_LOOK = 10
"""Iterations between looks at the count of skipped steps, each of which waits for a GPU."""


def this_machine() -> MachineConfig:
    """A GPU where there is one, else the CPU; nerfstudio's default is CUDA, which fails without."""
    return MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu")


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam in one pass over memory."""

    betas: Tuple[float, float] = (0.9, 0.999)
    """Decay of the running means of the gradient and its square."""
    fused: bool = True
    """Whether to use the fused implementation; the values are the same up to rounding."""


@dataclass
class SparseStyleTrainerConfig(TrainerConfig):
    """Settings of a run of either method."""

    _target: Type = field(default_factory=lambda: SparseStyleTrainer)
    machine: MachineConfig = field(default_factory=this_machine)
    """Where to run; the GPU where there is one."""
    max_skipped_steps: int = 20
    """Iterations in a row, at least 1, whose gradient isn't finite and whose step is therefore skipped, after which
    training stops."""
    previews: Tuple[float, ...] = (0.1, 0.25, 0.5, 1.0)
    """Shares of the iterations, in (0, 1], after which a held-out view is rendered, into the folder previews of the run
    and into tensorboard where it is on; none: --previews alone."""
    preview_side: int = 256
    """Longer side of a preview in pixels, at most; its time grows with the square."""

    @exit_on_input_error
    def save_config(self) -> None:
        """Writes config.yml into the run's folder; `ns-train` calls it right before it starts processes."""
        gpus = torch.cuda.device_count()
        if self.machine.device_type == "cuda" and self.machine.num_devices > gpus:
            raise InputError(
                f"--machine.device-type is cuda and --machine.num-devices {self.machine.num_devices}, but torch finds "
                f"{gpus or 'no'} GPU{'s' * (gpus > 1)} here; "
                + ("ask for fewer." if gpus else "give --machine.device-type cpu.")
            )
        if self.machine.num_devices * self.machine.num_machines > 1:
            prepare_launch()
        try:
            self.get_base_dir().mkdir(parents=True, exist_ok=True)
            write_whole(self.get_base_dir() / "config.yml", yaml.dump(self))
        except OSError as error:
            raise InputError(
                f"The run can't be saved in {self.get_base_dir()} ({error.strerror}); name a folder that can be "
                "written to with --output-dir."
            ) from error


warnings.filterwarnings("ignore", message="Using a non-tuple sequence", module="nerfstudio")
warnings.filterwarnings("ignore", message="Sparse invariant checks are implicitly disabled")


class SparseStyleTrainer(Trainer, ABC):
    """The trainer of both methods."""

    config: SparseStyleTrainerConfig
    optimizers: FiniteOptimizers
    stage: ClassVar[str]
    """What its bar is called."""

    def __init__(self, config: SparseStyleTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        super().__init__(config, local_rank, world_size)
        self._total = config.max_num_iterations

    @exit_on_input_error
    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Sets up the run and records what it is trained on, and which effects are simulated."""
        if self.config.max_skipped_steps < 1:
            raise InputError(f"--max-skipped-steps is {self.config.max_skipped_steps}; give 1 or more.")
        self._preview_steps = preview_steps(self.config.previews, self._total)
        self._reported = 0
        self._kept_step: Optional[int] = None
        checkpoint = self.resumed_checkpoint()
        if checkpoint is not None:
            self.config.pipeline.decided = read_decisions(checkpoint, self.config.pipeline.effects)
        super().setup(test_mode)
        self._save_record()

    def setup_optimizers(self) -> Optimizers:
        """Optimisers that skip steps whose gradient isn't finite."""
        return FiniteOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups())

    @check_main_thread
    def _save_record(self) -> None:
        manager = self.pipeline.datamanager
        record_scene(manager.config.data, manager.train_dataparser_outputs, self.pipeline.effects).save(self.base_dir)
        self.save_decisions()

    def save_decisions(self) -> None:
        """Writes which effects are simulated into effects.json, and into config.yml, from which a run is loaded."""
        self.pipeline.effects.save(self.base_dir)
        self._saved_decisions = self.pipeline.effects
        iterations, self.config.max_num_iterations = self.config.max_num_iterations, self._total
        self.config.save_config()
        self.config.max_num_iterations = iterations

    def resumed_checkpoint(self) -> Optional[Path]:
        """The checkpoint that training goes on from; None for a new run.

        Raises:
            InputError: there is none where the command line says.
        """
        for source in (self.config.load_dir, self.config.load_checkpoint):
            if source is not None and not source.exists():
                raise InputError(
                    f"There is nothing to resume at {source}; name a folder of checkpoints or a .ckpt file."
                )
        folder, step = self.config.load_dir, self.config.load_step
        if folder is None:
            return self.config.load_checkpoint
        checkpoint = newest_checkpoint(folder) if step is None else folder / f"step-{step:09d}.ckpt"
        if checkpoint is None or not checkpoint.is_file():
            what = "checkpoint" if step is None else f"checkpoint of iteration {step}"
            raise InputError(f"There is no {what} in {folder}; name a run's nerfstudio_models folder.")
        return checkpoint

    def _load_checkpoint(self) -> None:
        checkpoint = self.resumed_checkpoint()
        if checkpoint is not None:
            self._resume(load_checkpoint(checkpoint))
            CONSOLE.print(f"Going on from {checkpoint}.", soft_wrap=True)
        share_state(self.pipeline.model)

    def _resume(self, state: Dict[str, Any]) -> None:
        """Takes over all of a checkpoint, as nerfstudio does."""
        self.pipeline.load_pipeline(state["pipeline"], state["step"])
        self.optimizers.load_optimizers(state["optimizers"])
        if self.config.load_scheduler:
            self.optimizers.load_schedulers(state["schedulers"])
        self.grad_scaler.load_state_dict(state["scalers"])
        self._start_step = state["step"] + 1
        self._kept_step = state["step"]

    @exit_on_input_error
    def train(self) -> None:
        """Trains, and says what was made and what to type next."""
        self.train_to_end()
        self.finish()

    def train_to_end(self) -> None:
        """Trains up to `max_num_iterations`, counted from the very first iteration, also when resuming.

        Ctrl-C ends training after the iteration that is under way and saves a checkpoint; a second one stops at once.
        """
        total = self._total
        if self._start_step >= total:
            raise InputError(
                f"The checkpoint is of iteration {self._start_step}, and --max-num-iterations is {total}; raise it to "
                "train on."
            )
        self._interrupted = False
        former = signal.signal(signal.SIGINT, self._on_interrupt)
        self.config.max_num_iterations = total - self._start_step
        has_table = self.config.logging.local_writer.enable  # nerfstudio's, which would write over the bar
        try:
            with ExitStack() as self._bars:
                shown = bar(self.stage, total, self._start_step, "iterations", visible=not has_table)
                self._bar = self._bars.enter_context(shown)
                super().train()
        except TrainingInterruptedError:
            self.save_checkpoint(self.step)
            CONSOLE.print(f"Stopped after iteration {self.step + 1} of {total}; the checkpoint is saved.")
        finally:
            self.config.max_num_iterations = total
            signal.signal(signal.SIGINT, former)

    def _after_train(self) -> None:
        self._bars.close()  # a viewer may stay open for hours after training
        super()._after_train()

    @check_viewer_enabled
    def _train_complete_viewer(self) -> None:
        """The viewer stays until Ctrl-C, with which the command ends as well as without a viewer."""
        self.finish()
        try:
            super()._train_complete_viewer()
        except KeyboardInterrupt:
            CONSOLE.print("The viewer is closed.")

    def _on_interrupt(self, number: int, frame: Any) -> None:
        if self._interrupted or self.training_state == "completed":
            raise KeyboardInterrupt
        self._interrupted = True
        self.training_state = "training"  # one that the viewer paused goes on for an iteration
        CONSOLE.print("Ctrl-C: finishing this iteration, then saving. Press it again to stop at once.")

    def train_iteration(self, step: int) -> Any:
        """One iteration.

        Raises:
            InputError: the gradients of too many iterations in a row weren't finite.
        """
        result = super().train_iteration(step)
        note = None
        if (step + 1) % self.config.logging.steps_per_log == 0:  # reading the values waits for a GPU
            note = ", ".join(f"{name} {float(value):.3g}" for name, value in result[2].items())
        self._bar.advance(note=note)
        if (step + 1) % STEPS_PER_LOOK == 0:
            self._look_at_skipped(step)
        return result

    def _look_at_skipped(self, step: int) -> int:
        """Reports steps that were skipped since the last look; returns how many were, in a row, up to now."""
        total, in_a_row = self.optimizers.skipped()
        if total > self._reported:
            CONSOLE.print(
                f"Steps skipped up to iteration {step + 1}, because their gradients weren't finite: "
                f"{total - self._reported} ({total} in all)."
            )
            writer.put_scalar(name="Skipped Steps", scalar=total, step=step)
            self._reported = total
        if in_a_row >= self.config.max_skipped_steps:
            kept = "No checkpoint was saved before."
            if self._kept_step is not None:
                kept = f"The checkpoint of iteration {self._kept_step + 1} is from before and stays."
            raise InputError(
                f"Training stopped after iteration {step + 1}, because the gradients of the last {in_a_row} weren't "
                "finite; try a lower learning rate, --optimizers.fields.optimizer.lr. " + kept
            )
        return in_a_row

    def eval_iteration(self, step: int) -> None:
        """What nerfstudio evaluates after an iteration, and the preview after some; then it is over.

        Raises:
            TrainingInterruptedError: Ctrl-C was pressed, in any process.
        """
        if step + 1 in self._preview_steps:
            self._write_preview(step + 1)
        super().eval_iteration(step)
        # Not before: what callbacks decide after an iteration wouldn't be in the checkpoint.
        self._interrupted = any_process(self._interrupted, self.pipeline.device)
        if self._interrupted:
            raise TrainingInterruptedError

    @check_main_thread
    def _write_preview(self, iterations: int) -> None:
        picture = render_preview(self.pipeline, self.config.preview_side)
        writer.put_image(name="Preview", image=picture, step=iterations)
        try:
            save_preview(picture, self.base_dir, iterations)
        except OSError as error:
            say(f"The preview after {iterations} iterations can't be saved ({error.strerror}); training goes on.")

    def finish(self) -> None:
        """Prints the command's last line."""
        if self._interrupted:
            made = f"{self.base_dir}, up to iteration {self.step + 1} of {self._total}"
            finish(made, resume_command(self.config.method_name, self.checkpoint_dir))
        else:
            finish(self.base_dir, self.next_command())

    @abstractmethod
    def next_command(self) -> List[str]:
        """A command that uses the finished run."""

    def notes(self) -> Dict[str, Any]:
        """What a checkpoint says beside the state: numbers and words only."""
        return {"effects": self.pipeline.effects.records()}

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Saves a checkpoint as nerfstudio does, but only whole and finite ones, and drops the former one after that.

        While steps are being skipped, the state is under suspicion: nothing is saved then, and at the end of training
        the former checkpoint is kept beside the last.

        Raises:
            InputError: there is a number in it that isn't finite, or the disk is full or can't be written to.
        """
        suspect = self._look_at_skipped(step) > 0
        ends = self._interrupted or step + 1 == self._start_step + self.config.max_num_iterations
        if suspect and not ends:
            CONSOLE.print(f"No checkpoint of iteration {step + 1}: its step was skipped.")
            return
        target = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        state = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: part.state_dict() for name, part in self.optimizers.optimizers.items()},
            "schedulers": {name: part.state_dict() for name, part in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            **self.notes(),
        }
        for name, tensor in state["pipeline"].items():
            if tensor.is_floating_point() and not tensor.isfinite().all():
                raise InputError(
                    f"Iteration {step + 1} isn't saved, because {name} isn't finite in it; go on from an earlier "
                    "checkpoint with a lower learning rate, --optimizers.fields.optimizer.lr."
                )
        # nerfstudio takes every file in the folder of checkpoints for one, so the unfinished one is kept outside.
        unfinished = self.base_dir / "checkpoint.unfinished"
        try:
            self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
            write_whole(target, lambda file: torch.save(without_numpy_scalars(state), file), unfinished)
        except (OSError, RuntimeError) as error:  # torch's writer makes a RuntimeError of some OSErrors
            unfinished.unlink(missing_ok=True)
            raise InputError(
                f"The checkpoint of iteration {step + 1} can't be saved in {self.checkpoint_dir} ({error}); the former "
                "one is still there. Make room, and go on from it with --load-dir."
            ) from error
        self._kept_step = step
        if self.config.save_only_latest_checkpoint and not suspect:
            for path in self.checkpoint_dir.glob("step-*.ckpt"):
                if path != target:
                    path.unlink()
        if self.pipeline.effects != self._saved_decisions:
            self.save_decisions()


def read_decisions(checkpoint: Path, settings: Any) -> Optional[Decisions]:
    """Which effects a checkpoint was made with; None where it doesn't say.

    Raises:
        InputError: the settings ask for others.
    """
    records = load_checkpoint(checkpoint).get("effects")
    if records is None:
        return None
    decisions = Decisions.from_records(records)
    decisions.check_choices(settings, f"the checkpoint {checkpoint}")
    return decisions


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


class TrainingInterruptedError(Exception):
    """Ctrl-C was pressed during the iteration that just ended."""


class CoarseFewShotTrainer(SparseStyleTrainer):
    """The trainer of stage 1."""

    stage = "Stage 1"

    def notes(self) -> Dict[str, Any]:
        """What `SparseStyleTrainer.notes` has and, where a feature network took part, which."""
        unseen = self.pipeline.unseen
        return super().notes() | ({} if unseen is None else {"backbone": asdict(unseen.backbone.description)})

    def next_command(self) -> List[str]:
        """See `SparseStyleTrainer.next_command`."""
        return ns_train_style(self.base_dir, self.config)


@dataclass
class HierStyleTrainerConfig(SparseStyleTrainerConfig):
    """Settings of a stylised run."""

    _target: Type = field(default_factory=lambda: HierStyleTrainer)


class HierStyleTrainer(SparseStyleTrainer):
    """The trainer of stage 2: finds or trains the coarse run first."""

    stage = "Stage 2"
    _first_backbone: Optional[Dict[str, Any]] = None
    """The feature network's note in the checkpoint that is gone on with."""

    @exit_on_input_error
    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Checks the style's files, makes sure of a coarse run, and sets up the stylised run."""
        pipeline = self.config.pipeline
        resumes = self.config.load_dir is not None or self.config.load_checkpoint is not None
        if resumes:
            self._adopt_checkpoint()
        pipeline.check_style()
        self._check_encoding(resumes)
        for name in ("style_image", "vgg_weights"):  # the run may be measured from another folder
            path: Optional[Path] = getattr(pipeline, name)
            setattr(pipeline, name, None if path is None else path.expanduser().resolve())
        run = None
        if not resumes:
            manager = self._photos()
            decided = decide(manager.scene, pipeline.effects)
            run = self.coarse_run(manager, decided)
            self.config.pipeline.coarse_run = run.folder.resolve()
            self.config.pipeline.model.coarse_field = copy.deepcopy(run.config.pipeline.model.coarse_field)
            self.config.pipeline.decided = self._decide(manager, run, decided)
        self._coarse_state = None if run is None else run.model_state()
        super().setup(test_mode)
        self.config.pipeline.backbone = self.pipeline.targets.backbone.description.name
        self._write_config(self.config)
        self._keep_thumbnail()

    def _check_encoding(self, resumes: bool) -> None:
        model = self.config.pipeline.model
        if model.fine_encoding != "tiny-cuda-nn" or resumes:
            return
        if not has_tiny_cuda_nn(torch.device(self.device), model.features_per_level):
            raise InputError(
                "--pipeline.model.fine-encoding is tiny-cuda-nn, which isn't installed here, finds no GPU, or has no "
                f"rows of {model.features_per_level} features (but of 1, 2, 4 and 8); leave the setting out: the hash "
                "grid has kernels of its own."
            )

    @check_main_thread
    def _write_config(self, config: TrainerConfig) -> None:
        config.save_config()

    @check_main_thread
    def _keep_thumbnail(self) -> None:
        save_thumbnail(self.base_dir, StyleImage.read(self.config.pipeline.style_image))

    def notes(self) -> Dict[str, Any]:
        """Which feature network stylised the scene, where its weights came from, and which coarse run it builds on."""
        pipeline = self.config.pipeline
        backbone = asdict(self.pipeline.targets.backbone.description)
        if self._first_backbone is not None and self._first_backbone["sha256"] == backbone["sha256"]:
            backbone = self._first_backbone  # how it was found when the run began
        return {
            **super().notes(),
            "backbone": backbone,
            "coarse_run": str(pipeline.coarse_run),
            "coarse_field": asdict(pipeline.model.coarse_field),
            "fine_encoding": pipeline.model.fine_encoding,
        }

    def _load_checkpoint(self) -> None:
        super()._load_checkpoint()
        if self._coarse_state is not None:
            self.pipeline.model.adopt_coarse(self._coarse_state)
            self._coarse_state = None

    def _adopt_checkpoint(self) -> None:
        """Takes from the run that is resumed what was found out when it began: the coarse field, and what auto was."""
        # Its config.yml may be this command's own by now, where training goes on in the same folder.
        state = load_checkpoint(self.resumed_checkpoint())
        if "coarse_field" not in state:  # a coarse run's has none; loading it says what is wrong
            return
        pipeline = self.config.pipeline
        pipeline.model.coarse_field = CoarseFieldConfig(**state["coarse_field"])
        pipeline.coarse_run = Path(state["coarse_run"])
        if pipeline.model.fine_encoding == "auto":
            pipeline.model.fine_encoding = state.get("fine_encoding", "hash")
        self._first_backbone = state["backbone"]
        if pipeline.backbone == "auto" and pipeline.vgg_weights is None:
            pipeline.backbone = state["backbone"]["name"]

    def coarse_run(self, manager: FewShotDataManager, decided: Decisions) -> CoarseRun:
        """The coarse run that was asked for, else the newest that fits, else a new one, trained here and now.

        Args:
            manager: the photos.
            decided: what was decided about them.

        Raises:
            InputError: the run that was asked for doesn't exist or is of another scene.
        """
        scene = record_scene(manager.config.data, manager.train_dataparser_outputs, decided)
        asked = self.config.pipeline.coarse_run
        if asked is not None:
            run = read_coarse_run(asked)
            check_scene(run, scene)
            CONSOLE.print(f"Stylising the coarse run {run.in_words()}.", soft_wrap=True)
            return run
        draft = self.config.method_name.endswith("-draft")
        methods = ("coarse-fewshot", "coarse-fewshot-draft") if draft else ("coarse-fewshot",)
        found = from_first_process(find_coarse_run(self.config.output_dir, methods, scene))
        if found is not None:
            CONSOLE.print(f"Stylising the newest coarse run of this scene, {found.folder}.")
            return found
        CONSOLE.print("There is no finished coarse run of this scene and these views; training one first.")
        return self._train_coarse(methods[-1], decided)

    def _photos(self) -> FewShotDataManager:
        config = copy.deepcopy(self.config.pipeline.datamanager)
        return config.setup(device="cpu", test_mode="inference")

    def _decide(self, manager: FewShotDataManager, run: CoarseRun, decided: Decisions) -> Decisions:
        """What is simulated: as in the coarse run, and the rest by its field and the painting."""
        settings, scene = self.config.pipeline, manager.scene
        scene.coarse_density = run.density(decided)
        scene.style_image = load_style_image(settings.style_image)
        return decide(scene, settings.effects, decided)

    def _train_coarse(self, method: str, decided: Decisions) -> CoarseRun:
        from sparsestyle_ns.method_configs import method_config

        config: TrainerConfig = copy.deepcopy(method_config(method))
        ours: Dict[str, Any] = vars(self.config.pipeline.datamanager)
        for name in (
            "data",
            "dataparser",
            "num_views",
            "view_ids",
            "max_image_side",
            "seed",
            "camera_res_scale_factor",
        ):
            setattr(config.pipeline.datamanager, name, copy.deepcopy(ours[name]))
        config.pipeline.effects, config.pipeline.decided = self.config.pipeline.effects, decided
        config.data, config.output_dir = self.config.data, self.config.output_dir
        config.experiment_name, config.project_name = self.config.experiment_name, self.config.project_name
        config.machine, config.logging = self.config.machine, self.config.logging
        config.vis = "tensorboard"
        config.viewer.quit_on_train_completion = True
        config.set_timestamp()
        config.timestamp = from_first_process(config.timestamp)
        self._write_config(config)
        trainer = config.setup(local_rank=self.local_rank, world_size=self.world_size)
        trainer.setup()
        trainer.train_to_end()
        if trainer._interrupted:
            resume = ["ns-train", method, "--load-dir", str(trainer.checkpoint_dir), *scene_arguments(config, method)]
            raise InputError(
                "The coarse run was interrupted, so there is nothing to stylise yet; finish it with "
                f"{shlex.join(resume)} and run this command again."
            )
        for state in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, writer.GLOBAL_BUFFER):
            state.clear()
        from_first_process(None)  # the others wait here until it has saved
        return read_coarse_run(trainer.base_dir)

    def next_command(self) -> List[str]:
        """See `SparseStyleTrainer.next_command`."""
        return ["sparsestyle", "gallery", str(self.base_dir)]

"""nerfstudio's trainer, made to keep what it has: whole checkpoints, also on Ctrl-C, and resuming where it stopped."""

import functools
import os
import signal
import time
import warnings
from abc import ABC, abstractmethod
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, Dict, List, Literal, Optional, Tuple, Type

import torch
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import comms, writer
from nerfstudio.utils.decorators import check_main_thread, check_viewer_enabled
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.engine.hints import finish, ns_train_style, resume_command
from sparsestyle_ns.engine.previews import preview_steps, write_preview
from sparsestyle_ns.engine.run_config import RunConfig
from sparsestyle_ns.engine.schedules import over_iterations
from sparsestyle_ns.engine.training import check_skipped, training_step
from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipeline
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.runs import checkpoints
from sparsestyle_ns.runs.checkpoints import CheckpointNotes, checkpoint_path
from sparsestyle_ns.runs.run_folder import COARSE_METHOD, STYLE_METHOD, release_folder, remove_empty_run
from sparsestyle_ns.runs.scene_record import RECORD_FILE, ExpectedScene, SceneRecord, record_scene
from sparsestyle_ns.utils.distributed import any_process, prepare_launch, share_state
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error
from sparsestyle_ns.utils.interrupts import StoppedByCtrlC, stop, take_away_at_end
from sparsestyle_ns.utils.progress import bar, say
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers

STEPS_PER_LOOK = 10
"""Iterations between looks at the count of skipped steps, each of which waits for a GPU."""

SECONDS_OF_ONE_PRESS = 1.0
"""Ctrl-C that comes again within so long is the same one: pressed twice, or passed on by the process above."""

warnings.filterwarnings("ignore", message="Using a non-tuple sequence", module="nerfstudio")
warnings.filterwarnings("ignore", message="Sparse invariant checks are implicitly disabled")


def this_machine() -> MachineConfig:
    """A GPU where there is one, else the CPU; nerfstudio's default is CUDA, which fails without."""
    return MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu")


@dataclass
class SparseStyleTrainerConfig(RunConfig):
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
        """Finds the run its folder, and writes config.yml there; `ns-train` calls it before it starts processes."""
        machine, gpus = self.machine, torch.cuda.device_count()
        if machine.device_type == "cuda" and machine.num_devices > gpus:
            advice = "ask for fewer." if gpus else "give --machine.device-type cpu."
            raise InputError(
                f"--machine.device-type is cuda and --machine.num-devices {machine.num_devices}, but torch finds "
                f"{gpus or 'no'} GPU{'s' * (gpus > 1)} here; {advice}"
            )
        is_new = self.find_place()
        if machine.num_devices * machine.num_machines > 1:
            prepare_launch()
        folder = self.get_base_dir()
        is_there, around = folder.exists(), [outer for outer in folder.parents if not outer.exists()]
        self.hold_folder()
        if not is_there:
            take_away_at_end(lambda: remove_empty_run(folder, around))
        if is_new:  # what a run that is gone on with says stays until it is known that it can be
            self.write_config()


def run_notes(effects: Decisions, record: Optional[SceneRecord]) -> CheckpointNotes:
    """What the checkpoint of every run says beside the state, as far as it is known."""
    return {"effects": effects.records(), **({} if record is None else {"scene": asdict(record)})}


class SparseStyleTrainer(Trainer, ABC):
    """The trainer of both methods."""

    config: SparseStyleTrainerConfig
    optimizers: FiniteOptimizers
    pipeline: CheckedPipeline
    stage: ClassVar[str]
    """What its bar is called."""
    _interrupted = False

    @exit_on_input_error
    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Sets up the run and records what it is trained on, and which effects are simulated."""
        if self.config.max_skipped_steps < 1:
            raise InputError(f"--max-skipped-steps is {self.config.max_skipped_steps}; give 1 or more.")
        self._preview_steps = preview_steps(self.config.previews, self.config.max_num_iterations)
        self._reported = 0
        self._kept_step: Optional[int] = None
        self._own_checkpoint: Optional[Path] = None
        self.record: Optional[SceneRecord] = None
        if self.resumed is not None:
            self._expect_what_was(self.resumed)
        if self.config.data is not None and not os.access(self.config.data, os.W_OK):
            self.config = replace(self.config, data=None)  # where nerfstudio's viewer would make a folder
        super().setup(test_mode)
        manager = self.pipeline.datamanager
        manager.config.expected = None  # it is that scene
        if comms.is_main_process():
            parts = manager.train_dataparser_outputs, self.pipeline.effects, manager.measured_views()
            self.record = self.completed(record_scene(manager.config.data, *parts))
            with self.config.saving():
                self.record.save(self.base_dir)
                self._save_decisions()

    def _expect_what_was(self, before: Dict[str, Any]) -> None:
        """Takes from a checkpoint what training goes on with; InputError where the command line says something else."""
        is_style = self.config.method_name.startswith(STYLE_METHOD)
        if is_style != any(name.startswith("_model.residual.") for name in before["pipeline"]):
            other, advice = (
                (COARSE_METHOD, "name its run with --coarse-run") if is_style else (STYLE_METHOD, "go on with that")
            )
            raise InputError(f"The checkpoint {self.config.resumed_checkpoint()} is of {other}; {advice} instead.")
        done, total = before["step"] + 1, self.config.max_num_iterations
        if done >= total:
            of = f"The checkpoint is of iteration {done}"
            raise InputError(f"{of}, and --max-num-iterations is {total}; raise it to train on.")
        self.config.pipeline.datamanager.expected = self._expected_scene()
        if "effects" in before:
            decided = Decisions.from_records(before["effects"])
            decided.check_choices(self.config.pipeline.effects, f"the checkpoint {self.config.resumed_checkpoint()}")
            self.config = replace(self.config, pipeline=replace(self.config.pipeline, decided=decided))

    def completed(self, record: SceneRecord) -> SceneRecord:
        """The record of the scene with what the method adds to it."""
        return record

    def _expected_scene(self) -> Optional[ExpectedScene]:
        """What the scene was when the checkpoint that training goes on from was made; None where nothing says that."""
        checkpoint = self.config.resumed_checkpoint()
        if "scene" in self.resumed:
            record = SceneRecord.from_content(self.resumed["scene"])
        elif (checkpoint.parents[1] / RECORD_FILE).is_file():  # of an earlier version
            record = SceneRecord.load(checkpoint.parents[1])
        else:
            return None
        advice = "go on with the photos, views and settings of the dataparser that it was trained with, or begin anew"
        return ExpectedScene(record, f"The checkpoint {checkpoint}", advice, measured=False)

    def setup_optimizers(self) -> FiniteOptimizers:
        """Optimisers that skip steps whose gradient isn't finite."""
        optimizers = over_iterations(self.config.optimizers, self.config.max_num_iterations)
        return FiniteOptimizers(optimizers, self.pipeline.get_param_groups())

    def _save_decisions(self) -> None:
        self.pipeline.effects.save(self.base_dir)
        self._saved_decisions = self.pipeline.effects
        decided = replace(self.config.pipeline, decided=self.pipeline.effects)
        replace(self.config, pipeline=decided).write_config()

    @functools.cached_property
    def resumed(self) -> Optional[Dict[str, Any]]:
        """What is in the checkpoint that training goes on from, until it is loaded; None for a new run."""
        checkpoint = self.config.resumed_checkpoint()
        return None if checkpoint is None else checkpoints.load_checkpoint(checkpoint)

    def _load_checkpoint(self) -> None:
        state = self.resumed
        if state is not None:
            self.pipeline.load_pipeline(state["pipeline"], state["step"])
            self.optimizers.load_optimizers(state["optimizers"])
            if self.config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            self.grad_scaler.load_state_dict(state["scalers"])
            self._start_step, self._kept_step = state["step"] + 1, state["step"]
            CONSOLE.print(f"Going on from {self.config.resumed_checkpoint()}.", soft_wrap=True)
        self.resumed = None
        share_state(self.pipeline.model)

    @exit_on_input_error
    def train(self) -> None:
        """Trains, and says what was made and what to type next; after Ctrl-C it ends the process, with status 130."""
        self.train_to_end()
        self.finish()
        if self._interrupted:
            raise StoppedByCtrlC

    def train_to_end(self) -> bool:
        """Trains up to `max_num_iterations`, counted from the very first iteration, also when resuming.

        Ctrl-C ends training after the iteration that is under way and saves a checkpoint; a second one stops at once.
        Returns whether nobody pressed it.
        """
        total = self.config.max_num_iterations
        self._interrupted = self._waits = False
        self._interrupted_at: Optional[float] = None
        former = signal.signal(signal.SIGINT, self._on_interrupt)
        has_table = self.config.logging.local_writer.enable  # nerfstudio's, which would write over the bar
        shown = bar(self.stage, total, self._start_step, "iterations", visible=not has_table)
        try:
            with ExitStack() as self._bars:
                self._bar = self._bars.enter_context(shown)
                super().train()
        except OSError as error:  # what nerfstudio writes: events and the dataparser's transform
            raise self._cant_save("What training writes", error) from error
        except TrainingInterruptedError:
            self.save_checkpoint(self.step)
            say(f"Stopped after iteration {self.step + 1} of {total}; the checkpoint is saved.")
        finally:
            signal.signal(signal.SIGINT, former)
            release_folder(self.base_dir)
        return not self._interrupted

    def _after_train(self) -> None:
        self._bars.close()  # a viewer may stay open for hours after training
        # Of a resumed run, nerfstudio begins an iteration past the last before it looks whether to stop.
        self.step = min(self.step, self.config.max_num_iterations - 1)
        super()._after_train()

    @check_viewer_enabled
    def _train_complete_viewer(self) -> None:
        """The viewer stays until Ctrl-C, which ends the command as if there were none; another may train on by then."""
        release_folder(self.base_dir)
        self.finish()
        if self._interrupted:  # while the last checkpoint was saved
            raise StoppedByCtrlC
        self._waits = True
        try:
            super()._train_complete_viewer()
        except KeyboardInterrupt:
            say("The viewer is closed.")

    def _on_interrupt(self, number: int, frame: Optional[FrameType]) -> None:
        if self._waits:
            raise KeyboardInterrupt
        if self._interrupted_at is not None and time.monotonic() - self._interrupted_at < SECONDS_OF_ONE_PRESS:
            return
        if self._interrupted:
            kept = "nothing was saved" if self._kept_step is None else f"iteration {self._kept_step + 1} is saved"
            stop(f"Stopped by Ctrl-C at once; {kept}.")
        self._interrupted = True
        if self.training_state == "paused":  # by the viewer; it goes on for an iteration
            self.training_state = "training"
        self._interrupted_at = time.monotonic()
        if comms.is_main_process():  # not by Python's printing, which may be what is interrupted
            os.write(1, b"\nCtrl-C: finishing this iteration, then saving. Press it again to stop at once.\n")

    def train_iteration(self, step: int) -> Tuple[Tensor, Dict[str, Tensor], Dict[str, Tensor]]:
        """One iteration: its loss, the losses by name, and metrics."""

        def compute_losses() -> Tuple[Dict[str, Tensor], Dict[str, Tensor]]:
            with torch.autocast(self.pipeline.device.type, enabled=self.mixed_precision):
                return self.pipeline.get_train_loss_dict(step)[1:]

        scaling = self.grad_scaler, self.gradient_accumulation_steps
        loss, losses, metrics = training_step(self.optimizers, compute_losses, step, *scaling)
        self._log_step(step, metrics)
        self.stop_training = step + 1 == self.config.max_num_iterations  # nerfstudio counts from where it resumed
        return loss, losses, metrics

    def _log_step(self, step: int, metrics: Dict[str, Tensor]) -> None:
        for name, scheduler in self.optimizers.schedulers.items():
            writer.put_scalar(name=f"learning_rate/{name}", scalar=scheduler.get_last_lr()[0], step=step)
        if self.config.log_gradients:
            named = self.pipeline.model.named_parameters()
            norms = {f"Gradients/{name}": part.grad.norm() for name, part in named if part.grad is not None}
            metrics.update(norms, **{"Gradients/Total": sum(norms.values(), torch.zeros(()))})
        note = None
        if (step + 1) % self.config.logging.steps_per_log == 0:  # reading the values waits for a GPU
            note = ", ".join(f"{name} {float(value):.3g}" for name, value in metrics.items())
        self._bar.advance(note=note)
        if (step + 1) % STEPS_PER_LOOK == 0:
            self._look_at_skipped(step)

    def _look_at_skipped(self, step: int) -> int:
        """Reports steps that were skipped since the last look; returns how many were in a row up to now."""
        total, _ = self.optimizers.skipped()
        if total > self._reported:
            new = f"{total - self._reported} ({total} in all)"
            CONSOLE.print(f"Steps skipped up to iteration {step + 1}, because their gradients weren't finite: {new}.")
            writer.put_scalar(name="Skipped Steps", scalar=total, step=step)
            self._reported = total
        kept = "No checkpoint was saved before."
        if self._kept_step is not None:
            kept = f"The checkpoint of iteration {self._kept_step + 1} is from before and stays."
        advice = f"try a lower learning rate, --optimizers.fields.optimizer.lr. {kept}"
        return check_skipped(self.optimizers, self.config.max_skipped_steps, step, advice)

    def eval_iteration(self, step: int) -> None:
        """What nerfstudio evaluates after an iteration, and the preview after some; then Ctrl-C ends training."""
        if step + 1 in self._preview_steps:
            write_preview(self.pipeline, self.base_dir, step + 1, self.config.preview_side)
        super().eval_iteration(step)
        # Not before: what callbacks decide after an iteration wouldn't be in the checkpoint.
        self._interrupted = any_process(self._interrupted, self.pipeline.device)
        if self._interrupted:
            raise TrainingInterruptedError

    def finish(self) -> None:
        """Prints the command's last line."""
        if self._interrupted and self.step + 1 < self.config.max_num_iterations:
            made = f"{self.base_dir}, up to iteration {self.step + 1} of {self.config.max_num_iterations}"
            finish(made, resume_command(self.config.method_name, self.checkpoint_dir))
        else:
            finish(self.base_dir, self.next_command())

    @abstractmethod
    def next_command(self) -> List[str]:
        """A command that uses the finished run."""

    def notes(self) -> CheckpointNotes:
        """What a checkpoint says beside the state."""
        return run_notes(self.pipeline.effects, self.record)

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Saves a checkpoint as nerfstudio does, but only a whole and finite one, and drops the former one after that.

        None is dropped that was there when training began or went on. While steps are being skipped nothing is saved;
        at the end of training the former checkpoint is kept then.
        """
        suspect = self._look_at_skipped(step) > 0
        if suspect and not self._interrupted and step + 1 < self.config.max_num_iterations:
            CONSOLE.print(f"No checkpoint of iteration {step + 1}: its step was skipped.")
            return
        target, state = checkpoint_path(self.checkpoint_dir, step), self.pipeline.state_dict()
        try:
            checkpoints.write_checkpoint(target, step, state, self.optimizers, self.notes(), self.grad_scaler)
        except (OSError, RuntimeError) as error:  # torch's writer makes a RuntimeError of some OSErrors
            raise self._cant_save(f"The checkpoint of iteration {step + 1}", error) from error
        self._kept_step = step
        if self.config.save_only_latest_checkpoint and not suspect and self._own_checkpoint not in (None, target):
            self._own_checkpoint.unlink(missing_ok=True)
        self._own_checkpoint = target
        if self.pipeline.effects != self._saved_decisions:
            self._save_decisions()

    def _cant_save(self, what: str, error: BaseException) -> InputError:
        """An error that says why something of the run can't be written, and what is saved of it."""
        while not isinstance(error, OSError) and error.__context__ is not None:
            error = error.__context__
        advice = "nothing was saved before, so make room on the disk and begin anew"
        if self._kept_step is not None:
            advice = (
                f"iteration {self._kept_step + 1} is saved, so make room on the disk and go on from it with --load-dir"
            )
        reason = getattr(error, "strerror", None) or str(error)
        return InputError(f"{what} can't be saved in {self.base_dir} ({reason})", advice)


class CoarseFewShotTrainer(SparseStyleTrainer):
    """Trains a coarse field."""

    stage = "Stage 1"
    pipeline: CoarseFewShotPipeline

    def notes(self) -> CheckpointNotes:
        """The effects and, where a feature network took part, which."""
        unseen = self.pipeline.unseen
        return {**super().notes(), **({} if unseen is None else {"backbone": asdict(unseen.backbone.description)})}

    def next_command(self) -> List[str]:
        """Stylising it."""
        return ns_train_style(self.base_dir, self.config)


class TrainingInterruptedError(Exception):
    """Ctrl-C was pressed during the iteration that just ended."""

"""nerfstudio's trainer, made to keep what it has: whole checkpoints, also on Ctrl-C, and resuming where it stopped."""

import functools
import signal
import warnings
from abc import ABC, abstractmethod
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, Dict, List, Literal, Optional, Tuple, Type

import torch
import yaml
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import comms, writer
from nerfstudio.utils.decorators import check_main_thread, check_viewer_enabled
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.engine.hints import finish, ns_train_style, resume_command
from sparsestyle_ns.engine.previews import preview_steps, write_preview
from sparsestyle_ns.engine.schedules import over_iterations
from sparsestyle_ns.engine.training import check_skipped, training_step
from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipeline
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.runs import checkpoints
from sparsestyle_ns.runs.checkpoints import CheckpointNotes, checkpoint_path
from sparsestyle_ns.runs.scene_record import record_scene
from sparsestyle_ns.utils.distributed import any_process, prepare_launch, share_state
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import bar
from sparsestyle_ns.utils.skip_nonfinite import FiniteOptimizers

STEPS_PER_LOOK = 10
"""Iterations between looks at the count of skipped steps, each of which waits for a GPU."""

warnings.filterwarnings("ignore", message="Using a non-tuple sequence", module="nerfstudio")
warnings.filterwarnings("ignore", message="Sparse invariant checks are implicitly disabled")


def this_machine() -> MachineConfig:
    """A GPU where there is one, else the CPU; nerfstudio's default is CUDA, which fails without."""
    return MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu")


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
        machine, folder, gpus = self.machine, self.get_base_dir(), torch.cuda.device_count()
        if machine.device_type == "cuda" and machine.num_devices > gpus:
            advice = "ask for fewer." if gpus else "give --machine.device-type cpu."
            raise InputError(
                f"--machine.device-type is cuda and --machine.num-devices {machine.num_devices}, but torch finds "
                f"{gpus or 'no'} GPU{'s' * (gpus > 1)} here; {advice}"
            )
        if machine.num_devices * machine.num_machines > 1:
            prepare_launch()
        try:
            write_whole(folder / "config.yml", yaml.dump(self))
        except OSError as error:
            where = f"{folder} ({error.strerror}); name a folder that can be written to with --output-dir."
            raise InputError(f"The run can't be saved in {where}") from error


class SparseStyleTrainer(Trainer, ABC):
    """The trainer of both methods."""

    config: SparseStyleTrainerConfig
    optimizers: FiniteOptimizers
    pipeline: CheckedPipeline
    stage: ClassVar[str]
    """What its bar is called."""

    @exit_on_input_error
    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Sets up the run and records what it is trained on, and which effects are simulated."""
        if self.config.max_skipped_steps < 1:
            raise InputError(f"--max-skipped-steps is {self.config.max_skipped_steps}; give 1 or more.")
        self._preview_steps = preview_steps(self.config.previews, self.config.max_num_iterations)
        self._reported = 0
        self._kept_step: Optional[int] = None
        if self.resumed is not None and "effects" in self.resumed:
            decided = Decisions.from_records(self.resumed["effects"])
            decided.check_choices(self.config.pipeline.effects, f"the checkpoint {self._resumed_checkpoint()}")
            self.config = replace(self.config, pipeline=replace(self.config.pipeline, decided=decided))
        super().setup(test_mode)
        if comms.is_main_process():
            manager, effects = self.pipeline.datamanager, self.pipeline.effects
            record_scene(manager.config.data, manager.train_dataparser_outputs, effects).save(self.base_dir)
            self._save_decisions()

    def setup_optimizers(self) -> FiniteOptimizers:
        """Optimisers that skip steps whose gradient isn't finite."""
        optimizers = over_iterations(self.config.optimizers, self.config.max_num_iterations)
        return FiniteOptimizers(optimizers, self.pipeline.get_param_groups())

    def _save_decisions(self) -> None:
        self.pipeline.effects.save(self.base_dir)
        self._saved_decisions = self.pipeline.effects
        decided = replace(self.config.pipeline, decided=self.pipeline.effects)
        replace(self.config, pipeline=decided).save_config()

    @functools.cached_property
    def resumed(self) -> Optional[Dict[str, Any]]:
        """What is in the checkpoint that training goes on from, until it is loaded; None for a new run."""
        checkpoint = self._resumed_checkpoint()
        return None if checkpoint is None else checkpoints.load_checkpoint(checkpoint)

    def _resumed_checkpoint(self) -> Optional[Path]:
        for source in (self.config.load_dir, self.config.load_checkpoint):
            if source is not None and not source.exists():
                raise InputError(
                    f"There is nothing to resume at {source}; name a folder of checkpoints or one of them."
                )
        folder, step = self.config.load_dir, self.config.load_step
        if folder is None:
            return self.config.load_checkpoint
        checkpoint = checkpoints.newest_checkpoint(folder) if step is None else checkpoint_path(folder, step)
        if checkpoint is None or not checkpoint.is_file():
            what = "checkpoint" if step is None else f"checkpoint of iteration {step}"
            raise InputError(f"There is no {what} in {folder}; name a run's nerfstudio_models folder.")
        return checkpoint

    def _load_checkpoint(self) -> None:
        state = self.resumed
        if state is not None:
            self.pipeline.load_pipeline(state["pipeline"], state["step"])
            self.optimizers.load_optimizers(state["optimizers"])
            if self.config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            self.grad_scaler.load_state_dict(state["scalers"])
            self._start_step, self._kept_step = state["step"] + 1, state["step"]
            CONSOLE.print(f"Going on from {self._resumed_checkpoint()}.", soft_wrap=True)
        self.resumed = None
        share_state(self.pipeline.model)

    @exit_on_input_error
    def train(self) -> None:
        """Trains, and says what was made and what to type next."""
        self.train_to_end()
        self.finish()

    def train_to_end(self) -> bool:
        """Trains up to `max_num_iterations`, counted from the very first iteration, also when resuming.

        Ctrl-C ends training after the iteration that is under way and saves a checkpoint; a second one stops at once.
        Returns whether training came to its end.
        """
        total = self.config.max_num_iterations
        if self._start_step >= total:
            done = f"The checkpoint is of iteration {self._start_step}"
            raise InputError(f"{done}, and --max-num-iterations is {total}; raise it to train on.")
        self._interrupted = False
        former = signal.signal(signal.SIGINT, self._on_interrupt)
        has_table = self.config.logging.local_writer.enable  # nerfstudio's, which would write over the bar
        shown = bar(self.stage, total, self._start_step, "iterations", visible=not has_table)
        try:
            with ExitStack() as self._bars:
                self._bar = self._bars.enter_context(shown)
                super().train()
        except TrainingInterruptedError:
            self.save_checkpoint(self.step)
            CONSOLE.print(f"Stopped after iteration {self.step + 1} of {total}; the checkpoint is saved.")
        finally:
            signal.signal(signal.SIGINT, former)
        return not self._interrupted

    def _after_train(self) -> None:
        self._bars.close()  # a viewer may stay open for hours after training
        # Of a resumed run, nerfstudio begins an iteration past the last before it looks whether to stop.
        self.step = min(self.step, self.config.max_num_iterations - 1)
        super()._after_train()

    @check_viewer_enabled
    def _train_complete_viewer(self) -> None:
        """The viewer stays until Ctrl-C, which ends the command as if there were none."""
        self.finish()
        try:
            super()._train_complete_viewer()
        except KeyboardInterrupt:
            CONSOLE.print("The viewer is closed.")

    def _on_interrupt(self, number: int, frame: Optional[FrameType]) -> None:
        if self._interrupted or self.training_state == "completed":
            raise KeyboardInterrupt
        self._interrupted = True
        self.training_state = "training"  # one that the viewer paused goes on for an iteration
        CONSOLE.print("Ctrl-C: finishing this iteration, then saving. Press it again to stop at once.")

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
        if self._interrupted:
            made = f"{self.base_dir}, up to iteration {self.step + 1} of {self.config.max_num_iterations}"
            finish(made, resume_command(self.config.method_name, self.checkpoint_dir))
        else:
            finish(self.base_dir, self.next_command())

    @abstractmethod
    def next_command(self) -> List[str]:
        """A command that uses the finished run."""

    def notes(self) -> CheckpointNotes:
        """What a checkpoint says beside the state."""
        return {"effects": self.pipeline.effects.records()}

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Saves a checkpoint as nerfstudio does, but only a whole and finite one, and drops the former one after that.

        While steps are being skipped nothing is saved; at the end of training the former checkpoint is kept then.
        """
        suspect = self._look_at_skipped(step) > 0
        if suspect and not self._interrupted and step + 1 < self.config.max_num_iterations:
            CONSOLE.print(f"No checkpoint of iteration {step + 1}: its step was skipped.")
            return
        target, state = checkpoint_path(self.checkpoint_dir, step), self.pipeline.state_dict()
        try:
            checkpoints.write_checkpoint(target, step, state, self.optimizers, self.notes(), self.grad_scaler)
        except (OSError, RuntimeError) as error:  # torch's writer makes a RuntimeError of some OSErrors
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
            self._save_decisions()


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

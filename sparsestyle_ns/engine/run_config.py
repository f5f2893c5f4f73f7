"""Where a run is: a new one never takes another's folder, and one that is opened is found where it lies now."""

import os
import shutil
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, Iterator, Optional

import tyro
import yaml
from nerfstudio.engine.trainer import TrainerConfig

from sparsestyle_ns.pipelines.ns_commands import begin_command
from sparsestyle_ns.runs.checkpoints import checkpoint_path, checkpoint_step, load_checkpoint, newest_checkpoint
from sparsestyle_ns.runs.run_folder import hold_folder, is_held, read_config
from sparsestyle_ns.runs.scene_record import RECORD_FILE, ExpectedScene, SceneRecord
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.interrupts import ns_option, take_away_at_end
from sparsestyle_ns.utils.progress import say

NO_TIMESTAMP = "{timestamp}"
"""nerfstudio's sign that a run has no name of its own yet."""


@dataclass
class RunConfig(TrainerConfig):
    """nerfstudio's config of a run, which keeps track of the run's folder."""

    run_folder: tyro.conf.Suppress[Optional[Path]] = None
    """Where a run that was opened lies, whatever its config.yml says; not in that file."""

    def __setstate__(self, state: Dict[str, Any]) -> None:
        """Called when a config.yml is read, which nerfstudio's commands do first of all."""
        vars(self).update(state)
        begin_command()

    def get_base_dir(self) -> Path:
        """The run's folder."""
        return self.run_folder or super().get_base_dir()

    @exit_on_input_error
    def get_checkpoint_dir(self) -> Path:
        """Where the run's checkpoints are.

        nerfstudio's commands ask for it when they have read a config.yml, before they set up the pipeline; the run is
        then opened in that file's folder or, for a copy of that file alone, where it says that the run is.
        """
        opened = _config_being_opened()
        if opened is not None and self.run_folder is None:
            folder, told = opened.resolve().parent, super().get_base_dir().resolve()
            is_run = newest_checkpoint(folder / self.relative_model_dir) is not None
            self.open_in(folder if is_run or not told.is_dir() else told)
        return super().get_checkpoint_dir()

    def open_in(self, folder: Path) -> None:
        """Makes this the config of the run in a folder: of its newest checkpoint, and of the scene that it is of.

        InputError where it has no checkpoint that can be read, or its scene isn't there.
        """
        if is_held(folder):
            self.relative_model_dir = _kept_copy(folder / self.relative_model_dir)
        newest = newest_checkpoint(folder / self.relative_model_dir)
        if newest is None:
            raise InputError(f"{folder} has no checkpoint yet; train it, or name another run.")
        load_checkpoint(newest, mmap=True)  # nerfstudio, which reads it, would say of a damaged one what torch does
        record, manager = SceneRecord.load(folder), self.pipeline.datamanager
        self.run_folder, self.load_step = folder, checkpoint_step(newest)
        # A command, as `ns-render dataset --data FOLDER`, may have named another place.
        if manager.data == read_config(folder).pipeline.datamanager.data:
            manager.data = record.find_data(folder)
        self.data = manager.data
        advice = (
            "put its photos and poses back as they were, or write where they are now behind "
            f'"data" in {folder / RECORD_FILE}'
        )
        manager.expected = ExpectedScene(record, f"The run {folder}", advice)
        for name in ("style_image", "vgg_weights"):
            path: Optional[Path] = getattr(self.pipeline, name, None)
            if path is not None:
                setattr(self.pipeline, name, record.found(path, folder))

    def set_timestamp(self) -> None:
        """Names a run that has no name by the time, to the second, of which no other has the name."""
        is_new = self.timestamp == NO_TIMESTAMP
        super().set_timestamp()
        while is_new and self.get_base_dir().exists():
            time.sleep(0.1)
            self.timestamp = NO_TIMESTAMP
            super().set_timestamp()

    def find_place(self) -> bool:
        """Makes paths absolute, and sees to it that no run is there yet where this one will be; returns whether so.

        Else it goes on with that run. A config that `--load-config` has read goes on with its own run where that isn't
        finished, and else begins a new one. InputError where there is a run that this one doesn't go on with.
        """
        self._say_what_it_leaves_out()
        self._settle_paths()
        folder, newest = self.get_base_dir(), newest_checkpoint(self.get_checkpoint_dir())
        if newest is None:
            return True
        if self.pipeline.decided is not None:  # so it was read from a run's config.yml
            if checkpoint_step(newest) + 1 < self.max_num_iterations:
                self.load_dir, self.load_step, self.load_checkpoint = newest.parent.resolve(), None, None
                say(f"The run {folder} isn't finished; going on with it.")
                return False
            self.timestamp, self.pipeline.decided = NO_TIMESTAMP, None
            self.set_timestamp()
            say(f"The run {folder} is finished and stays as it is; this is a new one, {self.get_base_dir()}.")
            return True
        resumed = self.resumed_checkpoint()
        if resumed is None or resumed.resolve() != newest.resolve():
            raise InputError(
                f"There is a run in {folder} already; name a new one with --timestamp, or go on with that one by "
                f"--load-dir {newest.parent}."
            )
        return False

    def _say_what_it_leaves_out(self) -> None:
        """Names what was typed beside `--load-config`, whose file nerfstudio takes in place of all of it.

        InputError where it is of another method than the one that was asked for.
        """
        path, words = ns_option("load-config"), sys.argv[1:]
        if path is None or words[0].startswith("-"):
            return
        if self.pipeline.decided is not None and words[0] != self.method_name:
            raise InputError(
                f"--load-config {path} is of a run of {self.method_name}, and {words[0]} was asked for; "
                f"type ns-train {self.method_name} --load-config {path}."
            )
        others = sorted({word.split("=")[0] for word in words if word.startswith("--")})
        others = [word for word in others if word.replace("_", "-") != "--load-config"]
        if others:
            say(f"Without effect beside --load-config, whose file says all: {', '.join(others)}.")

    def _settle_paths(self) -> None:
        """A run may be opened from another folder, and a shell leaves ~ alone behind an equals sign."""
        manager = self.pipeline.datamanager
        places = [
            (self, ("data", "load_dir", "load_checkpoint")),
            (manager, ("data",)),
            (manager.dataparser, ("data",)),
        ]
        for part, names in [*places, (self.pipeline, ("style_image", "coarse_run", "vgg_weights"))]:
            for name in names:
                path: Any = getattr(part, name, None)
                if path is not None:
                    setattr(part, name, Path(os.path.abspath(Path(path).expanduser())))
        self.output_dir = self.output_dir.expanduser()

    def hold_folder(self) -> None:
        """Makes the run's folder, its own until the process ends; InputError where it can't, or another has it."""
        with self.saving():
            hold_folder(self.get_base_dir())

    def write_config(self) -> None:
        """Writes config.yml into the run's folder; InputError where it can't be written."""
        with self.saving():
            write_whole(self.get_base_dir() / "config.yml", yaml.dump(self))

    @contextmanager
    def saving(self) -> Iterator[None]:
        """InputError where something can't be written into the run's folder before training begins."""
        try:
            yield
        except OSError as error:
            where = f"{self.get_base_dir()} ({error.strerror}); name a folder that can be written to with --output-dir."
            raise InputError(f"The run can't be saved in {where}") from error

    def resumed_checkpoint(self) -> Optional[Path]:
        """The checkpoint that training goes on from, None for a new run; InputError where it isn't there."""
        for source in (self.load_dir, self.load_checkpoint):
            if source is not None and not source.exists():
                raise InputError(
                    f"There is nothing to resume at {source}; name a folder of checkpoints or one of them."
                )
        folder, step = self.load_dir, self.load_step
        if folder is None:
            if self.load_checkpoint is not None and self.load_checkpoint.is_dir():
                raise InputError(f"--load-checkpoint {self.load_checkpoint} is a folder; name it with --load-dir.")
            return self.load_checkpoint
        checkpoint = newest_checkpoint(folder) if step is None else checkpoint_path(folder, step)
        if checkpoint is None or not checkpoint.is_file():
            newest = newest_checkpoint(folder)
            if newest is None:
                raise InputError(f"There is no checkpoint in {folder}; name a run's nerfstudio_models folder.")
            raise InputError(
                f"There is no checkpoint of iteration {step} in {folder}; leave --load-step out to go on from "
                f"{checkpoint_step(newest)}, the newest."
            )
        return checkpoint


def _kept_copy(checkpoints: Path) -> Path:
    """A folder with a copy of the newest checkpoint, for as long as the process runs.

    A training that is under way drops a checkpoint when it has saved the next one, perhaps before this one is read.
    """
    copies = Path(tempfile.mkdtemp(prefix="checkpoint-"))
    take_away_at_end(lambda: shutil.rmtree(copies, ignore_errors=True))
    while (newest := newest_checkpoint(checkpoints)) is not None:
        with suppress(FileNotFoundError):
            shutil.copy(newest, copies)
            return copies
    return checkpoints


def _config_being_opened() -> Optional[Path]:
    """The config.yml that nerfstudio's `eval_setup`, from which this is called, has read; None where it isn't.

    It tells the config everything but that.
    """
    frame = sys._getframe(1)
    while frame is not None:
        if (frame.f_globals.get("__name__"), frame.f_code.co_name) == ("nerfstudio.utils.eval_utils", "eval_setup"):
            return Path(frame.f_locals["config_path"])
        frame = frame.f_back
    return None

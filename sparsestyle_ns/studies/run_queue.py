"""Training the runs that a table needs: each once, resumable, several at a time where the machine has room.

A run's folder carries a digest of all that decides the outcome: a finished run is used, an interrupted one goes on.
"""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Callable, Dict, List, Mapping, Optional, Sequence, Tuple

import torch
import yaml
from nerfstudio.scripts import train

from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.runs.checkpoints import checkpoint_step, newest_checkpoint
from sparsestyle_ns.studies.study import Stage, Study
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.interrupts import PRESSES, end_on_ctrl_c, ending_on, stop
from sparsestyle_ns.utils.progress import PROGRESS_FILE, ProgressReport, bar, duration, report, say

SECONDS_FILE = "training_seconds.json"
TRAINING_PROCESS = (sys.executable, "-m", "sparsestyle_ns.studies.run_queue")
"""Followed by a config's file, it trains a run in a process of its own."""
ENDINGS = (*PRESSES, SystemExit)
"""What a signal raises that ends this process, and has to end the runs that it waits for."""
CORES_PER_JOB = 4
"""CPU cores that a run makes good use of."""
SECONDS_BETWEEN_LOOKS = 2.0
PICTURE_SIDE = 256
"""Longer side, in pixels, of pictures of a run on its way."""
Settings = Mapping[str, object]
"""Values by their place in a method's config."""


@dataclass(frozen=True)
class Run:
    """A training run that a table needs."""

    study: Study
    output_dir: Path
    """What `ns-train --output-dir` names."""
    name: str
    stage: Stage
    settings: Tuple[Tuple[str, object], ...] = ()
    """`Settings` beside the preset's, as pairs."""
    painting: Optional[Path] = None
    coarse: Optional["Run"] = None
    """The run whose field it stylises."""
    own_iterations: Optional[int] = None
    """How many it has, where not as many as the study's other runs."""
    pictures: Tuple[int, ...] = ()
    """Iterations after which a picture is made of it on its way (see `preview_path`)."""

    @property
    def method(self) -> str:
        """The name that ns-train knows its preset by."""
        return self.study.method(self.stage)

    @property
    def iterations(self) -> int:
        """How many it has when it is finished."""
        return self.own_iterations or self.study.iterations(self.stage)

    @property
    def digest(self) -> str:
        """Eight hexadecimal digits of all that decides the outcome but the program itself."""
        study = self.study
        parts = [self.method, self.iterations, *self.settings, *study.flags(self.stage), study.data.resolve()]
        parts.append(study.photo_digest)
        parts += [study.dataparser, study.max_image_side, study.num_views, study.view_ids]
        if self.painting is not None:
            parts.append(hashlib.sha256(self.painting.read_bytes()).hexdigest())
        if self.coarse is not None:
            parts.append(self.coarse.digest)
        return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:8]

    @property
    def folder(self) -> Path:
        """Where it is."""
        return self.output_dir / self.study.name / self.method / f"{self.name}-{self.digest}"

    @property
    def steps_done(self) -> int:
        """Iterations that its newest checkpoint has behind it."""
        checkpoint = newest_checkpoint(self.folder / "nerfstudio_models")
        return 0 if checkpoint is None else checkpoint_step(checkpoint) + 1

    @property
    def is_finished(self) -> bool:
        """Whether it has all its iterations."""
        return self.steps_done >= self.iterations

    def config(self) -> SparseStyleTrainerConfig:
        """The config that trains it to its end, from where it is."""
        config = self.study.config(self.stage, dict(self.settings), self.painting)
        config.max_num_iterations = self.iterations
        config.output_dir, config.experiment_name = self.output_dir, self.study.name
        config.timestamp = self.folder.name
        config.previews = tuple(count / self.iterations for count in self.pictures)
        config.preview_side = PICTURE_SIDE
        config.vis, config.viewer.quit_on_train_completion = "tensorboard", True
        if self.steps_done > 0:
            config.load_dir = self.folder / "nerfstudio_models"
        elif self.coarse is not None:
            config.pipeline.coarse_run = self.coarse.folder
        return config


def time_spent(path: Path) -> Dict[str, float]:
    """Seconds and iterations of all processes of a run so far; zeros where the file is missing or was cut short."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return {"seconds": 0.0, "iterations": 0}


@dataclass
class RunQueue:
    """Trains the runs of one study."""

    folder: Path
    """Where they all are; has their logs, too."""
    jobs: Optional[int] = None
    """Runs at a time; None for one on a machine of few cores or with a GPU, else one for every four cores."""
    say: Callable[[str], None] = say
    """Told what goes on, a line at a time."""
    _training: List[subprocess.Popen] = field(default_factory=list, init=False)

    def train(self, runs: Sequence[Run]) -> None:
        """Brings all runs, and the coarse ones they build on, to their end; named twice, one is trained once.

        Raises:
            InputError: a run failed.
            StoppedByCtrlC: Ctrl-C was pressed; either way what is done is kept.
            SystemExit: SIGTERM or SIGHUP, which end the runs that are under way as Ctrl-C does.
        """
        wanted = list(dict.fromkeys([*(run.coarse for run in runs if run.coarse is not None), *runs]))
        self.say(self.forecast(wanted))
        try:
            with ending_on(signal.SIGTERM, signal.SIGHUP):
                for has_coarse in (False, True):
                    stage = [run for run in wanted if (run.coarse is not None) is has_coarse and not run.is_finished]
                    self._train_beside_each_other(stage, wanted)
        except PRESSES:
            stop("Stopped by Ctrl-C; the same command goes on where it was.")

    def _train_beside_each_other(self, runs: Sequence[Run], wanted: Sequence[Run]) -> None:
        jobs = max(1, min(self._jobs(), len(runs)))

        def train(run: Run) -> None:
            self._train(run, jobs)
            if not all(other.is_finished for other in wanted):
                self.say(self.forecast(wanted))

        if jobs == 1:  # in this thread, which is the one that Ctrl-C reaches
            list(map(train, runs))
            return
        with ThreadPoolExecutor(jobs) as pool:
            try:
                list(pool.map(train, runs))
            except BaseException as error:
                pool.shutdown(wait=False, cancel_futures=True)
                if isinstance(error, ENDINGS):
                    _interrupt(self._training)
                raise

    def forecast(self, wanted: Sequence[Run]) -> str:
        """How much is to do and how long it will take, by what earlier runs of the same methods took."""
        left = [run for run in wanted if not run.is_finished]
        line = f"{len(wanted)} runs, {len(wanted) - len(left)} of them finished."
        rates = self._seconds_per_iteration()
        known = [run for run in left if run.method in rates]
        seconds = sum(rates[run.method] * (run.iterations - run.steps_done) for run in known)
        if known:
            line += f" {len(known)} take about {duration(seconds / self._jobs())}, as earlier runs did."
        if len(known) < len(left):
            line += f" How long {len(left) - len(known)} take will be known once the first of their kind runs."
        return line

    def _jobs(self) -> int:
        if self.jobs is not None:
            return self.jobs
        return 1 if torch.cuda.is_available() else max(1, (os.cpu_count() or 1) // CORES_PER_JOB)

    def _seconds_per_iteration(self) -> Dict[str, float]:
        """Of each method the mean over its runs that are on this disk."""
        rates: Dict[str, List[float]] = {}
        for path in self.folder.glob(f"*/*/{SECONDS_FILE}"):
            spent = time_spent(path)
            if spent["iterations"] > 0:
                rates.setdefault(path.parents[1].name, []).append(spent["seconds"] / spent["iterations"])
        return {method: sum(values) / len(values) for method, values in rates.items()}

    def _train(self, run: Run, jobs: int) -> None:
        name, done, total, start = run.folder.name, run.steps_done, run.iterations, time.monotonic()
        base = self.folder / "logs" / name
        log, config_path, progress = (Path(f"{base}.{suffix}") for suffix in ("log", "yml", "progress.json"))
        write_whole(config_path, yaml.dump(run.config()))
        progress.unlink(missing_ok=True)
        self.say(f"{name}: iterations {done} to {total}; the log is {log}")
        environment = {**os.environ, PROGRESS_FILE: str(progress)}
        if jobs > 1:
            environment["OMP_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // jobs))
        command = [*TRAINING_PROCESS, str(config_path)]
        with (
            log.open("a") as output,
            subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=environment) as process,
        ):
            self._training.append(process)
            _follow(process, progress, name, total, done)
        if process.returncode != 0 or not run.is_finished:
            failure = ProgressReport.read(progress).failure or f"its process ended with status {process.returncode}"
            raise InputError(f"The run {name} didn't finish ({failure}); all it said is in {log}.")
        seconds, spent = time.monotonic() - start, time_spent(run.folder / SECONDS_FILE)
        self.say(f"{name}: {total - done} iterations in {duration(seconds)}")
        spent = {"seconds": spent["seconds"] + seconds, "iterations": spent["iterations"] + total - done}
        write_whole(run.folder / SECONDS_FILE, json.dumps(spent) + "\n")


def _interrupt(processes: Sequence[subprocess.Popen]) -> None:
    """Passes Ctrl-C on to runs, which a terminal has done already, and waits until they have saved what they have."""
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    for process in processes:
        process.wait()


def _follow(process: subprocess.Popen, progress: Path, name: str, iterations: int, done: int) -> None:
    """Waits for a run, and shows how far it is by what it reports."""
    with bar(name, iterations, done, "iterations") as shown:
        while process.poll() is None:
            try:
                process.wait(timeout=SECONDS_BETWEEN_LOOKS)
            except ENDINGS:
                _interrupt([process])
                raise
            except subprocess.TimeoutExpired:
                for work in ProgressReport.read(progress).works:
                    if work.unit == "iterations":
                        shown.reach(work.done)


def train_run(config: SparseStyleTrainerConfig) -> None:
    """What ns-train does once it has read its command line; reports why it didn't where it fails."""
    try:
        train.main(config)
    except SystemExit as end:  # so an InputError ends, with its sentence
        if end.code:
            report(ProgressReport(failure=str(end.code)))
        raise
    except Exception as error:
        report(ProgressReport(failure=f"{type(error).__name__}: {error}"))
        raise


if __name__ == "__main__":
    end_on_ctrl_c()
    train_run(yaml.load(Path(sys.argv[1]).read_text(encoding="utf-8"), Loader=yaml.Loader))

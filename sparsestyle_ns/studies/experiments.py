"""Training the runs that a table needs: each once, resumable, several at a time where the machine has room.

An experiment is a method and its settings. Its run's folder carries a digest of everything that decides the outcome, so
that a run is found again by what it is: a finished one is used as it is, an interrupted one is gone on with.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Callable, Dict, List, Optional, Sequence, Tuple

from sparsestyle_ns.runs.checkpoints import checkpoint_step, newest_checkpoint
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import Bar, bar, duration, say

SECONDS_FILE = "training_seconds.json"
CORES_PER_JOB = 4
"""CPU cores that a run makes good use of."""
SECONDS_BETWEEN_LOOKS = 2.0
"""At the log of a run, to see how far it is."""


@dataclass(frozen=True)
class SceneSettings:
    """The photos of all experiments of a table, and where their runs go.

    Attributes:
        data: folder of the scene.
        parser: name of the dataparser.
        output_dir: what `ns-train --output-dir` names.
        flags: settings of the datamanager that all runs share.
    """

    data: Path
    parser: str
    output_dir: Path
    flags: Tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The experiment's name in nerfstudio's sense, that of the scene."""
        return self.data.resolve().name


@dataclass(frozen=True)
class Experiment:
    """A run that a table needs.

    Attributes:
        name: short name, part of the run's folder.
        method: name of the method that ns-train knows.
        iterations: how many.
        flags: its settings for ns-train.
        painting: the style image, of a stylised run.
        coarse: the experiment whose field it stylises.
        stops: iterations at which training pauses, so that a picture can be made.
    """

    name: str
    method: str
    iterations: int
    flags: Tuple[str, ...] = ()
    painting: Optional[Path] = None
    coarse: Optional["Experiment"] = None
    stops: Tuple[int, ...] = ()

    def digest(self, scene: SceneSettings) -> str:
        """Eight hexadecimal digits of all that decides the outcome but the program itself."""
        parts = [self.method, self.iterations, *self.flags, scene.data.resolve(), scene.parser, *scene.flags]
        if self.painting is not None:
            parts.append(hashlib.sha256(self.painting.read_bytes()).hexdigest())
        if self.coarse is not None:
            parts.append(self.coarse.digest(scene))
        return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:8]

    def folder(self, scene: SceneSettings) -> Path:
        """Where its run is."""
        return scene.output_dir / scene.name / self.method / f"{self.name}-{self.digest(scene)}"

    def steps_done(self, scene: SceneSettings) -> int:
        """Iterations that its newest checkpoint has behind it."""
        checkpoint = newest_checkpoint(self.folder(scene) / "nerfstudio_models")
        return 0 if checkpoint is None else checkpoint_step(checkpoint) + 1

    def is_finished(self, scene: SceneSettings) -> bool:
        """Whether it has all its iterations."""
        return self.steps_done(scene) >= self.iterations

    def command(self, scene: SceneSettings, iterations: int) -> List[str]:
        """The command that trains it up to some iteration, from where it is."""
        folder = self.folder(scene)
        command = [sys.executable, "-m", "nerfstudio.scripts.train", self.method, "--data", scene.data]
        command += ["--output-dir", scene.output_dir, "--experiment-name", scene.name, "--timestamp", folder.name]
        command += ["--max-num-iterations", iterations, "--vis", "tensorboard"]
        command += ["--viewer.quit-on-train-completion", "True", *scene.flags, *self.flags]
        if self.painting is not None:
            command += ["--style-image", self.painting]
        if self.steps_done(scene) > 0:
            command += ["--load-dir", folder / "nerfstudio_models"]
        elif self.coarse is not None:
            command += ["--coarse-run", self.coarse.folder(scene)]
        return [str(part) for part in (*command, scene.parser)]


AfterStop = Callable[[Experiment, int], None]


@dataclass
class Laboratory:
    """Runs experiments of a scene.

    Attributes:
        scene: its photos.
        jobs: runs at a time; None for one on a machine of few cores or with a GPU, else one for every four cores.
        say: told what goes on, a line at a time.
    """

    scene: SceneSettings
    jobs: Optional[int] = None
    say: Callable[[str], None] = say
    _log_folder: Path = field(init=False)
    _one_at_a_time: threading.Lock = field(init=False, default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self._log_folder = self.scene.output_dir / self.scene.name / "logs"

    def run(self, experiments: Sequence[Experiment], after_stop: Optional[AfterStop] = None) -> None:
        """Brings all experiments, and the coarse ones they build on, to their end.

        Args:
            experiments: what to run; named twice, it is run once.
            after_stop: called when an experiment has reached one of its stops, with that iteration.

        Raises:
            InputError: a run failed, or Ctrl-C was pressed; either way what is done is kept.
        """
        try:
            self._run(experiments, after_stop)
        except KeyboardInterrupt as interrupt:
            raise InputError("Interrupted; the same command goes on where it was.") from interrupt

    def _run(self, experiments: Sequence[Experiment], after_stop: Optional[AfterStop]) -> None:
        styled = list(dict.fromkeys(experiments))
        coarse = list(dict.fromkeys(each.coarse for each in styled if each.coarse is not None))
        wanted = [*coarse, *(each for each in styled if each not in coarse)]
        left = self._unfinished(wanted)
        self.say(self.forecast(wanted, left))

        def train(each: Experiment, jobs: int) -> None:
            self._train(each, jobs, after_stop)
            if still := self._unfinished(wanted):
                self.say(self.forecast(wanted, still))

        for stage in (coarse, styled):
            todo = [each for each in stage if each in left]
            jobs = min(self._jobs(), len(todo))
            if jobs < 2:
                for each in todo:
                    train(each, 1)
                continue
            with ThreadPoolExecutor(jobs) as pool:
                try:
                    list(pool.map(lambda each, jobs=jobs: train(each, jobs), todo))
                except BaseException:
                    pool.shutdown(cancel_futures=True)
                    raise

    def _unfinished(self, experiments: Sequence[Experiment]) -> List[Experiment]:
        return [each for each in experiments if not each.is_finished(self.scene)]

    def forecast(self, wanted: Sequence[Experiment], left: Sequence[Experiment]) -> str:
        """How much is to do and how long it will take, by what earlier runs of the same methods took."""
        line = f"{len(wanted)} runs, {len(wanted) - len(left)} of them finished."
        if not left:
            return line
        rates = self._seconds_per_iteration()
        known = [each for each in left if each.method in rates]
        seconds = sum(rates[each.method] * (each.iterations - each.steps_done(self.scene)) for each in known)
        if known:
            line += f" {len(known)} take about {duration(seconds / self._jobs())}, as earlier runs did."
        if len(known) < len(left):
            line += f" How long {len(left) - len(known)} take will be known once the first of their kind runs."
        return line

    def _jobs(self) -> int:
        if self.jobs is not None:
            return self.jobs
        import torch

        return 1 if torch.cuda.is_available() else max(1, (os.cpu_count() or 1) // CORES_PER_JOB)

    def _seconds_per_iteration(self) -> Dict[str, float]:
        """Of each method the mean over its runs that are on this disk."""
        spent: Dict[str, List[float]] = {}
        for path in (self.scene.output_dir / self.scene.name).glob(f"*/*/{SECONDS_FILE}"):
            record = _spent(path)
            spent.setdefault(path.parents[1].name, []).append(record["seconds"] / record["iterations"])
        return {method: sum(rates) / len(rates) for method, rates in spent.items()}

    def _train(self, experiment: Experiment, jobs: int, after_stop: Optional[AfterStop]) -> None:
        for iterations in (*experiment.stops, experiment.iterations):
            if experiment.steps_done(self.scene) < iterations:
                self._train_to(experiment, iterations, jobs)
            is_stop = iterations in experiment.stops and experiment.steps_done(self.scene) == iterations
            if after_stop is not None and is_stop:
                with self._one_at_a_time:
                    after_stop(experiment, iterations)

    def _train_to(self, experiment: Experiment, iterations: int, jobs: int) -> None:
        self._log_folder.mkdir(parents=True, exist_ok=True)
        folder = experiment.folder(self.scene)
        log = self._log_folder / f"{folder.name}.log"
        environment = dict(os.environ)
        if jobs > 1:
            environment["OMP_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // jobs))
        done, start = experiment.steps_done(self.scene), time.monotonic()
        self.say(f"{folder.name}: iterations {done} to {iterations}; the log is {log}")
        with log.open("a") as output:
            command = experiment.command(self.scene, iterations)
            with (
                bar(folder.name, iterations, done, "iterations") as run,
                subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, env=environment) as process,
            ):
                self._watch(process, log, log.stat().st_size, run)
        if process.returncode != 0 or experiment.steps_done(self.scene) < iterations:
            words = last_words(log.read_text(errors="replace"))
            raise InputError(f"The run {folder.name} didn't finish ({words}); all it said is in {log}.")
        seconds = time.monotonic() - start
        self.say(f"{folder.name}: {iterations - done} iterations in {duration(seconds)}")
        self._record(folder / SECONDS_FILE, seconds, iterations - done)

    def _watch(self, process: subprocess.Popen, log: Path, begin: int, run: Bar) -> None:
        """Waits for a run, and shows how far it is by what it says itself."""
        while process.poll() is None:
            try:
                process.wait(timeout=SECONDS_BETWEEN_LOOKS)
            except KeyboardInterrupt:  # the run got it too, and saves what it has
                process.wait()
                raise
            except subprocess.TimeoutExpired:
                share = share_done(log.read_bytes()[begin:].decode(errors="replace"))
                if share is not None:
                    run.reach(share * run.task.total)

    @staticmethod
    def _record(path: Path, seconds: float, iterations: int) -> None:
        before = _spent(path)
        record = {"seconds": before["seconds"] + seconds, "iterations": before["iterations"] + iterations}
        write_whole(path, json.dumps(record) + "\n")


def _spent(path: Path) -> Dict[str, float]:
    """Seconds and iterations that a run has taken so far; nothing where no file, or no JSON, says."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return {"seconds": 0.0, "iterations": 0}


def last_words(log: str) -> str:
    """The last line of a log, or all that the last box says where it ends with one, as a wrong flag's does."""
    lines = log.strip().splitlines() or [""]
    if not lines[-1].startswith("╰"):
        return lines[-1]
    start = max((number for number, line in enumerate(lines) if line.startswith("╭")), default=0)
    return " ".join(" ".join(line.strip("╭╮╰╯│─ ") for line in lines[start:]).split())


def share_done(log: str) -> Optional[float]:
    """The share in [0, 1] of its iterations that a run's log says are done; None where it says nothing yet."""
    found = re.findall(r"^Stage \d: .*\((\d+)%\)", log, flags=re.MULTILINE)
    return float(found[-1]) / 100 if found else None

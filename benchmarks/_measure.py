"""Timing contenders in turn, the record of where and when, and the files that benchmarks write."""

import gc
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Callable, Dict, List, Literal, Optional, Sequence, Tuple, Union

import psutil
import torch
from torch import Tensor

from sparsestyle_ns.core.precision import multiplies_bfloat16
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.machine import BUSY_SHARE, core_seconds, device_name, others_share, synchronize, versions

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
CACHE = ROOT / ".bench"
"""What can be made again, and results that nobody should quote; not in git."""

# ------------------------------------------------------------------------------------------------------- command line


@dataclass
class Options:
    """What all benchmarks take."""

    quick: bool = False
    """Small sizes and few repetitions: shows that everything works, not how fast it is."""
    repeats: Optional[int] = None
    """Repetitions of every contender; None: the benchmark's own number."""
    device: Optional[Literal["cpu", "cuda"]] = None
    """Where to run; None: the GPU where there is one."""
    threads: Optional[int] = None
    """Threads on the CPU; None: as many as cores."""
    output_dir: Optional[Path] = None
    """Folder of the results. None: benchmarks/results, and a folder in .bench for --quick and --sample."""
    data: Optional[Path] = None
    """Folder that holds llff/fern and styles. None: $SPARSESTYLE_DATA, else ../shared/data beside the repository."""
    sample: bool = False
    """Use the project's own sample scene and painting, which are made here, instead of --data."""
    coarse_iterations: Optional[int] = None
    """Iterations of the coarse run that stage 2 builds on; None: those of coarse-fewshot-draft."""

    def repetitions(self, usual: int) -> int:
        """How often to measure; `usual` is the benchmark's own number."""
        return self.repeats or (min(usual, 2) if self.quick else usual)

    @property
    def results(self) -> Path:
        """Folder of the results."""
        if self.output_dir is not None:
            return self.output_dir
        marks = [word for word in ("quick", "sample") if getattr(self, word)]
        return CACHE / "-".join(["results", *marks]) if marks else RESULTS

    def set_up(self) -> torch.device:
        """Sets threads and the seed; returns the device.

        Raises:
            InputError: a number is below 1, or there is no such device.
        """
        for flag in ("repeats", "threads", "coarse_iterations"):
            value = getattr(self, flag)
            if value is not None and value < 1:
                raise InputError(f"--{flag.replace('_', '-')} is {value}, but has to be at least 1.")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise InputError("--device is cuda, but torch finds no GPU here; leave it out or give cpu.")
        torch.set_num_threads(self.num_threads)
        torch.manual_seed(0)
        return torch.device(self.device or ("cuda" if torch.cuda.is_available() else "cpu"))

    @property
    def num_threads(self) -> int:
        """Threads on the CPU."""
        return self.threads or os.cpu_count() or 1


# -------------------------------------------------------------------------------------------------------- the machine


def peak_bytes(device: torch.device) -> int:
    """The most memory this process has had: of a GPU what torch had allocated, else all that was resident."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    status = Path("/proc/self/status")
    if status.is_file():
        # Unlike getrusage's figure, this one isn't inherited from the process that started this one.
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


class OtherLoad:
    """How much of all cores other processes use: for a second before a benchmark, and on average while it runs."""

    def __init__(self) -> None:
        self.before = psutil.cpu_percent(interval=1.0) / 100
        self._start = core_seconds()

    def record(self) -> Dict[str, Union[float, bool]]:
        """Both shares, in [0, 1], and whether the machine counts as busy."""
        during = others_share(self._start, core_seconds())
        return {
            "before": round(self.before, 3),
            "during": round(during, 3),
            "busy": max(self.before, during) > BUSY_SHARE,
        }


# ------------------------------------------------------------------------------------------------------------- timing


@dataclass(frozen=True)
class Duration:
    """What one repetition took.

    Attributes:
        seconds: on the clock.
        stopped: it was stopped then, and would have taken longer.
    """

    seconds: float
    stopped: bool = False


Measure = Callable[[int], Duration]
"""Does a contender's work once; takes the number of the repetition, −1 for the warm-up."""


def timed(
    work: Callable[..., Any],
    device: torch.device,
    prepare: Callable[[int], Tuple[Any, ...]] = lambda repetition: (),
    clock: Callable[[], float] = time.perf_counter,
) -> Measure:
    """A contender that is timed while it does `work` with what `prepare` gives; preparing is outside of the clock."""

    def measure(repetition: int) -> Duration:
        arguments = prepare(repetition)
        gc.collect()
        synchronize(device)
        start = clock()
        work(*arguments)
        synchronize(device)
        return Duration(clock() - start)

    return measure


def alternate(contenders: Dict[str, Measure], repeats: int, warm_up: bool = True) -> Dict[str, List[Duration]]:
    """Measures contenders in turn, A B A B …, so that a slow spell of the machine meets all of them.

    With `warm_up`, each runs once before, and that run doesn't count.
    """
    found: Dict[str, List[Duration]] = {name: [] for name in contenders}
    for repetition in range(-1 if warm_up else 0, repeats):
        for name, measure in contenders.items():
            duration = measure(repetition)
            if repetition >= 0:
                found[name].append(duration)
                limit = " and more" if duration.stopped else ""
                print(f"  {repetition + 1}/{repeats} {name}: {duration.seconds:.4g} s{limit}", flush=True)
    return found


@dataclass(frozen=True)
class Ratio:
    """How many times as long the peer took.

    Attributes:
        median: of the pairs.
        spread: smallest and largest of the pairs.
        at_least: a pair's peer was stopped, so that the true ratio is this or larger.
    """

    median: float
    spread: Tuple[float, float]
    at_least: bool = False


def ratio_of_pairs(peer: Sequence[Duration], ours: Sequence[Duration]) -> Ratio:
    """Compares two contenders pair by pair.

    Raises:
        ValueError: ours was stopped, which bounds nothing, or there are no pairs.
    """
    if any(duration.stopped for duration in ours):
        raise ValueError("a contender that never finished can't be what others are compared with")
    ratios = [theirs.seconds / mine.seconds for theirs, mine in zip(peer, ours, strict=True)]
    if not ratios:
        raise ValueError("there is nothing to compare")
    stopped = any(duration.stopped for duration in peer)
    return Ratio(statistics.median(ratios), (min(ratios), max(ratios)), stopped)


# ------------------------------------------------------------------------------------------------------------- memory


def in_fresh_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a function in a new interpreter, whose peak of memory is that of the function alone."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


# -------------------------------------------------------------------------------------------------------- environment


def git(*arguments: str) -> Optional[str]:
    """What git says of the repository; None where it says nothing."""
    try:
        return subprocess.run(
            ["git", "-C", str(ROOT), *arguments], check=True, capture_output=True, text=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def commit() -> Dict[str, Any]:
    """The commit that is checked out, and whether files differ from it. The results themselves don't count."""
    status = git("status", "--porcelain", "--", ".", f":(exclude){RESULTS.relative_to(ROOT)}")
    return {"commit": git("rev-parse", "HEAD"), "dirty": None if status is None else status != ""}


# ------------------------------------------------------------------------------------------------------------- report


class Report:
    """What one benchmark finds: every repetition, the rows of the table, and where and when.

    Args:
        name: of the benchmark's module.
        options: of its command line.
    """

    def __init__(self, name: str, options: Options) -> None:
        self.device = options.set_up()
        self.name, self.options = name, options
        self.load = OtherLoad()
        self.repetitions: Dict[str, Dict[str, Any]] = {}
        self.rows: List[Dict[str, Any]] = []
        self.extra: Dict[str, Any] = {}
        self.notes: List[str] = []
        print(f"{name} on {device_name(self.device)}, {options.num_threads} threads", flush=True)

    def measure(
        self, part: str, contenders: Dict[str, Measure], repeats: int, warm_up: bool = True
    ) -> Dict[str, List[Duration]]:
        """`alternate`, with every repetition recorded under the name of the part."""
        found = alternate(contenders, repeats, warm_up)
        self.repetitions[part] = {name: _listed(durations) for name, durations in found.items()}
        return found

    def add_row(self, name: str, what: str, against: str, ratio: Ratio, target: float, **more: Any) -> None:
        """Adds a line of the table: `against` took `ratio` times what `what` takes, and should take `target` times."""
        row = {"name": name, "what": what, "against": against, "device": device_name(self.device)}
        row.update(ratio=ratio.median, spread=list(ratio.spread), target=target)
        if ratio.at_least:
            row["at_least"] = True
        self.rows.append(row | more)

    def content(self) -> Dict[str, Any]:
        """What is written."""
        return {
            "benchmark": self.name,
            **commit(),
            "versions": versions(),
            "device": device_name(self.device),
            "matrix_products": "bfloat16" if multiplies_bfloat16(self.device) else "float32",
            "threads": self.options.num_threads,
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "quick": self.options.quick,
            "sample": self.options.sample,
            "load_of_others": self.load.record(),
            "note": " ".join(self.notes),
            **self.extra,
            "repetitions": self.repetitions,
            "rows": self.rows,
        }

    def write(self) -> Path:
        """Writes NAME.json, or NAME-cuda.json on a GPU, so that neither replaces the other."""
        suffix = "-cuda" if self.device.type == "cuda" else ""
        path = write_json(self.options.results / f"{self.name}{suffix}.json", self.content())
        print(f"Wrote {path}", flush=True)
        return path


def _listed(durations: Sequence[Duration]) -> Dict[str, Any]:
    columns = {key: [asdict(duration)[key] for duration in durations] for key in ("seconds", "stopped")}
    return columns if any(columns["stopped"]) else {"seconds": columns["seconds"]}


def write_json(path: Path, content: Any) -> Path:
    """Writes a file that is whole or not there.

    Raises:
        InputError: the folder can't be written to.
    """
    try:
        return write_whole(path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
    except OSError as error:
        raise InputError(f"{path} can't be written ({error.strerror}); name another --output-dir.") from error


def check_equal(ours: Tensor, peer: Tensor, what: str, tolerance: float) -> None:
    """Makes sure that contenders do the same work.

    Raises:
        RuntimeError: their results differ by more than `tolerance` times the largest of the peer's.
    """
    difference = ((ours - peer).abs().max() / peer.abs().max()).item()
    if not difference <= tolerance:
        raise RuntimeError(f"{what}: the contenders differ by {difference:.2g}, so timing them would say nothing")

"""This version against an earlier one of the package: iterations, pictures, and a whole scene in a painting's style.

The earlier version is a git worktree of it, named by --before. Each version works in a process of its own, and they
take turns. Both have the same coarse field, made by this version, and their methods' defaults otherwise. Without
--before, this version's seconds are measured alone.
"""

import contextlib
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, Optional, Tuple

import torch
import tyro

from benchmarks._measure import CACHE, ROOT, Duration, Measure, Options, Ratio, Report, ratio_of_pairs
from benchmarks._scene import BACKBONE, Scene, find_or_train_coarse, find_scene
from sparsestyle_ns.runs.coarse_run import CoarseRun
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error

WORKER = Path(__file__).with_name("_worker.py")
IN_WORDS = {
    "style_step": "one iteration of hier-style",
    "coarse_view": "a view of the coarse field",
    "style_view": "a stylised view, exact",
}
TARGETS = {"style_step": 3.0, "style_step_252": 3.5, "coarse_view": 6.0, "style_view": 2.0, "whole": 10.0}
WARM_COARSE_STEPS = 20
"""Iterations of stage 1 before those that are timed."""


@dataclass
class BeforeOptions(Options):
    """What this benchmark takes."""

    before: Optional[Path] = None
    """A git worktree of the earlier version; None: this version alone."""
    sides: Tuple[int, ...] = (252, 504)
    """Longer sides of the photos, in pixels, at which iterations are timed; pictures, and the whole, at the last."""
    whole: bool = True
    """Whether a whole hier-style, with its stage 1, is timed too."""


class Version:
    """A process with one version of the package, which does pieces of work when told.

    Args:
        tree: folder that has the package.
        task: what `_worker.py` works on.
    """

    def __init__(self, tree: Path, task: Dict[str, Any]) -> None:
        self.tree = tree
        environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": str(task["threads"])}
        # By its text, so that no folder but the version's comes before the installed packages.
        self.process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", WORKER.read_text(encoding="utf-8"), json.dumps(task)],
            cwd=tree,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, line: str) -> Dict[str, Any]:
        """The answer to a line; InputError where the process has ended."""
        try:
            self.process.stdin.write(line + "\n")
            self.process.stdin.flush()
            answer = self.process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            raise InputError(f"The version in {self.tree} couldn't do {line}; see the lines above.")
        return json.loads(answer)

    def does(self, work: str) -> Measure:
        """A contender that does a piece of work."""
        return lambda repetition: Duration(self.ask(work)["seconds"])

    def end(self) -> None:
        """Ends the process."""
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        self.process.wait()


def task_for(scene: Scene, coarse_state: Path, side: int, report: Report) -> Dict[str, Any]:
    """What both versions work on, at a size."""
    return {
        "scene": str(scene.folder.resolve()),
        "style_image": str(scene.style_image.resolve()),
        "backbone": BACKBONE,
        "coarse_state": str(coarse_state.resolve()),
        "side": max(32, side // 8) if report.options.quick else side,
        "device": report.device.type,
        "threads": report.options.num_threads,
        "quick": report.options.quick,
    }


def save_coarse(coarse: CoarseRun) -> Path:
    """The coarse field that both versions get: its state and its shape, in a file."""
    path = CACHE / "before" / "coarse.pt"
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = dataclasses.asdict(coarse.config.pipeline.model.coarse_field)
    shape.pop("_target", None)
    torch.save({"state": coarse.model_state(), "coarse_field": shape}, path)
    return path


def compare(versions: Dict[str, Version], side: int, is_last: bool, report: Report) -> None:
    """Times one size, and adds its rows."""
    size = "×".join(map(str, versions["ours"].ask("facts")["size"]))
    works = ["style_step", *(["coarse_view", "style_view"] if is_last else [])]
    for work in works:
        print(f"{IN_WORDS[work]}, {size}", flush=True)
        contenders = {name: version.does(work) for name, version in versions.items()}
        found = report.measure(f"{work}_{side}", contenders, report.options.repetitions(5))
        if "before" in found:
            ratio = ratio_of_pairs(found["before"], found["ours"])
            what = f"{IN_WORDS[work]}, {report.extra['scene']} at {size}"
            report.add_row(
                f"before_{work}_{side}", what, _earlier(report), ratio, TARGETS.get(f"{work}_{side}", TARGETS[work])
            )


def _earlier(report: Report) -> str:
    return f"this package at {str(report.extra['before_commit'])[:10]}"


def extrapolate(version: Version, report: Report) -> Dict[str, Any]:
    """Seconds of the earlier version's iterations, all of its defaults, from some of each kind; nothing else counts."""
    facts, repeats = version.ask("facts"), report.options.repetitions(5)
    for _ in range(2 if report.options.quick else WARM_COARSE_STEPS):
        version.ask("coarse_step")
    seconds = {
        work: [version.ask(work)["seconds"] for _ in range(repeats + 1)][1:]
        for work in ("coarse_step", "warm_start_step", "style_step")
    }
    counts = {
        "coarse_step": facts["coarse_iterations"],
        "warm_start_step": facts["warm_start_steps"],
        "style_step": facts["style_iterations"],
    }
    totals = {
        kind: sum(counts[work] * summary(seconds[work]) for work in counts)
        for kind, summary in (("median", statistics.median), ("least", min), ("most", max))
    }
    return {"iterations": counts, "seconds_an_iteration": seconds, "seconds": totals}


def time_whole(scene: Scene, side: int, report: Report) -> float:
    """Seconds of `ns-train hier-style` with all of its defaults, which trains stage 1 first, as a user starts it.

    Raises:
        InputError: it failed.
    """
    options = report.options
    with tempfile.TemporaryDirectory() as folder:
        command = ["-m", "nerfstudio.scripts.train", "hier-style", "--data", scene.folder, "--output-dir", folder]
        command += ["--style-image", scene.style_image, "--pipeline.backbone", BACKBONE]
        command += ["--max-image-side", str(max(32, side // 8) if options.quick else side)]
        command += ["--pipeline.datamanager.camera-res-scale-factor", "inf"]
        command += ["--machine.device-type", report.device.type, "--vis", "tensorboard"]
        command += ["--viewer.quit-on-train-completion", "True"]
        if options.quick:
            # Stage 1 has all of its iterations, so --quick takes a coarse run of a few.
            coarse = find_or_train_coarse(scene, options)
            command += ["--coarse-run", coarse.folder, "--max-num-iterations", "2", "--pipeline.warm-start-steps", "1"]
            command += ["--pipeline.model.log2-table-size", "12", "--pipeline.feature-side", "64"]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": str(options.num_threads)}
        start = time.perf_counter()
        command = [sys.executable, *map(str, command), "llff-data"]
        ended = subprocess.run(command, env=environment | {"PYTHONWARNINGS": "ignore"}, stdout=subprocess.DEVNULL)
        if ended.returncode != 0:
            raise InputError("hier-style couldn't be trained; see the lines above.")
        return time.perf_counter() - start


def compare_whole(versions: Dict[str, Version], scene: Scene, side: int, report: Report) -> None:
    """The whole of hier-style, with stage 1: ours measured, the earlier version's extrapolated."""
    print("The whole of hier-style, with stage 1", flush=True)
    size = "×".join(map(str, versions["ours"].ask("facts")["size"]))
    before = extrapolate(versions["before"], report) if "before" in versions else None
    for version in versions.values():
        version.end()  # its memory and threads are ours then
    ours = [time_whole(scene, side, report) for _ in range(report.options.repeats or 1)]
    print(f"  ours: {', '.join(f'{one:.0f} s' for one in ours)}", flush=True)
    report.extra["whole"] = {"size": size, "ours_seconds": ours, "before_extrapolated": before}
    if before is None:
        return
    totals, middle = before["seconds"], statistics.median(ours)
    print(f"  before, extrapolated: {totals['median']:.0f} s", flush=True)
    counts = " + ".join(f"{count:,}" for count in before["iterations"].values())
    ratio = Ratio(totals["median"] / middle, (totals["least"] / max(ours), totals["most"] / min(ours)))
    what = f"the whole of hier-style with its stage 1, {scene.name} at {size}: {middle:.0f} s"
    against = f"{_earlier(report)}, extrapolated: its seconds an iteration times {counts} iterations"
    report.add_row("before_whole", what, against, ratio, TARGETS["whole"])


def commit_of(tree: Path) -> Optional[str]:
    """The commit of a worktree; None where git doesn't say."""
    command = ["git", "-C", str(tree), "rev-parse", "HEAD"]
    found = subprocess.run(command, capture_output=True, text=True)
    return found.stdout.strip() if found.returncode == 0 else None


@exit_on_input_error
def main(options: BeforeOptions) -> None:
    """Times both versions.

    Raises:
        InputError: there is no such version, a size is missing, or one of them fails.
    """
    trees = {"ours": ROOT}
    if options.before is not None:
        trees["before"] = options.before.resolve()
        if not (trees["before"] / "sparsestyle_ns" / "__init__.py").is_file():
            raise InputError(f"--before {options.before} has no sparsestyle_ns; name a git worktree of this package.")
    if not options.sides or min(options.sides) < 32:
        raise InputError("--sides needs a size at least, of 32 pixels or more.")
    report = Report("before", options)
    scene = find_scene(options)
    coarse = find_or_train_coarse(scene, options)
    state = save_coarse(coarse)
    report.extra["scene"] = scene.name
    report.extra["coarse_field_iterations"] = coarse.config.max_num_iterations
    report.extra["before_commit"] = commit_of(trees["before"]) if "before" in trees else None
    report.notes.append(
        "Both versions with the defaults of coarse-fewshot and hier-style, on the same coarse field; iterations of "
        "stage 2 at the size that is named, none at a smaller one. The earlier version's whole is extrapolated from "
        "its seconds an iteration, without start, freezing, pictures on the way and files; ours is a whole command. "
        "The first of everything is a warm-up that doesn't count: for the coarse field's view that is also when this "
        "version measures the field's densities, once."
    )
    for side in options.sides:
        is_last = side == options.sides[-1]
        versions: Dict[str, Version] = {}
        try:
            for name, tree in trees.items():
                versions[name] = Version(tree, task_for(scene, state, side, report))
            compare(versions, side, is_last, report)
            if is_last and options.whole:
                compare_whole(versions, scene, side, report)
        finally:
            for version in versions.values():
                version.end()
    report.write()


if __name__ == "__main__":
    main(tyro.cli(BeforeOptions, description=__doc__))

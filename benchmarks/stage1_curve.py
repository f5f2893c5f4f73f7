"""What more iterations of stage 1 buy on views that it hasn't seen, against the time that they take; draws the curve.

The runs are finished ones of coarse-fewshot on one scene, each trained to an end of its own, however and wherever.
Their time is that of an iteration, measured here at the beginning and at the end of training, times their number.
"""

import copy
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List, Tuple

import tyro

from benchmarks._measure import RESULTS, ROOT, Options, Report, timed
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.runs.coarse_run import CoarseRun, read_coarse_run
from sparsestyle_ns.studies.run_figures import measure_coarse
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error

PLOT = ROOT / "docs" / "images" / "stage1_fern.png"
FIGURES = {"psnr": "PSNR, dB", "ssim": "SSIM", "st_lpips": "ST-LPIPS (lower is better)"}
ITERATIONS = 30
"""That are timed at once."""


@dataclass
class CurveOptions(Options):
    """What this benchmark takes."""

    runs: Tuple[Path, ...] = ()
    """Folders of the runs."""


def seconds_per_iteration(options: Options, run: CoarseRun) -> List[float]:
    """An iteration's seconds, of an untrained field and of the run's own."""
    device, found = options.set_up(), []
    for is_trained in (False, True):
        training = Training(copy.deepcopy(run.config), device)
        if is_trained:
            training.pipeline.model.load_state_dict(run.model_state())

        def iterations(training: Training = training) -> None:
            for _ in range(ITERATIONS):
                training.step()

        measure = timed(iterations, device)
        measure(0)
        found += [measure(repetition).seconds / ITERATIONS for repetition in range(options.repetitions(3))]
    return found


def plot(points: List[Dict[str, Any]], path: Path) -> None:
    """Each figure over minutes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(FIGURES), figsize=(11, 3.6), layout="constrained")
    for panel, (name, label) in zip(panels, FIGURES.items(), strict=True):
        minutes = [point["seconds"] / 60 for point in points]
        panel.plot(minutes, [point["figures"][name] for point in points], marker="o")
        for place, point in zip(minutes, points, strict=True):
            panel.annotate(
                f"{point['iterations']:,}", (place, point["figures"][name]), (4, -10), textcoords="offset points"
            )
        panel.set(xscale="log", xlabel="minutes (iterations beside the dots)", ylabel=label)
        panel.set_xticks(ticks := [0.5, 1, 2, 4, 8, 16, 32], [f"{tick:g}" for tick in ticks])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


@exit_on_input_error
def main(options: CurveOptions) -> None:
    """Measures each run on the held-out views, and what an iteration takes here."""
    if not options.runs:
        raise InputError("There is no run; name the folders of finished coarse-fewshot runs with --runs.")
    report, points = Report("stage1_curve", options), []
    for folder in options.runs:
        run = read_coarse_run(folder)
        if not run.is_finished:
            raise InputError(f"The run {folder} isn't finished; a curve is of runs with an end of their own.")
        seconds, iterations = seconds_per_iteration(options, run), run.config.max_num_iterations
        point = {"iterations": iterations, "seconds_per_iteration": seconds, "figures": measure_coarse(run.folder)}
        points.append({**point, "seconds": iterations * statistics.fmean(seconds)})
        print(f"  {iterations} iterations, {points[-1]['seconds']:.0f} s: {point['figures']}", flush=True)
    points.sort(key=lambda point: point["seconds"])
    report.extra["points"] = points
    report.notes.append(
        "Seconds are those of an iteration, measured here, times their number; without start and files."
    )
    path = report.write().with_suffix(".png")
    plot(points, PLOT if path.parent == RESULTS else path)


if __name__ == "__main__":
    main(tyro.cli(CurveOptions, description=__doc__))

"""How time and memory of stage 2 grow with the photos' size: an iteration, an exact view, and freezing. Ours alone.

Each cost of each size has a process of its own, whose peak memory is that of this work, with torch and the scene.
"""

import math
import statistics
from pathlib import Path
from typing import Any, Callable, Dict, List, Tuple

import torch
import tyro

from benchmarks._measure import RESULTS, ROOT, Options, Report, alternate, in_fresh_process, peak_bytes, timed
from benchmarks._scene import Scene, find_or_train_coarse, find_scene, style_config
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline
from sparsestyle_ns.runs.coarse_run import CoarseRun, read_coarse_run
from sparsestyle_ns.utils.errors import exit_on_input_error

SIDES = (126, 252, 504, 1008)
PLOT = ROOT / "docs" / "images" / "scaling_fern.png"
Prepared = Tuple[HierStylePipeline, Callable[[], Any]]


def prepare_step(config: Any, coarse: CoarseRun, device: torch.device) -> Prepared:
    """Whole iterations at the photos' size."""
    training = Training(config, device, coarse.model_state())
    return training.pipeline, training.step


def prepare_view(config: Any, coarse: CoarseRun, device: torch.device) -> Prepared:
    """Exact renders of a held-out view."""
    pipeline = _untrained(config, coarse, device)
    camera = pipeline.datamanager.eval_dataset.cameras[:1].to(device)
    return pipeline, lambda: pipeline.model.get_outputs_for_camera(camera)


def prepare_freezing(config: Any, coarse: CoarseRun, device: torch.device) -> Prepared:
    """Freezing all views, at the photos' size."""
    pipeline = _untrained(config, coarse, device)
    return pipeline, pipeline.freeze_views


def _untrained(config: Any, coarse: CoarseRun, device: torch.device) -> HierStylePipeline:
    pipeline = config.pipeline.setup(device=str(device), test_mode="val")
    pipeline.model.adopt_coarse(coarse.model_state())
    return pipeline.eval()


COSTS = {"step": prepare_step, "view": prepare_view, "freezing": prepare_freezing}
LABELS = {"step": "one iteration", "view": "one view, exact", "freezing": "freezing all views"}


def measure_cost(options: Options, scene: Scene, coarse_run: Path, side: int, cost: str) -> Dict[str, Any]:
    """Seconds of each repetition, the process's peak memory, and the size of a view."""
    device = options.set_up()
    coarse = read_coarse_run(coarse_run)
    config = style_config(scene, coarse, side, options, only_whole=True)
    config.pipeline.warm_start_steps = 0
    pipeline, work = COSTS[cost](config, coarse, device)
    found = alternate({f"{cost}, {side}": timed(work, device)}, options.repetitions(3))
    cameras = pipeline.datamanager.train_dataset.cameras
    return {
        "size": [int(cameras.width[0]), int(cameras.height[0])],
        "views": len(cameras),
        "seconds": [duration.seconds for durations in found.values() for duration in durations],
        "peak_bytes": peak_bytes(device),
    }


def plot(points: Dict[str, List[Dict[str, Any]]], path: Path) -> None:
    """Seconds, with bars from the fastest to the slowest repetition, and memory, over pixels; on logarithmic scales."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (times, memory) = pyplot.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    for cost, found in points.items():
        pixels = [math.prod(point["size"]) for point in found]
        middle = [statistics.median(point["seconds"]) for point in found]
        below = [center - min(point["seconds"]) for center, point in zip(middle, found, strict=True)]
        above = [max(point["seconds"]) - center for center, point in zip(middle, found, strict=True)]
        times.errorbar(pixels, middle, yerr=(below, above), marker="o", capsize=3, label=LABELS[cost])
        memory.plot(pixels, [point["peak_bytes"] / 1e9 for point in found], marker="o", label=LABELS[cost])
    for panel, label in ((times, "seconds"), (memory, "peak memory of the process, GB")):
        panel.set(xscale="log", yscale="log", xlabel="size of the photos", ylabel=label)
        panel.set_xticks(pixels, ["{} × {}".format(*point["size"]) for point in found])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    times.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


@exit_on_input_error
def main(options: Options) -> None:
    """Measures each cost at each size, the settings being those of hier-style, and draws what it finds."""
    report = Report("scaling", options)
    scene = find_scene(options)
    coarse = find_or_train_coarse(scene, options)
    points: Dict[str, List[Dict[str, Any]]] = {cost: [] for cost in COSTS}
    for side in SIDES[:2] if options.quick else SIDES:
        for cost, found in points.items():
            found.append(in_fresh_process(measure_cost, options, scene, coarse.folder, side, cost))
            print(f"  peak {found[-1]['peak_bytes'] / 1e9:.2f} GB", flush=True)
    report.extra["points"] = points
    report.notes.append(
        "Settings of hier-style, all iterations at the photos' size. Each cost of each size in a process of its own; "
        "its peak is resident memory on a CPU, what torch allocated on a GPU."
    )
    path = report.write().with_suffix(".png")
    plot(points, PLOT if path.parent == RESULTS else path)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

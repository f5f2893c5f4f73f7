"""How the costs of stage 2 grow with pixels, samples, views and levels of the hash grid. Ours alone, no peer."""

import math
import statistics
from pathlib import Path
from typing import Any, Callable, Dict, List, Tuple

import tyro

from benchmarks._measure import Options, Report, alternate, timed
from benchmarks._scene import find_or_train_coarse, find_scene, style_config
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.runs.coarse_run import CoarseRun
from sparsestyle_ns.utils.errors import exit_on_input_error

SIDE = 126
COSTS = {"step": "one iteration", "render": "one view, exact", "prepare": "freezing all views"}
LABELS = {
    "pixels": "pixels of a view",
    "samples": "steps along a ray",
    "views": "photos",
    "levels": "levels of the hash grid",
}


def set_side(config: Any, side: int) -> None:
    """Longer side of the photos."""
    config.pipeline.datamanager.max_image_side = side


def set_samples(config: Any, num_steps: int) -> None:
    """Steps along a ray."""
    config.pipeline.model.num_steps = num_steps


def set_views(config: Any, num_views: int) -> None:
    """Photos to stylise."""
    config.pipeline.datamanager.num_views = num_views


def set_levels(config: Any, hash_levels: int) -> None:
    """Levels of the hash grid."""
    config.pipeline.model.hash_levels = hash_levels


AXES: Dict[str, Tuple[Callable[[Any, int], None], Tuple[int, ...]]] = {
    "pixels": (set_side, (63, 126, 252, 504)),
    "samples": (set_samples, (32, 64, 128, 256)),
    "views": (set_views, (1, 2, 4, 8)),
    "levels": (set_levels, (2, 4, 8, 16)),
}


def measure_costs(config: Any, coarse: CoarseRun, report: Report) -> Dict[str, Any]:
    """Pixels of a view, what the views take in memory, and seconds of each repetition for each of `COSTS`."""
    training = Training(config, report.device, coarse.model_state())
    pipeline = training.pipeline
    camera = pipeline.datamanager.eval_dataset.cameras[:1].to(report.device)
    work = {
        "step": training.step,
        "render": lambda: pipeline.model.get_outputs_for_camera(camera),
        "prepare": pipeline.freeze_views,
    }
    measures = {name: timed(function, report.device) for name, function in work.items()}
    found = alternate(measures, report.options.repetitions(3))
    seconds: Dict[str, Any] = {name: [one.seconds for one in durations] for name, durations in found.items()}
    return {
        "pixels": math.prod(pipeline.datamanager.pixels.sizes[0]),
        "kept_bytes": sum(view.frozen.kept_bytes for view in pipeline.task.views),
        "seconds": seconds,
    }


def plot(points: Dict[str, List[Dict[str, Any]]], path: Path) -> None:
    """Draws medians, with bars from the fastest to the slowest repetition; both scales are logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(points), figsize=(4 * len(points), 3.6), sharey=True, layout="constrained")
    for panel, (axis, found) in zip(panels, points.items(), strict=True):
        values = [point["value"] for point in found]
        for cost, label in COSTS.items():
            seconds = [point["seconds"][cost] for point in found]
            middle = [statistics.median(one) for one in seconds]
            below = [center - min(one) for center, one in zip(middle, seconds, strict=True)]
            above = [max(one) - center for center, one in zip(middle, seconds, strict=True)]
            panel.errorbar(values, middle, yerr=(below, above), marker="o", capsize=3, label=label)
        panel.set(xscale="log", yscale="log", xlabel=LABELS[axis])
        panel.set_xticks(values, [f"{value:,}" for value in values], rotation=30)
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("seconds")
    panels[0].legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


@exit_on_input_error
def main(options: Options) -> None:
    """Measures along each axis, the others being those of hier-style, and draws what it finds."""
    report = Report("scaling", options)
    scene = find_scene(options)
    coarse = find_or_train_coarse(scene, options)
    points: Dict[str, List[Dict[str, Any]]] = {}
    for axis, (change, values) in AXES.items():
        for value in values[:1] if options.quick else values:
            config = style_config(scene, coarse, SIDE, options)
            config.pipeline.warm_start_steps = 0
            change(config, value)
            print(f"{axis}: {value}", flush=True)
            found = measure_costs(config, coarse, report)
            value = found["pixels"] if axis == "pixels" else value
            points.setdefault(axis, []).append({"value": value, **found})
    report.extra["settings"] = {"side": SIDE}
    report.extra["points"] = points
    report.notes.append(f"Each axis with the defaults of hier-style otherwise, photos of {SIDE} pixels.")
    plot(points, report.write().with_suffix(".png"))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

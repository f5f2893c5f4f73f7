"""The most memory that steps of hier-style take, each size in a process of its own."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List

import tyro

from benchmarks._measure import Options, Ratio, Report, in_fresh_process, peak_bytes
from benchmarks._scene import Scene, find_or_train_coarse, find_scene, style_config
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.runs.coarse_run import read_coarse_run
from sparsestyle_ns.utils.errors import exit_on_input_error

SIDES = (1008, 252)
LIMIT = 8_000_000_000


@dataclass
class MemoryOptions(Options):
    """What this benchmark takes."""

    cache_gigabytes: float = 1.0
    """What may be kept of the views between iterations (the setting of the same name)."""
    steps: int = 2
    """Iterations; the second has the optimiser's state too."""


def peak_of_steps(options: MemoryOptions, scene: Scene, coarse_run: Path, side: int) -> Dict[str, Any]:
    """Prepares a stylised run, does the steps, and says what they took."""
    device = options.set_up()
    coarse = read_coarse_run(coarse_run)
    config = style_config(scene, coarse, side, options)
    config.pipeline.cache_gigabytes = options.cache_gigabytes
    config.pipeline.warm_start_steps = 1
    training = Training(config, device, coarse.model_state())
    training.num_steps = training.pipeline.task.levels[-1].schedule.first  # the largest views take most
    for _ in range(options.steps):
        training.step()
    frozen = [view.frozen for view in training.pipeline.scene_views.views]
    height, width = training.pipeline.datamanager.pixels.sizes[0]
    return {
        "size": [width, height],
        "peak_bytes": peak_bytes(device),
        "kept_bytes": sum(view.kept_bytes for view in frozen),
        "views": len(frozen),
        "views_kept": sum(view.is_kept for view in frozen),
        "chunks": sum(view.num_chunks for view in frozen),
    }


@exit_on_input_error
def main(options: MemoryOptions) -> None:
    """Measures each size."""
    report = Report("memory", options)
    scene = find_scene(options)
    coarse = find_or_train_coarse(scene, options)
    report.notes.append(
        "Peaks are of the whole process: resident memory on a CPU, what torch allocated on a GPU. The ratio is the "
        "limit over the peak."
    )
    report.extra["settings"] = {"cache_gigabytes": options.cache_gigabytes, "steps": options.steps}
    report.extra["sizes"] = {}
    for side in SIDES:
        found: List[Dict[str, Any]] = [
            in_fresh_process(peak_of_steps, options, scene, coarse.folder, side) for _ in range(options.repeats or 1)
        ]
        width, height = found[0]["size"]
        peaks = sorted(one["peak_bytes"] for one in found)
        print(f"  {width}×{height}: {peaks[-1] / 1e9:.2f} GB", flush=True)
        report.extra["sizes"][f"{width}x{height}"] = found
        report.add_row(
            f"memory_{width}x{height}",
            f"peak memory of hier-style's steps, {scene.name} at {width}×{height}",
            f"{LIMIT / 1e9:g} GB",
            # The largest peak counts, not the middle one: a limit is for the worst.
            Ratio(LIMIT / peaks[-1], (LIMIT / peaks[-1], LIMIT / peaks[0])),
            1.0,
            bytes=peaks[-1],
            timed=False,
        )
    report.write()


if __name__ == "__main__":
    main(tyro.cli(MemoryOptions, description=__doc__))

"""One iteration of hier-style (rendering, losses, backward pass, optimiser) against the plain way to do it.

At the size of the photos: the iterations before, at half of it, are quicker.
"""

import tyro

from benchmarks._measure import Options, Report, ratio_of_pairs, timed
from benchmarks._scene import PLAIN_NOTE, PlainTraining, find_or_train_coarse, find_scene, style_config
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.utils.errors import exit_on_input_error

SIDE = 252
TARGET = 60.0


@exit_on_input_error
def main(options: Options) -> None:
    """Measures both."""
    report = Report("stage2_step", options)
    scene = find_scene(options)
    coarse = find_or_train_coarse(scene, options)
    config = style_config(scene, coarse, SIDE, options, only_whole=True)
    config.pipeline.warm_start_steps = 0
    ours = Training(config, report.device, coarse.model_state())
    plain = PlainTraining(ours)
    height, width = ours.pipeline.datamanager.pixels.sizes[0]

    measures = {"ours": timed(ours.step, report.device), "plain": timed(plain.step, report.device)}
    found = report.measure("step", measures, options.repetitions(6))
    views = ours.pipeline.scene_views.views
    report.extra["settings"] = {
        "size": [width, height],
        "views": len(views),
        "views_kept": sum(view.frozen.is_kept for view in views),
        "kept_bytes": sum(view.frozen.kept_bytes for view in views),
        "coarse_iterations": coarse.config.max_num_iterations,
    }
    report.notes.append(PLAIN_NOTE)
    report.add_row(
        "stage2_step",
        f"one step of hier-style, {scene.name} at {width}×{height}",
        "the plain way",
        ratio_of_pairs(found["plain"], found["ours"]),
        TARGET,
    )
    report.write()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

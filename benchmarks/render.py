"""Stylised views from new cameras, exact and baked, against the plain way.

The cameras are those of a flight from one held-out view to the next, as `ns-render interpolate` makes it. Baked
rendering keeps what it works out: its first picture is timed by itself, then it has a camera it hasn't seen in each
repetition, as the others have, and in the end the same ones once more, when all they need is there.
"""

from dataclasses import dataclass
from typing import Any, Dict, Tuple

import torch
import tyro
from nerfstudio.cameras.camera_paths import get_interpolated_camera_path
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from benchmarks._measure import Measure, Options, Report, ratio_of_pairs, timed
from benchmarks._scene import PLAIN_NOTE, Scene, find_or_train_coarse, find_scene, plain_field_of, style_config
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline
from sparsestyle_ns.rendering.look import RenderMode
from sparsestyle_ns.utils.errors import exit_on_input_error

SIDE = 252
FRAMES_BETWEEN_VIEWS = 10
"""As `ns-render interpolate` has them."""
EXACT_TARGET, BAKED_TARGET = 8.0, 50.0


@dataclass
class RenderOptions(Options):
    """What this benchmark takes."""

    style_iterations: int = 20
    """Iterations of the stylised run; it need not be finished, only be no coarse field any more."""


def stylise(options: RenderOptions, scene: Scene, device: torch.device) -> Tuple[HierStylePipeline, Dict[str, Any]]:
    """A pipeline that has been stylised for a few iterations, and its settings for the record."""
    coarse = find_or_train_coarse(scene, options)
    config = style_config(scene, coarse, SIDE, options)
    config.pipeline.warm_start_steps = min(config.pipeline.warm_start_steps, options.style_iterations)
    training = Training(config, device, coarse.model_state())
    iterations = 1 if options.quick else options.style_iterations
    for _ in range(iterations):
        training.step()
    training.pipeline.eval()
    settings = {
        "style_iterations": iterations,
        "coarse_iterations": coarse.config.max_num_iterations,
        "bake_resolution": config.pipeline.model.bake_resolution,
    }
    return training.pipeline, settings


@exit_on_input_error
def main(options: RenderOptions) -> None:
    """Stylises for a few iterations, then measures all three."""
    report = Report("render", options)
    scene = find_scene(options)
    pipeline, settings = stylise(options, scene, report.device)
    model, views = pipeline.model, pipeline.datamanager.eval_dataset.cameras
    plain = plain_field_of(model)
    del pipeline
    flight = get_interpolated_camera_path(views, FRAMES_BETWEEN_VIEWS, order_poses=False).to(report.device)
    pictures: Dict[Any, Tensor] = {}

    def contender(name: str, draw: Any) -> Measure:
        def work(repetition: int, camera: Cameras) -> None:
            pictures[name, repetition] = draw(camera)

        def prepare(repetition: int) -> Tuple[int, Cameras]:
            # The first picture and the warm-up come before repetition 0.
            frame = (repetition + 2) % len(flight)
            return repetition, flight[frame : frame + 1]

        return timed(work, report.device, prepare)

    def picture(camera: Cameras, mode: RenderMode) -> Tensor:
        with model.display.rendering(mode):
            return model.get_outputs_for_camera(camera)["rgb"]

    exact = contender("exact", lambda camera: picture(camera, "exact"))
    baked = contender("baked", lambda camera: picture(camera, "baked"))
    slow = contender("plain", plain.picture)

    first = baked(-2).seconds
    repeats = options.repetitions(6)
    found = report.measure("new_view", {"exact": exact, "baked": baked, "plain": slow}, repeats)
    again = report.measure("same_view_again", {"baked": baked}, repeats, warm_up=False)
    likeness = {
        name: sum(psnr(pictures[name, number], pictures["exact", number]) for number in range(repeats)) / repeats
        for name in ("baked", "plain")
    }

    height, width, _ = pictures["exact", 0].shape
    report.extra["settings"] = {"size": [width, height], **settings}
    report.extra["psnr_to_exact"] = likeness
    report.extra["first_baked_picture_seconds"] = first
    report.notes.append(PLAIN_NOTE + " Here it runs without gradients.")
    what, against = f"a stylised view of {scene.name} at {width}×{height}", "the plain way"
    ratio = ratio_of_pairs(found["plain"], found["exact"])
    report.add_row("render_exact", f"{what}, exact", against, ratio, EXACT_TARGET)
    baked_remarks = {"psnr_to_exact": likeness["baked"], "baking_seconds": first}
    for name, how, durations in (
        ("render_baked", "baked, a camera it hasn't seen", found["baked"]),
        ("render_baked_again", "baked, a camera it has seen", again["baked"]),
    ):
        ratio = ratio_of_pairs(found["plain"], durations)
        report.add_row(name, f"{what}, {how}", against, ratio, BAKED_TARGET, **baked_remarks)
    report.write()


if __name__ == "__main__":
    main(tyro.cli(RenderOptions, description=__doc__))

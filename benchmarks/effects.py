"""What each effect costs: the work that it is part of with it, against the same without it, on scenes made here.

Most rows are iterations of stage 1 (coarse-fewshot-draft) on a scene that calls for the effect. Space always has a
layout, so a layout is compared with the one that would take its place. Residual density is measured in rendering and
differentiating a stylised view, lens distortion in making all rays, palette transfer in reading the photos: work that
is done once.
"""

import dataclasses
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Dict, Tuple

import torch
import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from benchmarks._measure import CACHE, ROOT, Measure, Options, Report, device_name, ratio_of_pairs, timed
from benchmarks._scene import COARSE_METHOD
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.effects.registry import EFFECTS, decide
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager, gather_pixels
from sparsestyle_ns.style.palette import palette_of
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error

PARSERS: Dict[str, Callable[[], DataParserConfig]] = {
    "llff": LLFFDataParserConfig,
    "blender": BlenderDataParserConfig,
    "nerfstudio": NerfstudioDataParserConfig,
}
STAGE_1: Dict[str, Tuple[str, Tuple[str, ...], Dict[str, str], Dict[str, str]]] = {
    "ndc": ("llff", (), {"ndc": "on"}, {"contraction": "on"}),
    "box": ("blender", (), {"box": "on"}, {"contraction": "on"}),
    "contraction": ("nerfstudio", (), {"contraction": "on"}, {"box": "on"}),
    "background": ("blender", (), {"background": "on"}, {"background": "off"}),
    "view_color": ("llff", ("--shiny", "0.8"), {"view_color": "on"}, {"view_color": "off"}),
    "exposure": ("llff", ("--exposure", "0.5"), {"exposure": "on"}, {"exposure": "off"}),
    "matched_depth": ("llff", (), {"matched_depth": "on"}, {"matched_depth": "off"}),
    "pose_refinement": ("llff", (), {"pose_refinement": "on"}, {"pose_refinement": "off"}),
    "empty_space": ("llff", (), {"empty_space": "on"}, {"empty_space": "off"}),
}
"""By effect: the layout and options of the scene, and the settings with it and without."""


def make_scene(layout: str, flags: Tuple[str, ...], quick: bool) -> Path:
    """The folder of a scene by data_scripts/make_sample_scene.py, made where it isn't there yet.

    Raises:
        InputError: it couldn't be made.
    """
    width = "32" if quick else "126"
    folder = CACHE / "effects" / "-".join([width, *(flag.strip("-") for flag in flags)])
    if not (folder / layout).exists():
        script = str(ROOT / "data_scripts" / "make_sample_scene.py")
        sizes = ["--width", width, "--num-train", "20", "--num-val", "1", "--num-test", "1", "--supersample", "1"]
        command = [sys.executable, script, str(folder), "--layout", layout, *sizes, *flags]
        if subprocess.run(command).returncode != 0:
            raise InputError(f"The scene {folder / layout} couldn't be made; see the lines above.")
    return folder / layout


def config_of(method: str, layout: str, folder: Path, settings: Dict[str, str]) -> Any:
    """A method's config for a scene, with some effects set."""
    config = method_config(method)
    config.pipeline.datamanager.data, config.pipeline.datamanager.dataparser = folder, PARSERS[layout]()
    config.pipeline.effects = EffectSettings(**settings)
    if method == COARSE_METHOD:
        config.pipeline.model.refinement_start = 0.0  # what is timed is an iteration that learns cameras
    return config


def stage_1(name: str, report: Report) -> Dict[str, Measure]:
    """Iterations of stage 1 with an effect and without."""
    layout, flags, on, off = STAGE_1[name]
    folder = make_scene(layout, flags, report.options.quick)
    trainings = {
        word: Training(config_of(COARSE_METHOD, layout, folder, settings), report.device)
        for word, settings in (("with", on), ("without", off))
    }
    return {word: timed(training.step, report.device) for word, training in trainings.items()}


def photos(layout: str, flags: Tuple[str, ...], settings: Dict[str, str], report: Report) -> FewShotDataManager:
    """A scene's photos, with some effects set."""
    config = config_of(COARSE_METHOD, layout, make_scene(layout, flags, report.options.quick), settings).pipeline
    manager = config.datamanager.setup(device="cpu", test_mode="inference")
    manager.set_effects(decide(manager.scene, config.effects))
    return manager


def lens_distortion(report: Report) -> Dict[str, Measure]:
    """Making the rays of all training photos, for a lens that bends lines and for one that is taken as straight."""
    bent = ("nerfstudio", ("--distortion", "0.1"))
    managers = {
        word: photos(*bent, {"lens_distortion": choice}, report)
        for word, choice in (("with", "on"), ("without", "off"))
    }
    return {
        word: timed(lambda manager=manager: gather_pixels(manager.train_dataset, report.device), report.device)
        for word, manager in managers.items()
    }


def palette(report: Report) -> Dict[str, Measure]:
    """Reading the training photos, and then giving them another palette or not."""
    manager = photos("llff", (), {}, report)
    style = torch.rand(10_000, 3, generator=torch.Generator().manual_seed(0)).to(report.device)

    def read(transfer: bool) -> None:
        colors = gather_pixels(manager.train_dataset, report.device).colors
        if transfer:
            palette_of(colors, torch.ones_like(colors[:, 0]), style, "transport")(colors)

    return {"with": timed(lambda: read(True), report.device), "without": timed(lambda: read(False), report.device)}


def residual_density(report: Report) -> Dict[str, Measure]:
    """Rendering a photo's view of a stylised field that hasn't learned anything yet, and its gradients."""
    manager = photos("llff", (), {}, report)
    dataset, decision = manager.train_dataset, manager.effects["residual_density"]
    pixels = gather_pixels(dataset, report.device)
    origins, directions = pixels.origins[: pixels.starts[1]], pixels.directions[: pixels.starts[1]]

    def contender(on: bool) -> Measure:
        effects = manager.effects.replaced(dataclasses.replace(decision, on=on))
        settings = method_config("hier-style-draft").pipeline
        settings.settle_resolution(manager.photo_side)
        model = settings.model.setup(
            scene_box=dataset.scene_box, num_train_data=len(dataset), effects=effects, ndc=manager.scene.ndc
        )
        frozen = model.to(report.device).freeze(origins, directions)
        return timed(lambda: model.stylised(frozen).rgb.square().mean().backward(), report.device)

    return {"with": contender(True), "without": contender(False)}


@dataclass
class EffectOptions(Options):
    """What this benchmark takes."""

    only: Tuple[str, ...] = ()
    """Effects to time, by name; all where left out."""


@exit_on_input_error
def main(options: EffectOptions) -> None:
    """Measures the effects, in the order of their table.

    Raises:
        InputError: there is no such effect.
    """
    unknown = set(options.only) - EFFECTS.keys()
    if unknown:
        raise InputError(f"--only names {', '.join(sorted(unknown))}; the effects are {', '.join(EFFECTS)}.")
    report = Report("effects", options)
    special = {"lens_distortion": lens_distortion, "residual_density": residual_density, "palette": palette}
    for name in options.only or EFFECTS:
        print(name, flush=True)
        measures = special[name](report) if name in special else stage_1(name, report)
        found = report.measure(name, measures, options.repetitions(20))
        ratio = ratio_of_pairs(found["with"], found["without"])
        report.rows.append(
            {"name": name, "with_over_without": ratio.median, "spread": list(ratio.spread)}
            | {"device": device_name(report.device)}
        )
    for row in report.rows:
        low, high = row["spread"]
        print(f"{row['name']:>17} {row['with_over_without']:.2f} ({low:.2f} to {high:.2f})")
    report.write()


if __name__ == "__main__":
    main(tyro.cli(EffectOptions, description=__doc__))

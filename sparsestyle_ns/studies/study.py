"""What the comparison and the ablations share: their runs as settings, and what is measured of each.

A *kind* of stage 1 or stage 2 is a set of flags of ns-train. Everything is measured on frames of the measuring path,
and kept beside the run, so that a table is made again without rendering again.
"""

import json
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np
import torch
from PIL import Image

from sparsestyle_ns.core.camera_paths import measuring_path
from sparsestyle_ns.engine.loading import evaluate_run, load_run
from sparsestyle_ns.evaluation.held_out import saved_report, stylisation_figures
from sparsestyle_ns.evaluation.path_frames import PathFrames, render_path
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.metrics.art_fid import ArtFID, missing_weights
from sparsestyle_ns.metrics.gram import gram_matrix
from sparsestyle_ns.metrics.image import has_lpips, image_metrics
from sparsestyle_ns.runs.checkpoints import checkpoint_step, newest_checkpoint
from sparsestyle_ns.runs.run_folder import REPORT_FILE
from sparsestyle_ns.studies.experiments import Experiment, SceneSettings
from sparsestyle_ns.style.backbones import available_backbone
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import track

HIGH_FREQUENCIES = (
    *("--pipeline.model.coarse-field.num-levels", "10"),
    *("--pipeline.model.distortion-weight", "0"),
)
VANILLA = (*HIGH_FREQUENCIES, "--pipeline.model.coarse-field.num-layers", "8")
COARSE_KINDS: Dict[str, Tuple[str, ...]] = {
    "ours": (),
    "paper": ("--pipeline.model.distortion-weight", "0"),
    "vanilla": VANILLA,
    "dietnerf": (*VANILLA, "--pipeline.semantic-weight", "0.1"),
    "freenerf": (
        *HIGH_FREQUENCIES,
        *("--pipeline.model.frequency-reveal", "0.9"),
        *("--pipeline.model.occlusion-weight", "0.01"),
    ),
}
"""Stage 1: as it is; as the paper writes it, on colours alone; NeRF's ten octaves, eight layers, view dependence; the
same with a semantic loss of DietNeRF's kind; and ten octaves with FreeNeRF's regularisers."""
COLORS_ALONE = ("--pipeline.effects.view-color", "on", "--pipeline.effects.matched-depth", "off")
SCENE_KINDS: Dict[str, Tuple[str, ...]] = {
    "ours": (),
    "paper": COLORS_ALONE,
    "vanilla": COLORS_ALONE,
    "dietnerf": COLORS_ALONE,
    "freenerf": COLORS_ALONE,
}
"""What both stages have to be told of a kind of stage 1."""
FINE_TUNING = (
    *("--pipeline.model.stylised-field", "coarse"),
    *("--optimizers.fields.optimizer.lr", "5e-4"),
    *("--pipeline.loss-weights.content", "0.1", "--pipeline.content-decay", "1"),
    # A sample's activations take twice the memory that the residual field's do, and are all kept.
    *("--pipeline.samples-per-chunk", "131072"),
)


def constant_weight(weight: float) -> Tuple[str, ...]:
    """Flags for a content weight that stays as it is."""
    return ("--pipeline.loss-weights.content", f"{weight:g}", "--pipeline.content-decay", "1")


STYLE_KINDS: Dict[str, Tuple[str, ...]] = {
    "ours": (),
    "arf": FINE_TUNING,
    "ec-only": ("--pipeline.model.fine-encoding", "none"),
    "frequency": ("--pipeline.model.fine-encoding", "frequency"),
    "coarse-density": ("--pipeline.effects.residual-density", "off"),
    **{f"lambda-{weight:g}": constant_weight(weight) for weight in (10.0, 1.0, 0.1)},
}
"""Stage 2: as it is; the coarse field itself fine-tuned, as ARF does, at stage 1's learning rate and with the content
weight that ours ends with; and the paper's ablations."""
EVERY_LOSS = ("--logging.steps-per-log", "1")
"""Plots of the losses take those of every iteration."""
STOPS = (20, 100)
"""Iterations after which the paper shows what different content weights have done (Fig. 7 a)."""
MEASURED_FOLDER = "measured"
STYLE_EVERY = 4
"""Style and content are measured on every fourth frame of the path: neighbours say the same."""


@dataclass(frozen=True)
class Study:
    """The settings that all runs of a table share.

    Attributes:
        scene: its photos.
        draft: whether the methods are the drafts.
        coarse_flags: settings of all coarse runs, after their kind's.
        style_flags: settings of all stylised runs, after their kind's.
        coarse_iterations: of stage 1; None for the method's own.
        style_iterations: of stage 2; None for the method's own.
        backbone: the feature network of all runs, unless their flags name weights; None where there is none.
    """

    scene: SceneSettings
    draft: bool = False
    coarse_flags: Tuple[str, ...] = ()
    style_flags: Tuple[str, ...] = ()
    coarse_iterations: Optional[int] = None
    style_iterations: Optional[int] = None
    backbone: Optional[str] = field(default_factory=available_backbone)

    def coarse_kinds(self) -> Tuple[str, ...]:
        """The kinds of stage 1 that can be trained here: without weights of a feature network, not `dietnerf`."""
        found = self.backbone is not None or _names_weights(self.coarse_flags)
        return tuple(kind for kind in COARSE_KINDS if found or kind != "dietnerf")

    def _backbone_flags(self, flags: Sequence[str]) -> Tuple[str, ...]:
        """One network for all runs, whatever can be downloaded by the time that they begin."""
        return () if self.backbone is None or _names_weights(flags) else ("--backbone", self.backbone)

    def coarse(self, kind: str) -> Experiment:
        """The experiment of stage 1 of a kind."""
        method = "coarse-fewshot-draft" if self.draft else "coarse-fewshot"
        iterations = self.coarse_iterations or method_config(method).max_num_iterations
        network = self._backbone_flags(self.coarse_flags) if kind == "dietnerf" else ()
        flags = (*COARSE_KINDS[kind], *SCENE_KINDS[kind], *network, *self.coarse_flags)
        return Experiment(kind, method, iterations, flags)

    def stylised(self, painting: Path, style_kind: str = "ours", coarse_kind: str = "ours") -> Experiment:
        """The experiment of stage 2 of a kind, on a coarse field of a kind."""
        method = "hier-style-draft" if self.draft else "hier-style"
        iterations = self.style_iterations or method_config(method).max_num_iterations
        with_pictures = coarse_kind == "ours" and (style_kind == "ours" or style_kind.startswith("lambda-"))
        return Experiment(
            name=f"{coarse_kind}-{style_kind}-{painting.stem}",
            method=method,
            iterations=iterations,
            flags=(
                *STYLE_KINDS[style_kind],
                *SCENE_KINDS[coarse_kind],
                *EVERY_LOSS,
                *self._backbone_flags(self.style_flags),
                *self.style_flags,
            ),
            painting=painting,
            coarse=self.coarse(coarse_kind),
            stops=tuple(stop for stop in STOPS if stop < iterations) if with_pictures else (),
        )


def _names_weights(flags: Sequence[str]) -> bool:
    return any("vgg-weights" in flag.replace("_", "-") for flag in flags)


@dataclass
class Measured:
    """What a row of a table shows.

    Attributes:
        figures: as `PathFrames.figures` and `stylisation_figures` name them, and `unstylised_ssim`.
        pictures: PNG files of the path's first, middle and last frame.
        coarse_pictures: the same, unstylised.
    """

    figures: Dict[str, float]
    pictures: List[Path]
    coarse_pictures: List[Path] = field(default_factory=list)


class Painter:
    """A painting as the feature network of a study's runs sees it; loaded when it is first needed, and then kept."""

    def __init__(self, painting: Path) -> None:
        self.painting = painting
        self._targets: Optional[StyleTargets] = None
        self._gram: Optional[torch.Tensor] = None

    def figures(self, frames: PathFrames, settings: Any) -> Dict[str, float]:
        """Style strength and content kept, means over every `STYLE_EVERY`th frame, and ArtFID of all of these.

        Args:
            frames: the frames.
            settings: the pipeline's config of a run; it names network and sizes.
        """
        if self._targets is None:
            self._targets = replace(settings, style_image=self.painting).load_targets(torch.device("cpu"))
            self._gram = gram_matrix(self._targets.style_rows())
        values, art_fid = [], ArtFID.against(self._targets.style_image)
        for index in track(range(0, len(frames.stylised), STYLE_EVERY), "Style and content"):
            stylised, coarse = frames.stylised[index], frames.coarse[index]
            figures = stylisation_figures(
                self._targets, self._gram, coarse, stylised, frames.surfaces[index].covered.float()
            )
            values.append({**figures, "unstylised_ssim": image_metrics(stylised, coarse)["ssim"]})
            if art_fid is not None:
                art_fid.add(stylised, coarse)
        means = {key: sum(value[key] for value in values) / len(values) for key in values[0]}
        return means | ({} if art_fid is None else art_fid.figures())


def measure_run(folder: Path, painter: Painter) -> Measured:
    """What is measured of a stylised run; kept beside it and read again while its checkpoint is the same."""
    step = _newest_step(folder)
    known = _read(folder / MEASURED_FOLDER, step)
    if known is not None:
        return known
    config, pipeline, _ = load_run(folder / "config.yml")
    frames = render_path(pipeline.model, measuring_path(pipeline.datamanager.train_dataset.cameras))
    return _measure(folder / MEASURED_FOLDER, step, frames, painter, config.pipeline)


def measure_frames_of_2d(
    folder: Path, painter: Painter, stylised_by: Dict[str, Any], names: Sequence[str]
) -> Dict[str, Measured]:
    """What is measured of frames stylised in 2D, by names of `stylised_by`, on a run's unstylised frames.

    Args:
        folder: of the run that they are compared with; kept beside its own figures.
        painter: the painting.
        stylised_by: functions from a `PathFrames` to its stylised frames.
        names: those to measure.
    """
    step = _newest_step(folder)
    found = {name: _read(folder / f"{MEASURED_FOLDER}-{name}", step) for name in names}
    missing = [name for name, known in found.items() if known is None]
    if missing:
        config, pipeline, _ = load_run(folder / "config.yml")
        frames = render_path(pipeline.model, measuring_path(pipeline.datamanager.train_dataset.cameras))
        for name in missing:
            changed = PathFrames(stylised_by[name](frames), frames.coarse, frames.surfaces)
            target = folder / f"{MEASURED_FOLDER}-{name}"
            found[name] = _measure(target, step, changed, painter, config.pipeline)
    return {name: known for name, known in found.items() if known is not None}


def measure_coarse(folder: Path) -> Dict[str, float]:
    """A coarse run's figures on its held-out views, kept beside it."""
    known = saved_report(folder, _newest_step(folder))
    if known is not None and ("lpips" in known.means or not has_lpips()):
        return known.means
    return evaluate_run(folder / "config.yml", folder / REPORT_FILE).means


def _newest_step(folder: Path) -> int:
    checkpoint = newest_checkpoint(folder / "nerfstudio_models")
    assert checkpoint is not None, folder
    return checkpoint_step(checkpoint)


def _measure(folder: Path, step: int, frames: PathFrames, painter: Painter, settings: Any) -> Measured:
    figures = {**frames.figures(), **painter.figures(frames, settings)}
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    shown = (0, len(frames.stylised) // 2, len(frames.stylised) - 1)
    for place, index in enumerate(shown):
        save_png(frames.stylised[index], folder / f"stylised-{place}.png")
        save_png(frames.coarse[index], folder / f"coarse-{place}.png")
    # Last, so that a folder with figures is a whole one.
    write_whole(folder / "figures.json", json.dumps({"step": step, "figures": figures}, indent=1) + "\n")
    return Measured(figures, *_pictures(folder))


def _read(folder: Path, step: int) -> Optional[Measured]:
    """What was measured, if it is of that iteration and nothing can be measured by now that couldn't be then."""
    path = folder / "figures.json"
    try:
        content = json.loads(path.read_text()) if path.is_file() else {"step": None}
    except ValueError:  # no JSON
        return None
    if content["step"] != step:
        return None
    figures = content["figures"]
    if not ("art_fid" in figures or missing_weights()) or ("short_lpips" not in figures and has_lpips()):
        return None
    return Measured(figures, *_pictures(folder))


def _pictures(folder: Path) -> Tuple[List[Path], List[Path]]:
    return tuple(sorted(folder.glob(f"{name}-*.png")) for name in ("stylised", "coarse"))


def save_png(picture: torch.Tensor, path: Path) -> None:
    """Saves a picture [H, W, 3] in [0, 1]."""
    pixels = (picture.detach().cpu().clamp(0.0, 1.0) * 255.0).round().numpy().astype(np.uint8)
    Image.fromarray(pixels).save(path)


def picture_after(folder: Path, iterations: int) -> Path:
    """Where the picture of a run after so many iterations is."""
    return folder / f"after-{iterations}.png"


@torch.no_grad()
def save_picture_after(folder: Path, iterations: int) -> None:
    """Renders a run's present state from the middle of the measuring path."""
    _, pipeline, _ = load_run(folder / "config.yml")
    path = measuring_path(pipeline.datamanager.train_dataset.cameras)
    middle = len(path) // 2
    with pipeline.model.rendering("exact"):
        outputs = pipeline.model.get_outputs_for_camera(path[middle : middle + 1].to(pipeline.device))
    save_png(outputs["rgb"], picture_after(folder, iterations))


def loss_traces(folder: Path) -> Dict[str, Tuple[List[int], List[float]]]:
    """Iterations and values of `content` and `style` (the losses of Eq. 5, without λ) as a run wrote them down.

    An iteration that was done twice, before and after an interruption, counts as it was done last.
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    traces = {}
    for name in ("content", "style"):
        last = {event.step: event.value for event in events.Scalars(f"Train Metrics Dict/{name}")}
        traces[name] = (sorted(last), [last[step] for step in sorted(last)])
    return traces

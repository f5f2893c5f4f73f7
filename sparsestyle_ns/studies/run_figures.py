"""What is measured of a run. Everything is kept beside it, so that a table is made again without rendering again."""

import json
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Callable, Dict, List, Mapping, Optional, Tuple

import torch
from jaxtyping import Float
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor
from torchvision.utils import save_image

from sparsestyle_ns.core.camera_paths import measuring_path
from sparsestyle_ns.engine.loading import evaluate_run, load_run
from sparsestyle_ns.evaluation.held_out import PathFrames, render_path, saved_report, stylisation_figures
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.metrics.art_fid import ArtFID, missing_weights
from sparsestyle_ns.metrics.image import gram_matrix, has_lpips, image_metrics
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.runs.checkpoints import checkpoint_step, newest_checkpoint
from sparsestyle_ns.runs.run_folder import REPORT_FILE
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import track

OWN_FRAMES = ""
"""Names the frames that a run itself renders."""
STYLE_EVERY = 4
"""Style and content are measured on every fourth frame of the path: neighbours say the same."""

Stylise = Callable[[PathFrames], List[Float[Tensor, "H W 3"]]]
"""Makes stylised frames of a path's unstylised ones."""
Trace = Tuple[List[int], List[float]]
"""Iterations, and the values of a loss there."""


@dataclass
class RunFigures:
    """What a row of a table shows.

    Attributes:
        figures: as `PathFrames.figures` and `stylisation_figures` name them, and `unstylised_ssim`.
        pictures: PNG files of the path's first, middle and last frame.
        coarse_pictures: the same, unstylised.
    """

    figures: Dict[str, float]
    pictures: List[Path]
    coarse_pictures: List[Path] = field(default_factory=list)


class PaintingMeasure:
    """A painting as the feature network of a study's runs sees it; loaded when it is first needed, and then kept."""

    def __init__(self, painting: Path) -> None:
        self.painting = painting
        self._targets: Optional[StyleTargets] = None
        self._gram: Optional[Tensor] = None

    def figures(self, frames: PathFrames, settings: HierStylePipelineConfig) -> Dict[str, float]:
        """Style strength and content kept, means over every `STYLE_EVERY`th frame, and ArtFID of all of these.

        Args:
            frames: the frames.
            settings: the pipeline's config of a run; it names network and sizes.
        """
        if self._targets is None:
            settings = replace(settings, style_image=self.painting)
            self._targets = settings.targets_of(*settings.load_style(), torch.device("cpu"))
            self._gram = gram_matrix(self._targets.style_rows())
        values, art_fid = [], ArtFID.against(self._targets.style_image)
        for index in track(range(0, len(frames.stylised), STYLE_EVERY), "Style and content"):
            stylised, coarse = frames.stylised[index], frames.coarse[index]
            covered = frames.surfaces[index].covered.float()
            figures = stylisation_figures(self._targets, self._gram, coarse, stylised, covered)
            values.append({**figures, "unstylised_ssim": image_metrics(stylised, coarse)["ssim"]})
            if art_fid is not None:
                art_fid.add(stylised, coarse)
        means = {key: sum(value[key] for value in values) / len(values) for key in values[0]}
        return means | ({} if art_fid is None else art_fid.figures())


def measure_run(folder: Path, painting: PaintingMeasure) -> RunFigures:
    """What is measured of a stylised run, on the measuring path."""
    return measure_frames(folder, painting, {OWN_FRAMES: lambda frames: frames.stylised})[OWN_FRAMES]


def measure_frames(
    folder: Path, painting: PaintingMeasure, stylised_by: Mapping[str, Stylise]
) -> Dict[str, RunFigures]:
    """What is measured of frames that are stylised in several ways, by the ways' names; known figures are read again.

    Args:
        folder: of the run whose unstylised frames and geometry all are compared with.
        painting: the painting.
        stylised_by: what makes the frames.
    """
    checkpoint = newest_checkpoint(folder / "nerfstudio_models")
    assert checkpoint is not None, folder
    step = checkpoint_step(checkpoint)
    targets = {name: folder / ("measured" + (f"-{name}" if name else "")) for name in stylised_by}
    missing = [name for name, target in targets.items() if read_figures(target, step) is None]
    if missing:
        config, pipeline, _ = load_run(folder / "config.yml")
        frames = render_path(pipeline.model, measuring_path(pipeline.datamanager.train_dataset.cameras))
        for name in missing:
            changed = replace(frames, stylised=stylised_by[name](frames))
            figures = {**changed.figures(), **painting.figures(changed, config.pipeline)}
            _save_figures(targets[name], step, changed, figures)
    found = {name: read_figures(target, step) for name, target in targets.items()}
    return {name: figures for name, figures in found.items() if figures is not None}


def _save_figures(folder: Path, step: int, frames: PathFrames, figures: Mapping[str, float]) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for place, index in enumerate((0, len(frames.stylised) // 2, len(frames.stylised) - 1)):
        save_picture(frames.stylised[index], folder / f"stylised-{place}.png")
        save_picture(frames.coarse[index], folder / f"coarse-{place}.png")
    # Last, so that a folder with figures is a whole one.
    write_whole(folder / "figures.json", json.dumps({"step": step, "figures": figures}, indent=1) + "\n")


def read_figures(folder: Path, step: int) -> Optional[RunFigures]:
    """What was measured, if it is of that iteration and nothing can be measured by now that couldn't be then."""
    try:
        content = json.loads((folder / "figures.json").read_text())
    except (OSError, ValueError):  # there is none, or it was cut short
        return None
    figures = content["figures"]
    has_all = ("art_fid" in figures or missing_weights()) and ("short_lpips" in figures or not has_lpips())
    if content["step"] != step or not has_all:
        return None
    return RunFigures(figures, *(sorted(folder.glob(f"{name}-*.png")) for name in ("stylised", "coarse")))


def measure_coarse(folder: Path) -> Dict[str, float]:
    """A coarse run's figures on its held-out views, kept beside it."""
    checkpoint = newest_checkpoint(folder / "nerfstudio_models")
    known = None if checkpoint is None else saved_report(folder, checkpoint_step(checkpoint))
    if known is not None and ("lpips" in known.means or not has_lpips()):
        return known.means
    return evaluate_run(folder / "config.yml", folder / REPORT_FILE).means


def save_picture(picture: Float[Tensor, "H W 3"], path: Path) -> None:
    """Saves a picture in [0, 1]."""
    save_image(picture.detach().cpu().permute(2, 0, 1), path)


def loss_traces(folder: Path) -> Dict[str, Trace]:
    """`content` and `style` (the losses of Eq. 5, without λ) of a run's iterations, as it logged them.

    An iteration that was done twice, before and after an interruption, counts as it was done last.
    """
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    traces = {}
    for name in ("content", "style"):
        last = {event.step: event.value for event in events.Scalars(f"Train Metrics Dict/{name}")}
        traces[name] = (sorted(last), [last[step] for step in sorted(last)])
    return traces

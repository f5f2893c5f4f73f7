"""What is measured of a run. Everything is kept beside it, so that a table is made again without rendering again."""

import functools
import itertools
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Callable, Dict, List, Optional, Sequence, Tuple

import torch
from jaxtyping import Float
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor
from torchvision.utils import save_image

from sparsestyle_ns.core.camera_paths import measuring_path
from sparsestyle_ns.engine.loading import evaluate_run, load_run
from sparsestyle_ns.evaluation.held_out import PathFrames, StyleFigures, render_path, saved_report
from sparsestyle_ns.metrics.art_fid import ArtFID, missing_weights
from sparsestyle_ns.metrics.image import has_lpips
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.runs.checkpoints import CHECKPOINT_FOLDER, checkpoint_step, newest_checkpoint
from sparsestyle_ns.runs.run_folder import REPORT_FILE
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import track

FIGURES_FILE = "figures.json"
STYLE_EVERY = 4
"""Style and content are measured on every fourth frame of the path: neighbours say the same."""

Stylise = Callable[[PathFrames], Sequence[Float[Tensor, "H W 3"]]]
"""Makes stylised frames of a path's unstylised ones."""
Trace = Tuple[List[int], List[float]]
"""Iterations, and the values of a loss there."""


@dataclass
class RunFigures:
    """What a row of a table shows."""

    figures: Dict[str, float]
    """As `PathFrames.figures` and `StyleFigures` name them."""
    pictures: List[Path]
    """PNG files of the path's first, middle and last frame."""
    coarse_pictures: List[Path] = field(default_factory=list)
    """The same, unstylised."""


class PaintingMeasure:
    """A painting as the feature network of a study's runs sees it; loaded when it is first needed, and then kept."""

    def __init__(self, painting: Path) -> None:
        self.painting = painting
        self._style: Optional[StyleFigures] = None

    def figures(self, frames: PathFrames, settings: HierStylePipelineConfig) -> Dict[str, float]:
        """Means over some frames of style strength and content kept, and their ArtFID; by a run's network and sizes."""
        if self._style is None:
            settings, side = replace(settings, style_image=self.painting), max(frames.stylised[0].shape[:2])
            self._style = StyleFigures(settings.targets_of(*settings.load_style(), torch.device("cpu"), side))
        values, art_fid = [], ArtFID.against(self._style.targets.style_image)
        for index in track(range(0, len(frames.stylised), STYLE_EVERY), "Style and content"):
            stylised, coarse = frames.stylised[index], frames.coarse[index]
            covered = frames.surfaces[index].covered.float()
            values.append(self._style.of(coarse, stylised, covered))
            if art_fid is not None:
                art_fid.add(stylised, coarse)
        means = {key: sum(value[key] for value in values) / len(values) for key in values[0]}
        return means | ({} if art_fid is None else art_fid.figures())


def measure_run(
    folder: Path, painting: PaintingMeasure, way: str = "", stylise: Optional[Stylise] = None, strength: float = 1.0
) -> RunFigures:
    """What is measured of a stylised run on the measuring path; known figures are read again.

    With the name of a way, and `stylise` for it, of frames stylised so in place of the run's own; with a strength below
    1, of frames that show only so much of the style.
    """
    way = way or ("" if strength == 1.0 else f"strength-{strength:g}")
    step = checkpoint_step(newest_checkpoint(folder / CHECKPOINT_FOLDER))
    target = _free_for(folder / (f"measured-{way}" if way else "measured"), step)
    known = read_figures(target, step)
    if known is not None:
        return known
    settings, frames = _render(folder, step, strength)
    if stylise is not None:
        frames = replace(frames, stylised=stylise(frames))
    figures = {**frames.figures(), **painting.figures(frames, settings)}
    target.mkdir(exist_ok=True)
    for place, index in enumerate((0, len(frames.stylised) // 2, len(frames.stylised) - 1)):
        for name, pictures in (("stylised", frames.stylised), ("coarse", frames.coarse)):
            save_image(pictures[index].detach().cpu().permute(2, 0, 1), target / f"{name}-{place}.png")
    # Last, so that a folder with figures is a whole one.
    write_whole(target / FIGURES_FILE, json.dumps({"step": step, "figures": figures}, indent=1) + "\n")
    return RunFigures(figures, *_pictures(target))


def _free_for(folder: Path, step: int) -> Path:
    """A folder for what is measured of an iteration: this one, unless it has figures of another, which stay there."""
    try:
        taken = json.loads((folder / FIGURES_FILE).read_text())["step"] != step
    except (OSError, ValueError, KeyError, TypeError):
        taken = False
    return folder.with_name(f"{folder.name}-{step:09d}") if taken else folder


@functools.lru_cache(maxsize=1)
def _render(folder: Path, _step: int, strength: float) -> Tuple[HierStylePipelineConfig, PathFrames]:
    config, pipeline, _ = load_run(folder / "config.yml")
    display = pipeline.model.display
    if strength != 1.0:
        display.own = replace(display.own, mix=display.own.mix._replace(strength=strength))
    return config.pipeline, render_path(pipeline.model, measuring_path(pipeline.datamanager.train_dataset.cameras))


def _pictures(folder: Path) -> List[List[Path]]:
    return [sorted(folder.glob(f"{name}-*.png")) for name in ("stylised", "coarse")]


def read_figures(folder: Path, step: int) -> Optional[RunFigures]:
    """What was measured, if it is of that iteration and nothing can be measured by now that couldn't be then."""
    try:
        content = json.loads((folder / FIGURES_FILE).read_text())
    except (OSError, ValueError):  # there is none, or it was cut short
        return None
    figures = content["figures"]
    has_all = ("art_fid" in figures or missing_weights()) and ("short_lpips" in figures or not has_lpips())
    return RunFigures(figures, *_pictures(folder)) if content["step"] == step and has_all else None


def measure_coarse(folder: Path) -> Dict[str, float]:
    """A coarse run's figures on its held-out views, kept beside it."""
    known = saved_report(folder, checkpoint_step(newest_checkpoint(folder / CHECKPOINT_FOLDER)))
    if known is not None and ("lpips" in known.means or not has_lpips()):
        return known.means
    return evaluate_run(folder / "config.yml", folder / REPORT_FILE).means


def _logged(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    return events.Reload()


def iteration_times(folder: Path) -> Dict[int, float]:
    """Seconds that a run's iterations took, by their number; of a run that logs every one, without the first."""
    logged = sorted((event.step, event.wall_time) for event in _logged(folder).Scalars("Train Metrics Dict/style"))
    return {step: end - start for (before, start), (step, end) in itertools.pairwise(logged) if step == before + 1}


def loss_traces(folder: Path) -> Dict[str, Trace]:
    """`content` and `style` (the losses of Eq. 5, without λ) of a run's iterations, as it logged them.

    An iteration that was done twice, before and after an interruption, counts as it was done last.
    """
    events, traces = _logged(folder), {}
    for name in ("content", "style"):
        last = {event.step: event.value for event in events.Scalars(f"Train Metrics Dict/{name}")}
        traces[name] = (sorted(last), [last[step] for step in sorted(last)])
    return traces

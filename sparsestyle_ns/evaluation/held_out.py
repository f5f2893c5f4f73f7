"""What a run is worth on the views it hasn't seen: how true the coarse field is, how stylised the stylised one."""

import json
import statistics
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Dict, List, Optional, Sequence, Union

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor
from torchvision.utils import save_image

from sparsestyle_ns.core.camera_paths import measuring_path
from sparsestyle_ns.core.occupancy import interval_lengths
from sparsestyle_ns.core.precision import autocast
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.core.volrend import dense_weights, effective_samples, optical_depth
from sparsestyle_ns.evaluation.path_frames import render_path
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.metrics.art_fid import ArtFID
from sparsestyle_ns.metrics.image import gram_distance, gram_matrix, image_metrics, psnr
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.runs.run_folder import REPORT_FILE
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import track

EVEN_SAMPLES = 64
"""Even samples a ray on which `mean_effective_samples` counts: the number means something only with this one."""
MIN_ACCUMULATION = 0.5
"""Rays with less weight than this show background, and have no surface to be sharp."""


@dataclass
class HeldOutReport:
    """What was measured of a run."""

    means: Dict[str, float]
    """Over the held-out views, and for a stylised run those over pairs of the measuring path."""
    views: List[Dict[str, float]]
    """The held-out views' own values."""
    rays: List[int] = field(default_factory=list)
    """Each view's pixels; not in a file."""
    seconds: List[float] = field(default_factory=list)
    """How long each view took to render; not in a file."""

    def deviations(self) -> Dict[str, float]:
        """As `…_std`, the standard deviations between views; nothing of what fewer than two views have."""
        found = by_figure(self.views)
        return {f"{key}_std": statistics.stdev(values) for key, values in found.items() if len(values) > 1}

    def speed(self) -> Dict[str, float]:
        """`num_rays_per_sec` and `fps`, means over the views."""
        rates = [rays / seconds for rays, seconds in zip(self.rays, self.seconds, strict=True)]
        fps = statistics.fmean(1.0 / seconds for seconds in self.seconds)
        return {"num_rays_per_sec": statistics.fmean(rates), "fps": fps}

    def save(self, path: Path, experiment: str, method: str, step: int) -> None:
        """Writes JSON in the layout of `ns-eval`, with the views' own values beside the means."""
        run = {"experiment_name": experiment, "method_name": method, "step": step}
        write_whole(path, json.dumps({**run, "results": self.means, "views": self.views}, indent=2) + "\n")


def saved_report(folder: Path, step: int) -> Optional[HeldOutReport]:
    """The report in a run's folder, where there is one of the checkpoint of iteration `step`."""
    try:
        content = json.loads((folder / REPORT_FILE).read_text())
        return HeldOutReport(content["results"], list(content["views"])) if content["step"] == step else None
    except (OSError, ValueError, KeyError, TypeError):  # there is none, or another file has its name
        return None


def by_figure(views: Sequence[Dict[str, float]]) -> Dict[str, List[float]]:
    """Each figure's values, of the views that have it."""
    names = dict.fromkeys(name for view in views for name in view)
    return {name: [view[name] for view in views if name in view] for name in names}


@torch.no_grad()
def evaluate_held_out(
    model: Union[CoarseFewShotModel, HierStyleModel],
    views: InputDataset,
    training_cameras: Cameras,
    targets: Optional[StyleTargets] = None,
    baked: bool = False,
    picture_folder: Optional[Path] = None,
) -> HeldOutReport:
    """Evaluates a model on views that it hasn't seen, and on the measuring path.

    Coarse model: `psnr` in dB, `ssim`, `lpips` and `st_lpips` where there are weights, and `effective_samples`.
    Stylised model: the same of the coarse field with the prefix `coarse_`; `content_ssim`; with `targets` what
    `stylisation_figures` gives and, where there are weights for it, `art_fid` of all views, with photos as content; and
    the consistency of frames on the measuring path (`PathFrames.figures`), where there are the two training cameras
    that it takes. All of these are of exact renders.

    Args:
        model: in evaluation.
        views: photos and their cameras.
        training_cameras: those that the measuring path leads through.
        targets: the painting's features, for a stylised model.
        baked: whether a stylised model's baked renders are held against the exact ones as well (`baked_psnr`, in dB).
        picture_folder: where to save the views as pictures, beside their photos; None for nowhere.
    """
    style = None if isinstance(model, CoarseFewShotModel) else _StyleMeasure(model, targets, baked)
    values, rays, seconds = [], [], []
    for index in track(range(len(views)), "Held-out views"):
        camera = views.cameras[index : index + 1].to(model.device)
        photo = views[index]["image"][..., :3]
        start = time.perf_counter()
        outputs = exact_outputs(model, camera)
        seconds.append(time.perf_counter() - start)
        rays.append(photo.shape[0] * photo.shape[1])
        if style is not None:
            values.append(style.view(outputs, photo, camera))
        else:
            effective = mean_effective_samples(model, camera)
            extra = {} if effective is None else {"effective_samples": effective}
            values.append({**image_metrics(outputs["rgb"], photo), **extra})
        if picture_folder is not None:
            picture_folder.mkdir(parents=True, exist_ok=True)
            _, pictures = model.get_image_metrics_and_images(outputs, {"image": photo})
            for name, picture in pictures.items():
                save_image(picture.permute(2, 0, 1).cpu(), picture_folder / f"eval_{name}_{index:04d}.png")
    means = {key: statistics.fmean(found) for key, found in by_figure(values).items()}
    if style is not None:
        if style.art_fid is not None:
            means.update(style.art_fid.figures())
        if len(training_cameras) > 1:
            means.update(render_path(model, measuring_path(training_cameras)).figures())
    return HeldOutReport(means, values, rays, seconds)


class _StyleMeasure:
    """What is measured of a stylised model's views."""

    def __init__(self, model: HierStyleModel, targets: Optional[StyleTargets], baked: bool) -> None:
        self.model, self.targets, self.baked = model, targets, baked
        self.style_gram = None if targets is None else gram_matrix(targets.style_rows())
        self.art_fid = None if targets is None else ArtFID.against(targets.style_image)

    def view(self, outputs: Dict[str, Tensor], photo: Tensor, camera: Cameras) -> Dict[str, float]:
        model, coarse, stylised = self.model, outputs["rgb_coarse"], outputs["rgb"]
        values = {f"coarse_{key}": value for key, value in image_metrics(coarse, photo).items()}
        values["content_ssim"] = image_metrics(stylised, photo)["ssim"]
        if self.targets is not None:
            covered = None if model.background is None else outputs["accumulation"].squeeze(-1)
            values.update(stylisation_figures(self.targets, self.style_gram, coarse, stylised, covered))
        if self.art_fid is not None:
            self.art_fid.add(stylised, photo)
        if self.baked:
            with model.display.rendering("baked"):
                values["baked_psnr"] = psnr(model.get_outputs_for_camera(camera)["rgb"], stylised)
        return values


def exact_outputs(model: Union[CoarseFewShotModel, HierStyleModel], camera: Cameras) -> Dict[str, Tensor]:
    """A camera's outputs, of a stylised run in exact rendering whatever its own mode is; a coarse run has no other."""
    if isinstance(model, CoarseFewShotModel):
        return model.get_outputs_for_camera(camera)
    with model.display.rendering("exact"):
        return model.get_outputs_for_camera(camera)


def stylisation_figures(
    targets: StyleTargets,
    style_gram: Float[Tensor, "C C"],
    coarse: Float[Tensor, "H W 3"],
    stylised: Float[Tensor, "H W 3"],
    accumulation: Optional[Float[Tensor, "H W"]],
) -> Dict[str, float]:
    """How strong the style of a view is, before and after stylising, and how far its content has moved.

    `style_loss` is the nearest neighbour feature matching of Eq. 5, `content_loss` the distance of features (Eq. 5)
    from the unstylised view, and any other loss of `targets` likewise `NAME_loss`; `gram_distance` is that of
    `metrics.image`. All but the content loss come with their value for the unstylised view, as `…_before`. With
    `accumulation`, only where the scene covers the picture: a background can't be stylised.
    """
    content = targets.features(coarse)
    figures = {}
    for suffix, picture in (("_before", coarse), ("", stylised)):
        view = targets.view(picture, content, accumulation)
        losses = targets.losses(view)
        figures.update({f"{name}_loss{suffix}": float(value) for name, value in losses.items()})
        figures[f"gram_distance{suffix}"] = float(gram_distance(gram_matrix(view.features), style_gram))
    figures.pop("content_loss_before", None)
    return figures


@torch.no_grad()
def mean_effective_samples(model: CoarseFewShotModel, camera: Cameras) -> Optional[float]:
    """Mean of `effective_samples` over a view's rays that meet a surface, on `EVEN_SAMPLES` even samples.

    None where no ray does: JSON has no word for a mean of nothing.
    """
    rays = camera.generate_rays(camera_indices=0, keep_shape=False).flatten()
    counts = []
    for start in range(0, len(rays), model.config.eval_num_rays_per_chunk):
        part = rays[start : start + model.config.eval_num_rays_per_chunk]
        segments = model.space.segments(part.origins, part.directions)
        edges = even_edges(len(part), EVEN_SAMPLES, model.device)
        with autocast(model.device, model.config.precision):
            density, _ = model.field.density_and_feature(segments.positions(0.5 * (edges[:, 1:] + edges[:, :-1])))
        weights = dense_weights(optical_depth(density, interval_lengths(segments, edges, model.space.unbounded)))
        counts.append(effective_samples(weights)[weights.sum(dim=-1) > MIN_ACCUMULATION])
    found = torch.cat(counts)
    return float(found.mean()) if len(found) else None

"""What a run is worth on the views it hasn't seen: how true the coarse field is, how stylised the stylised one."""

import json
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torchvision.utils import save_image

from sparsestyle_ns.core.camera_paths import measuring_path
from sparsestyle_ns.core.occupancy import interval_lengths
from sparsestyle_ns.core.precision import autocast
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.core.volrend import dense_weights, effective_samples, optical_depth
from sparsestyle_ns.evaluation.path_frames import render_path
from sparsestyle_ns.losses.stylization import StyleTargets, covered_rows
from sparsestyle_ns.metrics.art_fid import ArtFID
from sparsestyle_ns.metrics.gram import gram_distance, gram_matrix
from sparsestyle_ns.metrics.image import image_metrics, psnr
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.pipelines.base import CheckedPipeline
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.runs.run_folder import REPORT_FILE, load_run
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.progress import track

EVEN_SAMPLES = 64
"""Even samples a ray on which `mean_effective_samples` counts: the number means something only with this one."""
MIN_ACCUMULATION = 0.5
"""Rays with less weight than this show background, and have no surface to be sharp."""


@dataclass
class HeldOutReport:
    """What was measured of a run.

    Attributes:
        means: means over the held-out views, and for a stylised run those over pairs of the measuring path.
        views: the held-out views' own values.
        rays: each view's pixels.
        seconds: how long each view took to render.
    """

    means: Dict[str, float]
    views: List[Dict[str, float]]
    rays: List[int]
    seconds: List[float]

    def deviations(self) -> Dict[str, float]:
        """As `…_std`, the standard deviations between views; nothing of what fewer than two views have."""
        found = by_figure(self.views)
        return {f"{key}_std": statistics.stdev(values) for key, values in found.items() if len(values) > 1}

    def speed(self) -> Dict[str, float]:
        """`num_rays_per_sec` and `fps`, means over the views."""
        rates = [rays / seconds for rays, seconds in zip(self.rays, self.seconds, strict=True)]
        return {
            "num_rays_per_sec": statistics.fmean(rates),
            "fps": statistics.fmean(1.0 / seconds for seconds in self.seconds),
        }

    def save(self, path: Path, experiment: str, method: str, step: int) -> None:
        """Writes JSON in the layout of `ns-eval`, with the views' own values beside the means.

        Raises:
            OSError: it can't be written.
        """
        content = {
            "experiment_name": experiment,
            "method_name": method,
            "step": step,
            "results": self.means,
            "views": self.views,
        }
        write_whole(path, json.dumps(content, indent=2) + "\n")


def by_figure(views: Sequence[Dict[str, float]]) -> Dict[str, List[float]]:
    """Each figure's values, of the views that have it."""
    names = dict.fromkeys(name for view in views for name in view)
    return {name: [view[name] for view in views if name in view] for name in names}


@dataclass
class SavedReport:
    """What a report on the disk says.

    Attributes:
        means: see `HeldOutReport`.
        num_views: held-out views that they are means of.
    """

    means: Dict[str, float]
    num_views: int


def saved_report(folder: Path, step: int) -> Optional[SavedReport]:
    """The report in a run's folder, where there is one of the checkpoint of iteration `step`."""
    try:
        content = json.loads((folder / REPORT_FILE).read_text())
        return SavedReport(content["results"], len(content["views"])) if content["step"] == step else None
    except (OSError, ValueError, KeyError, TypeError):  # there is none, or another file has its name
        return None


@torch.no_grad()
def evaluate_held_out(
    pipeline: CheckedPipeline,
    targets: Optional[StyleTargets] = None,
    baked: bool = False,
    picture_folder: Optional[Path] = None,
) -> HeldOutReport:
    """Evaluates a loaded run of either method on all views of its evaluation split, and on the measuring path.

    Coarse run: `psnr` in dB, `ssim`, `lpips` and `st_lpips` where there are weights, and `effective_samples`. Stylised
    run: the same of the coarse field with the prefix `coarse_`; `content_ssim`; with `targets` what
    `stylisation_figures` gives and, where there are weights for it, `art_fid` of all views, with photos as content; and
    the consistency of frames on the measuring path (`PathFrames.figures`), where there are the two training cameras
    that it takes. All of these are of exact renders.

    Args:
        pipeline: in the state in which `eval_setup` leaves it.
        targets: the painting's features, for a stylised run.
        baked: whether a stylised run's baked renders are held against the exact ones as well (`baked_psnr`, in dB).
        picture_folder: where to save the views as pictures, beside their photos; None for nowhere.
    """
    model, views, rays, seconds = pipeline.model, [], [], []
    dataset = pipeline.datamanager.eval_dataset
    style_gram = None if targets is None else gram_matrix(targets.style_rows())
    art_fid = None if targets is None else ArtFID.against(targets.style_image)
    for index in track(range(len(dataset)), "Held-out views"):
        camera = dataset.cameras[index : index + 1].to(model.device)
        photo = dataset[index]["image"][..., :3]
        start = time.perf_counter()
        outputs = exact_outputs(model, camera)
        seconds.append(time.perf_counter() - start)
        rays.append(photo.shape[0] * photo.shape[1])
        if isinstance(model, CoarseFewShotModel):
            values = image_metrics(outputs["rgb"], photo)
            effective = mean_effective_samples(model, camera)
            values.update({} if effective is None else {"effective_samples": effective})
        else:
            values = {f"coarse_{key}": value for key, value in image_metrics(outputs["rgb_coarse"], photo).items()}
            values["content_ssim"] = image_metrics(outputs["rgb"], photo)["ssim"]
            if targets is not None:
                accumulation = None if model.background is None else outputs["accumulation"].squeeze(-1)
                values.update(
                    stylisation_figures(targets, style_gram, outputs["rgb_coarse"], outputs["rgb"], accumulation)
                )
            if art_fid is not None:
                art_fid.add(outputs["rgb"], photo)
            if baked:
                with model.rendering("baked"):
                    values["baked_psnr"] = psnr(model.get_outputs_for_camera(camera)["rgb"], outputs["rgb"])
        if picture_folder is not None:
            picture_folder.mkdir(parents=True, exist_ok=True)
            _, pictures = model.get_image_metrics_and_images(outputs, {"image": photo})
            for name, picture in pictures.items():
                save_image(picture.permute(2, 0, 1).cpu(), picture_folder / f"eval_{name}_{index:04d}.png")
        views.append(values)
    means = {key: sum(values) / len(values) for key, values in by_figure(views).items()}
    if art_fid is not None:
        means.update(art_fid.figures())
    training_cameras = pipeline.datamanager.train_dataset.cameras
    if isinstance(model, HierStyleModel) and len(training_cameras) > 1:
        means.update(render_path(model, measuring_path(training_cameras)).figures())
    return HeldOutReport(means, views, rays, seconds)


def exact_outputs(model: Any, camera: Any) -> Dict[str, Tensor]:
    """A camera's outputs, of a stylised run in exact rendering whatever its own mode is; a coarse run has no other."""
    if isinstance(model, CoarseFewShotModel):
        return model.get_outputs_for_camera(camera)
    with model.rendering("exact"):
        return model.get_outputs_for_camera(camera)


def stylisation_figures(
    targets: StyleTargets,
    style_gram: Float[Tensor, "768 768"],
    coarse: Float[Tensor, "H W 3"],
    stylised: Float[Tensor, "H W 3"],
    accumulation: Optional[Float[Tensor, "H W"]],
) -> Dict[str, float]:
    """How strong the style of a view is, before and after stylising, and how far its content has moved.

    `style_loss` is the nearest neighbour feature matching of Eq. 5 and `gram_distance` that of `style_strength`, each
    with its value for the unstylised view as `…_before`; `content_loss` is the distance of features (Eq. 5) from the
    unstylised view. With `accumulation`, only where the scene covers the picture: a background can't be stylised.
    """
    content = targets.features(coarse)
    values = {}
    for suffix, picture in (("_before", coarse), ("", stylised)):
        style, moved = targets.losses(picture, content, accumulation)
        gram = gram_matrix(covered_rows(targets.features(picture), accumulation))
        values[f"style_loss{suffix}"] = float(style)
        values[f"gram_distance{suffix}"] = float(gram_distance(gram, style_gram))
    return {**values, "content_loss": float(moved)}


@torch.no_grad()
def mean_effective_samples(model: CoarseFewShotModel, camera: Any) -> Optional[float]:
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


def evaluate_run(
    config_path: Path, output_path: Path, style_image: Optional[Path] = None, baked: bool = False
) -> HeldOutReport:
    """Loads a run, evaluates it, and writes the report.

    Args:
        config_path: the run's config.yml.
        output_path: JSON file to write.
        style_image: painting to measure against; None for the one the run was made with. Where that file is gone, the
            style losses are left out.
        baked: whether to measure a stylised run's baked renders as well.

    Raises:
        InputError: the run has no checkpoint.
    """
    config, pipeline, step = load_run(config_path)
    if isinstance(config.pipeline, HierStylePipelineConfig):
        config.pipeline.style_image = style_image or config.pipeline.style_image
    report = evaluate_held_out(pipeline, pipeline.painting(), baked)
    report.save(output_path, config.experiment_name, config.method_name, step)
    return report

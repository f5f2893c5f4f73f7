"""What a run is worth on the views it hasn't seen: how true the coarse field is, how stylised the stylised one."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List, Optional

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.models.base_model import Model
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from rich.progress import track
from torch import Tensor

from sparsestyle_ns.evaluation.image_metrics import image_metrics, psnr
from sparsestyle_ns.files import write_whole
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import RenderMode
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.rendering.compositing import dense_weights, effective_samples, optical_depth
from sparsestyle_ns.rendering.density_grid import interval_lengths
from sparsestyle_ns.rendering.precision import autocast
from sparsestyle_ns.rendering.sampling import even_edges
from sparsestyle_ns.run_folder import load_run
from sparsestyle_ns.style.targets import StyleTargets

EVEN_SAMPLES = 64
"""Even samples a ray on which `mean_effective_samples` counts: the number means something only with this one."""
MIN_ACCUMULATION = 0.5
"""Rays with less weight than this show background, and have no surface to be sharp."""


@dataclass
class HeldOutReport:
    """Means over the held-out views, and the values of each view."""

    means: Dict[str, float]
    views: List[Dict[str, float]]

    def save(self, path: Path, experiment: str, method: str, step: int) -> None:
        """Writes JSON in the layout of `ns-eval`, with the views' own values beside the means."""
        content = {
            "experiment_name": experiment,
            "method_name": method,
            "step": step,
            "results": self.means,
            "views": self.views,
        }
        write_whole(path, json.dumps(content, indent=2) + "\n")


@torch.no_grad()
def evaluate_held_out(
    pipeline: VanillaPipeline, targets: Optional[StyleTargets] = None, baked: bool = False
) -> HeldOutReport:
    """Evaluates a loaded run of either method on all views of its evaluation split.

    Coarse run: `psnr` in dB, `ssim`, `lpips` where its weights exist, and `effective_samples`. Stylised run: the same
    of the coarse field with the prefix `coarse_`, `content_ssim`, and with `targets` the style loss of the coarse and
    the stylised render (`style_loss_before`, `style_loss`), and `content_loss` against the coarse render. All of these
    are of exact renders.

    Args:
        pipeline: in the state in which `eval_setup` leaves it.
        targets: the painting's features, for a stylised run.
        baked: whether a stylised run's baked renders are held against the exact ones as well (`baked_psnr`, in dB).
    """
    model, views = pipeline.model, []
    dataset = pipeline.datamanager.eval_dataset
    for index in track(range(len(dataset)), description="Held-out views"):
        camera = dataset.cameras[index : index + 1].to(model.device)
        photo = dataset[index]["image"][..., :3]
        outputs = rendered(model, camera, "exact")
        if isinstance(model, CoarseFewShotModel):
            values = image_metrics(outputs["rgb"], photo)
            values["effective_samples"] = mean_effective_samples(model, camera)
        else:
            values = {f"coarse_{key}": value for key, value in image_metrics(outputs["rgb_coarse"], photo).items()}
            values["content_ssim"] = image_metrics(outputs["rgb"], photo)["ssim"]
            if targets is not None:
                accumulation = None if model.background is None else outputs["accumulation"].squeeze(-1)
                losses = stylisation_losses(targets, outputs["rgb_coarse"], outputs["rgb"], accumulation)
                values.update(losses)
            if baked:
                values["baked_psnr"] = psnr(rendered(model, camera, "baked")["rgb"], outputs["rgb"])
        views.append(values)
    means = {key: sum(view[key] for view in views) / len(views) for key in views[0]}
    return HeldOutReport(means, views)


def rendered(model: Model, camera: Cameras, mode: RenderMode) -> Dict[str, Tensor]:
    """A camera's outputs in a render mode, whatever the model's own is; a coarse run has one."""
    if isinstance(model, CoarseFewShotModel):
        return model.get_outputs_for_camera(camera)
    before, model.render_mode.value = model.render_mode.value, mode
    try:
        return model.get_outputs_for_camera(camera)
    finally:
        model.render_mode.value = before


def stylisation_losses(
    targets: StyleTargets,
    coarse: Float[Tensor, "H W 3"],
    stylised: Float[Tensor, "H W 3"],
    accumulation: Optional[Float[Tensor, "H W"]],
) -> Dict[str, float]:
    """Style loss of a view before and after stylising, and the content loss against the view before.

    With `accumulation`, only where the scene covers the picture: a background can't be stylised.
    """
    content = targets.features(coarse)
    before, _ = targets.losses(coarse, content, accumulation)
    after, moved = targets.losses(stylised, content, accumulation)
    return {"style_loss_before": float(before), "style_loss": float(after), "content_loss": float(moved)}


@torch.no_grad()
def mean_effective_samples(model: CoarseFewShotModel, camera: Any) -> float:
    """Mean of `effective_samples` over a view's rays that meet a surface, on `EVEN_SAMPLES` even samples."""
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
    return float(torch.cat(counts).mean())


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
    targets = None
    settings = config.pipeline
    if isinstance(settings, HierStylePipelineConfig):
        settings.style_image = style_image or settings.style_image
        if settings.style_image is not None and settings.style_image.is_file():
            targets = settings.load_targets(pipeline.device)
    report = evaluate_held_out(pipeline, targets, baked)
    report.save(output_path, config.experiment_name, config.method_name, step)
    return report

"""What the gallery shows of a run: its files, renders of it, a film, and what was measured of it."""

from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from sparsestyle_ns.data.photos import PhotoDataset, at_size
from sparsestyle_ns.data.view_selection import evenly_spaced
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.evaluation.held_out import SavedReport, exact_outputs, saved_report
from sparsestyle_ns.evaluation.tables import report_tables
from sparsestyle_ns.gallery.film import as_pixels, make_film
from sparsestyle_ns.gallery.page import Picture, RunPictures, View, read_film
from sparsestyle_ns.runs.run_folder import REPORT_FILE, STYLE_METHOD, find_config
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.page import Pixels
from sparsestyle_ns.utils.progress import say, track

LONGEST_SIDE = 512
"""Pixels that a picture on the page has at most along its longer side."""


def collect_run(
    config_path: Path, video: Optional[Path] = None, num_views: int = 3, frames: int = 48, evaluate: bool = False
) -> RunPictures:
    """Loads a stylised run, renders what the page shows of it, and finds out what was measured of it.

    Args:
        config_path: the run's config.yml, or its folder. The run may have been moved since it was made.
        video: an MP4 file to show instead of a film that is made here.
        num_views: held-out views to render, evenly spaced; fewer where there are fewer.
        frames: of the film; 0 for none.
        evaluate: whether to measure the run as `sparsestyle evaluate` does, where its folder has no report of its
            newest checkpoint; the report is then left there, if that can be. Without one, the views that are shown are
            measured.

    Raises:
        InputError: it isn't a finished run of this package, its photos are gone, or the video can't be read.
    """
    config_path = find_config(config_path, STYLE_METHOD)
    film = None if video is None else read_film(video)
    if num_views < 1:
        raise InputError(f"--num-views is {num_views}; at least one view is needed.")
    config, pipeline, step = load_run(config_path)
    dataset, held_out = pipeline.datamanager.train_dataset, pipeline.datamanager.eval_dataset
    originals = _at_full_size(dataset)
    photos = [Picture(_photo(originals, index), path.name) for index, path in enumerate(originals.image_filenames)]
    views, measured = _render_views(pipeline, held_out, num_views)
    if film is None and frames > 0:
        film = make_film(pipeline.model, dataset.cameras, frames, LONGEST_SIDE)
    report = saved_report(config_path.parent, step)
    if report is None and evaluate:
        made = pipeline.held_out_report()
        report = SavedReport(made.means, len(made.views))
        try:
            made.save(config_path.parent / REPORT_FILE, config.experiment_name, config.method_name, step)
        except OSError as error:
            say(f"{REPORT_FILE} can't be left in {config_path.parent} ({error.strerror}); its figures are on the page.")
    painting = config.pipeline.style_image
    return RunPictures(
        name=Path(config.experiment_name).name,
        subtitle=f"{config.method_name}, {len(photos)} photos, {step + 1} iterations",
        photos=photos,
        views=views,
        style_name="" if painting is None else painting.stem,
        style=_style_picture(painting),
        style_note=f"The style image, {painting}, is no longer there.",
        film=film,
        figures=_figures(measured),
        tables=[] if report is None else report_tables(report.means, report.num_views),
        settings=_settings(config, dataset, step),
        effects=pipeline.effects.rows(),
    )


def _render_views(pipeline: Any, dataset: PhotoDataset, num_views: int) -> Tuple[List[View], List[Dict[str, float]]]:
    """Held-out views with their photos, and what the model measures of each."""
    trained = set(pipeline.datamanager.train_dataset.image_filenames)
    originals = _at_full_size(dataset)
    views, measured = [], []
    for index in track(evenly_spaced(len(dataset), min(num_views, len(dataset))), "Views"):
        path = dataset.image_filenames[index]
        photo = _photo(originals, index)
        height, width = photo.shape[:2]
        camera = at_size(originals.cameras[index : index + 1], *torch.tensor([width, height]).view(2, 1, 1))
        camera = camera.to(pipeline.device)
        camera.distortion_params = dataset.cameras[index : index + 1].distortion_params
        with torch.no_grad():
            outputs = exact_outputs(pipeline.model, camera)
            metrics, _ = pipeline.model.get_image_metrics_and_images(
                outputs, {"image": torch.from_numpy(photo).to(pipeline.device) / 255.0}
            )
        measured.append(metrics)
        views.append(
            View(
                name=f"{'Training view' if path in trained else 'Held-out view'} {path.name}",
                stylised=as_pixels(outputs["rgb"].cpu().numpy()),
                coarse=as_pixels(outputs["rgb_coarse"].cpu().numpy()),
                photo=photo,
                depth=depth_picture(outputs["depth"].cpu().numpy(), outputs["accumulation"].cpu().numpy()),
            )
        )
    return views, measured


def depth_picture(depth: Float[np.ndarray, "H W 1"], accumulation: Float[np.ndarray, "H W 1"]) -> Pixels:
    """Depth as shades, near light and far dark, with the background in the middle grey of nothing.

    The shade is linear in 1 / depth, between the 2nd and the 98th percentile of what is seen, so that a far wall
    doesn't take all shades from the things before it.
    """
    nearness = 1.0 / np.maximum(depth[..., 0], 1e-6)
    weight = np.clip(accumulation, 0.0, 1.0)
    seen = nearness[weight[..., 0] > 0.5]
    far, near = np.percentile(seen, (2, 98)) if seen.size else (0.0, 1.0)
    share = np.clip((nearness - far) / max(near - far, 1e-9), 0.0, 1.0)[..., None]
    dark, light = np.array([0.10, 0.13, 0.22]), np.array([0.98, 0.93, 0.82])
    middle = np.array([0.72, 0.38, 0.30])
    shade = np.where(share < 0.5, dark + (middle - dark) * 2 * share, middle + (light - middle) * (2 * share - 1))
    return as_pixels(shade * weight + 0.5 * (1.0 - weight))


def _at_full_size(dataset: PhotoDataset) -> PhotoDataset:
    """The same photos at the size of their files, where the run was trained on smaller ones."""
    return PhotoDataset(dataset._dataparser_outputs)


def _photo(dataset: PhotoDataset, index: int) -> Pixels:
    """A photo of a dataset, at most 512 pixels along its longer side."""
    return _fitted(Image.fromarray(dataset.get_image_uint8(index)[..., :3].numpy()))


def _fitted(image: Image.Image) -> Pixels:
    image.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.LANCZOS)
    return np.array(image)


def _style_picture(path: Optional[Path]) -> Optional[Picture]:
    if path is None:
        return None
    try:
        image = Painting.read(path).pixels
    except InputError:
        return None
    return Picture(_fitted(Image.fromarray(as_pixels(image.permute(1, 2, 0).numpy()))), path.name)


FIGURE_LABELS = {
    "coarse_psnr": ("Coarse PSNR", "{:.2f} dB"),
    "coarse_ssim": ("Coarse SSIM", "{:.3f}"),
    "coarse_lpips": ("Coarse LPIPS", "{:.3f}"),
    "content_ssim": ("Stylised SSIM to photo", "{:.3f}"),
}


def _figures(measured: Sequence[Dict[str, float]]) -> List[Tuple[str, str]]:
    """Means over the views of what the model measured, and over how many."""
    figures = []
    for key, (label, form) in FIGURE_LABELS.items():
        values = [metrics[key] for metrics in measured if key in metrics]
        if values:
            figures.append((label, form.format(sum(values) / len(values))))
    if figures:
        figures.append(("Mean of", f"{len(measured)} view" + "s" * (len(measured) > 1)))
    return figures


def _settings(config: Any, dataset: Any, step: int) -> List[Tuple[str, str]]:
    pipeline = config.pipeline
    height, width = int(dataset.cameras.height[0]), int(dataset.cameras.width[0])
    weight = pipeline.loss_weights["content"]
    return [
        ("Method", config.method_name),
        ("Made", config.timestamp),
        ("Views trained on", ", ".join(map(str, dataset.metadata["scene_info"].view_ids))),
        ("Photo size in training", f"{width} × {height} pixels"),
        ("Iterations", f"{step + 1} of {config.max_num_iterations}"),
        ("Coarse run", "none" if pipeline.coarse_run is None else pipeline.coarse_run.name),
        ("Style image", "none" if pipeline.style_image is None else pipeline.style_image.name),
        ("Feature network", pipeline.backbone if pipeline.vgg_weights is None else pipeline.vgg_weights.name),
        ("Size it sees views at", f"{pipeline.feature_side} pixels"),
        (
            "Content weight λ",
            f"{weight:g} to {weight * pipeline.content_decay:g} in {pipeline.content_steps} iterations",
        ),
        ("Warm start", f"{pipeline.warm_start_steps} steps"),
    ]

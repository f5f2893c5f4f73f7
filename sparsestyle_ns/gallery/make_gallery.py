"""`sparsestyle gallery`: what its page shows of runs is their files, renders, films, and what was measured of them."""

from itertools import zip_longest
from pathlib import Path
from typing import Dict, List, Optional, Sequence, Tuple

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.engine.trainer import TrainerConfig

from sparsestyle_ns.data.photos import PhotoDataset, at_size
from sparsestyle_ns.data.view_selection import evenly_spaced
from sparsestyle_ns.engine.hints import finish
from sparsestyle_ns.engine.loading import LoadedRun, load_run
from sparsestyle_ns.evaluation.held_out import HeldOutReport, exact_outputs, means_of, saved_report
from sparsestyle_ns.evaluation.tables import Table, report_tables, table_of
from sparsestyle_ns.gallery.film import as_pixels, make_film, read_film
from sparsestyle_ns.gallery.gallery_options import GalleryOptions
from sparsestyle_ns.gallery.layout import Film, Picture, RunPictures, View, gallery_page, thumbnail
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline, HierStylePipelineConfig
from sparsestyle_ns.runs.run_folder import REPORT_FILE, STYLE_METHOD, find_config
from sparsestyle_ns.runs.scene_record import ExpectedScene
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import free_path, write_output
from sparsestyle_ns.utils.page import Pixels
from sparsestyle_ns.utils.progress import say, track

LONGEST_SIDE = 512
"""Pixels that a picture on the page has at most along its longer side."""


def make_gallery(options: GalleryOptions) -> None:
    """Writes the page, from checked options, and says where it is; `InputError` if a run or a video can't be used."""
    films = list(map(read_film, options.video))  # rendering takes minutes, so what can fail before does
    runs = []
    for run, film in zip_longest(options.runs, films):
        say(f"Showing {run}")
        runs.append(collect_run(run, film, options.num_views, options.frames, options.evaluate))
    page = write_output(options.output_path, gallery_page(runs, options.title), "The page", "index.html")
    first = find_config(options.runs[0]).parent
    finish(page, ["sparsestyle", "export", first, "--format", "html", "--output-path", free_path(Path("scene.html"))])


def collect_run(
    run: Path, film: Optional[Film] = None, num_views: int = 3, frames: int = 48, evaluate: bool = False
) -> RunPictures:
    """Loads a stylised run, renders what the page shows of it, and finds out what was measured of it.

    Raises an `InputError` if it isn't a finished run of this package, or its photos are gone.

    Args:
        run: its folder or its config.yml. The run may have been moved since it was made.
        film: what to show instead of a film of so many `frames` (0 for none) that is made here.
        num_views: held-out views to render, evenly spaced; fewer where there are fewer.
        evaluate: whether to measure the run as `sparsestyle evaluate` does, and save that in its folder, if there is no
            report of its newest checkpoint. Without a report, the views that are shown are measured.
    """
    config_path = find_config(run, STYLE_METHOD)
    loaded = load_run(config_path)
    config, pipeline, step = loaded
    dataset = pipeline.datamanager.train_dataset
    originals = PhotoDataset(dataset._dataparser_outputs)  # at their files' size, whatever the run was trained on
    photos = [Picture(_photo(originals, index), path.name) for index, path in enumerate(originals.image_filenames)]
    views, measured = _render_views(pipeline, num_views)
    if film is None and frames > 0:
        film = make_film(pipeline.model, dataset.cameras, frames, LONGEST_SIDE)
    report = saved_report(config_path.parent, step)
    if report is None and evaluate:
        report = _evaluate(config_path.parent, loaded)
    painting = config.pipeline.style_image
    return RunPictures(
        name=Path(config.experiment_name).name,
        subtitle=f"{config.method_name}, {len(photos)} photos, {step + 1} iterations",
        photos=photos,
        views=views,
        style_name="" if painting is None else painting.stem,
        style=_style_picture(painting, pipeline.datamanager.config.expected),
        style_note=f"The style image, {painting}, is no longer there.",
        film=film,
        tables=[_views_table(measured)] if report is None else report_tables(report.means, len(report.views)),
        settings=_settings(config, dataset, pipeline.datamanager.photo_side, step),
        effects=pipeline.effects.rows(),
    )


def _evaluate(folder: Path, run: LoadedRun) -> HeldOutReport:
    """Measures a run on all held-out views, and saves the report in its folder, if that can be."""
    report = run.pipeline.held_out_report()
    try:
        run.save_report(report, folder / REPORT_FILE)
    except OSError as error:
        say(f"{REPORT_FILE} can't be saved in {folder} ({error.strerror}); its figures are on the page.")
    return report


@torch.no_grad()
def _render_views(pipeline: HierStylePipeline, num_views: int) -> Tuple[List[View], List[Dict[str, float]]]:
    """Held-out views with their photos, and what the model measures of each."""
    dataset = pipeline.datamanager.eval_dataset
    trained = set(pipeline.datamanager.train_dataset.image_filenames)
    originals = PhotoDataset(dataset._dataparser_outputs)
    views, measured = [], []
    for index in track(evenly_spaced(len(dataset), min(num_views, len(dataset))), "Views"):
        path = dataset.image_filenames[index]
        photo = _photo(originals, index)
        width_height = torch.tensor(photo.shape[1::-1]).view(2, 1, 1)
        camera = at_size(originals.cameras[index : index + 1], *width_height).to(pipeline.device)
        camera.distortion_params = dataset.cameras[index : index + 1].distortion_params
        outputs = exact_outputs(pipeline.model, camera)
        target = {"image": torch.from_numpy(photo).to(pipeline.device) / 255.0}
        measured.append(pipeline.model.get_image_metrics_and_images(outputs, target)[0])
        arrays = {key: value.cpu().numpy() for key, value in outputs.items()}
        name = f"{'Training view' if path in trained else 'Held-out view'} {path.name}"
        renders = as_pixels(arrays["rgb"]), as_pixels(arrays["rgb_coarse"])
        views.append(View(name, *renders, photo, depth_picture(arrays["depth"], arrays["accumulation"])))
    return views, measured


def depth_picture(depth: Float[np.ndarray, "H W 1"], accumulation: Float[np.ndarray, "H W 1"]) -> Pixels:
    """Depth as shades, near light and far dark; where there is nothing, middle grey.

    The shade is linear in 1 / depth, between the 2nd and the 98th percentile of what is seen, so that a far wall
    doesn't take all shades from the things before it.
    """
    nearness = 1.0 / np.maximum(depth[..., 0], 1e-6)
    weight = np.clip(accumulation, 0.0, 1.0)
    seen = nearness[weight[..., 0] > 0.5]
    far, near = np.percentile(seen, (2, 98)) if seen.size else (0.0, 1.0)
    share = np.clip((nearness - far) / max(near - far, 1e-9), 0.0, 1.0)
    shades = np.array([[0.10, 0.13, 0.22], [0.72, 0.38, 0.30], [0.98, 0.93, 0.82]])  # far, middle, near
    shade = np.stack([np.interp(share, (0.0, 0.5, 1.0), channel) for channel in shades.T], axis=-1)
    return as_pixels(shade * weight + 0.5 * (1.0 - weight))


def _photo(dataset: PhotoDataset, index: int) -> Pixels:
    return thumbnail(dataset.get_image_uint8(index)[..., :3].numpy(), LONGEST_SIDE)


def _style_picture(path: Optional[Path], expected: Optional[ExpectedScene]) -> Optional[Picture]:
    """The painting, where its file is still there; its caption says where that is another picture by now."""
    if path is None:
        return None
    try:
        painting = Painting.read(path)
    except InputError:
        return None
    is_other = expected is not None and expected.record.painting not in (None, painting.digest)
    pixels = thumbnail(as_pixels(painting.pixels.permute(1, 2, 0).numpy()), LONGEST_SIDE)
    return Picture(pixels, path.name + ", which is another picture by now" * is_other)


def _views_table(views: Sequence[Dict[str, float]]) -> Table:
    """Means over the views that are shown of what the model measured of them."""
    means = means_of(views)
    columns = [(f"coarse_{key}", key, "coarse ") for key in ("psnr", "ssim", "lpips")]
    columns.append(("content_ssim", "content_ssim", "stylised "))
    return table_of(f"Mean of the views above, {len(views)}", columns, [("", means)])


def _settings(config: TrainerConfig, dataset: PhotoDataset, photo_side: int, step: int) -> List[Tuple[str, str]]:
    pipeline: HierStylePipelineConfig = config.pipeline
    height, width = int(dataset.cameras.height[0]), int(dataset.cameras.width[0])
    weight = pipeline.loss_weights["content"]
    sizes, weights = [], []
    for level in pipeline.levels(config.max_num_iterations):
        sizes.append(f"{pipeline.side_at(level.scale, photo_side)} pixels in {level.length} iterations")
        first, last = (
            pipeline.weights_at(at, level)["content"] if weight > 0 else 0.0
            for at in (level.first, level.first + level.length)
        )
        weights.append(f"{first:g} to {last:g} in {round(pipeline.content_share * level.length)} iterations")
    return [
        ("Method", config.method_name),
        ("Made", config.timestamp),
        ("Views trained on", ", ".join(map(str, dataset.metadata["scene_info"].view_ids))),
        ("Photo size in training", f"{width} × {height} pixels"),
        ("Iterations", f"{step + 1} of {config.max_num_iterations}"),
        ("Coarse run", "none" if pipeline.coarse_run is None else pipeline.coarse_run.name),
        ("Style image", "none" if pipeline.style_image is None else pipeline.style_image.name),
        ("Feature network", pipeline.backbone if pipeline.vgg_weights is None else pipeline.vgg_weights.name),
        ("Size it sees views at", ", then ".join(sizes)),
        ("Content weight λ", ", then ".join(weights)),
        ("Warm start", f"{pipeline.warm_start_steps} steps"),
    ]

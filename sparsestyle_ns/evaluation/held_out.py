"""What a run is worth on views that it hasn't seen: how true the coarse field is, how stylised the stylised one."""

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
from sparsestyle_ns.effects.pose_refinement import moving_unit
from sparsestyle_ns.evaluation.camera_alignment import aligned_to_photo
from sparsestyle_ns.losses.nnfm import NNFMLoss, nearest_neighbors
from sparsestyle_ns.losses.stylization import StyleTargets
from sparsestyle_ns.metrics.art_fid import ArtFID
from sparsestyle_ns.metrics.consistency import RANGES, PathGeometry
from sparsestyle_ns.metrics.image import gram_distance, gram_matrix, image_metrics, psnr, structural_similarity
from sparsestyle_ns.metrics.strokes import stroke_width
from sparsestyle_ns.metrics.style_distance import StyleDistance
from sparsestyle_ns.metrics.warping import MIN_COVERAGE, Pinhole, Surface
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.runs.checkpoints import CHECKPOINT_FOLDER, checkpoint_path
from sparsestyle_ns.runs.run_folder import REPORT_FILE
from sparsestyle_ns.utils.files import digest, keep_former, write_whole
from sparsestyle_ns.utils.progress import track

EVEN_SAMPLES = 64
"""Even samples a ray on which `effective_samples` are counted: the number means something only with this one."""
MOST_RAYS = 10_000
"""Of a view, about; evenly spread, they have the mean of all."""
MIN_ACCUMULATION = 0.5
"""Rays with less weight than this show background, and have no surface to be sharp."""


@dataclass
class HeldOutReport:
    """What was measured of a run."""

    means: Dict[str, float]
    """Over the held-out views, and for a stylised run those over pairs of the measuring path."""
    views: List[Dict[str, float]]
    """The held-out views' own values."""
    speed: Dict[str, float] = field(default_factory=dict)
    """Of rendering: `num_rays_per_sec` and `fps`, means over the views; not in a file."""

    def deviations(self) -> Dict[str, float]:
        """As `…_std`, the standard deviations between views; nothing of what fewer than two views have."""
        found = by_figure(self.views)
        return {f"{key}_std": statistics.stdev(values) for key, values in found.items() if len(values) > 1}

    def save(self, path: Path, experiment: str, method: str, step: int, checkpoint: Optional[Path] = None) -> None:
        """Writes JSON in the layout of `ns-eval`, with the views' own values beside the means.

        What a run's own report said before, if it was something else, is kept under another name.
        """
        run = {"experiment_name": experiment, "method_name": method, "step": step}
        if checkpoint is not None:
            run["checkpoint"] = digest(checkpoint.read_bytes())
        content = json.dumps({**run, "results": self.means, "views": self.views}, indent=2) + "\n"
        if path.name == REPORT_FILE:
            keep_former(path, content)
        write_whole(path, content)


def saved_report(folder: Path, step: int) -> Optional[HeldOutReport]:
    """The report in a run's folder, where there is one of the checkpoint of iteration `step` as it is now."""
    try:
        content = json.loads((folder / REPORT_FILE).read_text())
        if content["step"] != step:
            return None
        if "checkpoint" in content:  # earlier versions said no more than the iteration
            checkpoint = checkpoint_path(folder / CHECKPOINT_FOLDER, step)
            if content["checkpoint"] != digest(checkpoint.read_bytes()):
                return None
        return HeldOutReport(content["results"], list(content["views"]))
    except (OSError, ValueError, KeyError, TypeError):  # there is none, or another file has its name
        return None


def by_figure(views: Sequence[Dict[str, float]]) -> Dict[str, List[float]]:
    """Each figure's values, of the views that have it."""
    names = dict.fromkeys(name for view in views for name in view)
    return {name: [view[name] for view in views if name in view] for name in names}


def means_of(views: Sequence[Dict[str, float]]) -> Dict[str, float]:
    """Each figure's mean over the views that have it."""
    return {name: statistics.fmean(values) for name, values in by_figure(views).items()}


@torch.no_grad()
def evaluate_held_out(
    model: Union[CoarseFewShotModel, HierStyleModel],
    views: InputDataset,
    training_cameras: Cameras,
    targets: Optional[StyleTargets] = None,
    baked: bool = False,
    picture_folder: Optional[Path] = None,
    align: bool = False,
) -> HeldOutReport:
    """Evaluates a model in evaluation on views that it hasn't seen, and on the measuring path, all by exact renders.

    Coarse model: `psnr` in dB, `ssim`, `lpips` and `st_lpips` where there are weights, and `effective_samples`.
    Stylised model: the same of the coarse field with the prefix `coarse_`; `content_ssim`; with `targets` what
    `StyleFigures` gives and, where there are weights for it, `art_fid` of all views, with photos as content; and
    the consistency of frames on the measuring path (`PathFrames.figures`), where there are two training cameras.

    Args:
        targets: the painting's features, for a stylised model.
        baked: whether a stylised model's baked renders are held against the exact ones as well (`baked_psnr`, in dB).
        picture_folder: where to save the views as pictures, beside their photos.
        align: whether each view's camera is first moved to where the coarse field looks most like its photo
            (`aligned_to_photo`), since it is known no better than cameras that were estimated.
    """
    style = None if isinstance(model, CoarseFewShotModel) else _StyleMeasure(model, targets, baked)
    values, speeds = [], []
    for index in track(range(len(views)), "Held-out views"):
        camera = views.cameras[index : index + 1].to(model.device)
        photo = views[index]["image"][..., :3]
        if align:
            camera = aligned_to_photo(model, camera, photo, moving_unit(training_cameras, model.ndc))
        start = time.perf_counter()
        outputs = exact_outputs(model, camera)
        fps = 1.0 / (time.perf_counter() - start)
        speeds.append({"num_rays_per_sec": fps * photo.shape[0] * photo.shape[1], "fps": fps})
        if style is not None:
            values.append(style.view(outputs, photo, camera))
        else:
            values.append({**image_metrics(outputs["rgb"], photo), **sharpness_figures(model, camera)})
        if picture_folder is not None:
            picture_folder.mkdir(parents=True, exist_ok=True)
            _, pictures = model.get_image_metrics_and_images(outputs, {"image": photo})
            for name, picture in pictures.items():
                save_image(picture.permute(2, 0, 1).cpu(), picture_folder / f"eval_{name}_{index:04d}.png")
    means = means_of(values)
    if style is not None:
        if style.art_fid is not None:
            means.update(style.art_fid.figures())
        if len(training_cameras) > 1:
            means.update(render_path(model, measuring_path(training_cameras)).figures())
    return HeldOutReport(means, values, means_of(speeds))


class _StyleMeasure:
    """What is measured of a stylised model's views."""

    def __init__(self, model: HierStyleModel, targets: Optional[StyleTargets], baked: bool) -> None:
        self.model, self.baked = model, baked
        self.style = None if targets is None else StyleFigures(targets)
        self.art_fid = None if targets is None else ArtFID.against(targets.style_image)

    def view(self, outputs: Dict[str, Tensor], photo: Tensor, camera: Cameras) -> Dict[str, float]:
        model, coarse, stylised = self.model, outputs["rgb_coarse"], outputs["rgb"]
        values = {f"coarse_{key}": value for key, value in image_metrics(coarse, photo).items()}
        values["content_ssim"] = structural_similarity(stylised, photo)
        if self.style is not None:
            covered = None if model.background is None else outputs["accumulation"].squeeze(-1)
            values.update(self.style.of(coarse, stylised, covered))
        if self.art_fid is not None:
            self.art_fid.add(stylised, photo)
        if self.baked:
            with model.display.rendering("baked"):
                values["baked_psnr"] = psnr(model.get_outputs_for_camera(camera)["rgb"], stylised)
        return values


def exact_outputs(model: Union[CoarseFewShotModel, HierStyleModel], camera: Cameras) -> Dict[str, Tensor]:
    """A camera's outputs in exact rendering, whatever a stylised model's own mode is; a coarse one has no other."""
    if isinstance(model, CoarseFewShotModel):
        return model.get_outputs_for_camera(camera)
    with model.display.rendering("exact"):
        return model.get_outputs_for_camera(camera)


class StyleFigures:
    """What is measured of views against a painting."""

    def __init__(self, targets: StyleTargets) -> None:
        self.targets = targets
        rows = targets.style_rows()
        self.gram, self.num_features = gram_matrix(rows), len(rows)
        style = targets.by_name.get("style")
        self.index = style.index if isinstance(style, NNFMLoss) else None
        self.distance = StyleDistance(targets.style_picture)

    @torch.no_grad()
    def of(
        self,
        coarse: Float[Tensor, "H W 3"],
        stylised: Float[Tensor, "H W 3"],
        accumulation: Optional[Float[Tensor, "H W"]],
    ) -> Dict[str, float]:
        """How strong a view's style is, before (`…_before`) and after stylising, and how far its content has moved.

        `style_loss` and `content_loss` are Eq. 5's: nearest neighbour feature matching, and the features' distance from
        the unstylised view; other losses of `targets` are `NAME_loss`, `gram_distance` is that of `metrics.image`,
        `features_used` is the share of the painting's feature vectors, or where a view has fewer, of as many, that are
        the most similar one of some place; `stroke_width` is that of `metrics.strokes` in pixels, `unstylised_ssim` the
        SSIM to the unstylised view, both of the whole picture, and the rest are of `StyleDistance`. With `accumulation`
        all else is of where the scene covers the picture: a background can't be stylised.
        """
        content, figures = self.targets.content(coarse), {}
        for suffix, picture in (("_before", coarse), ("", stylised)):
            view = self.targets.view(picture, content, accumulation)
            found = {f"{name}_loss": float(value) for name, value in self.targets.losses(view).items()}
            found["gram_distance"] = float(gram_distance(gram_matrix(view.features), self.gram))
            found |= self.distance.figures(picture, accumulation)
            found["stroke_width"] = stroke_width(picture)
            if self.index is not None:
                chosen = nearest_neighbors(view.features, self.index)
                found["features_used"] = len(chosen.unique()) / min(len(chosen), self.num_features)
            figures |= {f"{name}{suffix}": value for name, value in found.items()}
        figures["unstylised_ssim"] = structural_similarity(stylised, coarse)
        for name in ("content", "structure"):  # what keeps a view like its content, which it is before
            figures.pop(f"{name}_loss_before", None)
        return figures


@torch.no_grad()
def sharpness_figures(model: CoarseFewShotModel, camera: Cameras) -> Dict[str, float]:
    """Mean `effective_samples`, on `EVEN_SAMPLES` even ones, of a view's rays that meet a surface, where one does."""
    rays = camera.generate_rays(camera_indices=0, keep_shape=False).flatten()
    rays = rays[:: max(1, len(rays) // MOST_RAYS)]
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
    return {"effective_samples": float(found.mean())} if len(found) else {}


@dataclass
class PathFrames:
    """Frames of the measuring path, and what they show of the unstylised scene; on the CPU."""

    stylised: List[Float[Tensor, "H W 3"]]
    coarse: List[Float[Tensor, "H W 3"]]
    surfaces: List[Surface]

    def figures(self) -> Dict[str, float]:
        """Consistency of the stylised frames, `ceiling_…` of the unstylised ones, and `…_visible` shares of pixels."""
        geometry = PathGeometry(self.surfaces)
        values = geometry.consistency(self.stylised)
        values.update({f"ceiling_{key}": value for key, value in geometry.consistency(self.coarse).items()})
        shares = {f"{name}_visible": geometry.visible_share(name) for name in RANGES}
        return {**values, **{key: share for key, share in shares.items() if share is not None}}


@torch.no_grad()
def render_path(model: HierStyleModel, cameras: Cameras) -> PathFrames:
    """Renders a path's frames, each exactly, and finds the world points that the unstylised scene shows there."""
    frames = PathFrames([], [], [])
    for index in track(range(len(cameras)), "Measuring path"):
        camera = cameras[index : index + 1].to(model.device)
        outputs = exact_outputs(model, camera)
        rays = camera.generate_rays(camera_indices=0, keep_shape=True)
        points = rays.origins + outputs["depth_coarse"] * rays.directions  # in the world in every space, NDC too
        focal, center = (float(camera.fx), float(camera.fy)), (float(camera.cx), float(camera.cy))
        pinhole = Pinhole(camera.camera_to_worlds[0].cpu(), focal, center)
        covered = (outputs["accumulation_coarse"] > MIN_COVERAGE).squeeze(-1)
        frames.stylised.append(outputs["rgb"].clamp(0.0, 1.0).cpu())
        frames.coarse.append(outputs["rgb_coarse"].clamp(0.0, 1.0).cpu())
        frames.surfaces.append(Surface(pinhole, points.cpu(), covered.cpu()))
    return frames

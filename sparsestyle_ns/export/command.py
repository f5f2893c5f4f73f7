"""`sparsestyle export`: from a run to a file, with how far it is from the exact render."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, List, Literal

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from rich.progress import track
from torch import Tensor

from sparsestyle_ns.evaluation.held_out import rendered
from sparsestyle_ns.evaluation.image_metrics import psnr
from sparsestyle_ns.export.orbit import make_orbit, most_central, pinholes, resized, survey
from sparsestyle_ns.export.page import build_page, fit_page
from sparsestyle_ns.export.voxels import Voxels, bake_voxels, render_voxels
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.output_file import write_output
from sparsestyle_ns.run_folder import load_run

COMPARED_SIDE = 252
"""Pixels along the longer side of the pictures by which an export is measured, at most."""
MIN_ACCUMULATION = 0.5
"""Rays with less weight than this see no surface."""


@dataclass
class StylisedScene:
    """A run that is ready to be exported.

    Attributes:
        title: the scene and the painting.
        model: in evaluation mode.
        cameras: the training views, without distortion.
        names: their photos' file names.
    """

    title: str
    model: HierStyleModel
    cameras: Cameras
    names: List[str]


def load_scene(config_path: Path) -> StylisedScene:
    """Loads a stylised run.

    Raises:
        InputError: the run has no checkpoint.
    """
    config, pipeline, _ = load_run(config_path)
    dataset = pipeline.datamanager.train_dataset
    painting = config.pipeline.style_image
    title = config.experiment_name if painting is None else f"{config.experiment_name} · {Path(painting).stem}"
    names = [path.name for path in dataset.image_filenames]
    return StylisedScene(title, pipeline.model.eval(), pinholes(dataset.cameras.to("cpu")), names)


def exact_pictures(scene: StylisedScene) -> List[Dict[str, Tensor]]:
    """Exact renders of the training views, with at most `COMPARED_SIDE` pixels along a side, on the CPU."""
    pictures = []
    for index in track(range(len(scene.cameras)), description="Exact renders"):
        camera = resized(scene.cameras[index : index + 1], COMPARED_SIDE).to(scene.model.device)
        pictures.append({key: value.cpu() for key, value in rendered(scene.model, camera, "exact").items()})
    return pictures


def export_page(scene: StylisedScene, output_path: Path, resolution: int) -> None:
    """Writes the page and prints its size and error.

    Args:
        resolution: cells along a side of the cube; fewer are taken where the page gets too large.

    Raises:
        InputError: the scene doesn't fit into a page, or the file can't be written.
    """
    model, cameras = scene.model, scene.cameras
    exact = exact_pictures(scene)
    opening = most_central(cameras)
    orbit = make_orbit(model.space, cameras, opening, median_depth(exact[opening]))
    views = survey(orbit, cameras)
    page = fit_page(
        lambda resolution: bake_voxels(model, resolution, views),
        lambda voxels: build_page(voxels, model, cameras, scene.names, orbit, scene.title),
        resolution,
    )
    write_output(output_path, page.content, "The page", "scene.html")
    print(f"{page.voxels.resolution} cells along a side, {len(page.content) / 1e6:.1f} MB")
    errors = []
    for index, (name, picture) in enumerate(zip(scene.names, exact, strict=True)):
        seen = page_picture(page.voxels, model, resized(cameras[index : index + 1], COMPARED_SIDE))
        errors.append(psnr(seen, picture["rgb"]))
        print(f"PSNR to the exact render, view of {name}: {errors[-1]:.1f} dB")
    height, width = exact[0]["rgb"].shape[:2]
    print(f"Mean of the training views at {width} × {height}: {sum(errors) / len(errors):.1f} dB")


def page_picture(voxels: Voxels, model: HierStyleModel, camera: Cameras) -> Float[Tensor, "H W 3"]:
    """What the page shows of one camera, worked out in torch."""
    bundle = camera.generate_rays(camera_indices=0, keep_shape=True)
    background = torch.zeros(3) if model.background is None else model.background.cpu()
    colors = []
    for origins, directions in zip(
        bundle.origins.view(-1, 3).split(1 << 13), bundle.directions.view(-1, 3).split(1 << 13), strict=True
    ):
        segments = model.space.to("cpu").segments(origins, directions)
        colors.append(render_voxels(voxels, segments, model.config.num_steps, model.space.unbounded, background))
    return torch.cat(colors).view(bundle.origins.shape)


def median_depth(picture: Dict[str, Tensor]) -> float:
    """The median distance of what a picture shows, in world units."""
    surface = picture["accumulation"] > MIN_ACCUMULATION
    return float(picture["depth"][surface if surface.any() else slice(None)].median())

"""`sparsestyle export`: from a run to a file, with how far it is from the exact render."""

import copy
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Dict, List, Optional, Tuple

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.evaluation.held_out import exact_outputs
from sparsestyle_ns.export.orbit import make_orbit, most_central, pinholes, resized, survey
from sparsestyle_ns.export.page import build_page, fit_page
from sparsestyle_ns.export.points import (
    MIN_ACCUMULATION,
    Likeness,
    Points,
    cross_likeness,
    encode_ply,
    joined,
    likeness,
    surface_points,
    without_background,
)
from sparsestyle_ns.export.voxels import Voxels, bake_voxels, render_voxels
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.models.hier_style import RAYS_PER_CALL, HierStyleModel
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.output_file import write_output
from sparsestyle_ns.utils.progress import track

COMPARED_SIDE = 252
"""Pixels along the longer side of the pictures by which an export is measured, at most."""


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


def exact_pictures(scene: StylisedScene, longest: Optional[int]) -> List[Dict[str, Tensor]]:
    """Exact renders of the training views, on the CPU.

    Args:
        longest: pixels along a side, at most; None for all that the cameras have.
    """
    pictures = []
    for index in track(range(len(scene.cameras)), "Exact renders"):
        camera = scene.cameras[index : index + 1]
        camera = (camera if longest is None else resized(camera, longest)).to(scene.model.device)
        pictures.append({key: value.cpu() for key, value in exact_outputs(scene.model, camera).items()})
    return pictures


def export_page(scene: StylisedScene, output_path: Path, resolution: int) -> None:
    """Writes the page and prints its size and error.

    Args:
        resolution: cells along a side of the cube; fewer are taken where the page gets too large.

    Raises:
        InputError: the scene doesn't fit into a page, or the file can't be written.
    """
    model, cameras = scene.model, scene.cameras
    exact = exact_pictures(scene, COMPARED_SIDE)
    opening = most_central(cameras)
    orbit = make_orbit(model.space, cameras, opening, median_depth(exact[opening]))
    views = survey(orbit, cameras)
    page = fit_page(
        lambda cells: bake_voxels(model, cells, views),
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


def export_points(scene: StylisedScene, output_path: Path) -> None:
    """Writes the training views' surface points as PLY, and prints how well those of the others show each view.

    Raises:
        InputError: there is no surface point, or the file can't be written.
    """
    pictures, parts = _surfaces(scene)
    points = joined(parts)
    if len(points.positions) == 0:
        raise InputError(
            "The views show no surface point, so there is nothing to write; train the coarse field longer."
        )
    write_output(output_path, encode_ply(points), "The points", "scene.ply")
    print(f"{len(points.positions):,} points, in nerfstudio's coordinates")
    if len(parts) > 1:
        print("Each view as the points of all others show it, one pixel each, against the exact render:")
        _print_likeness(scene.names, cross_likeness(parts, scene.cameras, pictures))


def export_mesh(scene: StylisedScene, output_path: Path) -> None:
    """Writes a mesh with coloured vertices as PLY, and prints how well it shows each training view.

    Raises:
        InputError: there are too few surface points, or the file can't be written.
    """
    from sparsestyle_ns.export.mesh import encode_mesh, picture_of_mesh, poisson_mesh  # loads Open3D

    pictures, parts = _surfaces(scene)
    mesh = poisson_mesh(joined(parts))
    with tempfile.TemporaryDirectory() as folder:
        write_output(output_path, encode_mesh(mesh, Path(folder)), "The mesh", "scene.ply")
    print(f"{len(mesh.vertices):,} vertices, {len(mesh.triangles):,} triangles, in nerfstudio's coordinates")
    print("The mesh without light against the exact render:")
    found = []
    for index, picture in enumerate(pictures):
        found.append(likeness(*picture_of_mesh(mesh, scene.cameras[index : index + 1]), picture))
    _print_likeness(scene.names, found)


def _surfaces(scene: StylisedScene) -> Tuple[List[Dict[str, Tensor]], List[Points]]:
    """Full renders of the training views without background, and the points that each sees."""
    background = scene.model.background
    background = None if background is None else background.cpu()
    pictures = [without_background(picture, background) for picture in exact_pictures(scene, None)]
    parts = [surface_points(scene.cameras[index : index + 1], picture) for index, picture in enumerate(pictures)]
    return pictures, parts


def _print_likeness(names: List[str], found: List[Likeness]) -> None:
    for name, (covered, value) in zip(names, found, strict=True):
        if value is None:
            print(f"  {name}: none of its surfaces is covered, so there is no PSNR")
        else:
            print(f"  {name}: {100 * covered:.0f}% of its surfaces covered, PSNR there {value:.1f} dB")


def page_picture(voxels: Voxels, model: HierStyleModel, camera: Cameras) -> Float[Tensor, "H W 3"]:
    """What the page shows of one camera, worked out in torch."""
    bundle = camera.generate_rays(camera_indices=0, keep_shape=True)
    background = torch.zeros(3) if model.background is None else model.background.cpu()
    space, colors = copy.deepcopy(model.space).cpu(), []
    for origins, directions in zip(
        bundle.origins.view(-1, 3).split(RAYS_PER_CALL), bundle.directions.view(-1, 3).split(RAYS_PER_CALL), strict=True
    ):
        segments = space.segments(origins, directions)
        colors.append(render_voxels(voxels, segments, model.config.num_steps, model.space.unbounded, background))
    return torch.cat(colors).view(bundle.origins.shape)


def median_depth(picture: Dict[str, Tensor]) -> float:
    """The median distance of what a picture shows, in world units."""
    surface = picture["accumulation"] > MIN_ACCUMULATION
    return float(picture["depth"][surface if surface.any() else slice(None)].median())

"""The exported page: one HTML file with the voxels of one or two styles of a scene and the shader that shows them.

The voxels lie in it as base64 of gzip of: the occupancy's bits, the bits of the styles' voxels that have values and the
same of the coarse field's, and then, of those voxels, four planes of bytes for each style and for the coarse field:
density, red, green, blue. Bits are packed from the lowest; all grids have z as their fastest axis; each byte of a plane
is the difference, modulo 256, from the one before. From a second style's density the first one's is taken before.
"""

import base64
import gzip
from pathlib import Path
from typing import Callable, Dict, List, Sequence, Tuple

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.core.camera_paths import most_central, showing_path
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace, Space
from sparsestyle_ns.evaluation.held_out import MIN_ACCUMULATION
from sparsestyle_ns.export.orbit import Orbit, make_orbit, pinholes, survey
from sparsestyle_ns.export.stylised_scene import StylisedScene, exact_pictures
from sparsestyle_ns.export.voxel_grid import EMPTY, ROUNDING, VoxelGrid, Voxels, bake_voxels, picture_of_voxels
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.rendering.baked import DENSITY_STEP, DENSITY_UNIT
from sparsestyle_ns.rendering.mixing import Mix
from sparsestyle_ns.runs.scene_record import in_words
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_output
from sparsestyle_ns.utils.page import render_page

COMPARED_SIDE = 252
"""Pixels along the longer side of the pictures by which a page is measured, at most."""
MAX_BYTES = 30_000_000
"""Size that a page may have, so that it can be sent by e-mail and opened on a telephone."""
FLIGHT_POSES = 120
"""Of the path that the page plays; it goes evenly from one to the next."""
LEAST_RESOLUTION = 32
"""With fewer cells along a side a page shows no scene any more."""


def export_page(scenes: Sequence[StylisedScene], output_path: Path, resolution: int) -> None:
    """Writes the page of one or two styles, and prints its size and error; `InputError` if it doesn't fit.

    It has `resolution` cells along a side of the cube, or fewer if it gets too large. The error is that against the
    exact render of the training views.
    """
    scene, cameras = scenes[0], scenes[0].cameras
    exact = [exact_pictures(each, COMPARED_SIDE) for each in scenes]
    opening = most_central(cameras)
    orbit = make_orbit(scene.model.space, cameras, opening, median_depth(exact[0][opening]))
    views = survey(orbit, cameras)
    voxels, page = fit_page(
        lambda cells: bake_voxels([each.model for each in scenes], cells, views),
        lambda voxels: build_page(voxels, scenes, orbit),
        resolution,
    )
    write_output(output_path, page, "The page", "scene.html")
    print(f"{voxels.resolution} cells along a side, {len(page) / 1e6:.1f} MB")
    for blend, (style, pictures) in enumerate(zip(scenes, exact, strict=True)):
        mix = style.model.display.own.mix._replace(blend=float(blend))
        errors = errors_of_voxels(voxels, scene, mix, [picture["rgb"] for picture in pictures])
        for name, error in zip(scene.names, errors, strict=True):
            print(f"PSNR to the exact render, view of {name}: {error:.1f} dB")
        height, width = pictures[0]["rgb"].shape[:2]
        where = f"the training views at {width} × {height}"
        print(f"Mean of {where}{f', {style.style}' if len(scenes) > 1 else ''}: {sum(errors) / len(errors):.1f} dB")
    before = errors_of_voxels(voxels, scene, Mix(0.0), [picture["rgb_coarse"] for picture in exact[0]])
    print(f"The same of the coarse field, at strength 0: {sum(before) / len(before):.1f} dB")


def errors_of_voxels(
    voxels: VoxelGrid, scene: StylisedScene, mix: Mix, exact: Sequence[Float[Tensor, "H W 3"]]
) -> List[float]:
    """PSNR of the page's pictures of the training views against exact ones, in dB."""
    views = (pinholes(scene.cameras[index : index + 1], COMPARED_SIDE) for index in range(len(exact)))
    return [
        psnr(picture_of_voxels(voxels, scene.model, view, mix), picture)
        for view, picture in zip(views, exact, strict=True)
    ]


def median_depth(picture: Dict[str, Tensor]) -> float:
    """The median distance of what a picture shows, in world units."""
    surface = picture["accumulation"] > MIN_ACCUMULATION
    return float(picture["depth"][surface if surface.any() else slice(None)].median())


def fit_page(
    bake: Callable[[int], VoxelGrid], build: Callable[[VoxelGrid], bytes], resolution: int, max_bytes: int = MAX_BYTES
) -> Tuple[VoxelGrid, bytes]:
    """Makes a page of at most `max_bytes`, with as many voxels as it may have; `InputError` if the scene doesn't fit.

    A page that is too large is made again with fewer cells along a side, by the cube root of how much it is larger than
    95% of that.
    """
    while True:
        voxels = bake(resolution)
        page = build(voxels)
        if len(page) <= max_bytes:
            return voxels, page
        smaller = int(resolution * (0.95 * max_bytes / len(page)) ** (1.0 / 3.0))
        if smaller < LEAST_RESOLUTION:
            raise InputError(
                f"The scene doesn't fit into a page of {max_bytes / 1e6:.0f} MB, even with {resolution} cells along a "
                "side; it has hardly any empty space. Train its coarse field longer, or export it as ply."
            )
        print(
            f"With {resolution} cells along a side the page would have {len(page) / 1e6:.1f} MB, over "
            f"{max_bytes / 1e6:.0f}; taking {smaller} cells."
        )
        resolution = smaller


def build_page(voxels: VoxelGrid, scenes: Sequence[StylisedScene], orbit: Orbit) -> bytes:
    """The page's HTML, for one or two styles of a scene and their voxels."""
    scene, model, cameras = scenes[0], scenes[0].model, scenes[0].cameras
    background = torch.zeros(3) if model.background is None else model.background
    mix = model.display.own.mix
    title = " and ".join(filter(None, [scene.title, *(other.style for other in scenes[1:])]))
    described = {
        "file_name": f"{title}.png",
        "styles": [{"name": each.style or each.method, **describe_voxels(voxels.styles[0])} for each in scenes],
        "coarse": describe_voxels(voxels.coarse),
        "cells": len(voxels.occupied),
        "num_steps": model.config.num_steps,
        "mix": {"strength": mix.strength, "geometry": mix.geometry, "blend": mix.blend},
        "background": background.tolist(),
        "density": {"unit": DENSITY_UNIT, "step": DENSITY_STEP, "empty": EMPTY, "rounding": ROUNDING},
        "space": describe_space(model.space),
        "cameras": [describe_camera(cameras[index], name) for index, name in enumerate(scene.names)],
        "orbit": {**vars(orbit), "target": orbit.target.tolist(), "up": orbit.up.tolist()},
        "flight": showing_path(cameras, FLIGHT_POSES).camera_to_worlds.tolist() if len(cameras) > 1 else [],
    }
    packed = base64.b64encode(pack(voxels)).decode()
    captions = [caption(each) for each in scenes]
    told = {"title": title, "captions": captions, "scene": described, "voxels": packed}
    return render_page("web_page.html", __package__, **told).encode()


def caption(scene: StylisedScene) -> str:
    """What made a stylised scene, in a line."""
    painting = "a painting that isn't known" if scene.painting is None else scene.painting
    photos = f"{len(scene.names)} photo{'s' if len(scene.names) > 1 else ''} ({in_words(scene.names)})"
    return f"{scene.name} from {photos}, painted like {painting} by {scene.method} in {scene.iterations} iterations"


def describe_voxels(voxels: Voxels) -> Dict[str, int]:
    """How many voxels a field has, in the words of voxels.js."""
    return {"resolution": voxels.resolution, "known": int(voxels.known.sum())}


def describe_space(space: Space) -> Dict[str, object]:
    """A space in the words of renderer.js; what it has no use for is 0."""
    kind = {ForwardFacingSpace: "ndc", BoxSpace: "box", ContractedSpace: "contracted"}[type(space)]
    told = {"kind": kind, "unbounded": space.unbounded, "near": space.near, "unit": getattr(space, "unit", 1.0)}
    told |= {key: getattr(space, key, torch.zeros(3)).tolist() for key in ("minimum", "maximum")}
    told["focal_over_half_size"] = getattr(space, "focal_over_half_size", (0.0, 0.0))
    told["depths"] = [getattr(space, key, 0.0) for key in ("first", "last")]
    if kind == "box":  # its near plane is in half sides of the cube there, in world units here
        told["near"] = float(space.near * 0.5 * (space.maximum - space.minimum).amax())
    return told


def describe_camera(camera: Cameras, name: str) -> Dict[str, object]:
    """One pinhole camera in the words of cameras.js."""
    numbers = {key: float(getattr(camera, key)) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    return {"name": name, "pose": camera.camera_to_worlds.tolist(), **numbers}


def pack(voxels: VoxelGrid) -> bytes:
    """Voxels in the page's layout, compressed."""
    grids = (voxels.occupied, voxels.styles[0].known, voxels.coarse.known)
    bits = [np.packbits(grid.numpy(), bitorder="little").tobytes() for grid in grids]
    planes = [each.codes[each.known].T.numpy() for each in (*voxels.styles, voxels.coarse)]
    for other in planes[1 : len(voxels.styles)]:
        other[0] -= planes[0][0]  # bytes wrap around, here and below
    steps = [np.diff(each, axis=1, prepend=np.uint8(0)).tobytes() for each in planes]
    # Level 9 saves 0.1%. Without a time in it, the same scene gives the same file.
    return gzip.compress(b"".join([*bits, *steps]), compresslevel=6, mtime=0)

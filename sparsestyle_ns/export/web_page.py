"""The exported page: one HTML file with the voxels of a stylised scene and the shader that shows them.

The voxels lie in it as base64 of gzip of: the occupancy's bits, the bits of the voxels that have values, and of those
voxels four planes of bytes: density, red, green, blue. Bits are packed from the lowest; both grids have z as their
fastest axis; each byte of a plane is the difference, modulo 256, from the one before.
"""

import base64
import gzip
from pathlib import Path
from typing import Callable, Dict, Tuple

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.core.camera_paths import most_central
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace, Space
from sparsestyle_ns.evaluation.held_out import MIN_ACCUMULATION
from sparsestyle_ns.export.orbit import Orbit, make_orbit, pinholes, survey
from sparsestyle_ns.export.stylised_scene import StylisedScene, exact_pictures
from sparsestyle_ns.export.voxel_grid import EMPTY, ROUNDING, VoxelGrid, bake_voxels, picture_of_voxels
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.rendering.baked import DENSITY_STEP, DENSITY_UNIT
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_output
from sparsestyle_ns.utils.page import render_page

COMPARED_SIDE = 252
"""Pixels along the longer side of the pictures by which a page is measured, at most."""
MAX_BYTES = 30_000_000
"""Size that a page may have, so that it can be sent by e-mail and opened on a telephone."""
LEAST_RESOLUTION = 32
"""With fewer cells along a side a page shows no scene any more."""


def export_page(scene: StylisedScene, output_path: Path, resolution: int) -> None:
    """Writes the page, and prints its size and its error against the exact render; `InputError` if it doesn't fit.

    It has `resolution` cells along a side of the cube, or fewer if it gets too large.
    """
    model, cameras = scene.model, scene.cameras
    exact = exact_pictures(scene, COMPARED_SIDE)
    opening = most_central(cameras)
    orbit = make_orbit(model.space, cameras, opening, median_depth(exact[opening]))
    views = survey(orbit, cameras)
    voxels, page = fit_page(
        lambda cells: bake_voxels(model, cells, views), lambda voxels: build_page(voxels, scene, orbit), resolution
    )
    write_output(output_path, page, "The page", "scene.html")
    print(f"{voxels.resolution} cells along a side, {len(page) / 1e6:.1f} MB")
    errors = []
    for index, (name, picture) in enumerate(zip(scene.names, exact, strict=True)):
        shown = picture_of_voxels(voxels, model, pinholes(cameras[index : index + 1], COMPARED_SIDE))
        errors.append(psnr(shown, picture["rgb"]))
        print(f"PSNR to the exact render, view of {name}: {errors[-1]:.1f} dB")
    height, width = exact[0]["rgb"].shape[:2]
    print(f"Mean of the training views at {width} × {height}: {sum(errors) / len(errors):.1f} dB")


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


def build_page(voxels: VoxelGrid, scene: StylisedScene, orbit: Orbit) -> bytes:
    """The page's HTML, for a scene and its voxels."""
    model, cameras = scene.model, scene.cameras
    background = torch.zeros(3) if model.background is None else model.background
    described = {
        "resolution": voxels.resolution,
        "cells": len(voxels.occupied),
        "known": int(voxels.known.sum()),
        "num_steps": model.config.num_steps,
        "background": background.tolist(),
        "density": {"unit": DENSITY_UNIT, "step": DENSITY_STEP, "empty": EMPTY, "rounding": ROUNDING},
        "space": describe_space(model.space),
        "cameras": [describe_camera(cameras[index], name) for index, name in enumerate(scene.names)],
        "orbit": {**vars(orbit), "target": orbit.target.tolist(), "up": orbit.up.tolist()},
    }
    packed = base64.b64encode(pack(voxels)).decode()
    return render_page("web_page.html", __package__, title=scene.title, scene=described, voxels=packed).encode()


def describe_space(space: Space) -> Dict[str, object]:
    """A space in the words of web_page.js; what it has no use for is 0."""
    kind = {ForwardFacingSpace: "ndc", BoxSpace: "box", ContractedSpace: "contracted"}[type(space)]
    told = {"kind": kind, "unbounded": space.unbounded, "near": space.near, "unit": getattr(space, "unit", 1.0)}
    told |= {key: getattr(space, key, torch.zeros(3)).tolist() for key in ("minimum", "maximum")}
    told["focal_over_half_size"] = getattr(space, "focal_over_half_size", (0.0, 0.0))
    told["depths"] = [getattr(space, key, 0.0) for key in ("first", "last")]
    if kind == "box":  # its near plane is in half sides of the cube there, in world units here
        told["near"] = float(space.near * 0.5 * (space.maximum - space.minimum).amax())
    return told


def describe_camera(camera: Cameras, name: str) -> Dict[str, object]:
    """One pinhole camera in the words of web_page.js."""
    numbers = {key: float(getattr(camera, key)) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    return {"name": name, "pose": camera.camera_to_worlds.tolist(), **numbers}


def pack(voxels: VoxelGrid) -> bytes:
    """Voxels in the page's layout, compressed."""
    bits = [np.packbits(grid.numpy(), bitorder="little").tobytes() for grid in (voxels.occupied, voxels.known)]
    planes = voxels.codes[voxels.known].T.contiguous().numpy()
    steps = np.diff(planes, axis=1, prepend=np.uint8(0))  # bytes wrap around
    # Level 9 saves 0.1%. Without a time in it, the same scene gives the same file.
    return gzip.compress(b"".join([*bits, steps.tobytes()]), compresslevel=6, mtime=0)

"""The page: one HTML file with the voxels of a stylised scene and what shows them (page.html, page.js, raymarch.frag).

The voxels lie in it as base64 of gzip of: the occupancy's bits, the bits of the voxels that have values, and of those
voxels four planes of bytes: density, red, green, blue. Bits are packed from the lowest; both grids have z as their
fastest axis; each byte of a plane is the difference, modulo 256, from the one before.
"""

import base64
import gzip
import html
import json
import re
from dataclasses import dataclass
from importlib.resources import files
from string import Template
from typing import Any, Callable, Dict, Sequence, Tuple

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace, Space
from sparsestyle_ns.export.orbit import Orbit
from sparsestyle_ns.export.voxels import EMPTY, ROUNDING, Voxels
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.baked import DENSITY_STEP, DENSITY_UNIT
from sparsestyle_ns.utils.errors import InputError

MAX_BYTES = 30_000_000
"""Size that a page may have: what goes through e-mail and opens on a telephone."""
SHRINK_MARGIN = 0.95
"""Part of the limit that a page made again, with fewer voxels, aims for."""
LEAST_RESOLUTION = 32
"""With fewer cells along a side a page shows no scene any more."""


@dataclass
class Page:
    """A page, and the voxels in it.

    Attributes:
        content: the file.
        voxels: what it shows.
    """

    content: bytes
    voxels: Voxels


def fit_page(
    bake: Callable[[int], Voxels], build: Callable[[Voxels], bytes], resolution: int, max_bytes: int = MAX_BYTES
) -> Page:
    """Makes a page that isn't too large, with as many voxels as it may have.

    A page that is too large is made again with fewer cells along a side, by the cube root of how much it is too large.

    Args:
        bake: gives the voxels for a number of cells along a side.
        build: gives the page for voxels.
        resolution: cells along a side to begin with.

    Raises:
        InputError: the scene doesn't fit.
    """
    while True:
        voxels = bake(resolution)
        content = build(voxels)
        if len(content) <= max_bytes:
            return Page(content, voxels)
        smaller = int(resolution * (SHRINK_MARGIN * max_bytes / len(content)) ** (1.0 / 3.0))
        if smaller < LEAST_RESOLUTION:
            raise InputError(
                f"The scene doesn't fit into a page of {max_bytes / 1e6:.0f} MB, even with {resolution} cells along a "
                "side; it has hardly any empty space. Train its coarse field longer, or export it as ply."
            )
        print(
            f"With {resolution} cells along a side the page has {len(content) / 1e6:.1f} MB, over "
            f"{max_bytes / 1e6:.0f}; taking {smaller}."
        )
        resolution = smaller


def build_page(
    voxels: Voxels, model: HierStyleModel, cameras: Cameras, names: Sequence[str], orbit: Orbit, title: str
) -> bytes:
    """The page's HTML.

    Args:
        voxels: the model's.
        cameras: pinholes that it may be looked at with, one for each name.
        title: plain text.
    """
    background = torch.zeros(3) if model.background is None else model.background
    scene = {
        "resolution": voxels.resolution,
        "cells": len(voxels.occupied),
        "known": int(voxels.known.sum()),
        "num_steps": model.config.num_steps,
        "background": background.tolist(),
        "density": {"unit": DENSITY_UNIT, "step": DENSITY_STEP, "empty": EMPTY, "rounding": ROUNDING},
        "space": describe_space(model.space),
        "cameras": [describe_camera(cameras[index], name) for index, name in enumerate(names)],
        "orbit": {
            "opening": orbit.opening,
            "target": orbit.target.tolist(),
            "up": orbit.up.tolist(),
            "yaw": orbit.yaw,
            "pitch": orbit.pitch,
            "distance": orbit.distance,
        },
    }
    parts = {
        "title": html.escape(title),
        # "</script>" in a name must not end the script element
        "scene": json.dumps(scene).replace("<", "\\u003c"),
        "shader": _file("raymarch.frag"),
        "script": _file("page.js"),
        "voxels": base64.b64encode(pack(voxels)).decode(),
    }
    return Template(_file("page.html")).substitute(parts).encode()


def _file(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8")


def describe_space(space: Space) -> Dict[str, Any]:
    """A space in the words of page.js; what it has no use for is 0."""
    kind = {ForwardFacingSpace: "ndc", BoxSpace: "box", ContractedSpace: "contracted"}[type(space)]
    bounded = not isinstance(space, ContractedSpace)
    forward = isinstance(space, ForwardFacingSpace)
    near = space.near
    if isinstance(space, BoxSpace):  # in half sides of the cube there, in world units here
        near = float(near * 0.5 * (space.maximum - space.minimum).amax())
    return {
        "kind": kind,
        "unbounded": space.unbounded,
        "near": near,
        "unit": 1.0 if bounded else space.unit,
        "minimum": space.minimum.tolist() if bounded else [0.0] * 3,
        "maximum": space.maximum.tolist() if bounded else [0.0] * 3,
        "focal_over_half_size": space.focal_over_half_size if forward else [0.0] * 2,
        "depths": [space.first, space.last] if forward else [0.0] * 2,
    }


def describe_camera(camera: Cameras, name: str) -> Dict[str, Any]:
    """One pinhole camera in the words of page.js."""
    numbers = {key: float(getattr(camera, key)) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    return {"name": name, "pose": camera.camera_to_worlds.tolist(), **numbers}


def pack(voxels: Voxels) -> bytes:
    """Voxels in the page's layout, compressed."""
    planes = voxels.codes[voxels.known].T.contiguous().numpy()
    steps = np.diff(planes, axis=1, prepend=np.uint8(0))  # bytes wrap around
    # Level 9 saves 0.1%. Without a time in it, the same scene gives the same file.
    return gzip.compress(_bits(voxels.occupied) + _bits(voxels.known) + steps.tobytes(), compresslevel=6, mtime=0)


def unpack(content: bytes) -> Tuple[Dict[str, Any], Voxels]:
    """What a page says of its scene, and the voxels that it carries."""
    text = content.decode()
    scene = json.loads(re.search(r'<script id="scene"[^>]*>(.*?)</script>', text, re.DOTALL)[1])
    packed = re.search(r'<script id="voxels"[^>]*>(.*?)</script>', text, re.DOTALL)[1]
    data = np.frombuffer(gzip.decompress(base64.b64decode(packed)), np.uint8)
    sides = scene["cells"], scene["resolution"] + 1
    lengths = [-(-(side**3) // 8) for side in sides]
    occupied, known, planes = np.split(data, np.cumsum(lengths))
    occupied, known = (_from_bits(bits, side) for bits, side in zip((occupied, known), sides, strict=True))
    codes = torch.zeros(*known.shape, 4, dtype=torch.uint8)
    codes[..., 0] = EMPTY
    codes[known] = torch.from_numpy(np.cumsum(planes.reshape(4, -1), axis=1, dtype=np.uint8).T.copy())
    return scene, Voxels(codes, known, occupied)


def _bits(grid: Bool[Tensor, "x y z"]) -> bytes:
    return np.packbits(grid.numpy(), bitorder="little").tobytes()


def _from_bits(bits: UInt8[np.ndarray, "bytes"], side: int) -> Bool[Tensor, "x y z"]:
    values = np.unpackbits(bits, count=side**3, bitorder="little").astype(bool)
    return torch.from_numpy(values).view(side, side, side)

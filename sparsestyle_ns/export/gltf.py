"""Gaussians and meshes as one binary glTF file (.glb).

Gaussians are points with the extension `KHR_gaussian_splatting` of the Khronos Group; a program that doesn't know it
shows coloured points. glTF's worlds stand with y up: where nerfstudio's have z up, the root node is turned.
"""

import json
import math
import struct
from typing import Dict, List, NamedTuple, Sequence, Union

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestyle_ns.core.spaces import ForwardFacingSpace, Space
from sparsestyle_ns.export.gaussians import Gaussians
from sparsestyle_ns.export.splat_file import coefficients

SPLATTING, UNLIT = "KHR_gaussian_splatting", "KHR_materials_unlit"
GLTF_SPLAT_BYTES, VERTEX_BYTES, TRIANGLE_BYTES = 60, 36, 12
"""What a Gaussian takes in a file, and a mesh."""
GENERATOR = "sparsestyle_ns"
POINTS, TRIANGLES = 0, 4
FLOAT, UNSIGNED_BYTE, UNSIGNED_INT = 5126, 5121, 5125
VERTICES, TRIANGLE_CORNERS = 34962, 34963
Z_UP = (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""The turn (x, y, z, w) that brings z up to y up."""


class ColoredMesh(NamedTuple):
    """Triangles with colours at their vertices, as they are displayed, and normals; corners counter-clockwise."""

    positions: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    colors: Float[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]

    @property
    def bytes_in_gltf(self) -> int:
        """What it takes in a file."""
        return VERTEX_BYTES * len(self.positions) + TRIANGLE_BYTES * len(self.triangles)


def encode_gltf(contents: Sequence[Union[Gaussians, ColoredMesh]], space: Space) -> bytes:
    """A .glb file of Gaussians, of a mesh, or of both as two nodes of one scene, in a space's world."""
    writer = _Writer()
    turn = {} if isinstance(space, ForwardFacingSpace) else {"rotation": list(Z_UP)}
    for content in contents:
        if isinstance(content, Gaussians):
            writer.add("Splats", writer.splats(content), turn)
        else:
            writer.add("Mesh", writer.mesh(content), turn)
    return writer.encoded()


class _Writer:
    """Collects what a file is made of."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: List[Dict] = []
        self.accessors: List[Dict] = []
        self.nodes: List[Dict] = []
        self.meshes: List[Dict] = []
        self.used: List[str] = []

    def add(self, name: str, primitive: Dict, turn: Dict) -> None:
        """A node with a mesh of one primitive."""
        self.nodes.append({"name": name, "mesh": len(self.meshes), **turn})
        self.meshes.append({"name": name, "primitives": [primitive]})

    def accessor(self, values: np.ndarray, target: int = VERTICES, **more: object) -> int:
        """The number of a new accessor of rows of numbers, which takes a view of its own."""
        component = {"f": FLOAT, "B": UNSIGNED_BYTE, "I": UNSIGNED_INT}[values.dtype.char]
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes, "target": target}
        self.views.append(view)
        self.data += values.tobytes()
        self.data += bytes(-len(self.data) % 4)
        told = {"bufferView": len(self.views) - 1, "componentType": component, "count": len(values), "type": kind}
        self.accessors.append({**told, **more})
        return len(self.accessors) - 1

    def positions(self, values: np.ndarray) -> int:
        """An accessor of positions, which says between what they lie."""
        values = np.ascontiguousarray(values, np.float32)
        return self.accessor(values, min=values.min(axis=0).tolist(), max=values.max(axis=0).tolist())

    def splats(self, gaussians: Gaussians) -> Dict:
        """The primitive of Gaussians: linear scales, opacities in [0, 1], quaternions (x, y, z, w)."""
        turns = torch.nn.functional.normalize(gaussians.rotations, dim=-1)[:, [1, 2, 3, 0]]
        opacity = gaussians.logits.sigmoid()
        shown = torch.cat([gaussians.colors, opacity[:, None]], dim=-1)
        attributes = {
            "POSITION": self.positions(gaussians.means.numpy()),
            "COLOR_0": self.accessor((255.0 * shown).round().byte().numpy(), normalized=True),
            f"{SPLATTING}:ROTATION": self.accessor(_floats(turns)),
            f"{SPLATTING}:SCALE": self.accessor(_floats(gaussians.log_scales.exp())),
            f"{SPLATTING}:OPACITY": self.accessor(_floats(opacity)),
            f"{SPLATTING}:SH_DEGREE_0_COEF_0": self.accessor(_floats(coefficients(gaussians.colors))),
        }
        self.used.append(SPLATTING)
        told = {
            "kernel": "ellipse",
            "colorSpace": "srgb_rec709_display",
            "sortingMethod": "cameraDistance",
            "projection": "perspective",
        }
        return {"attributes": attributes, "mode": POINTS, "extensions": {SPLATTING: told}}

    def mesh(self, mesh: ColoredMesh) -> Dict:
        """The primitive of a mesh that needs no light; glTF's colours at vertices are linear."""
        self.used.append(UNLIT)
        attributes = {
            "POSITION": self.positions(mesh.positions),
            "NORMAL": self.accessor(np.ascontiguousarray(mesh.normals, np.float32)),
            "COLOR_0": self.accessor(linear(mesh.colors).astype(np.float32)),
        }
        corners = np.ascontiguousarray(mesh.triangles, np.uint32).reshape(-1)
        indices = self.accessor(corners, TRIANGLE_CORNERS)
        return {"attributes": attributes, "indices": indices, "mode": TRIANGLES, "material": 0}

    def encoded(self) -> bytes:
        """The file: a header, the description, and the numbers (glTF 2.0, "GLB file format")."""
        described = {
            "asset": {"version": "2.0", "generator": GENERATOR},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(self.nodes)))}],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
            "extensionsUsed": self.used,
        }
        if UNLIT in self.used:
            plain = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
            material = {"pbrMetallicRoughness": plain, "doubleSided": True, "extensions": {UNLIT: {}}}
            described["materials"] = [material]
        text = json.dumps(described, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self.data), b"BIN\0") + bytes(self.data)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _floats(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.numpy(), np.float32)


def linear(colors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Linear light from colours as they are displayed (sRGB, IEC 61966-2-1)."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)

"""Gaussians as SPZ, Niantic's form of files (version 3), which the package gsply writes.

A Gaussian takes 20 bytes, before they are compressed: its mean in 24 bits a number, opacity and colour in 8, scales in
sixteenths of their logarithms, and its quaternion in 32. The world stands with y up.
"""

import math
import tempfile
from pathlib import Path

import gsply
import torch
from gsply.spz import read_spz, write_spz

from sparsestyle_ns.core.spaces import ForwardFacingSpace, Space
from sparsestyle_ns.export.gaussians import Gaussians
from sparsestyle_ns.export.gltf import Z_UP
from sparsestyle_ns.export.splat_file import CONSTANT_HARMONIC, coefficients

MEAN_BITS = 23
"""Of a mean's numbers, besides the sign."""


def encode_spz(gaussians: Gaussians, space: Space) -> bytes:
    """A .spz file of Gaussians in a space's world. Means are as fine as the farthest one allows."""
    turned_up = gaussians if isinstance(space, ForwardFacingSpace) else turned(gaussians, Z_UP)
    whole_bits = math.ceil(math.log2(float(turned_up.means.abs().max()) + 1e-6))
    data = gsply.GSData(
        means=turned_up.means.numpy(),
        scales=turned_up.log_scales.numpy(),
        quats=turned_up.rotations.numpy(),
        opacities=turned_up.logits.numpy(),
        sh0=coefficients(turned_up.colors).numpy(),
        shN=None,
    )
    with tempfile.TemporaryDirectory() as folder:  # it only writes into files
        path = Path(folder) / "scene.spz"
        write_spz(path, data, version=3, fractional_bits=min(max(MEAN_BITS - whole_bits, 1), 24))
        return path.read_bytes()


def decode_spz(content: bytes, space: Space) -> Gaussians:
    """The Gaussians of a file that `encode_spz` has made."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.spz"
        path.write_bytes(content)
        data = read_spz(path)
    parts = (data.means, data.scales, data.quats, data.opacities.reshape(-1), 0.5 + CONSTANT_HARMONIC * data.sh0)
    gaussians = Gaussians.of(*(torch.tensor(part) for part in parts))
    x, y, z, w = Z_UP
    return gaussians if isinstance(space, ForwardFacingSpace) else turned(gaussians, (-x, -y, -z, w))


def turned(gaussians: Gaussians, turn: tuple) -> Gaussians:
    """Gaussians in a world that is turned by a unit quaternion (x, y, z, w)."""
    x, y, z, w = turn
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])  # of a quaternion w, x, y, z
    right = torch.tensor([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    matrix = (left @ right)[1:, 1:]  # p → q p q*
    rows = gaussians.rows.clone()
    rows[:, :3], rows[:, 6:10] = gaussians.means @ matrix.T, gaussians.rotations @ left.T
    return Gaussians(rows)

"""The part of the panel that shows a file of splats where the exact picture is.

`sparsestyle export --format splat` writes such files. Browsers draw them, so that they move as quickly as the mouse.
"""

from pathlib import Path
from typing import Callable, Dict, NamedTuple, Optional

import numpy as np
from jaxtyping import Float
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
from viser import ViserServer

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.viewer.styles import plain

NODE = "/splats"
"""Their name in viser's scene."""
FILE_NAME = "splats.ply"
"""What is offered to begin with is the file of this name in the run's folder."""
HARMONIC = 0.28209479177387814
"""Constant of the spherical harmonic of degree 0, 1/(2√π)."""


class Splats(NamedTuple):
    """Gaussians in world units, as viser wants them: means, covariances, colours and opacities in [0, 1]."""

    centers: Float[np.ndarray, "splats 3"]
    covariances: Float[np.ndarray, "splats 3 3"]
    rgbs: Float[np.ndarray, "splats 3"]
    opacities: Float[np.ndarray, "splats 1"]

    def scaled(self, factor: float) -> "Splats":
        """The same in a larger world."""
        return self._replace(centers=factor * self.centers, covariances=factor**2 * self.covariances)


def read_splats(path: Path) -> Splats:
    """Splats from a binary PLY with the reference implementation's fields; `InputError` where it isn't that."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} can't be read ({error.strerror}); export the run with --format splat.") from error
    head, _, body = content.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    counts = [int(line.split()[-1]) for line in lines if line.startswith("element vertex ")]
    values: Dict[str, np.ndarray] = {}
    if len(counts) == 1 and len(body) == 4 * len(names) * counts[0]:
        values = dict(zip(names, np.frombuffer(body, "<f4").reshape(counts[0], -1).T, strict=True))

    def columns(stem: str, keys: str) -> np.ndarray:
        return np.stack([values[stem + key] for key in keys], axis=-1).astype(np.float64)

    try:
        means, opacity = columns("", "xyz"), columns("", ("opacity",))
        turn, scale, colors = columns("rot_", "0123"), columns("scale_", "012"), columns("f_dc_", "012")
    except KeyError as error:
        raise InputError(f"{path} is no file of splats; export the run with --format splat.") from error
    axes = rotations(turn) * np.exp(scale)[:, None]
    rgbs = np.clip(0.5 + HARMONIC * colors, 0.0, 1.0)
    return Splats(means, axes @ axes.swapaxes(-1, -2), rgbs, 1.0 / (1.0 + np.exp(-opacity)))


def rotations(quaternions: Float[np.ndarray, "splats 4"]) -> Float[np.ndarray, "splats 3 3"]:
    """Rotation matrices of quaternions, w first, of any length but 0."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def drawing_of(server: ViserServer) -> Optional[Callable]:
    """viser's way to add splats; it was in trial, under another name, in the versions that nerfstudio takes."""
    return next(
        (
            getattr(server.scene, name)
            for name in ("add_gaussian_splats", "_add_gaussian_splats")
            if hasattr(server.scene, name)
        ),
        None,
    )


class SplatControls:
    """A path and a checkbox; without a way to draw splats, a sentence in their place."""

    def __init__(self, server: ViserServer, folder: Path) -> None:
        self._add, self._node = drawing_of(server), None
        if self._add is None:
            self.message = server.gui.add_markdown("This version of viser shows no splats.", image_root=Path())
            return
        self.path = server.gui.add_text("File of splats", str(folder / FILE_NAME), hint="sparsestyle export RUN")
        self.shown = server.gui.add_checkbox("Show the splats", False, hint="over the picture, at the same place")
        self.message = server.gui.add_markdown("", image_root=Path(), visible=False)
        self.path.on_update(lambda _: self.show())
        self.shown.on_update(lambda _: self.show())

    def show(self) -> None:
        """Shows what the controls say, or why that can't be."""
        if self._node is not None:
            self._node.remove()
            self._node = None
        said = ""
        if self.shown.value:
            try:
                splats = read_splats(Path(self.path.value).expanduser())
            except InputError as error:
                said = plain(str(error))
            else:
                self._node = self._add(NODE, **splats.scaled(VISER_NERFSTUDIO_SCALE_RATIO)._asdict())
                said = f"{len(splats.centers):,} splats"
        self.message.content, self.message.visible = said, bool(said)

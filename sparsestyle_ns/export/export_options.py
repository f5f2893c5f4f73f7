"""What `sparsestyle export` is asked for. Nothing heavy is imported here, so that help and refusals come at once."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional, Tuple

import tyro

from sparsestyle_ns.runs.run_folder import STYLE_METHOD, find_config
from sparsestyle_ns.utils.errors import CommandOptions, InputError
from sparsestyle_ns.utils.files import prepare_output

EXAMPLES = {"html": "scene.html", "glb": "scene.glb", "spz": "scene.spz"}
"""Good names of files by format, where they aren't PLY."""


@dataclass
class ExportOptions(CommandOptions):
    """Writes a stylised run as one file that needs no Python, and prints how close it comes to the exact render.

    html is a page that shows the scene in any browser with WebGL2, without server or network: a camera to move, a
    flight, strength, geometry, before and after, and of two runs the styles between them. It has at most 30 MB; if it
    would be larger, the scene gets fewer cells. splat is a PLY file of 3D Gaussians, for viewers and editors of splats;
    glb has the same as glTF, and with --mesh a mesh beside them; spz has 20 bytes a splat or less. ply is a cloud of
    coloured points. mesh is a PLY mesh with coloured vertices, made by Open3D's Poisson reconstruction.
    """

    runs: Annotated[Tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN]")]
    """The run's folder or its config.yml. html: two styles of one coarse run make a page that blends them."""
    output_path: Path
    """The file to write."""
    format: Literal["html", "splat", "glb", "spz", "ply", "mesh"] = "html"
    """What to write: a page, splats as PLY, as glTF or as SPZ, points or a mesh."""
    resolution: int = 255
    """html: cells along a side of the scene's cube. Every browser with WebGL2 can hold 255."""
    force: bool = False
    """Write over the file, if there is one of that name."""
    mesh: bool = False
    """glb: the coloured mesh too, which programs show that know no splats."""
    max_splats: Optional[int] = None
    """splat, glb and spz: how many splats there may be, from 1,000 on. Without it, as many as fit into 30 MB, at most
    400,000."""
    sh0: bool = False
    """splat: leave out the coefficients of spherical harmonics that are all 0 (f_rest_*). A splat then takes 68 bytes
    instead of 248. Some older importers miss them."""

    def check(self) -> None:
        """Raises an `InputError` if there is no such run, or the file can't be written."""
        if not 1 <= len(self.runs) <= (2 if self.format == "html" else 1):
            many = "one run, or two styles of one scene" if self.format == "html" else "one run"
            raise InputError(f"--format {self.format} takes {many}, not {len(self.runs)}.")
        if not 32 <= self.resolution <= 1023:
            raise InputError(f"--resolution {self.resolution} isn't between 32 and 1023; 255 suits most scenes.")
        if self.mesh and self.format != "glb":
            raise InputError("--mesh is for --format glb; for a mesh as PLY take --format mesh.")
        if self.format == "spz" and importlib.util.find_spec("gsply") is None:
            raise InputError("--format spz needs a package more: pip install gsply, or take --format splat --sh0.")
        if self.max_splats is not None and self.max_splats < 1000:
            raise InputError(f"--max-splats {self.max_splats} shows no scene; give 1000 or more.")
        for run in self.runs:
            find_config(run, STYLE_METHOD)
        prepare_output(self.output_path, "The scene", EXAMPLES.get(self.format, "scene.ply"), self.force)

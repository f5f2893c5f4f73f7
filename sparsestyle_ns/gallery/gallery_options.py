"""What `sparsestyle gallery` is asked for. Nothing heavy is imported here, so that help and refusals come at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Optional, Tuple

import tyro

from sparsestyle_ns.runs.run_folder import STYLE_METHOD, find_config
from sparsestyle_ns.utils.errors import CommandOptions, InputError
from sparsestyle_ns.utils.files import free_path, prepare_output


@dataclass
class GalleryOptions(CommandOptions):
    """Makes one HTML page of stylised runs that opens without a network.

    It shows the photos, the painting, a slider between the scene before and after, a film, settings, effects, and the
    figures that `sparsestyle evaluate` has saved in the run's folder. Several runs also get a grid of scenes and
    paintings.
    """

    runs: Annotated[Tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    """Stylised runs to show, each by its folder or its config.yml."""
    output_path: Optional[Path] = None
    """The page to write; left out, gallery.html here, or gallery-2.html where that is there already."""
    video: Tuple[Path, ...] = ()
    """MP4 files, as ns-render writes them, to show instead of films made here: one for each run, in the same order."""
    title: str = "Stylised scenes"
    """Heading of the page."""
    num_views: int = 3
    """Held-out views to render of each run."""
    frames: int = 48
    """Frames of the film, a flight between the photos' viewpoints or a turn about the scene, 16 a second; 0: none."""
    evaluate: bool = False
    """Measure runs that have no evaluation.json of their newest checkpoint, and save it in their folders."""
    force: bool = False
    """Write over the page that --output-path names, if there is one."""

    def check(self) -> None:
        """Raises an `InputError` if there are no such runs, or the page can't be written."""
        if not self.runs:
            raise InputError("There is no run to show; name at least one run's folder.")
        if len(self.video) > len(self.runs):
            given = f"{len(self.video)} videos for {len(self.runs)} runs"
            raise InputError(f"There are {given}; give at most one for each run.")
        if self.num_views < 1:
            raise InputError(f"--num-views is {self.num_views}; at least one view is needed.")
        if self.frames < 0:
            raise InputError(f"--frames is {self.frames}; give 0 for no film, or more.")
        for run in self.runs:
            find_config(run, STYLE_METHOD)
        self.output_path = self.output_path or free_path(Path("gallery.html"))
        prepare_output(self.output_path, "The page", "index.html", self.force)

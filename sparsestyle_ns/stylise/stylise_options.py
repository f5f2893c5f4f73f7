"""What `sparsestyle stylise` is asked for. Nothing heavy is imported here, so that help and refusals come at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sparsestyle_ns.utils.errors import CommandOptions, InputError
from sparsestyle_ns.utils.files import check_outside


@dataclass
class StyliseOptions(CommandOptions):
    """Does the whole way: a scene of the photos, both stages, a gallery page, and a page to fly through.

    It runs the commands that one would type and shows each: `sparsestyle prepare` (not where the photos are a scene
    already), `ns-train` for stage 1 and for stage 2, `sparsestyle gallery` and `sparsestyle export`. After Ctrl-C the
    same command goes on where it was.
    """

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of three to eight photos, a video, or the folder of a scene that ns-train reads."""
    painting: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PAINTING")]
    """The painting: a JPEG, PNG or WebP file."""
    output: Path
    """Folder for all that is made."""
    methods: Literal["default", "draft"] = "default"
    """Which methods train: default for pictures to keep, draft for a first look in a quarter of the time."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto is the GPU where there is one."""
    stroke_size: float = 1.0
    """How wide strokes are, from 0.5 to 2."""
    seed: int = 42
    """Of all that is drawn at random in training."""

    def check(self) -> None:
        """Raises an `InputError` where photos or painting aren't there, or the folder can't be made."""
        if not self.photos.exists():
            raise InputError(f"There is no folder {self.photos}; name the folder of the photos.")
        if not self.painting.is_file():
            raise InputError(f"There is no painting {self.painting}; name a JPEG, PNG or WebP file.")
        if not 0.5 <= self.stroke_size <= 2.0:
            raise InputError(f"--stroke-size is {self.stroke_size:g}; give a number from 0.5 to 2.")
        if self.seed < 0:
            raise InputError(f"--seed is {self.seed}; give 0 or more.")
        check_outside(self.output, self.photos)
        try:
            self.output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--output {self.output} can't be made ({error.strerror}); name another.") from error

"""`sparsestyle stylise`: the stages from photos and a painting to pages.

A scene's and a run's folder carry a digest of what decides their content, so that it may be used or gone on with.
"""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import List

from sparsestyle_ns.data.parser_choice import parser_name
from sparsestyle_ns.engine.hints import finish
from sparsestyle_ns.runs.checkpoints import checkpoint_step, newest_checkpoint
from sparsestyle_ns.runs.run_folder import COARSE_METHOD, STYLE_METHOD, read_config
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.stylise.stylise_options import StyliseOptions
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import digest, safe_file_name
from sparsestyle_ns.utils.interrupts import PRESSES, stop
from sparsestyle_ns.utils.stages import FINISHED, Command, Stage, StageFailedError, clock, run_stages

SECONDS = {"default": (15.0, 190.0, 290.0, 100.0, 80.0), "draft": (5.0, 65.0, 60.0, 40.0, 30.0)}
"""What the commands take, about, on two idle cores; the bar needs their ratios."""
PAGES = ("index.html", "scene.html")
"""With pictures, and to fly through."""
SHARE_READ = 1 << 16
"""Bytes of a photo at its beginning, and at its end, that tell it from others."""


def stylise(options: StyliseOptions) -> None:
    """Runs what isn't finished yet, by checked options, and says where to look.

    Raises:
        InputError: a command failed, and said why; the folder has pages that aren't this command's; or the painting
            can't be used.
        SystemExit: status 130, after Ctrl-C.
    """
    taken = [page for page in PAGES if (options.output / page).exists()]
    if taken and not (options.output / FINISHED).is_dir():
        raise InputError(f"{options.output} has a {taken[0]} that this command didn't make; name another --output.")
    Painting.read(options.painting)  # which stage 2 would do minutes later
    again = shlex.join(["sparsestyle", *sys.argv[1:]])
    try:
        durations = run_stages(options.output, make_stages(options))
    except StageFailedError as error:
        raise InputError(f"{error}\nThe same command goes on with this stage:\n  {again}") from error
    except PRESSES:
        stop(f"Stopped; the same command goes on where it was:\n  {again}")
    for heading, seconds in durations:
        print(f"  {'before' if seconds is None else clock(seconds):>6}  {heading}")
    page = options.output / PAGES[0]
    finish(page.resolve(), ["python", "-m", "webbrowser", page.resolve().as_uri()])


@dataclass
class _Way:
    """Where everything is, and the commands that make it."""

    options: StyliseOptions

    def __post_init__(self) -> None:
        options = self.options
        self.is_scene = is_scene(options.photos)
        self.photos = _short_digest(*scene_files(options.photos))
        self.scene = options.photos.resolve() if self.is_scene else options.output / f"scene-{self.photos}"
        self.outputs = options.output / "outputs"
        coarse = f"coarse-{_short_digest(self.method(COARSE_METHOD), options.seed, options.device, self.photos)}"
        style = _short_digest(coarse, digest(options.painting.read_bytes()), options.stroke_size)
        style = f"{safe_file_name(options.painting.stem, 'style')}-{style}"
        self.coarse, self.stylised = (
            self.outputs / self.scene.stem / self.method(kind) / name
            for kind, name in ((COARSE_METHOD, coarse), (STYLE_METHOD, style))
        )
        self.gallery_page, self.scene_page = (options.output / page for page in PAGES)

    def method(self, kind: str) -> str:
        """The method of a stage, by what the names of its methods start with."""
        return kind + ("-draft" if self.options.methods == "draft" else "")

    def prepare(self) -> Command:
        """Makes the scene."""
        return ["sparsestyle", "prepare", str(self.options.photos), "--output", str(self.scene)]

    def learn(self) -> List[Command]:
        """Stage 1."""
        return self._train(self.coarse, [], "pipeline.model.seed")

    def paint(self) -> List[Command]:
        """Stage 2."""
        flags = ["--style-image", str(self.options.painting), "--coarse-run", str(self.coarse)]
        if self.options.stroke_size != StyliseOptions.stroke_size:
            flags += ["--stroke-size", f"{self.options.stroke_size:g}"]
        return self._train(self.stylised, flags, "pipeline.seed")

    def _train(self, run: Path, flags: Command, own_seed: str) -> List[Command]:
        """Trains a run, from where it is; no command where it is finished."""
        checkpoints = run / "nerfstudio_models"
        newest = newest_checkpoint(checkpoints)
        if newest is not None and checkpoint_step(newest) + 1 >= read_config(run).max_num_iterations:
            return []
        command = ["ns-train", run.parent.name, *flags, "--data", str(self.scene)]
        command += ["--output-dir", str(self.outputs), "--timestamp", run.name]
        if newest is not None:
            command += ["--load-dir", str(checkpoints)]
        if self.options.device != "auto":
            command += ["--machine.device-type", self.options.device]
        if self.options.seed != StyliseOptions.seed:
            names = ("machine.seed", "pipeline.datamanager.seed", own_seed)
            command += [word for name in names for word in (f"--{name}", str(self.options.seed))]
        command += ["--vis", "tensorboard", "--viewer.quit-on-train-completion", "True"]
        return [[*command, parser_name(self.scene)]]

    def show(self) -> Command:
        """The page of pictures."""
        return ["sparsestyle", "gallery", str(self.stylised), "--output-path", str(self.gallery_page), "--force"]

    def export(self) -> Command:
        """The page to fly through."""
        return ["sparsestyle", "export", str(self.stylised), "--output-path", str(self.scene_page), "--force"]


def make_stages(options: StyliseOptions) -> List[Stage]:
    """What has to be done, as commands; those that train say at their turn whether they begin or go on."""
    way, seconds = _Way(options), SECONDS[options.methods]
    prepare = Stage("scene", "A scene of the photos", [way.prepare()], f"{way.scene.name}/*", seconds=seconds[0])
    coarse, stylised = (f"{run.relative_to(options.output)}/config.yml" for run in (way.coarse, way.stylised))
    films = {"Views": 0.1, "Filming": 0.3}
    stages = [
        Stage(
            "coarse", "Stage 1: the scene from a few photos", way.learn, coarse, coarse, seconds[1], {"Stage 1": 0.0}
        ),
        Stage("stylised", "Stage 2: the painting's style", way.paint, stylised, stylised, seconds[2], {"Stage 2": 0.1}),
        Stage("gallery", "A page of pictures", [way.show()], way.gallery_page.name, seconds=seconds[3], works=films),
        Stage("export", "A page to fly through", [way.export()], way.scene_page.name, seconds=seconds[4]),
    ]
    return stages if way.is_scene else [prepare, *stages]


def is_scene(folder: Path) -> bool:
    """Whether ns-train can read a folder as it is: it has poses and, where these are LLFF's, a folder of images."""
    parser = parser_name(folder)
    return parser is not None and (parser != "llff-data" or any(folder.glob("images*/")))


def scene_files(folder: Path) -> List[str]:
    """What tells a scene's files from others: names, sizes, and how they begin and end."""
    found = []
    for path in [folder] if folder.is_file() else sorted(path for path in folder.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            ends = file.read(SHARE_READ)
            file.seek(max(0, path.stat().st_size - SHARE_READ))
            ends += file.read()
        found += [str(path.relative_to(folder)), str(path.stat().st_size), digest(ends)]
    return found


def _short_digest(*parts: object) -> str:
    """Eight hexadecimal digits of all of them."""
    return digest(*(str(part).encode() for part in parts))[:8]

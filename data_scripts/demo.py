"""The whole way from photos and a painting to a film of the stylised scene, with the commands one would type.

    python data_scripts/demo.py                     # a still life, everything in demo/
    python data_scripts/demo.py --scene blender     # objects seen from all around

Photos and painting are made here, so nothing is downloaded. Each stage is a command, which is shown; what it prints is
passed on. A finished stage is not done again, unless it or one before it changes.
"""

import json
import math
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, List, Literal, Optional, Sequence

import tyro
from _command_line import check_ranges, parse, print_made
from _flight import flight

from sparsestyle_ns.utils.stages import FINISHED, Stage, StageFailedError, clock, run_stages

SCRIPTS = Path(__file__).resolve().parent
COARSE, STYLE = "coarse-fewshot-draft", "hier-style-draft"
PRODUCTS = ("scene", "style.png", "outputs", "camera_path.json", "stylised.mp4", "stylised", "index.html")
"""What the demo writes into its folder."""
CHECKPOINTS = "outputs/*/{}/*/nerfstudio_models/*.ckpt"
STAGE_1 = {"seconds": 60.0, "works": {"Stage 1": 0.1}}
STAGE_2 = {"seconds": 80.0, "works": {"Stage 2": 0.3}}
DRAFT = tyro.conf.arg(metavar="INT", help_behavior_hint="(default: the draft's own)")


@dataclass(frozen=True)
class Options:
    """The command line; the docstrings are its help."""

    output: Path = Path("demo")
    """Folder for everything."""
    scene: Literal["llff", "blender"] = "llff"
    """A still life, or objects seen from all around."""
    frames: int = 24
    """Frames of the film, 12 a second."""
    film_side: int = 252
    """Longer side of its frames in pixels, at least 16."""
    images: bool = False
    """Also write the film's frames as PNG files."""
    iterations_coarse: Annotated[Optional[int], DRAFT] = None
    """Iterations of stage 1."""
    iterations_style: Annotated[Optional[int], DRAFT] = None
    """Iterations of stage 2."""
    force: bool = False
    """Do all stages again, finished or not."""

    def __post_init__(self) -> None:
        at_least_one = (1, math.inf)
        check_ranges(self, frames=at_least_one, film_side=(16, math.inf))
        check_ranges(self, iterations_coarse=at_least_one, iterations_style=at_least_one)


def make_stages(options: Options) -> List[Stage]:
    """The stages of the demo."""
    folder = options.output
    scene, style, outputs = folder / "scene" / options.scene, folder / "style.png", folder / "outputs"
    film, page = folder / "stylised.mp4", folder / "index.html"
    scene_flags = ["--layout", options.scene, "--width", "252"]
    make_scene = ["python", str(SCRIPTS / "make_sample_scene.py"), str(folder / "scene"), *scene_flags, "--force"]
    make_style = ["python", str(SCRIPTS / "make_style_image.py"), str(style), "--force"]
    coarse = train_command(COARSE, [], scene, outputs, options.iterations_coarse)
    stylised = train_command(STYLE, ["--style-image", str(style)], scene, outputs, options.iterations_style)

    def render() -> List[List[str]]:
        run, path = newest_run(outputs / scene.name, STYLE), folder / "camera_path.json"
        content = flight(options.scene, scene, run, options.frames, options.film_side)
        path.write_text(json.dumps(content, indent=1) + "\n")
        command = ["ns-render", "camera-path", "--load-config", str(run / "config.yml")]
        command += ["--camera-path-filename", str(path), "--rendered-output-names", "rgb", "--output-path", str(film)]
        film.unlink(missing_ok=True)  # ns-render writes over nothing
        shutil.rmtree(film.with_suffix(""), ignore_errors=True)
        pictures = [[*command, "--output-format", "images", "--image-format", "png"]] if options.images else []
        return [command, *pictures]

    def show() -> List[List[str]]:
        run = newest_run(outputs / scene.name, STYLE)
        command = ["sparsestyle", "gallery", str(run), "--output-path", str(page), "--video", str(film)]
        return [[*command, "--title", "A few photos and a painting", "--force"]]

    rendering = f"{options.frames} frames of {options.film_side} pixels" + ", also as pictures" * options.images
    return [
        Stage("scene", "Photographing a sample scene", [make_scene], f"scene/{scene.name}/*", seconds=15.0),
        Stage("style", "Painting a style image", [make_style], style.name, seconds=5.0),
        Stage("coarse", "Stage 1: a scene from a few photos", [coarse], CHECKPOINTS.format(COARSE), **STAGE_1),
        Stage("stylised", "Stage 2: the painting's style", [stylised], CHECKPOINTS.format(STYLE), **STAGE_2),
        Stage("film", "Filming a flight through the scene", render, film.name, rendering, 50.0),
        Stage("page", "Laying out the page", show, page.name, seconds=30.0),
    ]


def claim_folder(folder: Path) -> None:
    """Makes the demo's folder; StageFailedError where files there that aren't the demo's would be written over."""
    notes = folder / FINISHED
    taken = [name for name in PRODUCTS if (folder / name).exists()]
    if taken and not notes.is_dir():
        raise StageFailedError(f"{folder} has a {taken[0]} that isn't the demo's; name a new folder with --output.")
    notes.mkdir(parents=True, exist_ok=True)


def train_command(method: str, flags: List[str], scene: Path, outputs: Path, iterations: Optional[int]) -> List[str]:
    """ns-train for a sample scene, without a viewer and with a log that can be piped."""
    command = ["ns-train", method, *flags, "--data", str(scene), "--output-dir", str(outputs)]
    command += ["--vis", "tensorboard", "--viewer.quit-on-train-completion", "True"]
    if iterations is not None:
        command += ["--max-num-iterations", str(iterations)]
    return [*command, f"{scene.name}-data"]


def newest_run(experiment: Path, method: str) -> Path:
    """The folder of the newest run of a method in an experiment's folder.

    Raises:
        StageFailedError: there is none.
    """
    configs = experiment.glob(f"{method}/*/config.yml")
    newest = max(configs, key=lambda path: path.stat().st_mtime, default=None)
    if newest is None:
        raise StageFailedError(f"There is no run of {method} in {experiment}.")
    return newest.parent


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The command line; `arguments` default to the process's own. Returns the exit status."""
    options = parse(Options, __doc__, arguments)
    start = time.monotonic()
    try:
        claim_folder(options.output)
        durations = run_stages(options.output, make_stages(options), options.force)
    except StageFailedError as error:
        print(f"\nError: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"\nError: {options.output} can't be used: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nStopped; the same command goes on with the stage that was under way.", file=sys.stderr)
        return 130
    print()
    for heading, seconds in durations:
        print(f"  {'before' if seconds is None else clock(seconds):>6}  {heading}")
    print(f"  {clock(time.monotonic() - start):>6}  in all\n")
    config = newest_run(options.output / "outputs" / options.scene, STYLE) / "config.yml"
    print_made((options.output / "index.html").resolve(), ["ns-viewer", "--load-config", config])
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The whole way from photos and a painting to a film of the stylised scene, with the commands one would type.

    python data_scripts/demo.py                     # a still life, everything in demo/
    python data_scripts/demo.py --scene blender     # objects seen from all around

Photos and painting are made here, so that nothing is downloaded. Each stage is a command, which is shown; what it
prints is passed on. A stage that is finished is not done again, unless it or one before it changes: its command is kept
in OUTPUT/.finished when it ends well.
"""

import argparse
import json
import math
import os
import queue
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Callable, Dict, Iterable, Iterator, List, Optional, Sequence, Tuple, Union

import numpy as np

SCRIPTS = Path(__file__).resolve().parent
FRAMES_PER_SECOND = 12
LINES_OF_A_FAILURE = 20
SILENCE = 20.0
"""Seconds after which a command that prints nothing is said to be still running."""
NEAR_IN_LLFF_WORLD = 4 / 3
"""Distance of the nearest thing seen in the world that the dataparser llff-data lays out (1 / its bound_scale)."""
COARSE, STYLE = "coarse-fewshot-draft", "hier-style-draft"
RULE = "─"
CHECKPOINTS = "outputs/*/{}/*/nerfstudio_models/*.ckpt"


class StageFailedError(Exception):
    """A stage's command ended with an error. The message says which and how."""


# ---------------------------------------------------------------------------------------------------------- the flight


def ellipse_path(cameras: np.ndarray, focus_distance: float, frames: int, widen: float = 1.0) -> np.ndarray:
    """A closed flight before a forward-facing scene: around the mean camera, always looking at one point of the scene.

    Args:
        cameras: camera-to-world matrices (N, 3 or 4, 4) of photos; columns right, up, back, position.
        focus_distance: how far before the mean camera the point lies that stays in the middle.
        frames: positions on the ellipse, evenly spaced; the last is just before the first, so that the film loops.
        widen: half axes of the ellipse, in standard deviations of the photos' positions along right and up.

    Returns:
        Camera-to-world matrices (frames, 4, 4).
    """
    centre = cameras[:, :3, 3].mean(0)
    back = _unit(cameras[:, :3, 2].mean(0))
    right = _unit(np.cross(cameras[:, :3, 1].mean(0), back))
    up = np.cross(back, right)
    offsets = cameras[:, :3, 3] - centre
    across, along = (widen * float(np.sqrt(np.mean((offsets @ axis) ** 2))) for axis in (right, up))
    least = 0.03 * focus_distance  # photos taken from one spot, or all in a row, still get some parallax
    focus = centre - focus_distance * back
    turns = 2 * math.pi * np.arange(frames) / frames
    positions = (
        centre + np.cos(turns)[:, None] * max(across, least) * right + np.sin(turns)[:, None] * max(along, least) * up
    )
    return np.stack([look_at(position, focus, up) for position in positions])


def orbit_path(cameras: np.ndarray, frames: int) -> np.ndarray:
    """A full turn about the z axis around the origin, at the photos' mean distance and height.

    Args:
        cameras: camera-to-world matrices (N, 3 or 4, 4) of photos taken from all around.
        frames: as in `ellipse_path`.

    Returns:
        Camera-to-world matrices (frames, 4, 4).
    """
    positions = cameras[:, :3, 3]
    radius = float(np.linalg.norm(positions, axis=-1).mean())
    elevation = math.asin(float(np.clip(positions[:, 2].mean() / radius, -0.95, 0.95)))
    turns = 2 * math.pi * np.arange(frames) / frames
    ring = np.stack(
        [
            np.cos(turns) * math.cos(elevation),
            np.sin(turns) * math.cos(elevation),
            np.full(frames, math.sin(elevation)),
        ],
        axis=-1,
    )
    return np.stack([look_at(radius * position, np.zeros(3), np.array([0.0, 0.0, 1.0])) for position in ring])


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The camera-to-world matrix (4, 4) of a camera that looks along its own -z, with y as near to `up` as can be."""
    back = _unit(position - target)
    right = _unit(np.cross(up, back))
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=-1)
    return pose


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def camera_path(poses: np.ndarray, size: Tuple[int, int], focal_over_height: float) -> Dict[str, Any]:
    """nerfstudio's camera path, as `ns-render camera-path` reads it.

    Args:
        poses: camera-to-world matrices (frames, 4, 4) in the world of the run's cameras.
        size: width and height of a frame in pixels; made even, since common video formats need that.
        focal_over_height: focal length as a share of the frame's height.
    """
    width, height = (side - side % 2 for side in size)
    field_of_view = math.degrees(2 * math.atan(0.5 / focal_over_height))
    return {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": FRAMES_PER_SECOND,
        "seconds": len(poses) / FRAMES_PER_SECOND,
        "is_cycle": True,
        "camera_path": [
            {"camera_to_world": pose.ravel().tolist(), "fov": field_of_view, "aspect": width / height} for pose in poses
        ],
    }


def flight(layout: str, scene: Path, run: Path, frames: int, longer_side: int) -> Dict[str, Any]:
    """The camera path for a run on a sample scene.

    Args:
        layout: `llff` or `blender`.
        scene: the scene's folder, which knows the photos' size and focal length.
        run: the run's folder, whose scene.json knows where its cameras stand in nerfstudio's world.
        frames: how many.
        longer_side: of a frame in pixels; the other one follows from the photos'.
    """
    cameras = np.array(json.loads((run / "scene.json").read_text())["cameras"])
    if layout == "blender":
        from PIL import Image

        transforms = json.loads((scene / "transforms_train.json").read_text())
        with Image.open(sorted((scene / "train").glob("*.png"))[0]) as photo:
            size = photo.size
        focal = 0.5 * size[0] / math.tan(0.5 * transforms["camera_angle_x"])
        poses = orbit_path(cameras, frames)
    else:
        rows = np.load(scene / "poses_bounds.npy")
        *size, focal = rows[0, :15].reshape(3, 5)[[1, 0, 2], 4]
        near, far = rows[:, 15].min(), rows[:, 16].max()
        # As LLFF's own flights: nearer to the front of the scene than to its back, which hardly moves anyway.
        poses = ellipse_path(cameras, NEAR_IN_LLFF_WORLD / near / (0.25 / near + 0.75 / far), frames)
    width, height = (round(side * longer_side / max(size)) for side in size)
    return camera_path(poses, (width, height), focal / size[1])


# ---------------------------------------------------------------------------------------------------------- the stages


@dataclass
class Stage:
    """One step of the demo.

    Attributes:
        name: of its note in OUTPUT/.finished.
        heading: what it does.
        commands: the commands, or what makes them when its turn comes, where they name what stages before it made.
        product: a pattern below OUTPUT; a finished stage is done again when nothing like it is there any more.
        settings: what it depends on beside its commands and the stages before it.
    """

    name: str
    heading: str
    commands: Union[List[List[str]], Callable[[], List[List[str]]]]
    product: str
    settings: str = ""

    @property
    def key(self) -> str:
        """What has to be the same for a finished stage to count as finished."""
        known = [] if callable(self.commands) else [shlex.join(command) for command in self.commands]
        return "\n".join([*known, self.settings])


class Demo:
    """Runs stages in a folder, each only where it has to be."""

    def __init__(self, folder: Path, force: bool = False):
        self.folder = folder
        self.force = force
        self.durations: List[Tuple[str, Optional[float]]] = []

    def is_finished(self, stage: Stage) -> bool:
        """Whether a stage ended well before, for the same settings, and what it made is still there."""
        note = self._note(stage)
        if self.force or not note.is_file() or note.read_text() != stage.key:
            return False
        return next(self.folder.glob(stage.product), None) is not None

    def run(self, stages: Sequence[Stage]) -> None:
        """Runs stages in their order; from the first one that has to be run, all of them.

        Raises:
            StageFailedError: a command failed; the stages before it stay finished.
        """
        stale = False
        for number, stage in enumerate(stages, start=1):
            heading = f"[{number}/{len(stages)}] {stage.heading}"
            stale = stale or not self.is_finished(stage)
            if not stale:
                print(f"{heading}: done before", flush=True)
                self.durations.append((stage.heading, None))
                continue
            print(f"\n{heading}", flush=True)
            self._note(stage).unlink(missing_ok=True)
            start = time.monotonic()
            for command in stage.commands() if callable(stage.commands) else stage.commands:
                run_command(command, stage.heading)
            self.durations.append((stage.heading, time.monotonic() - start))
            if next(self.folder.glob(stage.product), None) is None:
                raise StageFailedError(f"{stage.heading}: it ended without {self.folder / stage.product}.")
            self._note(stage).parent.mkdir(parents=True, exist_ok=True)
            self._note(stage).write_text(stage.key)
            print(f"      done in {clock(self.durations[-1][1] or 0)}", flush=True)

    def _note(self, stage: Stage) -> Path:
        return self.folder / ".finished" / stage.name


def run_command(command: List[str], heading: str) -> None:
    """Runs a command, shows it, and passes on what it prints, with the time since it started before each line.

    Ctrl-C reaches the command too; it is given the time to save what it has.

    Raises:
        StageFailedError: it can't be started or its exit status isn't 0; the message ends with its last lines.
    """
    print(f"      $ {shlex.join(command)}", flush=True)
    start, last = time.monotonic(), deque(maxlen=LINES_OF_A_FAILURE)
    program = [program_path(command[0]), *command[1:]]
    try:
        process = subprocess.Popen(
            program,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONWARNINGS": "ignore"},
            encoding="utf-8",
            errors="replace",
        )
    except OSError as error:
        raise StageFailedError(f"{heading}: {command[0]} can't be started ({error.strerror}).") from error
    assert process.stdout is not None

    def show(text: str) -> None:
        print(f"{clock(time.monotonic() - start)} {text}", flush=True)

    printed = read_lines(process.stdout)
    with process:
        try:
            for line in without_config(lines_of(printed, show)):
                last.append(line)
                show(line)
        except KeyboardInterrupt:
            for line in without_config(lines_of(printed, show)):
                show(line)
            raise
        except BaseException:
            process.terminate()
            raise
    if process.returncode != 0:
        tail = "\n".join(f"    {line}" for line in last)
        raise StageFailedError(
            f"{heading}: {command[0]} ended with exit status {process.returncode}; its last lines were\n{tail}"
        )


def program_path(name: str) -> str:
    """A program of the environment that this script runs in, else the one on PATH."""
    if name == "python":
        return sys.executable
    beside = Path(sys.executable).parent / name
    return str(beside) if beside.exists() else name


def clock(seconds: float) -> str:
    """Seconds as minutes and seconds, m:ss."""
    return f"{int(seconds) // 60:2d}:{int(seconds) % 60:02d}"


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


def read_lines(stream: IO[str]) -> "queue.Queue[Optional[str]]":
    """Reads a stream in the background into a queue, which ends with None."""
    lines: queue.Queue[Optional[str]] = queue.Queue()

    def read() -> None:
        for line in stream:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    return lines


def lines_of(lines: "queue.Queue[Optional[str]]", show: Callable[[str], None]) -> Iterator[str]:
    """The queue's lines as they come; after a while without any, says through `show` that there is no need to worry."""
    while True:
        try:
            line = lines.get(timeout=SILENCE)
        except queue.Empty:
            show("still running …")
            continue
        if line is None:
            return
        yield line


def without_config(lines: Iterable[str]) -> Iterator[str]:
    """Lines of a command's output without empty ones and without ns-train's 150 lines of configuration.

    They lie between a rule with the heading Config and a plain one; the run's config.yml has them too.
    """
    is_config = False
    for line in lines:
        is_rule = line.count(RULE) > 20
        if is_config or (is_rule and " Config " in line):
            is_config = not (is_config and is_rule)
        elif line.strip():
            yield line.rstrip()


def make_stages(options: argparse.Namespace) -> List[Stage]:
    """The stages of the demo for the command line's options."""
    folder: Path = options.output
    scene, style, outputs = folder / "scene" / options.scene, folder / "style.png", folder / "outputs"
    scene_flags = ["--layout", options.scene, "--width", "252" if options.scene == "llff" else "100"]
    make_scene = ["python", str(SCRIPTS / "make_sample_scene.py"), str(folder / "scene"), *scene_flags, "--force"]
    make_style = ["python", str(SCRIPTS / "make_style_image.py"), str(style)]
    coarse = train_command(COARSE, [], scene, outputs, options.iterations_coarse)
    stylised = train_command(STYLE, ["--style-image", str(style)], scene, outputs, options.iterations_style)
    film, page = folder / "stylised.mp4", folder / "index.html"

    def render() -> List[List[str]]:
        run, path = newest_run(outputs / scene.name, STYLE), folder / "camera_path.json"
        path.write_text(
            json.dumps(flight(options.scene, scene, run, options.frames, options.film_side), indent=1) + "\n"
        )
        command = ["ns-render", "camera-path", "--load-config", str(run / "config.yml")]
        command += ["--camera-path-filename", str(path), "--rendered-output-names", "rgb", "--output-path", str(film)]
        pictures = [[*command, "--output-format", "images", "--image-format", "png"]] if options.images else []
        return [command, *pictures]

    def show() -> List[List[str]]:
        run = newest_run(outputs / scene.name, STYLE)
        command = ["sparsestyle", "gallery", str(run), "--output-path", str(page), "--video", str(film)]
        return [[*command, "--title", "A few photos and a painting"]]

    rendering = f"{options.frames} frames of {options.film_side} pixels" + ", also as pictures" * options.images
    return [
        Stage("scene", "Photographing a sample scene", [make_scene], f"scene/{scene.name}/*"),
        Stage("style", "Painting a style image", [make_style], style.name),
        Stage("coarse", "Stage 1: a scene from a few photos", [coarse], CHECKPOINTS.format(COARSE)),
        Stage("stylised", "Stage 2: the painting's style", [stylised], CHECKPOINTS.format(STYLE)),
        Stage("film", "Filming a flight through the scene", render, film.name, rendering),
        Stage("page", "Laying out the page", show, page.name),
    ]


def train_command(method: str, flags: List[str], scene: Path, outputs: Path, iterations: Optional[int]) -> List[str]:
    """ns-train for a sample scene, without a viewer and with a log that can be piped."""
    command = ["ns-train", method, *flags, "--data", str(scene), "--output-dir", str(outputs)]
    command += ["--vis", "tensorboard", "--viewer.quit-on-train-completion", "True"]
    if iterations is not None:
        command += ["--max-num-iterations", str(iterations)]
    return [*command, f"{scene.name}-data"]


# ---------------------------------------------------------------------------------------------------- command line


def _parse(arguments: Optional[Sequence[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="From photos and a painting to a film of the stylised scene.")
    parser.add_argument("--output", type=Path, default=Path("demo"), help="folder for everything (default: demo)")
    parser.add_argument(
        "--scene", choices=("llff", "blender"), default="llff", help="a still life, or objects seen from all around"
    )
    parser.add_argument("--frames", type=int, default=24, help=f"frames of the film, {FRAMES_PER_SECOND} a second")
    parser.add_argument("--film-side", type=int, default=128, help="longer side of its frames in pixels (default: 128)")
    parser.add_argument("--images", action="store_true", help="also write the film's frames as PNG files")
    parser.add_argument("--iterations-coarse", type=int, help="iterations of stage 1 (default: the draft's own)")
    parser.add_argument("--iterations-style", type=int, help="iterations of stage 2 (default: the draft's own)")
    parser.add_argument("--force", action="store_true", help="do all again, finished or not")
    options = parser.parse_args(arguments)
    for name, least in (("frames", 1), ("film_side", 16), ("iterations_coarse", 1), ("iterations_style", 1)):
        value = getattr(options, name)
        if value is not None and value < least:
            parser.error(f"--{name.replace('_', '-')} is {value}, but has to be at least {least}")
    return options


def main(arguments: Optional[Sequence[str]] = None) -> int:
    """The command line; `arguments` default to the process's own. Returns the exit status."""
    options = _parse(arguments)
    start = time.monotonic()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the command that is under way ends too
    try:
        options.output.mkdir(parents=True, exist_ok=True)
        demo = Demo(options.output, options.force)
        demo.run(make_stages(options))
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
    for heading, seconds in demo.durations:
        print(f"  {'before' if seconds is None else clock(seconds):>6}  {heading}")
    print(f"  {clock(time.monotonic() - start):>6}  in all\n")
    viewer = [
        "ns-viewer",
        "--load-config",
        str(newest_run(options.output / "outputs" / options.scene, STYLE) / "config.yml"),
    ]
    print(f"Made {(options.output / 'index.html').resolve()} – next: {shlex.join(viewer)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

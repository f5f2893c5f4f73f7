"""`sparsestyle prepare`: photos in, a scene out."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import List, Literal, Sequence

import torch

from sparsestyle_ns.engine.hints import finish
from sparsestyle_ns.prepare.diagnosis import check_photos
from sparsestyle_ns.prepare.framing import MIN_PHOTOS, Framing, find_photos, frame_photos, write_photos
from sparsestyle_ns.prepare.poses import TRANSFORMS, find_poses, read_for_pose, say_what_is_turned
from sparsestyle_ns.prepare.prepare_options import PrepareOptions
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.machine import put_ffmpeg_on_path

PoseSource = Literal["auto", "file", "colmap"]


@dataclass
class PreparedScene:
    """What `prepare_scene` made: its folder, the dataparser that reads it, and its photos' file names."""

    folder: Path
    parser: str
    names: List[str]


def prepare(options: PrepareOptions) -> None:
    """Makes a scene of photos, and says where it is; see `prepare_scene`."""
    scene = prepare_scene(options.photos, options.output, options.poses)
    made = f"{scene.folder}, {len(scene.names)} photos with poses"
    finish(made, ["ns-train", "coarse-fewshot", "--data", scene.folder, scene.parser])


def prepare_scene(photos: Path, output: Path, source: PoseSource = "auto") -> PreparedScene:
    """Makes a scene of photos, of one size and with poses, in a folder that isn't there yet or is empty.

    Photos without poses are turned upright; photos with poses from a file stay as the poses are for them. What is wrong
    with photos is printed, a line each; an InputError where they or their poses can't be used, or COLMAP finds none.
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output} is there already; name a folder that isn't, with --output.")
    paths = find_photos(photos)
    poses = None if source == "colmap" else find_poses(paths[0].parent)
    if source == "file" and poses is None:
        raise InputError(f"Neither poses_bounds.npy nor transforms.json lies beside the photos in {paths[0].parent}.")
    if poses is not None:
        paths = poses.photos(paths)
    read = [read_for_pose(path, poses, index) for index, path in enumerate(paths)]
    say_what_is_turned(read, poses)
    framings = frame_photos([photo.image.size for photo in read])
    _say_what_changes(framings)
    framed = [framing.apply(photo.image) for photo, framing in zip(read, framings, strict=True)]
    findings = check_photos(framed, [path.name for path in paths])
    for sentence in findings:
        print(f"Warning: {sentence}", flush=True)
    if poses is None:
        _require_colmap(paths[0].parent)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".prepare-", dir=output.parent) as folder:
            scene = Path(folder) / "scene"
            scene.mkdir()
            if poses is not None:
                print(f"Poses are those in {poses.path}")
                names = write_photos(read, framings, scene / "images")
                poses.write(scene, names, framings)
            else:
                write_photos(read, framings, Path(folder) / "photos")
                names = _run_colmap(Path(folder) / "photos", scene, [path.name for path in paths], findings)
            if output.exists():
                output.rmdir()
            os.replace(scene, output)
    except OSError as error:
        raise InputError(f"The scene can't be written to {output} ({error.strerror}); name another folder.") from error
    return PreparedScene(output, "nerfstudio-data" if poses is None else poses.parser, names)


def _say_what_changes(framings: Sequence[Framing]) -> None:
    sizes = {framing.original for framing in framings}
    width, height = framings[0].size
    if len(sizes) > 1:
        print(
            f"The photos have {len(sizes)} sizes; their longer sides are scaled to {max(framings[0].scaled)} pixels, "
            f"and all are cropped about the middle to {width} × {height}"
        )


def _require_colmap(photos: Path) -> None:
    if shutil.which("colmap") is None:
        raise InputError(
            "Where the photos were taken isn't known: COLMAP, which works that out, is not installed, and no "
            f"poses_bounds.npy or transforms.json lies beside the photos in {photos}; install COLMAP (apt install "
            "colmap, brew install colmap, or conda install -c conda-forge colmap), or put one of the two files there."
        )


def _run_colmap(photos: Path, scene: Path, originals: Sequence[str], findings: Sequence[str]) -> List[str]:
    """Has COLMAP find the poses, by way of ns-process-data, which writes the scene, and returns its photos' names."""
    put_ffmpeg_on_path()
    program = shutil.which("ns-process-data") or str(Path(sys.executable).with_name("ns-process-data"))
    command = [
        *(program, "images", "--data", str(photos), "--output-dir", str(scene)),
        *("--matching-method", "exhaustive", "--num-downscales", "0"),
        "--gpu" if torch.cuda.is_available() else "--no-gpu",
    ]
    print("COLMAP looks for where the photos were taken …", flush=True)
    done = subprocess.run(command, capture_output=True, text=True)
    advice = " ".join(findings) or "Photos that overlap by two thirds, taken a step apart, work best."
    try:
        frames = json.loads((scene / TRANSFORMS).read_text())["frames"]
    except (OSError, ValueError, KeyError):
        frames = []
    if done.returncode != 0 or len(frames) < MIN_PHOTOS:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:] if done.returncode else []
        reason = f" (ns-process-data ended with: {last[0].strip()})" if last else ""
        raise InputError(f"COLMAP found where {len(frames)} of {len(originals)} photos were taken{reason}. {advice}")
    placed = [Path(frame["file_path"]).name for frame in frames]
    numbers = {int(Path(name).stem.rsplit("_", 1)[-1]) for name in placed}
    missing = [name for number, name in enumerate(originals, start=1) if number not in numbers]
    if missing:
        print(f"Warning: COLMAP couldn't tell where {', '.join(missing)} was taken; the scene does without. {advice}")
    return placed

"""`sparsestyle prepare`: photos in, a scene out."""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import List, Literal, Optional, Sequence, Tuple, Union

from sparsestyle_ns.engine.hints import finish
from sparsestyle_ns.prepare.diagnosis import compare, findings
from sparsestyle_ns.prepare.estimation import EstimatedPoses, estimate_poses
from sparsestyle_ns.prepare.framing import Framing, Photo, find_photos, frame_photos, write_masks, write_photos
from sparsestyle_ns.prepare.poses import Poses, find_poses, read_for_pose, say_what_is_turned, say_what_masks_are_unused
from sparsestyle_ns.prepare.prepare_options import PrepareOptions
from sparsestyle_ns.prepare.selection import without_useless
from sparsestyle_ns.prepare.video import VIDEO_SUFFIXES, choose_frames
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import all_or_nothing, check_outside, check_writable, not_writable
from sparsestyle_ns.utils.progress import track

PoseSource = Literal["auto", "file", "estimate"]
WHAT = "The scene"


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
    with photos, and which are left out, is printed, a line each.

    Args:
        photos: a folder of photos, or a video.

    Raises:
        InputError: photos or their poses can't be used, or where they were taken can't be told.
    """
    check_outside(output, photos)
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output} is there already; name a folder that isn't, with --output.")
    check_writable(output, WHAT, "--output")
    read, poses = _read_photos(photos, source)
    framings = frame_photos([photo.image.size for photo in read])
    _say_what_changes(framings)
    framed = [framing.apply(photo.image) for photo, framing in zip(read, framings, strict=True)]
    seen = compare(framed, [photo.path.name for photo in read])
    found: Union[Poses, EstimatedPoses]
    if poses is None:
        found = estimate_poses(read, framings, seen)
        read, framings = ([items[photo] for photo in found.found.photos] for items in (read, framings))
    else:
        found = poses
        for sentence in findings(seen):
            print(f"Warning: {sentence}", flush=True)
    print(found.summary())
    names = _write(found, read, framings, output)
    return PreparedScene(output, found.parser, names)


def _read_photos(photos: Path, source: PoseSource) -> Tuple[List[Photo], Optional[Poses]]:
    """The photos that a scene is made of, and their poses if a file has some."""
    if photos.is_file() and photos.suffix.lower() in VIDEO_SUFFIXES:
        if source == "file":
            raise InputError(f"{photos} is a video, which has no poses beside it; leave --poses file out.")
        return choose_frames(photos), None
    paths = find_photos(photos)
    poses = None if source == "estimate" else find_poses(paths[0].parent)
    if source == "file" and poses is None:
        raise InputError(f"Neither poses_bounds.npy nor transforms.json lies beside the photos in {paths[0].parent}.")
    if poses is not None:
        paths = poses.photos(paths)
    read = [read_for_pose(path, poses, index) for index, path in enumerate(track(paths, "Reading photos"))]
    say_what_is_turned(read, poses)
    say_what_masks_are_unused(paths[0].parent, read)
    return (without_useless(read) if poses is None else read), poses


def _write(
    poses: Union[Poses, EstimatedPoses], photos: Sequence[Photo], framings: Sequence[Framing], output: Path
) -> List[str]:
    try:
        with all_or_nothing([output]):
            output.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".prepare-", dir=output.parent) as folder:
                scene = Path(folder) / "scene"
                scene.mkdir()
                names = write_photos(photos, framings, scene / "images")
                write_masks(photos, framings, scene, names)
                poses.write(scene, names, framings)
                if output.exists():
                    output.rmdir()
                os.replace(scene, output)
    except OSError as error:
        raise not_writable(output, WHAT, error.strerror, "--output") from error
    return names


def _say_what_changes(framings: Sequence[Framing]) -> None:
    sizes = {framing.original for framing in framings}
    width, height = framings[0].size
    if len(sizes) > 1:
        print(
            f"The photos have {len(sizes)} sizes; their longer sides are scaled to {max(framings[0].scaled)} pixels, "
            f"and all are cropped about the middle to {width} × {height}"
        )

"""Camera poses that are estimated from the photos alone, and the scene that is written with them."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Dict, List, Sequence

import numpy as np
import torch
from jaxtyping import Float

from sparsestyle_ns.core.camera_paths import is_forward_facing
from sparsestyle_ns.data.estimated import POSES_ESTIMATED, TRANSFORMS
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.tracks import Tracks
from sparsestyle_ns.prepare.diagnosis import Comparison, findings, hopeless, left_out
from sparsestyle_ns.prepare.framing import Framing, Photo
from sparsestyle_ns.prepare.lenses import shared_lenses
from sparsestyle_ns.prepare.poses import POSES_BOUNDS
from sparsestyle_ns.prepare.reconstruction import Reconstruction, num_steps, reconstruct
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import bar

DEPTHS, BEYOND = (1.0, 99.0), 0.2
"""Percentiles of the depths of a photo's points, and the share by which it sees nearer and farther than that: matched
points aren't on everything."""


@dataclass
class EstimatedPoses:
    """Poses of those photos that have some, found by `reconstruct` at the size at which photos are compared."""

    found: Reconstruction
    seen: Comparison
    parser: str = field(default="nerfstudio-data", init=False)
    """The dataparser that reads what `write` writes; known after that."""

    def write(self, folder: Path, names: Sequence[str], framings: Sequence[Framing]) -> None:
        """Writes poses, bounds and tracks of the photos with poses into a folder that has them in `images`.

        For cameras that all look one way there is a `poses_bounds.npy` too, which `llff-data` reads with the lens from
        `transforms.json`.

        Args:
            names, framings: of the photos with poses.
        """
        sizes = [framing.size for framing in framings]
        scales = [size[0] / self.seen.greys[0].shape[1] for size in sizes]
        focals = self.found.focals * scales
        bounds = [self._bounds(photo) for photo in self.found.photos]
        self._write_transforms(folder, names, framings, focals)
        self._tracks(names).save(folder)
        rows = [
            poses_bounds_row(pose, (size[1], size[0], focal), bound)
            for pose, size, focal, bound in zip(self.found.poses, sizes, focals, bounds, strict=True)
        ]
        if is_forward_facing(torch.from_numpy(self.found.poses)):
            np.save(folder / POSES_BOUNDS, np.stack(rows))
            try:
                LLFFDataParserConfig(data=folder).setup().get_dataparser_outputs("train")
                self.parser = "llff-data"
            except InputError:  # a photo sees things beside the average camera, where NDC has no place for them
                (folder / POSES_BOUNDS).unlink()

    def _bounds(self, photo: int) -> Float[np.ndarray, "2"]:
        near, far = np.percentile(self.found.depths(photo), DEPTHS)
        return np.array([(1.0 - BEYOND) * near, (1.0 + BEYOND) * far])

    def _write_transforms(
        self, folder: Path, names: Sequence[str], framings: Sequence[Framing], focals: Float[np.ndarray, "photos"]
    ) -> None:
        frames: List[Dict[str, Any]] = []
        for index, (name, framing) in enumerate(zip(names, framings, strict=True)):
            width, height = framing.size
            pose = np.concatenate([self.found.poses[index], [[0.0, 0.0, 0.0, 1.0]]])
            lens = {"fl_x": focals[index], "fl_y": focals[index], "cx": width / 2, "cy": height / 2}
            bend = {"k1": self.found.distortion[index], "k2": 0.0, "p1": 0.0, "p2": 0.0}
            frame = {**lens, "w": width, "h": height, **bend, "transform_matrix": pose.tolist()}
            frames.append({"file_path": f"images/{name}", **frame})
        content = {"camera_model": "OPENCV", POSES_ESTIMATED: True, "frames": frames}
        (folder / TRANSFORMS).write_text(json.dumps(content, indent=2) + "\n")

    def _tracks(self, names: Sequence[str]) -> Tracks:
        photos, points, features = self.found.seen.T
        height, width = self.seen.greys[0].shape
        places = {photo: place for place, photo in enumerate(self.found.photos)}
        at = [self.seen.features[photo].points[row] for photo, row in zip(photos, features, strict=True)]
        which = np.array([places[photo] for photo in photos])
        return Tracks(tuple(names), which, points, (np.array(at) + 0.5) / (width, height))

    def summary(self) -> str:
        """What was found, in a line."""
        width = self.seen.greys[0].shape[1]
        focals = sorted({round(focal / width, 3) for focal in self.found.focals.tolist()})
        bend = self.found.distortion[np.abs(self.found.distortion).argmax()]
        return (
            f"Poses are estimated from {len(self.found.photos)} photos: {len(self.found.points)} points, "
            f"{self.found.error:.2f} pixels off on average at {width} pixels across; focal length "
            f"{', '.join(f'{focal:.3g}' for focal in focals)} widths" + (f", distortion {bend:+.3f}" if bend else "")
        )


def poses_bounds_row(
    pose: Float[np.ndarray, "3 4"], size: Sequence[float], bounds: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "17"]:
    """A row of `poses_bounds.npy` (`data.llff`); `size` is (height, width, focal length) in pixels."""
    right, up, back, position = pose.T
    return np.concatenate([np.stack([-up, right, back, position, size], axis=1).ravel(), bounds])


def estimate_poses(photos: Sequence[Photo], framings: Sequence[Framing], seen: Comparison) -> EstimatedPoses:
    """Finds where photos were taken; some may be left out.

    Raises:
        InputError: that can't be told of three photos; it says why, and which photo to take next.
    """
    reasons = findings(seen)
    if hopeless(seen):
        raise InputError(f"Where the photos were taken can't be told. {' '.join(reasons)}")
    lenses, lens_of = shared_lenses([(photo.exif, photo.image.size) for photo in photos])
    height, width = seen.greys[0].shape
    longer = max(framings[0].scaled) * width / framings[0].size[0]
    with bar("Estimating poses", 2 * num_steps(lenses)) as progress:
        found = reconstruct(seen.matches, (width, height), longer, lenses, lens_of, progress.advance)
        if found is None or len(found.photos) < len(photos):
            more = reconstruct(seen.guided(), (width, height), longer, lenses, lens_of, progress.advance)
            if more is not None and (found is None or len(more.photos) > len(found.photos)):
                found = more
        progress.reach(2 * num_steps(lenses))
    if found is None:
        raise InputError(f"Where the photos were taken can't be told. {' '.join(reasons or left_out(seen, ()))}")
    if len(found.photos) < len(photos):
        names = ", ".join(name for photo, name in enumerate(seen.names) if photo not in found.photos)
        print(f"Warning: {names}: left out, as no pose is found", flush=True)
        reasons += [reason for reason in left_out(seen, found.photos) if reason not in reasons]
    for reason in [*reasons, *_zoomed(found, lens_of, seen.names)]:
        print(f"Warning: {reason}", flush=True)
    return EstimatedPoses(found, seen)


def _zoomed(found: Reconstruction, lens_of: Sequence[int], names: Sequence[str]) -> List[str]:
    """Which photos of one lens, as far as EXIF tells, have a focal length of their own; in a sentence, if any."""
    usual = {
        lens: float(
            np.median(
                [focal for photo, focal in zip(found.photos, found.focals, strict=True) if lens_of[photo] == lens]
            )
        )
        for lens in set(lens_of)
    }
    factors = {
        names[photo]: focal / usual[lens_of[photo]] for photo, focal in zip(found.photos, found.focals, strict=True)
    }
    apart = [f"{name} ({factor:.2g} times)" for name, factor in factors.items() if abs(factor - 1.0) > 0.05]
    if not apart:
        return []
    return [
        f"{', '.join(apart)} seems to be taken with another zoom than the others, and gets a focal length of its own, "
        "which is less certain; take it again with theirs, from nearer or farther."
    ]

"""Which places in a scene's photos show the same point, kept with the scene where its cameras were estimated from them.

So the depth that stage 1 learns rests on the very matches that the poses do.
"""

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Optional, Sequence, Tuple

import numpy as np
from jaxtyping import Float, Int

from sparsestyle_ns.data.features import PhotoMatches
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole

TRACKS_FILE = "tracks.npz"


@dataclass
class Tracks:
    """Points as photos see them, an observation each.

    Attributes:
        names: file names of the photos.
        photos: the photo of each observation, a place in `names`.
        points: the point of each observation.
        positions: where in the photo, in shares of its width and height, from its left upper corner.
    """

    names: Tuple[str, ...]
    photos: Int[np.ndarray, "observations"]
    points: Int[np.ndarray, "observations"]
    positions: Float[np.ndarray, "observations 2"]

    def save(self, folder: Path) -> None:
        """Writes `tracks.npz` into a scene's folder."""
        content = {"names": np.array(self.names), "photos": self.photos, "points": self.points}
        write_whole(folder / TRACKS_FILE, lambda file: np.savez_compressed(file, **content, positions=self.positions))

    @classmethod
    def find(cls, folder: Path) -> Optional["Tracks"]:
        """What `save` wrote; None where there is nothing, an `InputError` where that can't be read."""
        path = folder / TRACKS_FILE
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as content:
                names, photos, points = (content[key] for key in ("names", "photos", "points"))
                positions = content["positions"]
            whole = photos.shape == points.shape == positions.shape[:1] and positions.shape[1:] == (2,)
            if not whole or photos.min(initial=0) < 0 or photos.max(initial=0) >= len(names):
                raise ValueError("its parts don't fit together")
        except Exception as error:  # numpy meets a damaged archive with errors of many kinds
            raise InputError(
                f"{path} can't be read ({error}): prepare the scene again, or take the file out, and points are "
                "matched anew."
            ) from error
        return cls(tuple(map(str, names)), photos.astype(int), points.astype(int), positions.astype(float))

    def matches(self, names: Sequence[str], sizes: Sequence[Tuple[int, int]]) -> PhotoMatches:
        """The tracks as matches of each two of some photos, given as files, and as (width, height) in pixels."""
        seen = [np.flatnonzero(self.photos == self._place(name)) for name in names]
        points = [self.positions[rows] * size - 0.5 for rows, size in zip(seen, sizes, strict=True)]
        shared = {
            pair: np.stack(np.intersect1d(*(self.points[seen[index]] for index in pair), return_indices=True)[1:])
            for pair in combinations(range(len(names)), 2)
        }
        return PhotoMatches(points, shared)

    def _place(self, name: str) -> int:
        return self.names.index(name) if name in self.names else -1

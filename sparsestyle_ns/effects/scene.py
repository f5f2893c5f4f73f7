"""What effects are measured on, read and computed at most once, and only when an effect asks for it."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Callable, List, Optional

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from PIL import Image
from torch import Tensor

from sparsestyle_ns.data.matches import PointMatches, match_points
from sparsestyle_ns.data.photos import open_photo
from sparsestyle_ns.data.scene_info import NDC, SCENE_INFO, scene_info
from sparsestyle_ns.data.view_selection import evenly_spaced

LONGEST_SIDE = 504
"""Pixels along the longer side at which photos are looked at."""
BORDER = 0.02
"""Width of a photo's border, as a part of its longer side; at least one pixel."""
MATCHED_VIEWS = 24
"""Photos among which points are matched; more would cost minutes and say the same."""
SAME_COLOR = 6 / 255
"""How far border pixels may lie from their median, in each channel, to count as one colour."""


@dataclass
class Scene:
    """A scene's training views as `read_scene` gives them, and once known σ_c at field coordinates and the painting."""

    outputs: DataparserOutputs
    coarse_density: Optional[Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points"]]] = None
    style_image: Optional[Float[Tensor, "3 H W"]] = None

    @property
    def cameras(self) -> Cameras:
        """The photos' cameras."""
        return self.outputs.cameras

    @property
    def ndc(self) -> Optional[NDC]:
        """The map to NDC, in which the scene box then is; None where the dataparser gives none."""
        return scene_info(self.outputs).ndc

    @cached_property
    def photos(self) -> List[Float[np.ndarray, "H W 4"]]:
        """RGBA in [0, 1], not premultiplied, at most `LONGEST_SIDE` pixels along the longer side."""
        return [read_rgba(path) for path in self.outputs.image_filenames]

    @cached_property
    def transparent(self) -> bool:
        """Whether photos have transparency, and the dataparser a colour to put behind it."""
        return self.outputs.alpha_color is not None and any((photo[..., 3] < 1.0).any() for photo in self.photos)

    @cached_property
    def empty_border(self) -> float:
        """Share of all photos' border pixels that show nothing: transparent, else all of one colour."""
        pixels = np.concatenate([border(photo) for photo in self.photos])
        if self.transparent:
            return float((pixels[:, 3] < 0.5).mean())
        return float((np.abs(pixels[:, :3] - np.median(pixels[:, :3], axis=0)) <= SAME_COLOR).all(axis=-1).mean())

    @cached_property
    def background_color(self) -> List[float]:
        """RGB behind the scene: the dataparser's for transparent photos, else the border's median."""
        if self.transparent:
            return [float(value) for value in self.outputs.alpha_color]
        return np.median(np.concatenate([border(photo)[:, :3] for photo in self.photos]), axis=0).tolist()

    @cached_property
    def matches(self) -> PointMatches:
        """Points that are seen in two of `matched_views`; photos are numbered by their places there."""
        chosen = self.matched_views
        names = [self.outputs.image_filenames[index].name for index in chosen]
        cameras, info = self.cameras[torch.tensor(chosen)], self.outputs.metadata.get(SCENE_INFO)
        tracks = None if info is None else info.tracks
        return match_points([self.photos[index] for index in chosen], cameras, names, tracks)

    @cached_property
    def sure_matches(self) -> PointMatches:
        """Those of them by which colours and cameras can be judged."""
        return self.matches.sure()

    @property
    def matched_views(self) -> List[int]:
        """Photos among which points are matched: at most `MATCHED_VIEWS`, evenly spaced."""
        return list(evenly_spaced(len(self.cameras), MATCHED_VIEWS))


def read_rgba(path: Path) -> Float[np.ndarray, "H W 4"]:
    """A photo, reduced to `LONGEST_SIDE`; an `InputError` if it can't be read."""
    image = open_photo(path).convert("RGBA")
    image.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.BOX)
    return np.asarray(image, dtype=np.float32) / 255.0


def border(photo: Float[np.ndarray, "H W C"]) -> Float[np.ndarray, "pixels C"]:
    """The pixels along a photo's four sides."""
    height, width = photo.shape[:2]
    inside = np.zeros((height, width), dtype=bool)
    rim = max(1, round(BORDER * max(height, width)))
    inside[rim:-rim, rim:-rim] = True
    return photo[~inside]

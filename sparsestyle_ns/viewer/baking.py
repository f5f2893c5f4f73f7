"""Baked volumes filled ahead, on a CPU: what cameras near the photos see is there when they come.

A camera that sees a place for the first time waits for the fields to be evaluated there, most of a second on two cores.
"""

import threading
import time
from contextlib import AbstractContextManager
from typing import Callable, List, Optional, Set, Tuple
from weakref import WeakKeyDictionary

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sparsestyle_ns.core.camera_paths import at_poses, poses_between
from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.baked import BakedVolume

SIDE = 252
"""Longer side of the pictures whose voxels are filled in: with a volume of 256 cells a side, one ray for each cell."""
STEPS_BETWEEN = 4
"""Cameras on the way from each photo's to the next one's."""
RAYS_AT_ONCE = 1024
"""Between so many, about a tenth of a second on two cores, the viewer's own pictures get their turn."""


def likely_cameras(cameras: Cameras) -> List[Cameras]:
    """Cameras that a viewer is likely to pass: those of the photos, then those on the way from each to the next."""
    gaps, steps, poses = len(cameras) - 1, STEPS_BETWEEN + 1, cameras.camera_to_worlds.cpu()
    path = poses_between(poses, gaps * steps + 1) if gaps else poses
    is_photo = torch.arange(len(path)) % steps == 0
    found = at_poses(torch.cat([path[is_photo], path[~is_photo]]), cameras)
    found.rescale_output_resolution(SIDE / int(max(found.width[0], found.height[0])))
    return [found[index : index + 1] for index in range(len(found))]


class Baker(threading.Thread):
    """Fills the volumes of the styles that are shown, while there is something to fill and the processor is free.

    `cameras` are those of the photos; `lock` is the one that the viewer's pictures are made under.
    """

    def __init__(
        self,
        model: HierStyleModel,
        cameras: Cameras,
        shown: Callable[[], Tuple[StylisedField, ...]],
        is_free: Callable[[], bool],
        lock: AbstractContextManager,
    ) -> None:
        super().__init__(name="baking", daemon=True)
        self.model, self.shown, self.is_free, self.lock = model, shown, is_free, lock
        self.cameras = likely_cameras(cameras)
        # The cameras whose rays have all been followed in a volume, for as long as the model keeps that.
        self.filled: WeakKeyDictionary[BakedVolume, Set[int]] = WeakKeyDictionary()
        self.ending = threading.Event()

    def run(self) -> None:
        """Works until `ending` is set."""
        while not self.ending.is_set():
            task = self._next() if self.is_free() else None
            if task is None:
                self.ending.wait(0.1)
            else:
                self._fill(*task)

    def is_done(self) -> bool:
        """Whether all is filled that the styles on the screen need."""
        return self._next() is None

    def _next(self) -> Optional[Tuple[StylisedField, int]]:
        """A style on the screen, and the number of a camera that its volume isn't filled for."""
        volumes = [(style, self.model.baked.kept(style)) for style in self.shown()]
        filled = [(style, set() if volume is None else self.filled.get(volume, set())) for style, volume in volumes]
        numbers = range(len(self.cameras))
        return next(((style, number) for number in numbers for style, known in filled if number not in known), None)

    def _fill(self, style: StylisedField, number: int) -> None:
        """Follows a camera's rays, as long as the style is shown and its volume stays the same."""
        followed: Optional[BakedVolume] = None
        bundle = self.cameras[number].to(self.model.device).generate_rays(camera_indices=0, keep_shape=False).flatten()
        parts = bundle.origins.split(RAYS_AT_ONCE), bundle.directions.split(RAYS_AT_ONCE)
        for origins, directions in zip(*parts, strict=True):
            volume = self._follow(style, origins, directions)
            if volume is None or followed not in (None, volume):
                return
            followed = volume
        self.filled.setdefault(followed, set()).add(number)

    @torch.no_grad()
    def _follow(self, style: StylisedField, origins: Tensor, directions: Tensor) -> Optional[BakedVolume]:
        """Fills what these rays meet, once there is time; None instead of the volume where that has become useless."""
        while not self.is_free() and not self.ending.wait(0.1):
            pass
        if self.ending.is_set() or style not in self.shown():
            return None
        with self.lock:
            model, segments = self.model, self.model.space.segments(origins, directions)
            model.baked.render((style,), segments, model.baked_marching, model.background)
            volume = self.model.baked.kept(style)
        time.sleep(0.005)  # whoever waits for the lock gets it
        return volume

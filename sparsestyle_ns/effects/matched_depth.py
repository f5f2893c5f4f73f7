"""The depth of points that two photos share: colours of few photos alone don't settle it.

Stage 1 learns that rays to such points end there (DS-NeRF's idea, Deng et al. 2022, without COLMAP).
"""

from dataclasses import dataclass
from typing import Optional

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestyle_ns.core.triangulation import distances_to_meeting
from sparsestyle_ns.data.matches import PointMatches, why_unmatched
from sparsestyle_ns.effects.decisions import Decisions, Measurement
from sparsestyle_ns.effects.scene import Scene

MIN_POINTS = 100
"""Matched points in a photo, on average, below which depth is known in too few places to be worth its cost."""


@dataclass
class MatchedRays:
    """Rays of unit direction to points whose distance is known, in the world, and the training views they are from."""

    origins: Float[Tensor, "rays 3"]
    directions: Float[Tensor, "rays 3"]
    distances: Float[Tensor, "rays 1"]
    views: Int[Tensor, "rays"]

    def __len__(self) -> int:
        return len(self.origins)


def triangulate(scene: Scene, matches: Optional[PointMatches] = None) -> MatchedRays:
    """Two rays, one from each camera, for each point that two photos share: where they come nearest, if before both.

    Of all the scene's matches, or of these of them.
    """
    matches, poses = scene.matches if matches is None else matches, scene.cameras.camera_to_worlds.double()
    views = torch.tensor(scene.matched_views)[torch.from_numpy(matches.views)]
    origins, directions = poses[views][..., 3], torch.from_numpy(matches.directions)
    distances = distances_to_meeting(origins, directions)
    ahead = (distances.isfinite() & (distances > 0)).all(dim=0)
    rays = (part[:, ahead].flatten(0, 1) for part in (origins, directions, distances[..., None]))
    return MatchedRays(*(part.float() for part in rays), views=views[:, ahead].flatten())


def measure_matched_depth(scene: Scene) -> Measurement:
    """How many points of a photo, on average, are matched and triangulated."""
    unmatched = why_unmatched(scene.cameras)
    if unmatched:
        return Measurement(False, f"not measurable: {unmatched}", None, float(MIN_POINTS), possible=False)
    count = len(triangulate(scene)) / max(1, len(scene.matched_views))
    words = "points a photo, on average, have a depth known from another photo"
    return Measurement(count >= MIN_POINTS, words, count, float(MIN_POINTS), possible=count > 0)


def matched_rays(effects: Decisions, scene: Scene) -> Optional[MatchedRays]:
    """Rays whose depth stage 1 learns beside the photos' colours; None where the effect is off."""
    return triangulate(scene) if effects.on("matched_depth") else None

"""Where rays of two cameras meet, or nearly so."""

import torch
from jaxtyping import Float
from torch import Tensor


def distances_to_meeting(
    origins: Float[Tensor, "2 rays 3"], directions: Float[Tensor, "2 rays 3"]
) -> Float[Tensor, "2 rays"]:
    """Where two rays of unit direction come nearest to each other: the distance from either's origin.

    Infinite, without a gradient, where they are parallel; negative where they come nearest behind an origin.
    """
    first, second = directions
    cosine = (first * second).sum(dim=-1)
    # 1 − cos² without its cancellation for rays that are nearly parallel.
    square_of_sine = torch.linalg.cross(first, second).square().sum(dim=-1)
    along_first, along_second = (directions * (origins[0] - origins[1])).sum(dim=-1)
    along = torch.stack([cosine * along_second - along_first, along_second - cosine * along_first])
    parallel = square_of_sine < 1e-12
    return torch.where(parallel, torch.inf, along / torch.where(parallel, 1.0, square_of_sine))


def reprojection_errors(
    origins: Float[Tensor, "2 rays 3"], directions: Float[Tensor, "2 rays 3"], nearest: float
) -> Float[Tensor, "2 rays"]:
    """The angle, in radians, between a camera's ray to a point and the middle of where two cameras' rays to it pass.

    0 where the rays meet. Points nearer than `nearest`, behind a camera or at infinity count as if at that distance, or
    not at all: rays that don't point to one place in front of both get an error of 0 and no gradient.
    """
    distances = distances_to_meeting(origins, directions)
    ahead = (distances.isfinite() & (distances > nearest)).all(dim=0)
    safe = torch.where(ahead, distances, 1.0)
    ends = origins + safe[..., None] * directions
    gap = ends[1] - ends[0]
    # Rays pass at a right angle to both, so the middle is half the gap aside; the root has no gradient at 0.
    half = 0.5 * (gap.square().sum(dim=-1) + 1e-18).sqrt()
    return torch.where(ahead, torch.atan2(half.expand_as(safe), safe), 0.0)

"""Normalised device coordinates (NDC) of forward-facing scenes: all beyond the near plane (NeRF, appendix C).

o + t d is a ray in the world, where the scene lies along -z; o' + t' d' the same ray in NDC, with t' = 0 on the near
plane z = -n and t' = 1 at infinity; f, w, h are focal length, width and height of the image in pixels.

A ray that doesn't point forward has no image in NDC. Every function here takes the ray straight ahead, direction
(0, 0, -1), from the same origin in its place, so that values and gradients stay finite.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Vectors = Float[Tensor, "*#batch 3"]
Numbers = Float[Tensor, "*#batch 1"]
MIN_FORWARD = 1e-6
"""Smallest -d_z / |d| of a ray that points forward, |d| its largest coordinate, and -z / n of a point with an image."""


def ndc_rays(
    origins: Vectors, directions: Vectors, focal_over_half_size: tuple[float, float], near: float = 1.0
) -> tuple[Vectors, Vectors, Bool[Tensor, "*batch 1"]]:
    """Images of world rays in NDC, where o' + t' d' for t' in [0, 1] runs from the near plane to infinity.

    The origin moves along its ray to the near plane (o_z = -n). Then, by NeRF's appendix C,

        o' = (-(2f/w) o_x/o_z, -(2f/h) o_y/o_z, 1 + 2n/o_z)
        d' = (-(2f/w) (d_x/d_z - o_x/o_z), -(2f/h) (d_y/d_z - o_y/o_z), -2n/o_z)

    so that z' runs from -1 to 1, and d' is not a unit vector. A ray from beyond the near plane (o_z < -n) starts behind
    its origin. `focal_over_half_size` is (2f/w, 2f/h), and `near` is n > 0. The third result says which rays point
    forward: mask what is computed from the others.
    """
    forward_z, valid = _forward(directions)
    slope = torch.where(valid, directions[..., :2], 0.0) / forward_z
    crossing = origins[..., :2] - (near + origins[..., 2:]) * slope
    scale_x, scale_y = focal_over_half_size
    one = torch.ones_like(crossing[..., 0])
    on_near_plane = torch.stack([scale_x * crossing[..., 0] / near, scale_y * crossing[..., 1] / near, -one], dim=-1)
    at_infinity = torch.stack([-scale_x * slope[..., 0], -scale_y * slope[..., 1], one], dim=-1)
    return on_near_plane, at_infinity - on_near_plane, valid


def ndc_distance(
    t_ndc: Numbers, origins: Vectors, directions: Vectors, near: float = 1.0, max_distance: float = math.inf
) -> Numbers:
    """Distance (z - o_z) / d_z from the ray's own origin to the point o' + t' d', with z = -n / (1 - t').

    In units of the direction's length; negative where the point lies behind the origin, and at most `max_distance`,
    which is the result, without a gradient, where t' >= 1.
    """
    forward_z, _ = _forward(directions)
    infinite = t_ndc >= 1
    z = -near / torch.where(infinite, 1.0, 1 - t_ndc)
    distance = (z - origins[..., 2:]) / forward_z
    return torch.where(infinite, max_distance, distance.clamp(max=max_distance))


def ndc_parameter(distance: Numbers, origins: Vectors, directions: Vectors, near: float = 1.0) -> Numbers:
    """t' = 1 + n/z at a distance along a world ray, at most 1: the inverse of `ndc_distance`.

    A point on or behind the camera plane counts as just before it.
    """
    forward_z, _ = _forward(directions)
    z = origins[..., 2:] + distance * forward_z
    return 1.0 + near / z.clamp(max=-MIN_FORWARD * near)


def _forward(directions: Vectors) -> tuple[Numbers, Bool[Tensor, "*batch 1"]]:
    """d_z, and which rays point forward; the others get the value of direction (0, 0, -1)."""
    z = directions[..., 2:]
    valid = z < -MIN_FORWARD * directions.detach().abs().amax(dim=-1, keepdim=True)
    return torch.where(valid, z, -1.0), valid

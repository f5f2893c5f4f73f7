"""Normalised device coordinates (NDC) for forward-facing scenes: all that lies beyond the near plane, in one box.

Source: NeRF (Mildenhall et al. 2020), appendix C. The letters:

- o, d: origin and direction of a ray in the world, where the scene lies along -z;
- o', d': the same ray in NDC;
- n: distance of the near plane, which is z = -n;
- t, t': position along the ray in the world (o + t d) and in NDC (o' + t' d'), with t' = 0 on the near plane and t' = 1
  at infinity;
- f, w, h: focal length, width and height of the image, in pixels. They only set the unit of x' and y': with the image's
  own values a camera at the world's origin sees x', y' in [-1, 1].

A ray that does not point forward (d_z >= 0, or so close to parallel that it makes less than about 1e-6 radians with the
near plane) never reaches the near plane and has no image in NDC. Every function here then takes the ray that looks
straight ahead, direction (0, 0, -1), from the same origin in its place, so that values and gradients stay finite, and
`ndc_rays` says which rays those are.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_FORWARD = 1e-6
"""Smallest -d_z / |d| of a ray that counts as pointing forward, |d| its largest coordinate, whose square need not
exist; and smallest -z / n of a point with an image in NDC."""


def ndc_rays(
    origins: Float[Tensor, "*batch 3"],
    directions: Float[Tensor, "*batch 3"],
    focal_over_half_size: tuple[float, float],
    near: float = 1.0,
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Bool[Tensor, "*batch 1"]]:
    """Images of world rays in NDC, where o' + t' d' for t' in [0, 1] runs from the near plane to infinity.

    The origin moves along its ray to the near plane (o_z = -n). Then, by NeRF's appendix C,

        o' = (-(2f/w) o_x/o_z, -(2f/h) o_y/o_z, 1 + 2n/o_z)
        d' = (-(2f/w) (d_x/d_z - o_x/o_z), -(2f/h) (d_y/d_z - o_y/o_z), -2n/o_z)

    so that z' runs from exactly -1 to 1, and d' is not a unit vector. A ray from an origin beyond the near plane
    (o_z < -n) starts behind its origin; `ndc_distance` is negative on that first stretch.

    Args:
        focal_over_half_size: (2f/w, 2f/h), the focal length over half the image's width and height.
        near: n, the near plane's distance from z = 0 in world units, above 0.

    Returns:
        o', d', and `valid`: False where a ray never reaches the near plane. Such a ray's o' and d' are finite, but are
        those of the ray that looks straight ahead from the same origin: mask what is computed from them.
    """
    slope, _, valid = _forward(directions)
    crossing = origins[..., :2] - (near + origins[..., 2:]) * slope
    scale_x, scale_y = focal_over_half_size
    one = torch.ones_like(crossing[..., 0])
    on_near_plane = torch.stack([scale_x * crossing[..., 0] / near, scale_y * crossing[..., 1] / near, -one], dim=-1)
    at_infinity = torch.stack([-scale_x * slope[..., 0], -scale_y * slope[..., 1], one], dim=-1)
    return on_near_plane, at_infinity - on_near_plane, valid


def ndc_distance(
    t_ndc: Float[Tensor, "*#batch 1"],
    origins: Float[Tensor, "*#batch 3"],
    directions: Float[Tensor, "*#batch 3"],
    near: float = 1.0,
    max_distance: float = math.inf,
) -> Float[Tensor, "*batch 1"]:
    """Distance along the world ray of the point o' + t' d' that `ndc_rays` gives for that ray.

    The point's depth is z = -n / (1 - t') (NeRF, appendix C), and the distance (z - o_z) / d_z is measured from the
    ray's own origin, before its move to the near plane, in units of the direction's length.

    It is negative where the point lies behind the origin, and at most `max_distance`, which is the result, without a
    gradient, where t' >= 1. A ray that never reaches the near plane gets the distance along the ray straight ahead that
    stands in for it. Shapes are broadcast against each other.
    """
    _, forward_z, _ = _forward(directions)
    infinite = t_ndc >= 1
    z = -near / torch.where(infinite, 1.0, 1 - t_ndc)
    distance = (z - origins[..., 2:]) / forward_z
    return torch.where(infinite, max_distance, distance.clamp(max=max_distance))


def ndc_parameter(
    distance: Float[Tensor, "*#batch 1"],
    origins: Float[Tensor, "*#batch 3"],
    directions: Float[Tensor, "*#batch 3"],
    near: float = 1.0,
) -> Float[Tensor, "*batch 1"]:
    """t' of the point at a distance along a world ray: the inverse of `ndc_distance`, t' = 1 + n/z.

    It is below 0 before the near plane and at most 1. A point on or behind the camera plane counts as just before it.
    """
    _, forward_z, _ = _forward(directions)
    z = origins[..., 2:] + distance * forward_z
    return 1.0 + near / z.clamp(max=-MIN_FORWARD * near)


def _forward(
    directions: Float[Tensor, "*batch 3"],
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 1"], Bool[Tensor, "*batch 1"]]:
    """(d_x/d_z, d_y/d_z), d_z, and which rays point forward; the others get the values of direction (0, 0, -1)."""
    z = directions[..., 2:]
    valid = z < -MIN_FORWARD * directions.detach().abs().amax(dim=-1, keepdim=True)
    forward_z = torch.where(valid, z, -1.0)
    return torch.where(valid, directions[..., :2], 0.0) / forward_z, forward_z, valid

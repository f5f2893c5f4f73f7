"""Which part of space a scene lies in, and how it is laid into the cube [−1, 1]³ that the fields live in.

A space turns rays into segments; s in [0, 1] goes from a segment's start to its end. Density is per unit of length in
the cube, so that the scale of the world's coordinates doesn't matter.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Optional, Tuple, Union

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.data.scene_box import SceneBox
from torch import Tensor, nn

from sparsestyle_ns.core.ndc import ndc_distance, ndc_parameter, ndc_rays

MAX_DISTANCE = 1e4
"""Stands for infinity in depth maps, in units of the near plane's distance or of the contraction's unit."""


class Segments(ABC):
    """The parts of a batch of rays that lie in the scene. Rays that miss it have length 0 and `hit` false."""

    hit: Bool[Tensor, "rays"]

    @abstractmethod
    def positions(
        self, s: Float[Tensor, "..."], ray_indices: Optional[Int[Tensor, "samples"]] = None
    ) -> Float[Tensor, "... 3"]:
        """Field coordinates at s: [rays, samples] on all rays, or [samples] on the rays `ray_indices`."""

    @abstractmethod
    def lengths(self, edges: Float[Tensor, "rays edges"]) -> Float[Tensor, "rays samples"]:
        """Length in field coordinates between neighbouring borders."""

    @abstractmethod
    def distance(self, s: Float[Tensor, "rays points"]) -> Float[Tensor, "rays points"]:
        """Distance from the ray's origin in world units, at most `MAX_DISTANCE` of the scene's."""

    @abstractmethod
    def at_distance(self, distance: Float[Tensor, "rays 1"]) -> Float[Tensor, "rays 1"]:
        """s at a distance from the ray's origin in world units: the inverse of `distance`, cut to [0, 1]."""

    def between(self, near: Float[Tensor, "rays 1"], far: Float[Tensor, "rays 1"]) -> "Segments":
        """The parts that lie between two distances in world units; rays that have nothing there don't hit."""
        start, end = self.at_distance(near), self.at_distance(far)
        return self._part(start, torch.maximum(start, end), self.hit & (end > start).squeeze(-1))

    @abstractmethod
    def _part(self, start: Float[Tensor, "rays 1"], end: Float[Tensor, "rays 1"], hit: Tensor) -> "Segments":
        """The parts from one s to another."""


@dataclass
class LinearSegments(Segments):
    """Segments that are straight in field coordinates: start + s · extent."""

    start: Float[Tensor, "rays 3"]
    extent: Float[Tensor, "rays 3"]
    hit: Bool[Tensor, "rays"]

    def positions(self, s: Tensor, ray_indices: Optional[Tensor] = None) -> Tensor:
        """See `Segments.positions`."""
        return _points(self.start, self.extent, s, ray_indices)

    def lengths(self, edges: Tensor) -> Tensor:
        """See `Segments.lengths`."""
        return (edges[:, 1:] - edges[:, :-1]) * self.extent.norm(dim=-1, keepdim=True)

    def _line(self, start: Tensor, end: Tensor, hit: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
        """Start, extent and hit of a part."""
        return self.start + start * self.extent, (end - start) * self.extent * hit[:, None], hit


@dataclass
class _ForwardFacingSegments(LinearSegments):
    """Linear segments in NDC, with the world rays they came from; t' runs from `first` to `last`."""

    origins: Float[Tensor, "rays 3"]
    directions: Float[Tensor, "rays 3"]
    near: float
    first: Float[Tensor, "rays 1"]
    last: Float[Tensor, "rays 1"]

    def distance(self, s: Tensor) -> Tensor:
        t_ndc = self.first + s * (self.last - self.first)
        distance = ndc_distance(t_ndc, self.origins, self.directions, self.near, MAX_DISTANCE * self.near)
        return distance.clamp(min=0.0)  # a ray may start at its own origin, but for rounding

    def at_distance(self, distance: Tensor) -> Tensor:
        t_ndc = ndc_parameter(distance, self.origins, self.directions, self.near)
        return _position_between(t_ndc, self.first, self.last)

    def _part(self, start: Tensor, end: Tensor, hit: Tensor) -> "_ForwardFacingSegments":
        first, last = (torch.lerp(self.first, self.last, s) for s in (start, end))
        line = self._line(start, end, hit)
        return _ForwardFacingSegments(*line, self.origins, self.directions, self.near, first, last)


@dataclass
class _BoxSegments(LinearSegments):
    """Linear segments in a box, entered at distance `near` and left at `far`; `beyond` is behind all of the box."""

    near: Float[Tensor, "rays 1"]
    far: Float[Tensor, "rays 1"]
    beyond: Float[Tensor, "rays 1"]

    def distance(self, s: Tensor) -> Tensor:
        """See `Segments.distance`; a ray that misses the box sees what is beyond it."""
        return torch.where(self.hit[:, None], self.near + s * (self.far - self.near), self.beyond)

    def at_distance(self, distance: Tensor) -> Tensor:
        return _position_between(distance, self.near, self.far)

    def _part(self, start: Tensor, end: Tensor, hit: Tensor) -> "_BoxSegments":
        near, far = (torch.lerp(self.near, self.far, s) for s in (start, end))
        return _BoxSegments(*self._line(start, end, hit), near, far, self.beyond)


@dataclass
class ContractedSegments(Segments):
    """Segments of world rays, bent by the contraction; origins and `near` are in multiples of `unit`, in the world."""

    origins: Float[Tensor, "rays 3"]
    directions: Float[Tensor, "rays 3"]
    near: float
    unit: float
    hit: Bool[Tensor, "rays"]
    ends: Optional[Tuple[Float[Tensor, "rays 1"], Float[Tensor, "rays 1"]]] = None
    """Where each ray starts and ends, by `spacing`; None: from `near` to `MAX_DISTANCE`."""

    def distance(self, s: Tensor) -> Tensor:
        """See `Segments.distance`."""
        return self.unit * self._distance_in_units(s)

    def _distance_in_units(self, s: Tensor, ray_indices: Optional[Tensor] = None) -> Tensor:
        start, end = self._ends(s)
        if self.ends is not None and ray_indices is not None:
            start, end = start[ray_indices, 0], end[ray_indices, 0]
        return inverse_spacing(start + s * (end - start))

    def _ends(self, like: Tensor) -> Tuple[Tensor, Tensor]:
        return self.ends or (spacing(like.new_full((), self.near)), spacing(like.new_full((), MAX_DISTANCE)))

    def _part(self, start: Tensor, end: Tensor, hit: Tensor) -> "ContractedSegments":
        first, last = self._ends(start)
        return replace(self, hit=hit, ends=tuple(first + s * (last - first) for s in (start, end)))

    def at_distance(self, distance: Tensor) -> Tensor:
        """See `Segments.at_distance`."""
        return _position_between(spacing(distance / self.unit), *self._ends(distance))

    def positions(self, s: Tensor, ray_indices: Optional[Tensor] = None) -> Tensor:
        """See `Segments.positions`."""
        distance = self._distance_in_units(s, ray_indices)
        return contract(_points(self.origins, self.directions, distance, ray_indices))

    def lengths(self, edges: Tensor) -> Tensor:
        """See `Segments.lengths`; chords of the bent ray."""
        points = self.positions(edges)
        return (points[:, 1:] - points[:, :-1]).norm(dim=-1)


def _points(origins: Tensor, directions: Tensor, t: Tensor, ray_indices: Optional[Tensor]) -> Tensor:
    """o + t d of all rays, or of the rays `ray_indices`."""
    if ray_indices is None:
        return origins[:, None] + t[..., None] * directions[:, None]
    return origins[ray_indices] + t[:, None] * directions[ray_indices]


def _position_between(value: Tensor, first: Union[float, Tensor], last: Union[float, Tensor]) -> Tensor:
    """Where a value lies between two, in [0, 1]; 0 where they are equal."""
    length = torch.as_tensor(last - first).to(value)
    return torch.where(length > 0, (value - first) / torch.where(length > 0, length, 1.0), 0.0).clamp(0.0, 1.0)


def spacing(distance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """g(t) = t/2 up to t = 1, then 1 − 1/(2t): even steps in g are even in distance near by, in disparity far away."""
    return torch.where(distance < 1.0, 0.5 * distance, 1.0 - 0.5 / distance.clamp(min=1.0))


def inverse_spacing(spaced: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The inverse of `spacing`, at most `MAX_DISTANCE`."""
    return torch.where(spaced < 0.5, 2.0 * spaced, 0.5 / (1.0 - spaced).clamp(min=0.5 / MAX_DISTANCE))


def contract(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """x/2 within the unit cube, (1 − 1/(2|x|)) x/|x| outside: mip-NeRF 360's (Eq. 10) with the maximum norm, halved."""
    norm = points.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
    # Equal to x/2 at norm 1, and so everywhere within the cube. x/|x| comes first: the largest x has no double.
    return (1.0 - 0.5 / norm) * (points / norm)


def uncontract(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The inverse of `contract`, at most `MAX_DISTANCE` away."""
    norm = points.abs().amax(dim=-1, keepdim=True).clamp(min=0.5)
    return 0.5 / (1.0 - norm).clamp(min=0.5 / MAX_DISTANCE) * (points / norm)


def intersect_box(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    minimum: Float[Tensor, "3"],
    maximum: Float[Tensor, "3"],
    near: Union[float, Float[Tensor, ""]] = 0.0,
) -> Tuple[Float[Tensor, "rays 1"], Float[Tensor, "rays 1"], Bool[Tensor, "rays"]]:
    """Distances at which rays enter and leave an axis-aligned box, and whether they meet it (the slab method).

    Rays start no closer than `near`; where they miss the box, both distances are `near`.
    """
    tiny = torch.finfo(directions.dtype).tiny
    safe = torch.where(directions.abs() < tiny, torch.full_like(directions, tiny), directions)
    to_minimum, to_maximum = (minimum - origins) / safe, (maximum - origins) / safe
    entry = torch.minimum(to_minimum, to_maximum).amax(dim=-1, keepdim=True).clamp(min=near)
    leave = torch.maximum(to_minimum, to_maximum).amin(dim=-1, keepdim=True)
    hit = leave > entry
    return torch.where(hit, entry, near), torch.where(hit, leave, near), hit.squeeze(-1)


class Space(nn.Module, ABC):
    """A map from world rays to segments in field coordinates."""

    unbounded: bool
    """Whether a segment's last interval goes on to infinity."""

    @abstractmethod
    def segments(self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]) -> Segments:
        """The parts of world rays (unit directions) that lie in the scene."""

    @abstractmethod
    def to_world(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """World coordinates of field coordinates in the cube; what lies at infinity is `MAX_DISTANCE` away."""


class ForwardFacingSpace(Space):
    """Normalised device coordinates (NeRF, appendix C), for cameras that all look one way: depth d at 1 − 2 near/d.

    Args:
        box: NDC box that holds all views' frusta; between the depths it becomes the cube.
        focal_over_half_size: 2f/width and 2f/height.
        near: distance of the near plane in world units.
        depth_range: depths in world units between which samples lie; None for all from `near` on. What lies at infinity
            looks the same from everywhere: with few photos, a field that puts a whole photo there is hard to dislodge.
    """

    unbounded = True

    def __init__(
        self,
        box: SceneBox,
        focal_over_half_size: Tuple[float, float],
        near: float,
        depth_range: Optional[Tuple[float, float]] = None,
    ) -> None:
        super().__init__()
        nearest, farthest = depth_range or (near, math.inf)
        self.first, self.last = 1.0 - near / max(near, nearest), 1.0 - near / farthest
        minimum, maximum = box.aabb.float().clone()
        minimum[2], maximum[2] = 2.0 * self.first - 1.0, 2.0 * self.last - 1.0
        self.register_buffer("minimum", minimum)
        self.register_buffer("maximum", maximum)
        self.focal_over_half_size = focal_over_half_size
        self.near = near

    def segments(self, origins: Tensor, directions: Tensor) -> _ForwardFacingSegments:
        """See `Space.segments`."""
        start, extent, valid = ndc_rays(origins, directions, self.focal_over_half_size, self.near)
        # A camera that has flown past the nearest thing doesn't see what is behind it, and past the farthest, nothing.
        own = ndc_parameter(torch.zeros_like(origins[:, :1]), origins, directions, self.near)
        first, last = own.clamp(min=self.first), own.clamp(min=self.last)
        hit = (valid & (first < last)).squeeze(-1)
        size = self.maximum - self.minimum
        scale = 2.0 / torch.where(size > 0, size, 2.0)
        start = (start + first * extent - self.minimum) * scale - 1.0
        extent = (last - first) * extent * scale * hit[:, None]
        return _ForwardFacingSegments(start, extent, hit, origins, directions, self.near, first, last)

    def to_world(self, positions: Tensor) -> Tensor:
        """See `Space.to_world`."""
        size = (self.maximum - self.minimum).to(positions)
        ndc = self.minimum.to(positions) + (0.5 * positions + 0.5) * size
        depth = 2.0 * self.near / (1.0 - ndc[..., 2:]).clamp(min=2.0 / MAX_DISTANCE)
        across = ndc[..., :2] * depth / ndc.new_tensor(self.focal_over_half_size)
        return torch.cat([across, -depth], dim=-1)


class BoxSpace(Space):
    """An axis-aligned box in the world, whose longest side is the cube's; rays start at `near`, in half sides of it."""

    unbounded = False

    def __init__(self, box: SceneBox, near: float = 1 / 30) -> None:
        super().__init__()
        self.register_buffer("minimum", box.aabb[0].float().clone())
        self.register_buffer("maximum", box.aabb[1].float().clone())
        self.near = near

    def segments(self, origins: Tensor, directions: Tensor) -> _BoxSegments:
        """See `Space.segments`."""
        center = 0.5 * (self.minimum + self.maximum)
        size = self.maximum - self.minimum
        scale = 2.0 / size.amax()
        near, far, hit = intersect_box(origins, directions, self.minimum, self.maximum, self.near / scale)
        start = (origins + near * directions - center) * scale
        beyond = (origins - center).norm(dim=-1, keepdim=True) + 0.5 * size.norm()
        return _BoxSegments(start, (far - near) * directions * scale, hit, near, far, beyond)

    def to_world(self, positions: Tensor) -> Tensor:
        """See `Space.to_world`."""
        minimum, maximum = self.minimum.to(positions), self.maximum.to(positions)
        return 0.5 * (minimum + maximum) + 0.5 * (maximum - minimum).amax() * positions


class ContractedSpace(Space):
    """All of space, bent beyond `unit`, a length in the world above 0, of which rays start at `near`."""

    unbounded = True

    def __init__(self, unit: float = 1.0, near: float = 0.05) -> None:
        super().__init__()
        self.unit, self.near = unit, near

    def segments(self, origins: Tensor, directions: Tensor) -> ContractedSegments:
        """See `Space.segments`."""
        hit = torch.ones(len(origins), dtype=torch.bool, device=origins.device)
        return ContractedSegments(origins / self.unit, directions, self.near, self.unit, hit)

    def to_world(self, positions: Tensor) -> Tensor:
        """See `Space.to_world`."""
        return self.unit * uncontract(positions)

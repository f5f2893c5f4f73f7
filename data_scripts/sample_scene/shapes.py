"""Balls, boxes and cylinders: where rays hit them, and which way their surfaces face."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Sequence

import numpy as np

from sample_scene.textures import Texture

Vector = tuple[float, float, float]

SELF_HIT_DISTANCE = 1e-3


def column(vector: Sequence[float]) -> np.ndarray:
    """Three numbers -> (3, 1) float32."""
    return np.array(vector, np.float32)[:, None]


def dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Inner products of vectors: (3, N) or (3, 1) each -> (N,). Several times faster than summing along the axis."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


class Shape(ABC):
    """A solid with a painted surface. What its subclasses work out is relative to the centre."""

    centre: Vector
    texture: Texture
    _reach: float
    """Distance from the centre to the farthest point of the surface, or a little more."""

    @abstractmethod
    def _span(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,) at which lines enter and leave it; for a miss the first is larger."""

    @abstractmethod
    def _surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `surface`."""

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the texture takes, and outward unit normals, at points (3, N) on the surface: (3, N) each."""
        return self._surface(points - column(self.centre))

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances along rays, origins (3, N) or (3, 1) and unit directions (3, N), to it: (N,), inf for a miss."""
        origins = origins - column(self.centre)
        along = dot(origins, directions)
        # Only rays that pass through the ball around the shape can hit it.
        near_rays = np.flatnonzero(dot(origins, origins) - along * along < np.float32(self._reach**2))
        origins = origins if origins.shape[1] == 1 else origins[:, near_rays]
        enter, leave = self._span(origins, directions[:, near_rays])
        first = np.where(enter > SELF_HIT_DISTANCE, enter, leave)
        is_hit = (enter <= leave) & (first > SELF_HIT_DISTANCE)
        distances = np.full(directions.shape[1], np.inf, np.float32)
        distances[near_rays[is_hit]] = first[is_hit]
        return distances


@dataclass(frozen=True)
class Sphere(Shape):
    """A ball. The texture sees points in units of the radius."""

    centre: Vector
    radius: float
    texture: Texture

    @property
    def _reach(self) -> float:
        return self.radius * 1.001

    def _span(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _roots(np.float32(1), dot(origins, directions), dot(origins, origins) - np.float32(self.radius**2))

    def _surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        normals = points / np.float32(self.radius)
        return normals, normals


@dataclass(frozen=True)
class Box(Shape):
    """A box, turned by `yaw` radians about its vertical axis. The texture sees points relative to the centre."""

    centre: Vector
    half_size: Vector
    texture: Texture
    yaw: float = 0.0

    @property
    def _reach(self) -> float:
        return math.hypot(*self.half_size) * 1.001

    @property
    def _turn(self) -> np.ndarray:
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]], np.float32)

    def _span(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        enter, leave = _between_planes(self._turn @ origins, self._turn @ directions, column(self.half_size))
        return enter.max(axis=0), leave.min(axis=0)

    def _surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local = self._turn @ points
        relative = local / column(self.half_size)
        axis = np.abs(relative).argmax(axis=0)
        normals = np.where(np.arange(3)[:, None] == axis, np.sign(relative), np.float32(0))
        return local, self._turn.T @ normals


@dataclass(frozen=True)
class Cylinder(Shape):
    """An upright solid cylinder with flat ends. The texture sees points relative to the centre."""

    centre: Vector
    radius: float
    half_height: float
    texture: Texture

    @property
    def _reach(self) -> float:
        return math.hypot(self.radius, self.half_height) * 1.001

    def _span(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = origins
        flat = np.maximum(directions[0] ** 2 + directions[1] ** 2, np.float32(1e-12))
        half_b = x * directions[0] + y * directions[1]
        enter_side, leave_side = _roots(flat, half_b, x * x + y * y - np.float32(self.radius**2))
        enter, leave = _between_planes(z, directions[2], np.float32(self.half_height))
        return np.maximum(enter_side, enter), np.minimum(leave_side, leave)

    def _surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = points
        from_axis = np.hypot(x, y)
        is_end = np.abs(z) / np.float32(self.half_height) > from_axis / np.float32(self.radius)
        zeros = np.zeros_like(from_axis)
        ends = np.stack([zeros, zeros, np.sign(z)])
        side = np.stack([x, y, zeros]) / np.maximum(from_axis, np.float32(1e-9))
        return points, np.where(is_end, ends, side)


def _roots(a: np.ndarray, half_b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roots t of a t² + 2 half_b t + c, (N,) each, the smaller first; inf and -inf where there are not two."""
    under_root = half_b * half_b - a * c
    root = np.sqrt(np.maximum(under_root, 0))
    missed = np.where(under_root > 0, np.float32(0), np.float32(np.inf))
    return (-half_b - root) / a + missed, (-half_b + root) / a - missed


def _between_planes(
    origins: np.ndarray, directions: np.ndarray, half_size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where lines enter and leave the space between the planes at -half_size and half_size, axis by axis."""
    inverse = 1 / np.where(np.abs(directions) < 1e-9, np.float32(1e-9), directions)
    middle, reach = -origins * inverse, np.abs(inverse) * half_size
    return middle - reach, middle + reach

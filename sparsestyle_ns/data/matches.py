"""The same surface points in different photos, found by matching and checked against the cameras.

Where a scene keeps the tracks that its cameras were estimated from, the points are those.

A match of two features counts where it obeys the epipolar geometry of the two known cameras within a pixel. Where two
photos have enough of them, features are then held against those alone that they may be by that geometry: with so few to
choose from, twice as many stand out. Colours are
those of blurred photos, so that a match that is off by a fraction of a pixel doesn't count as a difference.
"""

from dataclasses import dataclass
from typing import List, Optional, Sequence, Tuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from nerfstudio.cameras.camera_utils import radial_and_tangential_undistort
from nerfstudio.cameras.cameras import Cameras, CameraType

from sparsestyle_ns.data.features import Pair, find_features, linked_groups, match_photos, mutual_matches
from sparsestyle_ns.data.tracks import Tracks

MAX_EPIPOLAR_ERROR = 1.0
"""Sampson distance, in pixels, up to which a match obeys the cameras."""
MIN_LINKING = 20
"""Matches among all features by which two photos show the same thing, and others may be looked for along its lines. In
photos of one thing from afar, of repeated texture above all, most of what is found along lines is chance."""
BLUR = 2.0
"""Standard deviation, in pixels, of the blur under which colours are taken."""
LENSES = (CameraType.PERSPECTIVE, CameraType.FISHEYE)
"""Kinds of cameras whose directions are known here; photos of others aren't matched."""
NEAREST_VIEWS = 6
"""Photos that each photo is matched with: those whose cameras look most nearly the same way."""


@dataclass
class PointMatches:
    """Points seen in two photos; the first axis of each array is for the one photo and the other.

    Attributes:
        views: which photos.
        colors: RGB there, in [0, 1].
        directions: unit vectors in the world, from the cameras to the point.
        num_views: photos in all.
        num_sure: how many of them, the first ones, stand out among all features; None: all. Of the others, which stand
            out along epipolar lines alone, some are chance: few enough for depths, too many to judge colours by.
    """

    views: Int[np.ndarray, "2 matches"]
    colors: Float[np.ndarray, "2 matches 3"]
    directions: Float[np.ndarray, "2 matches 3"]
    num_views: int
    num_sure: Optional[int] = None

    def sure(self) -> "PointMatches":
        """Those that stand out among all features."""
        parts = (part[:, : self.num_sure] for part in (self.views, self.colors, self.directions))
        return PointMatches(*parts, num_views=self.num_views)

    def __len__(self) -> int:
        return self.views.shape[1]

    def fewest_in_a_view(self) -> int:
        """Matches of the photo that has fewest; 0 where matches don't link all photos to each other."""
        if len(linked_groups(self.num_views, np.unique(self.views, axis=1).T.tolist())) > 1:
            return 0
        return int(np.bincount(self.views.ravel(), minlength=self.num_views).min())


@dataclass
class PixelRays:
    """Directions (right, up, back; of any length) of a camera's image points, and their derivatives over these points,
    which are in focal lengths, to the right and down."""

    directions: Float[np.ndarray, "points 3"]
    tangents: Float[np.ndarray, "points 3 2"]

    def __getitem__(self, index: Int[np.ndarray, "some"]) -> "PixelRays":
        return PixelRays(self.directions[index], self.tangents[index])


@dataclass
class _View:
    """A photo's features; `directions` are unit vectors in the world, `pixel` a pixel's side over the focal length."""

    rays: PixelRays
    directions: Float[np.ndarray, "features 3"]
    rgba: Float[np.ndarray, "features 4"]
    pixel: float


def match_points(
    photos: Sequence[Float[np.ndarray, "H W 4"]],
    cameras: Cameras,
    names: Sequence[str] = (),
    tracks: Optional[Tracks] = None,
) -> PointMatches:
    """Points that two RGBA photos in [0, 1] see; only where both are opaque, and by cameras that are `LENSES`.

    Args:
        cameras: one for each photo, for images of any size with the same aspect.
        names: the photos' file names, by which `tracks` knows them.
        tracks: what is seen where, if that is known; else features are matched.
    """
    poses = cameras.camera_to_worlds.double().numpy()
    pairs = _neighbouring_pairs(poses)
    if tracks is None:
        features = [find_features(_grey(photo)) for photo in photos]
        found = match_photos(features, pairs)
    else:
        features, found = [], tracks.matches(names, [photo.shape[1::-1] for photo in photos])
    seen = [
        _look_at(photo, points, cameras, index)
        for index, (photo, points) in enumerate(zip(photos, found.points, strict=True))
    ]
    sure, others = _Found(seen), _Found(seen)
    for pair in pairs:
        both = [seen[index] for index in pair]
        if None in both:
            continue
        rows, between = found.pairs[pair], poses[list(pair)]
        most = MAX_EPIPOLAR_ERROR * max(view.pixel for view in both)
        error = epipolar_error(*(view.rays[row] for view, row in zip(both, rows, strict=True)), *between)
        rows = rows[:, error < most]
        sure.add(pair, rows)
        if features and rows.shape[1] >= MIN_LINKING:
            allowed = near_epipolar_lines(*(view.rays for view in both), *between, most)
            more = np.stack(mutual_matches(*(features[index].descriptors for index in pair), allowed=allowed))
            is_new = ~np.isin(more[0], rows[0]) & ~np.isin(more[1], rows[1])
            others.add(pair, more[:, is_new])
    parts = (np.concatenate([*ours, *theirs], axis=1) for ours, theirs in zip(sure.parts, others.parts, strict=True))
    return PointMatches(*parts, num_views=len(photos), num_sure=sum(part.shape[1] for part in sure.parts[0]))


class _Found:
    """Matches of photos' features, as `PointMatches` has them; only where both photos are opaque."""

    def __init__(self, seen: Sequence[Optional[_View]]) -> None:
        self.seen = seen
        self.parts: Tuple[List[np.ndarray], ...] = (
            [np.zeros((2, 0), int)],
            [np.zeros((2, 0, 3))],
            [np.zeros((2, 0, 3))],
        )

    def add(self, pair: Pair, rows: Int[np.ndarray, "2 matches"]) -> None:
        """Adds matches of two photos: which feature of the one is which of the other."""
        matched = list(zip((self.seen[index] for index in pair), rows, strict=True))
        rgba = np.stack([view.rgba[row] for view, row in matched])
        good = (rgba[..., 3] > 0.99).all(axis=0)
        views, colors, directions = self.parts
        views.append(np.repeat(np.array(pair)[:, None], good.sum(), axis=1))
        colors.append(rgba[:, good, :3])
        directions.append(np.stack([view.directions[row[good]] for view, row in matched]))


def _grey(photo: Float[np.ndarray, "H W 4"]) -> UInt8[np.ndarray, "H W"]:
    return (255.0 * (photo[..., :3] * photo[..., 3:]).mean(axis=-1)).astype(np.uint8)


def _look_at(
    photo: Float[np.ndarray, "H W 4"], points: Float[np.ndarray, "features 2"], cameras: Cameras, index: int
) -> Optional[_View]:
    kind = CameraType(int(cameras.camera_type[index]))
    if kind not in LENSES:
        return None
    pixels = float(cameras.width[index]) / photo.shape[1]
    center = np.array([float(cameras.cx[index]), float(cameras.cy[index])])
    focal = np.array([float(cameras.fx[index]), float(cameras.fy[index])])
    at = ((0.5 + points) * pixels - center) / focal
    rays = rays_of(undistorted(at, cameras, index), kind)
    directions = rays.directions @ cameras.camera_to_worlds[index, :, :3].double().numpy().T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rgba = sample(cv2.GaussianBlur(photo, (0, 0), BLUR), points)
    return _View(rays, directions, rgba, pixels / focal.mean())


def _neighbouring_pairs(poses: Float[np.ndarray, "views 3 4"]) -> List[Pair]:
    agreement = poses[:, :, 2] @ poses[:, :, 2].T
    near = np.argsort(-agreement, axis=1)[:, : NEAREST_VIEWS + 1]
    pairs = ((view, other) for view, others in enumerate(near.tolist()) for other in others if other != view)
    return sorted({(min(pair), max(pair)) for pair in pairs})


def undistorted(points: Float[np.ndarray, "points 2"], cameras: Cameras, index: int) -> Float[np.ndarray, "points 2"]:
    """Image points over the focal length, freed from the lens's distortion.

    nerfstudio's model, by which its rays are bent: OpenCV's with k1 to k4, p1 and p2, of a fisheye in angles.
    """
    if cameras.distortion_params is None:
        return points
    return radial_and_tangential_undistort(torch.from_numpy(points), cameras.distortion_params[index].double()).numpy()


def rays_of(points: Float[np.ndarray, "points 2"], kind: CameraType) -> PixelRays:
    """Where a camera without distortion sees image points, given over the focal length, right and down of the centre.

    A perspective camera's points lie on the plane at the distance 1. A fisheye's are as far from the middle as the
    angle θ to its axis (OpenCV's equidistant projection), so the ray is (sin θ, cos θ) aside and ahead.
    """
    x, y = points.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    if kind == CameraType.PERSPECTIVE:
        aside, slope, ahead, along = one, zero, one, zero
    else:
        angle = np.hypot(x, y)
        aside, ahead = np.sinc(angle / np.pi), np.cos(angle)  # sin θ / θ
        # Its derivative over θ, over θ once more, which is −1/3 at θ = 0.
        near = angle < 1e-4
        slope = np.where(near, -1.0 / 3.0, (ahead - aside) / np.where(near, 1.0, angle) ** 2)
        along = aside
    directions = np.stack([aside * x, -aside * y, -ahead], axis=-1)
    right = np.stack([aside + slope * x * x, -slope * x * y, along * x], axis=-1)
    down = np.stack([slope * x * y, -aside - slope * y * y, along * y], axis=-1)
    return PixelRays(directions, np.stack([right, down], axis=-1))


def why_unmatched(cameras: Cameras) -> Optional[str]:
    """Why points of photos by these cameras can't be matched; None where they can."""
    others = {CameraType(kind) for kind in cameras.camera_type.flatten().tolist()} - set(LENSES)
    if not others:
        return None
    names = ", ".join(sorted(kind.name.lower() for kind in others))
    return f"points are matched between perspective and fisheye cameras, and some here are {names}"


def epipolar_error(
    first: PixelRays, second: PixelRays, pose_first: Float[np.ndarray, "3 4"], pose_second: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "matches"]:
    """Sampson's distance of matches from the epipolar geometry of two camera-to-world poses, in focal lengths (Hartley
    and Zisserman, Multiple View Geometry, Eq. 11.9; a fisheye's gradient is over its own image points)."""
    essential = _essential_matrix(pose_first, pose_second)
    line_second, line_first = first.directions @ essential.T, second.directions @ essential
    algebraic = (second.directions * line_second).sum(axis=-1)
    gradient = sum(
        (np.einsum("mct,mc->mt", rays.tangents, line) ** 2).sum(axis=-1)
        for rays, line in ((second, line_second), (first, line_first))
    )
    return np.abs(algebraic) / np.sqrt(np.maximum(gradient, 1e-24))


def near_epipolar_lines(
    first: PixelRays,
    second: PixelRays,
    pose_first: Float[np.ndarray, "3 4"],
    pose_second: Float[np.ndarray, "3 4"],
    max_error: float,
) -> Bool[np.ndarray, "features others"]:
    """Which of one camera's points may be which of another's: those with an `epipolar_error` below `max_error`."""
    essential = _essential_matrix(pose_first, pose_second)
    line_second, line_first = first.directions @ essential.T, second.directions @ essential
    gradient = sum(
        (first.tangents[..., axis] @ line_first.T) ** 2 + (line_second @ second.tangents[..., axis].T) ** 2
        for axis in range(2)
    )
    return (line_second @ second.directions.T) ** 2 < max_error**2 * np.maximum(gradient, 1e-24)


def _essential_matrix(
    pose_first: Float[np.ndarray, "3 4"], pose_second: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "3 3"]:
    """Takes a direction of the first of two camera-to-world poses to the normal of its epipolar plane in the second."""
    rotation = pose_second[:, :3].T @ pose_first[:, :3]
    x, y, z = pose_second[:, :3].T @ (pose_first[:, 3] - pose_second[:, 3])
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation


def sample(image: Float[np.ndarray, "H W C"], points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points C"]:
    """Bilinear values at pixel positions (x, y), the centre of the first pixel at (0, 0)."""
    if len(points) == 0:
        return np.zeros((0, image.shape[-1]), dtype=image.dtype)
    x, y = points.astype(np.float32).T
    return cv2.remap(image, x[None], y[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]

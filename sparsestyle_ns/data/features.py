"""SIFT features of photos (Lowe 2004), which features of two photos look alike, and which photos that links.

The package's one matcher: poses are found, photos judged and depths triangulated by what it says.
"""

from dataclasses import dataclass
from typing import Any, Callable, Dict, Iterable, List, Optional, Sequence, Set, Tuple, TypeVar, Union

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

MAX_FEATURES, MIN_CONTRAST, MAX_RATIO = 4000, 0.02, 0.8
"""Features of a photo, their contrast, and Lowe's ratio; lenient, as the cameras' geometry sorts out wrong matches."""
GUIDED_DISTANCE = 0.7
"""Distance of descriptors up to which two features may match where the geometry leaves few to choose from."""

Pair = Tuple[int, int]
"""Numbers of two photos, the smaller first."""

T = TypeVar("T")


@dataclass
class Features:
    """A photo's features: (x, y) in pixels with the centre of the first at (0, 0), and descriptors of length 1."""

    points: Float[np.ndarray, "features 2"]
    descriptors: Float[np.ndarray, "features 128"]

    def __len__(self) -> int:
        return len(self.points)


@dataclass
class PhotoMatches:
    """Which places in which photos show the same thing, as far as their looks tell.

    Attributes:
        points: each photo's features: (x, y) in its pixels, the centre of the first at (0, 0).
        pairs: for two photos, which features match: the one's in the first row, the other's in the second.
    """

    points: List[Float[np.ndarray, "features 2"]]
    pairs: Dict[Pair, Int[np.ndarray, "2 matches"]]


def find_features(grey: UInt8[np.ndarray, "H W"]) -> Features:
    """A grey picture's strongest SIFT features, `MAX_FEATURES` at most."""
    sift = cv2.SIFT_create(nfeatures=MAX_FEATURES, contrastThreshold=MIN_CONTRAST)
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    if not keypoints:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
    # Square roots of the L1-normalised descriptor: Hellinger's distance (Arandjelović and Zisserman 2012).
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return Features(np.array([keypoint.pt for keypoint in keypoints]), descriptors)


def match_photos(features: Sequence[Features], pairs: Iterable[Pair]) -> PhotoMatches:
    """Matches the features of these pairs of photos."""
    found = {pair: np.stack(mutual_matches(*(features[index].descriptors for index in pair))) for pair in pairs}
    return PhotoMatches([photo.points for photo in features], found)


def estimated(estimator: Callable[..., T], *matches: Any, **settings: Any) -> Union[T, Tuple[None, None]]:
    """What an estimator of OpenCV's finds: a model, and which matches agree with it; None and None where it gives up.

    It gives up on degenerate matches, such as many of one point, in an assertion of its own.
    """
    try:
        return estimator(*matches, **settings)
    except cv2.error:
        return None, None


def linked_groups(count: int, links: Iterable[Pair]) -> List[Set[int]]:
    """Groups of photos, 0 to count − 1, that are linked to each other, directly or by way of others."""
    groups = [{photo} for photo in range(count)]
    for link in links:
        joined = [group for group in groups if group & set(link)]
        groups = [group for group in groups if group not in joined] + [set.union(*joined)]
    return groups


def mutual_matches(
    first: Float[np.ndarray, "features 128"],
    second: Float[np.ndarray, "others 128"],
    max_ratio: float = MAX_RATIO,
    allowed: Optional[Bool[np.ndarray, "features others"]] = None,
) -> Tuple[Int[np.ndarray, "matches"], Int[np.ndarray, "matches"]]:
    """Places of unit descriptors that are each other's nearest, and clearly nearer than the second nearest.

    Args:
        max_ratio: Lowe's ratio, the best match's distance over the second best's, in (0, 1]; lower is stricter.
        allowed: which pairs may match; others aren't looked at. Matches then are no farther than `GUIDED_DISTANCE`.
    """
    if min(len(first), len(second)) < 2:
        return np.empty(0, int), np.empty(0, int)
    similarity, rows = first @ second.T, np.arange(len(first))
    if allowed is not None:
        similarity = np.where(allowed, similarity, -1.0)
    best, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
    nearest = _distance(similarity[rows, best])
    similarity[rows, best] = -np.inf  # what is left has the second best, far sooner than a partition has it
    good = (back[best] == rows) & (nearest < max_ratio * _distance(np.maximum(similarity.max(axis=1), -1.0)))
    if allowed is not None:
        good &= nearest < GUIDED_DISTANCE
    return good.nonzero()[0], best[good]


def guided_matches(
    first: Features, second: Features, fundamental: Float[np.ndarray, "3 3"], max_error: float
) -> Int[np.ndarray, "2 matches"]:
    """Matches among features that are at most `max_error` pixels off the epipolar geometry, which is known by now.

    With so few to choose from, many stand out that look like another one somewhere else in the photo.
    """
    here, there = (np.column_stack([each.points, np.ones(len(each))]) for each in (first, second))
    lines_there, lines_here = here @ fundamental.T, there @ fundamental
    slopes = (lines_there[:, :2] ** 2).sum(axis=1)[:, None] + (lines_here[:, :2] ** 2).sum(axis=1)
    allowed = (lines_there @ there.T) ** 2 < max_error**2 * slopes  # Sampson's distance
    return np.stack(mutual_matches(first.descriptors, second.descriptors, allowed=allowed))


def _distance(similarity: Float[np.ndarray, "features"]) -> Float[np.ndarray, "features"]:
    """Between unit vectors of this inner product."""
    return np.sqrt(np.maximum(2.0 - 2.0 * similarity, 0.0))

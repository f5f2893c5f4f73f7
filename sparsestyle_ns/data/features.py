"""SIFT features of photos (Lowe 2004), which features of two photos look alike, and which photos that links.

The package's one matcher: poses are found, photos judged and depths triangulated by what it says.
"""

from dataclasses import dataclass
from typing import Dict, Iterable, List, Sequence, Set, Tuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

MAX_FEATURES, MIN_CONTRAST, MAX_RATIO = 4000, 0.02, 0.8
"""Features of a photo, their contrast, and Lowe's ratio; lenient, as the cameras' geometry sorts out wrong matches."""

Pair = Tuple[int, int]
"""Numbers of two photos, the smaller first."""


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


def linked_groups(count: int, links: Iterable[Pair]) -> List[Set[int]]:
    """Groups of photos, 0 to count − 1, that are linked to each other, directly or by way of others."""
    groups = [{photo} for photo in range(count)]
    for link in links:
        joined = [group for group in groups if group & set(link)]
        groups = [group for group in groups if group not in joined] + [set.union(*joined)]
    return groups


def mutual_matches(
    first: Float[np.ndarray, "features 128"], second: Float[np.ndarray, "others 128"], max_ratio: float = MAX_RATIO
) -> Tuple[Int[np.ndarray, "matches"], Int[np.ndarray, "matches"]]:
    """Places of unit descriptors that are each other's nearest, and clearly nearer than the second nearest.

    Args:
        max_ratio: Lowe's ratio, the best match's distance over the second best's, in (0, 1]; lower is stricter.
    """
    if min(len(first), len(second)) < 2:
        return np.empty(0, int), np.empty(0, int)
    similarity = first @ second.T
    best = similarity.argmax(axis=1)
    two = np.partition(similarity, -2, axis=1)[:, -2:]
    distances = np.sqrt(np.maximum(2.0 - 2.0 * two, 0.0))
    good = (similarity.argmax(axis=0)[best] == np.arange(len(first))) & (distances[:, 1] < max_ratio * distances[:, 0])
    return good.nonzero()[0], best[good]

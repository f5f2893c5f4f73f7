"""SIFT features of photos (Lowe 2004), which features of two photos look alike, and which photos that links."""

from dataclasses import dataclass
from typing import Any, Callable, Iterable, List, Set, Tuple, TypeVar, Union

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

T = TypeVar("T")


@dataclass
class Features:
    """A photo's features: (x, y) in pixels with the centre of the first at (0, 0), and descriptors of length 1."""

    points: Float[np.ndarray, "features 2"]
    descriptors: Float[np.ndarray, "features 128"]

    def __len__(self) -> int:
        return len(self.points)


def find_features(grey: UInt8[np.ndarray, "H W"], count: int, min_contrast: float = 0.04) -> Features:
    """A grey picture's SIFT features: the `count` strongest, of at least this contrast (OpenCV's default: 0.04)."""
    sift = cv2.SIFT_create(nfeatures=count, contrastThreshold=min_contrast)
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    if not keypoints:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
    # Square roots of the L1-normalised descriptor: Hellinger's distance (Arandjelović and Zisserman 2012).
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return Features(np.array([keypoint.pt for keypoint in keypoints]), descriptors)


def estimated(estimator: Callable[..., T], *matches: Any, **settings: Any) -> Union[T, Tuple[None, None]]:
    """What an estimator of OpenCV's finds: a model, and which matches agree with it; None and None where it gives up.

    It gives up on degenerate matches, such as many of one point, in an assertion of its own.
    """
    try:
        return estimator(*matches, **settings)
    except cv2.error:
        return None, None


def linked_groups(count: int, links: Iterable[Tuple[int, int]]) -> List[Set[int]]:
    """Groups of photos, 0 to count − 1, that are linked to each other, directly or by way of others."""
    groups = [{photo} for photo in range(count)]
    for link in links:
        joined = [group for group in groups if group & set(link)]
        groups = [group for group in groups if group not in joined] + [set.union(*joined)]
    return groups


def mutual_matches(
    first: Float[np.ndarray, "features 128"], second: Float[np.ndarray, "others 128"], max_ratio: float
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

"""What is wrong with a set of photos, in words: whether they share enough, and whether the camera moved.

Pairs of photos are compared by matched features that agree on a fundamental matrix F; cameras need not be known.
Where a homography explains the same matches, the second photo is only a warped first one: the camera turned without
moving, or all that it saw is flat, and depth can't be told. Where F's epipole, the point that the camera moves towards,
lies in the middle of the picture, it moved along its line of sight.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Dict, List, Optional, Sequence, Tuple

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from sparsestyle_ns.data.features import Features, estimated, find_features, linked_groups, mutual_matches
from sparsestyle_ns.utils.progress import track

COMPARED_SIDE = 1000
"""Pixels along the longer side of the pictures that are compared, at most."""
MAX_FEATURES, MAX_RATIO = 4000, 0.75
"""Of the matcher (`data.features`)."""
MIN_FEATURES = 300
"""Features of a photo below which it is blurred, or shows plain surfaces."""
MIN_MATCHES = 30
"""Matches that agree on one geometry, below which two photos count as sharing nothing: a dozen agree by chance."""
EPIPOLAR_ERROR, FLAT_ERROR = 1.5, 3.0
"""Pixels that a match may be off F and off a homography. Depth that moves a point by less is lost in noise."""
FLAT_SHARE = 0.85
"""Share of the matches that a homography explains, from which on a pair has no depth."""
AXIS_SHARE = 0.2
"""Distance of the epipole from the middle, in longer sides, up to which a move is along the line of sight."""


@dataclass
class Pair:
    """What two photos have in common.

    Attributes:
        agreeing: matched features that agree on one geometry.
        flat: share of the agreeing ones that a homography explains.
        epipole: where the second camera lies in the first photo, as an offset from the middle in longer sides; None
            where too few agree.
    """

    agreeing: int
    flat: float = 0.0
    epipole: Optional[Float[np.ndarray, "2"]] = None

    @property
    def linked(self) -> bool:
        """Whether the photos show the same thing."""
        return self.agreeing >= MIN_MATCHES

    @property
    def has_depth(self) -> bool:
        """Whether the camera stood elsewhere, as far as one can tell."""
        return self.linked and self.flat < FLAT_SHARE


def check_photos(images: Sequence[Image.Image], names: Sequence[str]) -> List[str]:
    """What is wrong with photos of one size, a sentence each; empty where nothing is."""
    small = [shrink(image) for image in images]
    features = [find_features(image, MAX_FEATURES) for image in small]
    pairs = {
        (first, second): compare_photos(features[first], features[second], small[0].shape)
        for first, second in track(list(combinations(range(len(images)), 2)), "Comparing photos")
    }
    return [*_faint(features, names), *_unlinked(pairs, names), *_without_depth(pairs, names)]


def shrink(image: Image.Image) -> np.ndarray:
    """A photo in grey, of the size that is compared."""
    grey = image.convert("L")
    grey.thumbnail((COMPARED_SIDE, COMPARED_SIDE), Image.Resampling.BOX)
    return np.asarray(grey)


def compare_photos(first: Features, second: Features, shape: Sequence[int]) -> Pair:
    """Matches two photos' features and looks at what geometry they agree on; `shape` is (rows, columns)."""
    here, there = mutual_matches(first.descriptors, second.descriptors, MAX_RATIO)
    start, end = first.points[here], second.points[there]
    if len(start) < MIN_MATCHES:
        return Pair(0)
    cv2.setRNGSeed(0)  # the same photos get the same verdict
    matrix, inliers = estimated(cv2.findFundamentalMat, start, end, cv2.USAC_MAGSAC, EPIPOLAR_ERROR, 0.999, 10_000)
    if matrix is None or matrix.shape != (3, 3) or inliers.sum() < MIN_MATCHES:
        return Pair(0 if inliers is None else int(inliers.sum()))
    agree = inliers.ravel() > 0
    _, explained = estimated(cv2.findHomography, start[agree], end[agree], cv2.RANSAC, FLAT_ERROR, maxIters=5_000)
    flat = 0.0 if explained is None else float(explained.mean())
    homogeneous = np.linalg.svd(matrix)[2][-1]
    middle = 0.5 * np.array([shape[1], shape[0]])
    point = homogeneous[:2] / (homogeneous[2] if abs(homogeneous[2]) > 1e-12 else 1e-12)
    return Pair(int(agree.sum()), flat, (point - middle) / max(shape))


def _faint(features: Sequence[Features], names: Sequence[str]) -> List[str]:
    return [
        f"{name} has only {len(found)} features that can be found again: it is blurred, dark, or shows plain "
        "surfaces; take it again, sharp and with something textured in it."
        for name, found in zip(names, features, strict=True)
        if len(found) < MIN_FEATURES
    ]


def _unlinked(pairs: Dict[Tuple[int, int], Pair], names: Sequence[str]) -> List[str]:
    links = [ids for ids, pair in pairs.items() if pair.linked]
    groups = sorted(linked_groups(len(names), links), key=lambda group: (-len(group), min(group)))
    if len(groups) == len(names):
        return [
            "No two photos share enough: they have too few matches to tell where the camera stood; take photos that "
            "overlap by two thirds, of one thing that doesn't move."
        ]
    sentences = []
    for group in groups[1:]:
        best = max(pair.agreeing for ids, pair in pairs.items() if (ids[0] in group) != (ids[1] in group))
        who = ", ".join(names[index] for index in sorted(group))
        verb, noun = ("shares", "it") if len(group) == 1 else ("share", "them")
        sentences.append(
            f"{who} {verb} too little with the other photos (at most {best} matches that fit together, {MIN_MATCHES} "
            f"are needed); take more photos between {noun} and the others, so that neighbours overlap by two thirds."
        )
    return sentences


def _without_depth(pairs: Dict[Tuple[int, int], Pair], names: Sequence[str]) -> List[str]:
    linked = {ids: pair for ids, pair in pairs.items() if pair.linked}
    if not linked:
        return []
    epipoles = [pair.epipole for pair in linked.values() if pair.has_depth]
    if not epipoles:
        return [
            "The camera turned without moving, or all that it sees is flat or far away: each photo is a "
            "warped copy of another, from which depth can't be told; take a step to the side between photos."
        ]
    # A short move's epipole is uncertain, so one pair alone says little.
    if np.median(np.linalg.norm(epipoles, axis=-1)) < AXIS_SHARE:
        return [
            "The camera moved only along its line of sight, where what is in the middle looks the same from "
            "everywhere; take photos from the sides too."
        ]
    return [
        f"{names[first]} and {names[second]} were taken from (nearly) the same place, so one of them adds little."
        for (first, second), pair in linked.items()
        if not pair.has_depth
    ]

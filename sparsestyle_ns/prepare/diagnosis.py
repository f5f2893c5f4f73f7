"""What is wrong with a set of photos, in words: whether they share enough, and whether the camera moved.

Pairs of photos are compared by matched features that agree on a fundamental matrix F; cameras need not be known.
Where a homography explains the same matches, the second photo is only a warped first one: the camera turned without
moving, or all that it saw is flat, and depth can't be told. Where F's epipole, the point that the camera moves towards,
lies in the middle of the picture, it moved along its line of sight.
"""

from dataclasses import dataclass, field
from itertools import combinations
from typing import Dict, List, Optional, Sequence, Set

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from sparsestyle_ns.data.features import (
    Features,
    Pair,
    PhotoMatches,
    estimated,
    find_features,
    guided_matches,
    linked_groups,
    mutual_matches,
)
from sparsestyle_ns.prepare.framing import MIN_PHOTOS
from sparsestyle_ns.utils.progress import track

COMPARED_SIDE = 1000
"""Pixels along the longer side of the pictures that are compared, at most."""
MIN_FEATURES = 300
"""Features of a photo of that size below which it is blurred, or shows plain surfaces; of smaller ones fewer, with the
root of their side."""
MIN_MATCHES = 20
"""Matches that agree on one geometry, below which two photos count as sharing nothing: of photos of different things up
to 16 agreed."""
EPIPOLAR_ERROR, FLAT_ERROR = 1.5, 3.0
"""Pixels that a match may be off F and off a homography. Depth that moves a point by less is lost in noise."""
FLAT_SHARE = 0.85
"""Share of the matches that a homography explains, from which on a pair has no depth."""
AXIS_SHARE = 0.2
"""Distance of the epipole from the middle, in longer sides, up to which a move is along the line of sight."""
BLURRED = 0.3
"""Contrast of the finest detail, as a part of that of the photos' median, below which a photo is blurred."""
SAME_LOOK, SAME_PLACE = 0.35, 8.0
"""Distance of two descriptors up to which features of one photo look the same, if they are so many pixels apart."""
REPEATED = 0.6
"""Share of a photo's features that look like another one of it, from which on its texture repeats itself: bricks and
tiles have 0.8 and more, other photos at most 0.25."""
TURNED = 0.06
"""How far a homography may be from a mere turn of the camera, by the best focal length: of turns 0.02 to 0.05, of a
wall 0.15 and more."""
AMBIGUOUS = 0.75
"""Share of the matches that agree on a geometry, below which matches of a repeated pattern aren't believed."""


@dataclass
class Link:
    """What two photos have in common.

    Attributes:
        agreeing: matched features that agree on one geometry.
        rows: which these are: features of the one photo and of the other.
        matched: all matched features.
        turn: how far the homography is from a mere turn of the camera; infinite where too few agree.
        flat: share of the agreeing ones that a homography explains.
        fundamental: the epipolar geometry; None where too few agree.
        epipole: where the second camera lies in the first photo, as an offset from the middle in longer sides; None
            where too few agree.
    """

    agreeing: int
    flat: float = 0.0
    turn: float = np.inf
    rows: Int[np.ndarray, "2 agreeing"] = field(default_factory=lambda: np.zeros((2, 0), int))
    matched: Int[np.ndarray, "2 matches"] = field(default_factory=lambda: np.zeros((2, 0), int))
    epipole: Optional[Float[np.ndarray, "2"]] = None
    fundamental: Optional[Float[np.ndarray, "3 3"]] = None

    @property
    def linked(self) -> bool:
        """Whether the photos show the same thing."""
        return self.agreeing >= MIN_MATCHES

    @property
    def has_depth(self) -> bool:
        """Whether the camera stood elsewhere, as far as one can tell."""
        return self.linked and self.flat < FLAT_SHARE


@dataclass
class Comparison:
    """Photos of one size, compared with each other at a reduced one.

    Attributes:
        names: what the photos are called.
        greys: in grey, at the reduced size.
        features, links: what is found in each, and what each two have in common.
    """

    names: List[str]
    greys: List[UInt8[np.ndarray, "H W"]]
    features: List[Features]
    links: Dict[Pair, Link]

    @property
    def matches(self) -> PhotoMatches:
        """The matches that agree on a geometry, of the photos that have enough of them."""
        pairs = {pair: link.rows for pair, link in self.links.items() if link.linked}
        return PhotoMatches([each.points for each in self.features], pairs)

    def guided(self) -> PhotoMatches:
        """More of them: matched anew along the epipolar lines that these tell of."""
        pairs = {}
        for pair, link in self.links.items():
            if link.has_depth:
                first, second = (self.features[photo] for photo in pair)
                pairs[pair] = guided_matches(first, second, link.fundamental, EPIPOLAR_ERROR)
        return PhotoMatches(self.matches.points, {**self.matches.pairs, **pairs})

    def groups(self) -> List[Set[int]]:
        """Photos that are linked to each other, directly or by way of others; the largest group first."""
        links = [pair for pair, link in self.links.items() if link.linked]
        return sorted(linked_groups(len(self.names), links), key=lambda group: (-len(group), min(group)))


def check_photos(images: Sequence[Image.Image], names: Sequence[str]) -> List[str]:
    """What is wrong with photos of one size, a sentence each; empty where nothing is."""
    return findings(compare(images, names))


def compare(images: Sequence[Image.Image], names: Sequence[str]) -> Comparison:
    """Finds the features of photos of one size, and which of them agree on a geometry."""
    greys = [shrink(image) for image in images]
    features = [find_features(grey) for grey in track(greys, "Looking for features")]
    links = {
        (first, second): compare_photos(features[first], features[second], greys[0].shape)
        for first, second in track(list(combinations(range(len(images)), 2)), "Comparing photos")
    }
    return Comparison(list(names), greys, features, links)


def findings(seen: Comparison) -> List[str]:
    """What is wrong with compared photos, a sentence each; empty where nothing is."""
    return [*_faint(seen), *unlinked(seen), *_of_moves(seen), *repeating(seen)]


def shrink(image: Image.Image) -> UInt8[np.ndarray, "H W"]:
    """A photo in grey, of the size that is compared."""
    grey = image.convert("L")
    grey.thumbnail((COMPARED_SIDE, COMPARED_SIDE), Image.Resampling.BOX)
    return np.asarray(grey)


def compare_photos(first: Features, second: Features, shape: Sequence[int]) -> Link:
    """Matches two photos' features and looks at what geometry they agree on; `shape` is (rows, columns)."""
    matched = np.stack(mutual_matches(first.descriptors, second.descriptors))
    start, end = first.points[matched[0]], second.points[matched[1]]
    if len(start) < MIN_MATCHES:
        return Link(0, matched=matched)
    cv2.setRNGSeed(0)  # the same photos get the same verdict
    matrix, inliers = estimated(cv2.findFundamentalMat, start, end, cv2.USAC_MAGSAC, EPIPOLAR_ERROR, 0.999, 10_000)
    if matrix is None or matrix.shape != (3, 3) or inliers.sum() < MIN_MATCHES:
        return Link(0 if inliers is None else int(inliers.sum()), matched=matched)
    agree = inliers.ravel() > 0
    points = start[agree], end[agree]
    warp, explained = estimated(cv2.findHomography, *points, cv2.USAC_MAGSAC, FLAT_ERROR, maxIters=5_000)
    flat = 0.0 if explained is None else float(explained.mean())
    homogeneous = np.linalg.svd(matrix)[2][-1]
    middle = 0.5 * np.array([shape[1], shape[0]])
    point = homogeneous[:2] / (homogeneous[2] if abs(homogeneous[2]) > 1e-12 else 1e-12)
    epipole = (point - middle) / max(shape)
    turn = np.inf if warp is None else _distance_from_turn(warp, middle, max(shape))
    return Link(int(agree.sum()), flat, turn, matched[:, agree], matched, epipole, matrix)


def _distance_from_turn(warp: Float[np.ndarray, "3 3"], middle: Float[np.ndarray, "2"], longer: int) -> float:
    """How far the homography is from K R K⁻¹ of a rotation R, for the best of a camera's usual focal lengths."""
    best = np.inf
    for focal in np.geomspace(0.5, 2.5, 12) * longer:
        camera = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
        turn = np.linalg.inv(camera) @ warp @ camera
        turn /= np.cbrt(np.linalg.det(turn)) or 1.0
        best = min(best, float(np.linalg.norm(turn.T @ turn - np.eye(3))))
    return best


def sharpness(grey: UInt8[np.ndarray, "H W"]) -> float:
    """The contrast of a picture's finest detail: the standard deviation of its Laplacian, in grey values."""
    return float(cv2.Laplacian(grey.astype(np.float32), cv2.CV_32F).std())


def repeated_share(found: Features) -> float:
    """Share of a photo's features that look like another one elsewhere in it."""
    if len(found) < 2:
        return 0.0
    chosen = np.random.default_rng(0).permutation(len(found))[:1000]
    similarity = found.descriptors[chosen] @ found.descriptors.T
    apart = np.linalg.norm(found.points[chosen][:, None] - found.points, axis=-1) > SAME_PLACE
    nearest = np.where(apart, similarity, -1.0).max(axis=1)
    return float((np.sqrt(np.maximum(2.0 - 2.0 * nearest, 0.0)) < SAME_LOOK).mean())


def _faint(seen: Comparison) -> List[str]:
    sharp = [sharpness(grey) for grey in seen.greys]
    usual, fewest = float(np.median(sharp)), MIN_FEATURES * np.sqrt(max(seen.greys[0].shape) / COMPARED_SIDE)
    sentences = []
    for name, found, contrast in zip(seen.names, seen.features, sharp, strict=True):
        if len(found) < fewest:
            sentences.append(
                f"{name} has only {len(found)} features that can be found again: it is blurred, dark, or shows plain "
                "surfaces; take it again, sharp and with something textured in it."
            )
        elif contrast < BLURRED * usual:
            sentences.append(
                f"{name} is blurred: take it again from the same place, with the camera held still and in more light."
            )
    return sentences


def unlinked(seen: Comparison) -> List[str]:
    """Which photos share too little with the others, and which photo would link them: a sentence each."""
    groups = seen.groups()
    if len(groups) == len(seen.names):
        return [
            "No two photos share enough: they have too few matches to tell where the camera stood; take photos that "
            "overlap by two thirds, of one thing that doesn't move."
        ]
    sentences = []
    for group in groups[1:]:
        pairs = [pair for pair in seen.links if (pair[0] in group) != (pair[1] in group)]
        best = max(seen.links[pair].agreeing for pair in pairs)
        verb = "shares" if len(group) == 1 else "share"
        sentences.append(
            f"{_listed(seen, group)} {verb} too little with the other photos (at most {best} matches that fit "
            f"together, {MIN_MATCHES} are needed); {next_photo(seen, group)}"
        )
    return sentences


def repeating(seen: Comparison) -> List[str]:
    """Which photos show one pattern again and again, in a sentence, if any do."""
    names = [name for name, found in zip(seen.names, seen.features, strict=True) if repeated_share(found) > REPEATED]
    if not names:
        return []
    return [
        f"One pattern comes again and again in {', '.join(names)}, whose copies are taken for each other; take photos "
        "in which something is there only once, a foot's length from each other, the next one beside where "
        f"{names[0]} was taken."
    ]


def hopeless(seen: Comparison) -> bool:
    """Whether photos' matches can't tell where three of them were taken."""
    links = [link for link in seen.links.values() if link.linked]
    if len(seen.groups()[0]) < MIN_PHOTOS or no_depth(seen):
        return True
    believed = sum(link.agreeing for link in links) >= AMBIGUOUS * sum(link.matched.shape[1] for link in links)
    return not believed and bool(repeating(seen))


def next_photo(seen: Comparison, group: Set[int]) -> str:
    """Advice which photo would link a group to the others: where to stand, and what to keep in sight."""
    pairs = [pair for pair in seen.links if (pair[0] in group) != (pair[1] in group)]
    pair = max(pairs, key=lambda pair: (seen.links[pair].agreeing, seen.links[pair].matched.shape[1]))
    inside, outside = pair if pair[0] in group else pair[::-1]
    link, known = seen.links[pair], seen.names[outside]
    rows = link.rows if link.agreeing >= MIN_MATCHES // 3 and link.rows.shape[1] else link.matched
    first, second = (seen.features[index].points[row] for index, row in zip(pair, rows, strict=True))
    shift = np.zeros(2) if len(first) < 4 else np.median(second - first, axis=0)
    if pair[0] == inside:
        shift = -shift  # now from the known photo to the one to be linked
    width = seen.greys[0].shape[1]
    step = f"take one more photo halfway between {known} and {seen.names[inside]}"
    if abs(shift[0]) > 0.1 * width:  # what is seen moves against the camera
        side = "right" if shift[0] < 0 else "left"
        return f"{step}: from where {known} was taken a step to the {side}, with its {side} half still in sight."
    return f"{step}, with most of what {known} shows still in sight."


def _listed(seen: Comparison, photos: Set[int]) -> str:
    return ", ".join(seen.names[photo] for photo in sorted(photos))


def _of_moves(seen: Comparison) -> List[str]:
    linked = {pair: link for pair, link in seen.links.items() if link.linked}
    epipoles = [link.epipole for link in linked.values() if link.has_depth]
    if no_depth(seen) or not epipoles:
        return no_depth(seen)
    # A short move's epipole is uncertain, so one pair alone says little.
    if np.median(np.linalg.norm(epipoles, axis=-1)) < AXIS_SHARE:
        return [
            "The camera moved only along its line of sight, where what is in the middle looks the same from "
            "everywhere; take photos from the sides too."
        ]
    return [
        f"{seen.names[first]} and {seen.names[second]} were taken from (nearly) the same place, so one of them adds "
        "little."
        for (first, second), link in linked.items()
        if not link.has_depth and link.turn < TURNED
    ]


def no_depth(seen: Comparison) -> List[str]:
    """Why all photos are warped copies of each other: of one place, or of one plane; empty where they aren't."""
    links = [link for link in seen.links.values() if link.linked]
    if not links or np.average([link.flat for link in links], weights=[link.agreeing for link in links]) < FLAT_SHARE:
        return []
    first = seen.names[0]
    if np.median([link.turn for link in links]) < TURNED:
        return [
            "The camera turned without moving, or all that it sees is far away: each photo is a warped copy of "
            "another, from which depth can't be told; take a step to the side between photos, as from where "
            f"{first} was taken half a metre to the left, with what is in its middle still in sight."
        ]
    return [
        "All that the photos share lies in one plane, as a wall or a picture does, from which neither depth nor focal "
        f"length can be told; take them again with something standing before it, as a step to the side of where "
        f"{first} was taken, with a corner of the room or a piece of furniture in sight."
    ]


def left_out(seen: Comparison, placed: Sequence[int]) -> List[str]:
    """Why photos have no pose, in sentences; `placed` are those that have one."""
    if not placed:
        weakest = min(range(len(seen.names)), key=lambda photo: _best_link(seen, photo))
        count = _best_link(seen, weakest)
        return [
            f"{seen.names[weakest]} shares too little with the other photos (at most {count} matches that fit "
            f"together, which don't settle where it was taken); {next_photo(seen, {weakest})}"
        ]
    missing = {photo for photo in range(len(seen.names)) if photo not in placed}
    apart = {photo for group in seen.groups()[1:] for photo in group}
    sentences = unlinked(seen) if apart & missing else []
    if missing - apart:
        sentences.append(
            f"{_listed(seen, missing - apart)} can't be placed, as no camera sees all that matches there: that may be "
            "another zoom, things that moved, or one thing that is there more than once; take it again a step beside "
            f"where {seen.names[placed[0]]} was taken, without zoom, when nothing moves."
        )
    return sentences


def _best_link(seen: Comparison, photo: int) -> int:
    """The most matches that a photo shares with another one."""
    return max(link.agreeing for pair, link in seen.links.items() if photo in pair)

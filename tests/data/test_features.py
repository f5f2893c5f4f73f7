"""Features and matches of degenerate pictures end in nothing found, not in an assertion of OpenCV's."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sparsestyle_ns.data.features import Features, estimated
from sparsestyle_ns.prepare.diagnosis import check_photos, compare_photos

KINDS = ["one point", "a line", "two points", "a small grid", "noise", "the same", "huge", "not finite"]


def points_of(kind: str, count: int, random: np.random.Generator) -> np.ndarray:
    spread = random.uniform(0, 100, (count, 2))
    if kind == "one point":
        return np.full((count, 2), 7.0)
    if kind == "a line":
        return spread[:, :1] * [1.0, 2.0]
    if kind == "two points":
        return np.where(spread[:, :1] > 50, 3.0, 60.0) * [1.0, 1.0]
    if kind == "a small grid":
        return spread.round(-1)
    return spread * {"huge": 1e6}.get(kind, 1.0)


@given(st.sampled_from(KINDS), st.sampled_from(KINDS), st.integers(30, 80), st.integers(0, 1000))
def test_matches_of_any_kind_get_a_verdict(first, second, count, seed):
    random = np.random.default_rng(seed)
    descriptors = np.eye(128)[random.permutation(128)[:count]]
    both = [Features(points_of(kind, count, random), descriptors) for kind in (first, second)]
    compare_photos(*both, (100, 100))


def test_what_opencv_gives_up_on_is_not_found():
    def gives_up(*matches: np.ndarray) -> None:
        raise cv2.error("(-215:Assertion failed) !model.empty() in function 'run'")

    assert estimated(gives_up, np.zeros((4, 2)), np.zeros((4, 2))) == (None, None)


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (500, 2)])
@pytest.mark.parametrize("fill", ["plain", "noise"])
def test_photos_of_any_size_are_judged_in_words(size, fill):
    random = np.random.default_rng(0)
    shape = (*size, 3)
    pictures = [np.zeros(shape, np.uint8) if fill == "plain" else random.integers(0, 256, shape, np.uint8)] * 3
    assert check_photos([Image.fromarray(picture) for picture in pictures], ["a", "b", "c"])

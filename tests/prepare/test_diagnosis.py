"""What is wrong with a set of photos is said in words, and nothing is said of a good one."""

import numpy as np
import pytest
from photo_sets import AHEAD, ASIDE, AWAY, TURNED, photo
from PIL import Image, ImageFilter

from sparsestyle_ns.data.features import find_features, linked_groups
from sparsestyle_ns.prepare.diagnosis import check_photos, compare_photos, shrink

NAMES = ["a.jpg", "b.jpg", "c.jpg"]


def check(places):
    return check_photos([photo(place) for place in places], NAMES[: len(places)])


def test_nothing_is_wrong_with_photos_taken_side_by_side():
    assert check(ASIDE) == []


def test_a_camera_that_only_turned_is_told_from_one_that_moved():
    (sentence,) = check(TURNED)
    assert sentence.startswith("The camera turned without moving")
    assert "take a step to the side" in sentence


def test_a_camera_that_only_moved_along_its_line_of_sight_is_told():
    (sentence,) = check(AHEAD)
    assert sentence.startswith("The camera moved only along its line of sight")


def test_a_photo_of_something_else_is_named():
    sentences = check([*ASIDE[:2], AWAY])
    (blamed,) = [s for s in sentences if s.startswith("c.jpg shares too little with the other photos")]
    assert not any(sentence.startswith(("a.jpg", "b.jpg")) for sentence in sentences)
    assert "take one more photo halfway between a.jpg and c.jpg" in blamed


def test_photos_of_different_things_have_too_few_matches():
    noise = [np.random.default_rng(seed).integers(0, 256, (60, 80), dtype=np.uint8) for seed in range(3)]
    images = [Image.fromarray(pixels).resize((640, 480), Image.Resampling.BICUBIC) for pixels in noise]
    (sentence,) = check_photos(images, NAMES)
    assert sentence.startswith("No two photos share enough")


def test_a_blurred_photo_is_named():
    images = [photo(place) for place in ASIDE]
    images[1] = images[1].filter(ImageFilter.GaussianBlur(6))
    assert any(s.startswith("b.jpg has only") and "blurred" in s for s in check_photos(images, NAMES))


def test_a_grey_wall_has_no_features_and_breaks_nothing():
    sentences = check_photos([Image.new("RGB", (320, 240), "grey")] * 3, NAMES)
    assert sentences[0].startswith("a.jpg has only 0 features")
    assert sentences[-1].startswith("No two photos share enough")


def test_one_photo_twice_is_named():
    sentences = check([ASIDE[0], ASIDE[1], ASIDE[1]])
    assert sentences == ["b.jpg and c.jpg were taken from (nearly) the same place, so one of them adds little."]


def test_the_epipole_of_a_step_ahead_is_where_the_camera_went():
    first, second = (find_features(shrink(photo(place))) for place in (AHEAD[0], AHEAD[2]))
    pair = compare_photos(first, second, (240, 320))
    # The camera looks down a little and goes level: towards a point above the middle by tan(0.5/6) focal lengths.
    np.testing.assert_allclose(pair.epipole, [0.0, -0.85 * 0.5 / 6], atol=0.02)


def test_large_photos_are_compared_reduced():
    assert max(shrink(Image.new("RGB", (4000, 3000))).shape) == 1000


@pytest.mark.parametrize(
    ("links", "groups"), [([], 4), ([(0, 1), (2, 3)], 2), ([(0, 1), (2, 3), (1, 2)], 1), ([(0, 1), (1, 2)], 2)]
)
def test_photos_are_linked_by_way_of_others(links, groups):
    assert len(linked_groups(4, links)) == groups

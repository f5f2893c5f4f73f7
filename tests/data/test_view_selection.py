import itertools

import pytest

from sparsestyle_ns.data.view_selection import BLENDER_VIEWS, evenly_spaced, select_views
from sparsestyle_ns.utils.errors import InputError


def trained_on(num_images):
    """Ids of an LLFF scene's views that are not held out: all but every eighth."""
    return [view for view in range(num_images) if view % 8 != 0]


def chosen_ids(available, num_views=None, view_ids=None, **protocol):
    return [available[position] for position in select_views(available, num_views, view_ids, **protocol)]


@pytest.mark.parametrize(
    "scene, num_images, expected",
    [
        ("fern", 20, [1, 10, 19]),
        ("flower", 34, [1, 17, 33]),
        ("horns", 62, [1, 30, 61]),
        ("orchids", 25, [1, 12, 23]),
        ("room", 41, [1, 20, 39]),
        ("trex", 55, [1, 28, 54]),
    ],
)
def test_three_views_of_an_llff_scene_are_those_of_the_literature(scene, num_images, expected):
    assert chosen_ids(trained_on(num_images), default_num_views=3) == expected
    assert chosen_ids(trained_on(num_images), num_views=3) == expected


def test_eight_views_of_a_blender_scene_are_those_of_the_literature():
    assert chosen_ids(range(100), standard=BLENDER_VIEWS) == [26, 86, 2, 55, 75, 93, 16, 73]


@pytest.mark.parametrize("num_views", [1, 4, 8])
def test_fewer_views_of_a_blender_scene_are_the_first_of_the_protocol(num_views):
    assert chosen_ids(range(100), num_views=num_views, standard=BLENDER_VIEWS) == list(BLENDER_VIEWS[:num_views])


def test_a_protocol_gives_way_where_it_has_too_few_views_or_one_of_them_is_missing():
    assert chosen_ids(range(100), num_views=9, standard=BLENDER_VIEWS) == [0, 12, 25, 37, 50, 62, 74, 87, 99]
    assert chosen_ids(range(90), num_views=2, standard=BLENDER_VIEWS) == [0, 89]


@pytest.mark.parametrize("count", [1, 2, 7, 100])
@pytest.mark.parametrize("num_views", [1, 2, 3, 8])
def test_evenly_spaced_views_are_distinct_ascending_and_reach_both_ends(count, num_views):
    views = evenly_spaced(count, num_views)
    assert len(views) == min(count, num_views)
    assert list(views) == sorted(set(views))
    assert views[0] >= 0 and views[-1] < count
    if 1 < num_views <= count:
        assert (views[0], views[-1]) == (0, count - 1)
        gaps = [right - left for left, right in itertools.pairwise(views)]
        assert max(gaps) - min(gaps) <= 1


def test_a_single_view_is_the_middle_one():
    assert chosen_ids(range(21), num_views=1) == [10]


def test_by_default_a_small_scene_is_used_whole():
    assert chosen_ids([3, 5, 9]) == [3, 5, 9]


def test_the_number_of_views_overrules_the_default():
    assert chosen_ids(range(9), num_views=5, default_num_views=3) == [0, 2, 4, 6, 8]


def test_the_users_own_choice_is_taken_in_its_order_and_overrules_all():
    assert chosen_ids(trained_on(20), num_views=7, view_ids=[19, 3, 10], standard=(1, 2)) == [19, 3, 10]
    assert select_views([4, 6, 8], None, [8, 4]) == (2, 0)


def test_a_view_that_is_held_out_or_absent_is_refused_by_name():
    with pytest.raises(InputError, match=r"--view-ids names 8, 77, but .* are 1, 2, 3, 4, 5, 6, 7, 9, 10, 11"):
        select_views(trained_on(12), None, [1, 8, 77])


@pytest.mark.parametrize("view_ids", [[], [1, 2, 1]])
def test_no_view_or_the_same_view_twice_is_refused(view_ids):
    with pytest.raises(InputError, match="at least one view, each only once"):
        select_views(trained_on(12), None, view_ids)


@pytest.mark.parametrize("num_views", [0, -2])
def test_fewer_than_one_view_is_refused(num_views):
    with pytest.raises(InputError, match=f"--num-views is {num_views}; at least one view is needed"):
        select_views(range(9), num_views, None)


def test_more_views_than_there_are_is_refused():
    with pytest.raises(InputError, match="--num-views is 10, but only 9 views can be trained on"):
        select_views(range(9), 10, None)

import itertools

import pytest
import reference

from sparsestyle_ns.core.schedules import Level, coarse_to_fine, content_weight
from sparsestyle_ns.utils.errors import InputError


@pytest.mark.parametrize("step", [0, 1, 37, 99, 100, 101, 5000])
@pytest.mark.parametrize("decay", [0.01, 0.5, 1.0])
def test_it_is_equation_6(step, decay):
    expected = reference.content_weight(step, initial=10.0, decay=decay, duration=100)
    assert content_weight(step, initial=10.0, decay=decay, duration=100) == pytest.approx(expected, rel=1e-12)


def test_the_papers_settings_fall_from_10_to_a_tenth_within_100_iterations():
    weights = [content_weight(step, initial=10.0, decay=0.01, duration=100) for step in range(200)]
    assert weights[0] == 10.0
    assert weights[50] == pytest.approx(1.0)
    assert weights[100:] == [pytest.approx(0.1)] * 100
    assert all(later < earlier for earlier, later in itertools.pairwise(weights[:101]))


def test_a_decay_of_1_keeps_the_weight_constant():
    assert {content_weight(step, initial=3.0, decay=1.0, duration=10) for step in range(20)} == {3.0}


def test_a_decay_of_0_keeps_the_first_iteration_only():
    assert [content_weight(step, initial=3.0, decay=0.0, duration=2) for step in range(4)] == [3.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("step", [0, 1, 100])
def test_without_a_duration_the_fall_is_over_from_the_first_iteration_on(step):
    assert content_weight(step, initial=10.0, decay=0.01, duration=0) == 0.1


@pytest.mark.parametrize(
    ("argument", "name"),
    [("step", "iteration"), ("initial", "initial value"), ("decay", "decay factor"), ("duration", "duration")],
)
@pytest.mark.parametrize("value", [-1, float("nan")])
def test_a_negative_argument_is_refused_by_name(argument, name, value):
    arguments = {"step": 0, "initial": 10.0, "decay": 0.01, "duration": 100} | {argument: value}
    with pytest.raises(InputError, match=rf"content weight's {name}.* is {value}: give a finite number"):
        content_weight(**arguments)


def test_iterations_are_divided_by_the_shares_from_small_to_large():
    assert coarse_to_fine((0.5, 1.0), (0.6, 0.4), 150) == (Level(0.5, 0, 90), Level(1.0, 90, 60))
    assert coarse_to_fine((1.0,), (7.0,), 33) == (Level(1.0, 0, 33),)


@pytest.mark.parametrize("total", [3, 7, 10, 100, 101, 1000])
@pytest.mark.parametrize("shares", [(1, 1, 1), (3, 2, 1), (0.1, 0.2, 0.7), (1e-9, 1e9, 5e8)])
def test_the_levels_follow_each_other_and_sum_up_to_all_iterations_however_they_are_rounded(shares, total):
    levels = coarse_to_fine((0.25, 0.5, 1.0), shares, total)
    assert sum(level.length for level in levels) == total
    assert levels[0].first == 0 and levels[-1].scale == 1.0
    assert all(after.first == level.first + level.length for level, after in itertools.pairwise(levels))
    # A border is rounded to a whole iteration, and a length is between two borders.
    lengths = {level.scale: level.length for level in levels}
    for scale, share in zip((0.25, 0.5, 1.0), shares, strict=True):
        assert abs(lengths.get(scale, 0) - total * share / sum(shares)) <= 1


def test_shares_neednt_sum_up_to_1():
    assert coarse_to_fine((0.5, 1.0), (3, 2), 150) == coarse_to_fine((0.5, 1.0), (0.6, 0.4), 150)


def test_a_size_that_gets_no_iteration_is_left_out_and_the_last_gets_one():
    assert coarse_to_fine((0.25, 0.5, 1.0), (0.1, 0.1, 9.8), 4) == (Level(1.0, 0, 4),)
    assert coarse_to_fine((0.5, 1.0), (0.6, 0.4), 1) == (Level(1.0, 0, 1),)
    assert coarse_to_fine((0.5, 1.0), (0.9, 0.1), 3) == (Level(0.5, 0, 2), Level(1.0, 2, 1))
    assert coarse_to_fine((0.5, 1.0), (0.6, 0.4), 0) == (Level(1.0, 0, 0),)


@pytest.mark.parametrize(
    ("scales", "shares", "sentence"),
    [
        ((), (), "scales are none and their shares of the iterations none"),
        ((0.5, 1.0), (1.0,), "scales are 0.5 1 and their shares of the iterations 1: give as many shares"),
        ((0.0, 1.0), (1.0, 1.0), "above 0 and up to 1"),
        ((0.5, 1.5), (1.0, 1.0), "above 0 and up to 1"),
        ((float("nan"), 1.0), (1.0, 1.0), "above 0 and up to 1"),
        ((1.0, 0.5), (1.0, 1.0), "each larger than the one before"),
        ((0.5, 0.5), (1.0, 1.0), "each larger than the one before"),
        ((0.5, 1.0), (0.0, 1.0), "shares of the iterations are 0 1: give numbers above 0"),
        ((0.5, 1.0), (-1.0, 1.0), "give numbers above 0"),
        ((0.5, 1.0), (float("inf"), 1.0), "give numbers above 0"),
        ((0.5, 1.0), (float("nan"), 1.0), "give numbers above 0"),
    ],
)
def test_scales_and_shares_that_are_none_are_refused(scales, shares, sentence):
    with pytest.raises(InputError, match=sentence):
        coarse_to_fine(scales, shares, 100)

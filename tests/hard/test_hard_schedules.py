import itertools
import math

import pytest
import reference
from hard.table import hard_case

from sparsestyle_ns.core.schedules import content_weight, ramp
from sparsestyle_ns.utils.errors import InputError


@hard_case(
    "schedules", case="T = 0", could_go_wrong="t / T divides by 0", must_hold="λ is λ0 α from the first iteration on"
)
def test_a_fall_that_takes_no_time_is_over():
    assert {content_weight(step, 10.0, 0.01, 0) for step in (0, 1, 10**9)} == {0.1}


@hard_case(
    "schedules",
    case="t > T, up to 1e18",
    could_go_wrong="α^(t/T) goes on falling to 0",
    must_hold="λ0 α, exactly, from t = T on",
)
def test_after_the_fall_the_weight_stays():
    assert {content_weight(step, 10.0, 0.01, 100) for step in (100, 101, 10**6, 10**18)} == {0.1}


@hard_case(
    "schedules",
    case="training resumed at any t",
    could_go_wrong="a weight that is multiplied up from step to step starts again at λ0",
    must_hold="λ depends on t alone: it is that of a run without a break, to rounding",
)
def test_a_resumed_run_has_the_weight_of_one_without_a_break():
    for step in range(0, 140, 7):
        expected = reference.content_weight(step, 10.0, 0.01, 100)
        assert content_weight(step, 10.0, 0.01, 100) == pytest.approx(expected, rel=1e-12)


@hard_case("schedules", case="λ0 = 0", could_go_wrong="the logarithm of 0", must_hold="the weight is 0 at all times")
def test_no_weight_stays_no_weight():
    assert {content_weight(t, 0.0, alpha, 100) for t in (0, 1, 50, 100, 101) for alpha in (0.0, 0.01, 1.0, 7.0)} == {0}


@hard_case(
    "schedules",
    case="α = 1",
    could_go_wrong="rounding makes the constant weight waver",
    must_hold="λ0, exactly, at all times",
)
def test_a_decay_of_1_changes_nothing():
    assert {content_weight(step, 10.0, 1.0, 97) for step in range(200)} == {10.0}


@hard_case(
    "schedules",
    case="α = 0, 1e-300 and 5e-324",
    could_go_wrong="0 to the power of 0; a step up where the fall ends",
    must_hold="λ0 at t = 0, then never rising, λ0 α at T",
)
@pytest.mark.parametrize("decay", [0.0, 5e-324, 1e-300])
def test_the_steepest_falls_never_rise(decay):
    weights = [content_weight(step, 10.0, decay, 10) for step in range(15)]
    assert weights[0] == 10.0 and weights[10:] == [10.0 * decay] * 5
    assert all(after <= before for before, after in itertools.pairwise(weights))


@hard_case(
    "schedules",
    case="settings that are negative, infinite or not a number",
    could_go_wrong="a loss of NaN after the first iteration",
    must_hold="one sentence that says which setting it is",
)
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["initial", "decay", "duration"])
def test_what_is_no_setting_is_refused(name, value):
    arguments = {"step": 3, "initial": 10.0, "decay": 0.01, "duration": 100, name: value}
    with pytest.raises(InputError, match=r"content weight's .* is (-1\.0|nan|inf): give a"):
        content_weight(**arguments)


@hard_case(
    "schedules",
    case="a regulariser that sets in at once, at the start or at the end of training",
    could_go_wrong="division by a ramp of length 0",
    must_hold="its share is 0 before it sets in, 1 after its ramp, and never outside of [0, 1]",
)
def test_a_ramp_without_length_is_a_step():
    assert [ramp(x, start=0.4, length=0.0) for x in (0.0, 0.39, 0.4, 1.0)] == [0, 0, 1, 1]
    assert [ramp(x, start=0.0, length=0.0) for x in (0.0, 1.0)] == [1, 1]
    assert [ramp(x, start=1.0, length=0.3) for x in (0.0, 1.0, 1e9)] == [0, 0, 1]
    assert ramp(0.55, start=0.4, length=0.3) == pytest.approx(0.5)
    assert [ramp(x, start=0.4, length=5e-324) for x in (0.3, 0.5)] == [0, 1]

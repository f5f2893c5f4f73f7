import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from clock import FakeClock

from sparsestyle_ns.studies.curves import Curve
from sparsestyle_ns.studies.time_budget import Budget, Case, OutOfTimeError, Plan, in_turns, parse_duration, run_plans
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.machine import LoadWatch


def make_curve(name="samples"):
    return Curve("quadrature", name, "Samples", "--samples", "64", "view_seconds", "rmse", [("view_seconds", "rmse")])


def worker(clock, seconds, calls=None, name=None):
    """Something that takes so long to measure."""

    def measure(round_):
        if calls is not None:
            calls.append(name)
        clock.work(seconds)
        return {"": {"view_seconds": seconds, "rmse": 1.0 / seconds}}

    return measure


def cases_of(curve, measures):
    return [Case([(curve, setting)], measure) for setting, measure in measures.items()]


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("10m", 600), ("1h30m", 5400), ("600", 600), ("1.5m", 90), ("1m5", 65)]
)
def test_durations_are_read_as_they_are_said(text, seconds):
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "0", "-5m", "10x", "1.2.3s"])
def test_what_is_no_duration_is_said_in_one_sentence(text):
    with pytest.raises(InputError, match="is no duration; give one such as"):
        parse_duration(text)


def test_a_part_of_a_budget_ends_with_the_whole():
    clock = FakeClock()
    budget = Budget(10.0, clock)
    clock.work(4.0)
    assert budget.part(100.0).left == 6.0
    part = budget.part(2.0)
    clock.work(3.0)
    assert (part.left, budget.left, budget.spent) == (-1.0, 3.0, 7.0)
    with pytest.raises(OutOfTimeError):
        part.check()
    budget.check(needed=2.9)
    with pytest.raises(OutOfTimeError):
        budget.check(needed=3.0)


def test_cases_take_turns():
    clock, calls = FakeClock(), []
    curve = make_curve()
    cases = {name: worker(clock, 1.0, calls, name) for name in ("a", "b", "c")}
    in_turns(cases_of(curve, cases), Budget(100.0, clock), rounds=2, watch=LoadWatch())
    assert calls == ["a", "b", "c", "a", "b", "c"]
    assert [point.spread("rmse").count for point in curve.points] == [2, 2, 2]
    assert curve.left_out == []


def test_a_case_that_took_longer_than_what_is_left_is_not_begun_again():
    clock = FakeClock()
    curve, budget = make_curve(), Budget(10.0, clock)
    cases = {"quick": worker(clock, 1.0), "slow": worker(clock, 6.0)}
    in_turns(cases_of(curve, cases), budget, rounds=9, watch=LoadWatch())
    assert len(curve.find("slow").values["rmse"]) == 1
    assert len(curve.find("quick").values["rmse"]) == 3
    assert clock.now <= 10.0


def test_what_was_not_measured_is_named():
    clock = FakeClock()
    curve = make_curve()
    cases = {name: worker(clock, 4.0) for name in ("a", "b", "c")}
    in_turns(cases_of(curve, cases), Budget(10.0, clock), rounds=3, watch=LoadWatch())
    assert [point.setting for point in curve.points] == ["a", "b"]
    assert curve.left_out == ["c: no time was left"]
    assert clock.now <= 10.0


def test_a_case_that_runs_out_of_time_leaves_what_there_was():
    clock = FakeClock()
    curve, budget = make_curve(), Budget(10.0, clock)

    def endless(round_):
        while True:
            budget.check()
            clock.work(1.0)

    in_turns(cases_of(curve, {"a": worker(clock, 1.0), "b": endless}), budget, rounds=3, watch=LoadWatch())
    assert [point.setting for point in curve.points] == ["a"]
    assert curve.left_out == ["b: no time was left"]
    assert clock.now == 10.0


def plans_of(clock, seconds, weights, spend):
    def plan(name, weight):
        curve = make_curve(name)

        def measure(budget):
            spend[name] = budget.left
            cases = {number: worker(clock, seconds) for number in range(3)}
            in_turns(cases_of(curve, cases), budget, rounds=100, watch=LoadWatch())

        return Plan([curve], weight, measure)

    return [plan(str(number), weight) for number, weight in enumerate(weights)]


def test_a_case_may_belong_to_several_curves_which_take_what_has_their_time():
    clock, curves = FakeClock(), [make_curve(), make_curve()]
    curves[1].time = "step_seconds"
    found = {"stop 1": {"view_seconds": 3.0, "rmse": 0.1}, "": {"step_seconds": [1.0, 2.0], "rmse": 0.2}}
    in_turns([Case([(curves[0], 8), (curves[1], "x")], lambda round_: found)], Budget(9.0, clock), 1, LoadWatch())
    assert [(point.name, point.values) for point in curves[0].points] == [
        ("8 stop 1", {"view_seconds": [3.0], "rmse": [0.1]})
    ]
    assert [(point.name, point.values["step_seconds"]) for point in curves[1].points] == [("x", [1.0, 2.0])]


def test_the_budget_is_kept_over_all_curves():
    clock, shares = FakeClock(), {}
    plans = plans_of(clock, 0.7, (1, 2, 3), shares)
    run_plans(plans, Budget(60.0, clock))
    assert clock.now <= 60.0
    assert clock.now > 58.0  # each curve leaves less than one measurement's time to the next, and the last ends so too
    assert shares["0"] == pytest.approx(10.0)
    assert all(plan.curves[0].points for plan in plans)


def test_time_that_is_left_over_goes_to_those_that_follow():
    clock, shares = FakeClock(), {}
    plans = plans_of(clock, 1.0, (1, 1), shares)
    plans[0].measure = lambda budget: clock.work(1.0)
    run_plans(plans, Budget(20.0, clock))
    assert shares["1"] == 19.0


def test_a_curve_with_no_time_left_says_so():
    clock = FakeClock()
    plans = plans_of(clock, 1.0, (1, 1), {})
    plans[0].measure = lambda budget: clock.work(50.0)
    run_plans(plans, Budget(20.0, clock))
    assert plans[1].curves[0].left_out == ["all: no time was left"]


def test_ctrl_c_keeps_what_was_measured():
    clock = FakeClock()
    curve = make_curve()

    def interrupted(round_):
        raise KeyboardInterrupt

    cases = {"a": worker(clock, 1.0), "b": interrupted, "c": worker(clock, 1.0)}
    with pytest.raises(KeyboardInterrupt):
        in_turns(cases_of(curve, cases), Budget(10.0, clock), rounds=2, watch=LoadWatch())
    assert [point.setting for point in curve.points] == ["a"]
    assert curve.left_out == ["b: no time was left", "c: no time was left"]

import math

import pytest

from sparsestyle_ns.studies.curves import (
    decibels,
    decibels_lost,
    error_that_costs,
    fastest_within,
    knee,
    observed_order,
    pareto_front,
    root_mean_square,
    time_factor_of_a_decibel,
)


def test_the_front_has_what_nothing_else_beats_from_the_fastest_on():
    times = [4.0, 1.0, 2.0, 3.0, 8.0, 2.5]
    errors = [0.2, 0.9, 0.5, 0.6, 0.2, 0.5]
    assert pareto_front(times, errors) == [1, 2, 0]


def test_the_front_of_equal_points_is_the_first_of_them():
    assert pareto_front([1.0, 1.0], [0.5, 0.5]) == [0]
    assert pareto_front([], []) == []


def test_the_knee_is_where_twice_the_time_no_longer_takes_enough_off():
    times = [1.0, 2.0, 4.0, 8.0]
    # Each doubling takes off 20%, 10%, 5%; more than 8.3% is worth it.
    errors = [1.0, 0.8, 0.72, 0.684]
    assert knee(times, errors) == 2
    assert knee(times, errors, exponent=1.0) == 0


def test_the_knee_depends_on_no_unit_and_of_nothing_is_none():
    times, errors = [1.0, 3.0, 10.0, 40.0], [0.5, 0.3, 0.25, 0.249]
    scaled = knee([60 * time for time in times], [1e-3 * error for error in errors])
    assert knee(times, errors) == scaled
    assert knee([], []) is None


def test_the_fastest_within_a_limit_or_else_the_most_accurate():
    times, errors = [3.0, 1.0, 2.0], [0.01, 0.1, 0.02]
    assert fastest_within(times, errors, 0.05) == 2
    assert fastest_within(times, errors, 0.001) == 0
    assert fastest_within([], [], 1.0) is None


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0])
def test_the_observed_order_is_the_exponent_of_a_power_law(order):
    samples = [8, 16, 32, 64]
    assert observed_order(samples, [3.0 * n**-order for n in samples]) == pytest.approx(order)


def test_there_is_no_order_without_two_errors():
    assert observed_order([8, 16], [0.1, 0.0]) is None
    assert observed_order([8, 8], [0.1, 0.2]) is None


def test_the_midpoint_rule_has_order_2():
    def error(n):
        return abs(sum(math.exp((i + 0.5) / n) for i in range(n)) / n - (math.e - 1))

    samples = [8, 16, 32, 64]
    assert observed_order(samples, list(map(error, samples))) == pytest.approx(2.0, abs=0.01)


def test_an_error_as_large_as_the_fields_own_costs_3_decibels():
    assert decibels_lost(0.1, 0.1) == pytest.approx(10 * math.log10(2))
    assert decibels_lost(error_that_costs(0.1, 0.07), 0.07) == pytest.approx(0.1)


def test_psnr_and_error_are_inverses():
    assert decibels(0.1) == pytest.approx(20.0)
    assert root_mean_square(decibels(0.03)) == pytest.approx(0.03)
    assert decibels(0.0) == math.inf


def test_half_a_decibel_for_twice_the_time_is_a_decibel_for_four_times():
    assert time_factor_of_a_decibel(10.0, 19.0, 20.0, 19.5) == pytest.approx(4.0)
    assert time_factor_of_a_decibel(10.0, 19.0, 20.0, 18.9) is None

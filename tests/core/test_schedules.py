import itertools

import pytest
import reference

from sparsestyle_ns.core.schedules import content_weight
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

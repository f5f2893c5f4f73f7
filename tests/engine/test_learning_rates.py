"""Learning rates over runs of any length."""

import itertools
import math

import pytest
import torch

from sparsestyle_ns.engine.schedules import ShareSchedulerConfig, over_iterations
from sparsestyle_ns.utils.errors import InputError


def rates_of(config: ShareSchedulerConfig, count: int) -> list:
    """The learning rates of an optimiser of rate 2 that steps so many times."""
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=2.0)
    schedule = config.setup().get_scheduler(optimizer, 2.0)
    rates = []
    for _ in range(count):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return rates


def test_a_rate_rises_evenly_and_falls_to_a_third_at_each_milestone():
    config = ShareSchedulerConfig(warm_up=0.4, milestones=(0.6, 0.8), gamma=0.33, iterations=10)
    expected = [0.5, 1.0, 1.5, 2.0, 2.0, 2.0, 0.66, 0.66, 0.66 * 0.33, 0.66 * 0.33]
    assert rates_of(config, 10) == pytest.approx(expected)


def test_a_rate_falls_exponentially_to_its_end_and_stays_there():
    rates = rates_of(ShareSchedulerConfig(final=0.01, iterations=20), 30)
    assert rates[10] == pytest.approx(0.2) and rates[20:] == pytest.approx([0.02] * 10)
    ratios = [after / before for before, after in itertools.pairwise(rates[:21])]
    assert ratios == pytest.approx([0.01 ** (1 / 20)] * 20)


def test_a_long_run_s_rate_falls_as_fast_as_a_shorter_one_s_and_stays_at_its_end():
    short, long = (rates_of(ShareSchedulerConfig(final=0.01, longest_fall=20, iterations=n), n) for n in (20, 60))
    assert long[:20] == pytest.approx(short) and long[20:] == pytest.approx([0.02] * 40)
    shorter = rates_of(ShareSchedulerConfig(final=0.01, longest_fall=20, iterations=10), 12)
    assert shorter[10:] == pytest.approx([0.02] * 2)


def test_a_fall_of_no_iterations_is_refused():
    with pytest.raises(InputError, match="longest fall is 0; give 1 iteration or more"):
        ShareSchedulerConfig(longest_fall=0, iterations=10).factor(0)


@pytest.mark.parametrize("total", [40, 400, 4000])
def test_runs_of_any_length_have_one_schedule(total):
    schedule = ShareSchedulerConfig(warm_up=0.1, milestones=(0.5,), gamma=0.25, final=0.1)
    group = {"fields": {"optimizer": None, "scheduler": schedule}}
    filled = over_iterations(group, total)["fields"]["scheduler"]
    assert group["fields"]["scheduler"].iterations is None
    found = [filled.factor(round(share * total)) for share in (0.25, 0.75, 1.0)]
    assert found == pytest.approx([0.1**0.25, 0.25 * 0.1**0.75, 0.025])


def test_a_group_without_a_schedule_keeps_its_rate():
    assert over_iterations({"fields": {"optimizer": 1, "scheduler": None}}, 5)["fields"]["scheduler"] is None


@pytest.mark.parametrize("wrong", [{"warm_up": 15.0}, {"milestones": (50, 100)}, {"final": math.nan}])
def test_settings_in_iterations_are_refused(wrong):
    with pytest.raises(InputError, match="give shares from 0 to 1"):
        ShareSchedulerConfig(**wrong, iterations=10).factor(0)

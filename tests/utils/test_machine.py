"""What is known of the machine that something is measured on."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

sys.path.append(str(Path(__file__).resolve().parents[2]))  # benchmarks isn't installed

from benchmarks._measure import OtherLoad
from sparsestyle_ns.utils import machine


def test_own_work_is_not_load_by_others():
    def now(elapsed, idle, own):
        return SimpleNamespace(monotonic=lambda: elapsed), SimpleNamespace(idle=idle), (own, 0, 0, 0, elapsed)

    with pytest.MonkeyPatch.context() as patch:

        def set_now(*state):
            clock, times, own = now(*state)
            patch.setattr(machine, "time", clock)
            patch.setattr(machine.psutil, "cpu_times", lambda: times)
            patch.setattr(machine.os, "times", lambda: own)

        patch.setattr(machine.os, "cpu_count", lambda: 2)
        patch.setattr(machine.psutil, "cpu_percent", lambda interval: 4.0)
        set_now(0.0, 0.0, 0.0)
        load = OtherLoad()
        # Ten seconds of two cores: 12 s are ours, 5 s are idle, and 3 s are another process'.
        set_now(10.0, 5.0, 12.0)
        assert load.record() == {"before": 0.04, "during": 0.15, "busy": True}
        set_now(10.0, 7.5, 12.0)
        assert load.record() == {"before": 0.04, "during": 0.025, "busy": False}


def test_a_short_measurement_is_judged_with_what_came_right_before_it(monkeypatch):
    monkeypatch.setattr(machine.os, "cpu_count", lambda: 2)
    readings = iter([(0.0, 0.0), (10.0, 0.0), (10.02, 0.02), (20.0, 0.02), (20.02, 0.02), (30.0, 0.02), (34.0, 2.02)])
    monkeypatch.setattr(machine, "core_seconds", lambda: next(readings))
    watch = machine.LoadWatch()
    found = []
    for _ in range(3):
        with watch:
            pass
        found.append(watch.busy)
    # 20 ms of another process in a blink of 20 ms say nothing; two seconds of four do.
    assert found == [False, False, True]

import subprocess
import sys
import threading

import numpy as np
import pytest
import torch

from sparsestyle_ns.utils.numba_kernels import even_parts, kernel, run_on_threads


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("length, count", [(0, 3), (1, 3), (2, 3), (7, 3), (9, 3), (10, 1), (100, 7)])
def test_parts_cover_everything_once_and_none_is_empty(length, count):
    parts = even_parts(length, count)
    assert [index for start, end in parts for index in range(start, end)] == list(range(length))
    assert len(parts) <= count
    assert all(end > start for start, end in parts)


def test_a_kernel_is_compiled_and_lets_other_threads_run(two_threads):
    @kernel
    def fill(values, start, end):
        for index in range(start, end):
            values[index] = 2 * index

    values = np.zeros(11)
    run_on_threads(fill, [(values, *part) for part in even_parts(11, 3)])
    assert values.tolist() == [2 * index for index in range(11)]
    assert fill.targetoptions["nogil"]


def test_parts_run_at_the_same_time_on_as_many_threads_as_torch_has(two_threads):
    # Each waits for the other: one after the other they would time out.
    meeting = threading.Barrier(2, timeout=10)
    run_on_threads(lambda: meeting.wait(), [(), ()])


def test_one_thread_means_the_callers_own(two_threads):
    torch.set_num_threads(1)
    seen = []
    run_on_threads(lambda: seen.append(threading.current_thread()), [(), ()])
    assert seen == [threading.current_thread()] * 2


@pytest.mark.parametrize("moment", ["pools_closed", "main_thread_over"])
def test_work_goes_on_while_python_ends(moment):
    """A thread that is at work then may come to its end: pools take no work any more."""
    script = """
import sys, threading, time
pools_closed = threading.Event()

def end():
    pools_closed.set()
    time.sleep(0.5)

threading._register_atexit(end)  # called after the pools', which is registered later
import torch
from sparsestyle_ns.utils.numba_kernels import run_on_threads

def work():
    threading.main_thread().join() if sys.argv[1] == "main_thread_over" else pools_closed.wait()
    done = []
    run_on_threads(lambda: done.append(1), [(), ()])
    print(len(done), flush=True)

torch.set_num_threads(2)
threading.Thread(target=work).start()
"""
    ended = subprocess.run([sys.executable, "-c", script, moment], capture_output=True, text=True, timeout=120)
    assert (ended.stdout, ended.stderr) == ("2\n", "")


def test_an_error_in_a_part_is_raised(two_threads):
    def fail(part):
        if part == 1:
            raise ValueError("part 1")

    with pytest.raises(ValueError, match="part 1"):
        run_on_threads(fail, [(0,), (1,), (2,)])


def test_where_nothing_can_be_written_a_kernel_still_compiles(monkeypatch):
    from numba.core import caching

    # What numba does when neither the source's folder nor a user's cache folder can be written to.
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])

    @kernel
    def double(values):
        values[0] *= 2

    values = np.ones(1)
    double(values)
    assert values[0] == 2


def test_what_was_compiled_of_an_earlier_version_is_not_used(tmp_path):
    """numba itself keeps a kernel while its own file is the same, and fails where a class in it has another name."""

    def found(part: str, pair: str) -> str:
        (tmp_path / "parts.py").write_text(
            "from sparsestyle_ns.utils.numba_kernels import inlined\n"
            f"@inlined\ndef part(value):\n    return value {part}\n"
        )
        source = tmp_path / "whole.py"
        text = f"""
from typing import NamedTuple
import numpy as np
from parts import part
from sparsestyle_ns.utils.numba_kernels import kernel

class {pair}(NamedTuple):
    first: float

@kernel
def fill(values, pair):
    values[0] = part(pair.first)

values = np.zeros(1)
fill(values, {pair}(3.0))
print(values[0], sum(fill.stats.cache_hits.values()))
"""
        if not source.exists() or source.read_text() != text:
            source.write_text(text)
        code = "import sys; sys.path.insert(0, sys.argv[1]); import whole"
        done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False)
        return done.stdout.strip() or done.stderr

    assert found("+ 1", "Pair") == "4.0 0"
    assert found("* 2", "Pair") == "6.0 0"
    assert found("* 2", "Renamed") == "6.0 0"

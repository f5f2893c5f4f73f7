import sys
import threading

import pytest

from sparsestyle_ns.utils.numba_kernels import untraced


class BrokenOffError(Exception):
    pass


def traced(work):
    """Runs work in a thread whose trace function raises at every line of a function called `fragile`."""
    found = []

    def trace(frame, event, arg):
        if event == "line" and frame.f_code.co_name == "fragile":
            raise BrokenOffError
        return trace

    def run():
        sys.settrace(trace)
        try:
            found.append(work())
            found.append(sys.gettrace() is trace)
        except BrokenOffError as error:
            found.append(error)
        finally:
            sys.settrace(None)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return found


def fragile():
    return 1


def test_a_trace_function_breaks_work_off():
    (error,) = traced(fragile)
    assert isinstance(error, BrokenOffError)


def test_undisturbed_work_is_done_and_the_trace_function_is_back_afterwards():
    assert traced(untraced(fragile)) == [1, True]


def test_an_error_gets_through():
    def fail():
        raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        untraced(fail)()

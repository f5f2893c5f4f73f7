"""Waiting for threads until nothing is left of them."""

import threading
import time

import psutil

from sparsestyle_ns.utils.threads import wait_for_end


def test_the_systems_thread_is_over_too():
    for _ in range(200):
        thread = threading.Thread(target=lambda: None)
        thread.start()
        wait_for_end([thread], 60.0)
        assert thread.native_id not in {each.id for each in psutil.Process().threads()}


def test_no_thread_is_waited_for_longer_than_is_said():
    event = threading.Event()
    threads = [threading.Thread(target=event.wait, args=(60.0,), daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    began = time.monotonic()
    wait_for_end(threads, 0.1)
    assert all(thread.is_alive() for thread in threads) and time.monotonic() - began < 30.0
    event.set()
    wait_for_end(threads, 60.0)
    assert not any(thread.is_alive() for thread in threads)

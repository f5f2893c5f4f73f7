"""Threads that must be over, whatever else happens."""

import threading
import time
from typing import Sequence

import psutil

SECONDS_BETWEEN_LOOKS = 0.001


def wait_for_end(threads: Sequence[threading.Thread], seconds: float) -> None:
    """Waits for `threads` until the operating system has ended them too, but no longer than `seconds` in all.

    `Thread.join` returns while a thread still clears away what libraries have kept for it. Torch needs Python for that,
    and aborts the process where Python has begun to end.
    """
    deadline = time.monotonic() + seconds
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    numbers = {thread.native_id for thread in threads}
    while numbers & {thread.id for thread in psutil.Process().threads()} and time.monotonic() < deadline:
        time.sleep(SECONDS_BETWEEN_LOOKS)

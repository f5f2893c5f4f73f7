"""The machine: what it is, whether others use it, how much memory is taken, and an ffmpeg for it."""

import atexit
import contextlib
import ctypes
import gc
import importlib.metadata
import os
import platform
import re
import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import psutil
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sparsestyle_ns.utils.errors import InputError

PACKAGES = ("torch", "numpy", "nerfstudio", "numba")
BUSY_SHARE, SHORTEST_WINDOW = 0.1, 0.5
"""Share of all cores that others may use before a figure is marked, and seconds over which it is averaged at least."""


def synchronize(device: torch.device) -> None:
    """Waits until a GPU has done what it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def numbers_on(values: Sequence[Any], device: torch.device, dtype: Optional[torch.dtype] = None) -> Tensor:
    """A tensor of a few numbers on a device, for whose copy nothing waits.

    `torch.tensor(values, device=...)` waits until a GPU has done all that it was told. A copy that doesn't block
    returns when the driver has taken the numbers over, from memory that isn't pinned too.
    """
    return torch.tensor(values, dtype=dtype).to(device, non_blocking=True)


def release_memory() -> None:
    """Gives back to the system what nobody uses any more, which Python and the C library would keep for later."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # another C library than GNU's
        ctypes.CDLL("libc.so.6").malloc_trim(0)


class PeakMemory:
    """The most memory that is taken inside of the `with`, in bytes: resident on a CPU, torch's own on a GPU."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.bytes = device, 0

    def __enter__(self) -> "PeakMemory":
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
            return self
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self.device.type == "cuda":
            self.bytes = torch.cuda.max_memory_allocated(self.device)
            return
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        ended = False
        while not ended:
            self.bytes = max(self.bytes, psutil.Process().memory_info().rss)
            ended = self._ended.wait(0.01)


def core_seconds() -> Tuple[float, float]:
    """Seconds that all cores together have had, and those of them in which another process ran."""
    times = psutil.cpu_times()
    cores = (os.cpu_count() or 1) * time.monotonic()
    own = sum(os.times()[:4])  # with those of processes that it started, once they have ended
    return cores, cores - times.idle - getattr(times, "iowait", 0.0) - own


def others_share(earlier: Tuple[float, float], later: Tuple[float, float]) -> float:
    """Share of all cores, in [0, 1], that other processes used between two readings of `core_seconds`."""
    cores, others = later[0] - earlier[0], later[1] - earlier[1]
    return min(1.0, max(0.0, others / max(cores, 1e-9)))


class LoadWatch:
    """Whether others kept the machine `busy` in the latest `with`; a short one is judged with what came before it."""

    def __init__(self) -> None:
        self.busy = False
        self._readings: List[Tuple[float, float]] = [core_seconds()]

    def __enter__(self) -> "LoadWatch":
        self._readings.append(core_seconds())
        return self

    def __exit__(self, *error: object) -> None:
        now, window = core_seconds(), SHORTEST_WINDOW * (os.cpu_count() or 1)
        while len(self._readings) > 1 and now[0] - self._readings[1][0] >= window:
            del self._readings[0]
        self.busy = others_share(self._readings[0], now) > BUSY_SHARE


def device_name(device: torch.device) -> str:
    """The GPU's name, or the CPU's model."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    information = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.+)", information.read_text()) if information.is_file() else None
    return found[1].strip() if found else platform.processor() or platform.machine()


def versions() -> Dict[str, str]:
    """Versions of Python and of the packages that matter, as far as they are installed."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def put_ffmpeg_on_path() -> None:
    """Puts imageio-ffmpeg's ffmpeg on this process's PATH, if there is no other; an `InputError` if neither exists."""
    if shutil.which("ffmpeg") is not None:
        return
    try:
        import imageio_ffmpeg

        executable = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise InputError(
            "There is no ffmpeg to write videos with: install it, or `pip install imageio-ffmpeg`."
        ) from error
    folder = tempfile.mkdtemp(prefix="ffmpeg-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (Path(folder) / "ffmpeg").symlink_to(executable)
    os.environ["PATH"] = folder + os.pathsep + os.environ.get("PATH", "")
    CONSOLE.print(f"No ffmpeg is installed; using the one in the package imageio-ffmpeg, {executable}", soft_wrap=True)

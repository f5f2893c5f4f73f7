"""An ffmpeg for `ns-render`, which doesn't start without one, on machines that have none installed."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE

from sparsestyle_ns.utils.errors import InputError


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

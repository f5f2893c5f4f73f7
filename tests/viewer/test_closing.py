"""The viewer's process ends as it should while the panel's threads are at work."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

OPENING = """
import sys, threading, time
from pathlib import Path

import torch
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.viewer.viewer import Viewer

from sparsestyle_ns.engine.loading import load_run

run, painting = Path(sys.argv[1]), sys.argv[2]
torch.set_num_threads(2)
_, pipeline, _ = load_run(run / "config.yml")
config = ViewerConfig(websocket_host="127.0.0.1")
viewer = Viewer(config, run / "viewer.txt", run, pipeline, train_lock=threading.Lock())
panel = pipeline.panel
"""
CLOSING = """
print("closing")
raise KeyboardInterrupt  # as in ns-viewer's main thread on Ctrl-C
"""
RESTYLING = """
panel.restyling.iterations.value, panel.restyling.path.value = 100000, painting
panel.restyling.restyle_path()
while "Iteration 2" not in panel.restyling.message.content:
    time.sleep(0.01)
"""
DRAWING = """
from types import SimpleNamespace
camera = SimpleNamespace(position=(0.0, 0.0, 1.0), wxyz=(1.0, 0.0, 0.0, 0.0), fov=0.8, aspect=1.5)
camera.on_update = lambda function: function
client = SimpleNamespace(client_id=0, camera=camera)
viewer.ready, model, began = True, pipeline.model, threading.Event()
def outputs(*_, **__):
    began.set()
    while True:
        torch.randn(1000, 1000) @ torch.randn(1000, 1000)
model.get_outputs_for_camera = outputs
viewer.handle_new_client(client)
began.wait()
"""


@pytest.mark.parametrize("work", [RESTYLING, DRAWING], ids=["restyling", "drawing a picture"])
def test_ctrl_c_while_threads_work_ends_the_process_without_a_crash(
    work: str, patterned_run: Path, painting: Path
) -> None:
    command = [sys.executable, "-c", OPENING + work + CLOSING, str(patterned_run), str(painting)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert "closing" in ended.stdout, ended.stderr
    # Python's own end after Ctrl-C; where a thread is left in the middle of torch, C++ aborts the process.
    assert "Traceback" not in ended.stdout
    assert ended.stderr.rstrip().endswith("KeyboardInterrupt"), ended.stderr
    assert ended.returncode == -signal.SIGINT

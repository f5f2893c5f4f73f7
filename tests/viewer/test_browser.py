"""ns-viewer on a real run, looked at and acted in through a browser."""

import json
import math
import os
import re
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from typing import Iterator

import numpy as np
import pytest
import torch
from chromium import Tab, needs_chromium, open_tab
from conftest import run_entrypoint

from sparsestyle_ns.core.camera_paths import most_central
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.export.gaussians import Gaussians
from sparsestyle_ns.export.splat_file import encode_splats
from sparsestyle_ns.viewer.splat_controls import FILE_NAME

WIDTH, HEIGHT = 760, 440  # small: a browser without a GPU draws it over and over
SCRIPT = "from nerfstudio.scripts.viewer.run_viewer import entrypoint; entrypoint()"
PATIENCE = 120
"""Seconds until something that doesn't happen counts as not happening; the first pictures compile kernels."""

HELPERS = """
window.leaf = text => [...document.querySelectorAll('label, div, p, span, button')]
  .filter(e => e.checkVisibility() && e.innerText.trim() === text).pop();
window.near = (text, selector) => {
  for (let e = leaf(text); e; e = e.parentElement) {
    const found = e.querySelector(selector);
    if (found) return found;
  }
};
0
"""
"""Finds the innermost visible element that says something (hidden tabs say the same), and the control beside it."""


class Page:
    """The viewer's page."""

    def __init__(self, tab: Tab, address: str) -> None:
        self.tab = tab
        tab.open(address)
        tab.evaluate(HELPERS)
        self.wait_for("!!leaf('Strength')")

    def wait_for(self, expression: str) -> None:
        """Until a JavaScript expression is true."""
        end = time.monotonic() + PATIENCE
        while not self.tab.evaluate(expression):
            assert time.monotonic() < end, f"{expression} never came true; the page says: " + self.text()
            time.sleep(0.2)

    def text(self) -> str:
        """What the page says."""
        return self.tab.evaluate("document.body.innerText")

    def click(self, text: str) -> None:
        """Clicks what says this."""
        self.wait_for(f"!!leaf({json.dumps(text)})")
        self.tab.evaluate(f"leaf({json.dumps(text)}).click()")

    def press(self, key: str) -> None:
        """A key, in whatever has the focus."""
        for kind in ("keyDown", "keyUp"):
            self.tab.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def slide(self, label: str, key: str) -> None:
        """Moves a slider by the keyboard: Home, End, ArrowLeft …"""
        self.tab.evaluate(f"near({json.dumps(label)}, '[role=slider]').focus()")
        self.press(key)

    def write(self, label: str, text: str) -> None:
        """Replaces what is in a text field."""
        self.tab.evaluate(f"(e => {{ e.focus(); e.select(); }})(near({json.dumps(label)}, 'input'))")
        self.tab.call("Input.insertText", text=text)

    def give(self, label: str, path: Path) -> None:
        """Chooses a file for an upload button."""
        self.wait_for(f"!!leaf({json.dumps(label)})")
        found = self.tab.call("Runtime.evaluate", expression=f"near({json.dumps(label)}, 'input[type=file]')")
        self.tab.call("DOM.setFileInputFiles", files=[str(path)], objectId=found["result"]["objectId"])

    def scene(self) -> np.ndarray:
        """The pixels left of the panel, once they are there and have come to rest."""
        before, since, end = self._pixels(), time.monotonic(), time.monotonic() + PATIENCE
        while time.monotonic() - since < 2.0 or not self._is_still():
            assert time.monotonic() < end, "there is no picture, or none that comes to rest"
            time.sleep(0.3)
            now = self._pixels()
            if np.abs(now - before).mean() > 0.5:
                before, since = now, time.monotonic()
        return before

    def scene_unlike(self, *others: np.ndarray) -> np.ndarray:
        """The still picture, once it shows what none of these do; a busy machine takes its time to draw it."""
        end = time.monotonic() + PATIENCE
        while min(difference(picture := self.scene(), other) for other in others) < ANOTHER:
            assert time.monotonic() < end, "the picture doesn't change"
        return picture

    def scene_like(self, other: np.ndarray) -> None:
        """Waits until the still picture is this one."""
        end = time.monotonic() + PATIENCE
        while (apart := difference(self.scene(), other)) >= ANOTHER:
            assert time.monotonic() < end, f"the picture doesn't come back: it is {apart:.1f} away"

    def _is_still(self) -> bool:
        """Whether the picture is a still one: while something moves, its longer side is smaller."""
        size = re.search(r"Resolution: (\d+)x(\d+)px", self.text())
        return size is not None and max(map(int, size.groups())) in (256, 512)  # on a CPU, on a GPU

    def _pixels(self) -> np.ndarray:
        return self.tab.screenshot()[60:420, 10:430].astype(float)


ANOTHER = 2.0
"""A difference from which on a picture is another one: those here are 20 and more apart; one that comes back, 0.2."""
BLOCK = 10
"""Pixels are compared in squares of so many a side: while a browser is short of time its picture is a coarser one."""


def difference(first: np.ndarray, second: np.ndarray) -> float:
    """Mean difference of squares, of 255."""
    height, width = (length // BLOCK * BLOCK for length in first.shape[:2])
    apart = (first - second)[:height, :width].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3)
    return float(np.abs(apart.mean(axis=(1, 3))).mean())


@pytest.fixture(scope="module")
def server(patterned_run: Path) -> Iterator[SimpleNamespace]:
    """ns-viewer in a process of its own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-c", SCRIPT, "--load-config", str(patterned_run / "config.yml")]
    command += ["--viewer.websocket-port", str(port), "--viewer.websocket-host", "127.0.0.1"]
    log = patterned_run.parent / "viewer.log"
    address = f"http://127.0.0.1:{port}"
    with open(log, "w") as output, subprocess.Popen(command, stdout=output, stderr=output) as process:
        try:
            end = time.monotonic() + PATIENCE
            while not answers(address):
                assert process.poll() is None and time.monotonic() < end, log.read_text()
                time.sleep(0.3)
            yield SimpleNamespace(address=address, process=process, log=log, run=patterned_run)
        finally:
            process.kill()


def answers(address: str) -> bool:
    try:
        with urllib.request.urlopen(address, timeout=5) as answer:
            return answer.status == 200
    except OSError:
        return False


@pytest.fixture(scope="module")
def page(server: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with open_tab(tmp_path_factory.mktemp("profile"), WIDTH, HEIGHT) as tab:
        yield Page(tab, server.address)


@needs_chromium
def test_the_picture_arrives_and_sliders_change_it(page: Page) -> None:
    stylised = page.scene()
    assert stylised.std() > 10
    page.slide("Strength", "Home")
    coarse = page.scene_unlike(stylised)
    assert difference(stylised, coarse) > 5
    page.slide("Strength", "End")
    page.scene_like(stylised)
    page.slide("Geometry", "Home")
    assert difference(page.scene(), coarse) > 5  # the style's colours stay
    page.slide("Geometry", "End")
    page.scene_like(stylised)


@needs_chromium
def test_nothing_in_the_panel_is_wider_than_the_panel(page: Page) -> None:
    page.click("Effects of this scene")
    time.sleep(1.0)
    panel = "leaf('Strength').closest('.mantine-ScrollArea-viewport')"
    assert page.tab.evaluate(f"{panel}.scrollWidth <= {panel}.clientWidth + 2")
    assert "Error" not in page.text()
    page.click("Effects of this scene")


@needs_chromium
def test_the_split_shows_the_coarse_field_on_the_left(page: Page) -> None:
    stylised = page.scene()
    page.tab.evaluate("near('Coarse | stylised', 'input[type=checkbox]').click()")
    split = page.scene_unlike(stylised)
    page.slide("Strength", "Home")
    coarse = page.scene_unlike(split)
    # Nothing but the right hand side depends on the strength; the divider is in the middle of the picture.
    assert difference(split[:, :190], coarse[:, :190]) < 1 < difference(split[:, 230:], coarse[:, 230:])
    page.slide("Strength", "End")
    page.tab.evaluate("near('Coarse | stylised', 'input[type=checkbox]').click()")
    page.scene_like(stylised)


@needs_chromium
def test_a_file_of_splats_is_drawn_where_the_picture_is(page: Page, server: SimpleNamespace) -> None:
    picture = page.scene()
    cameras = load_run(server.run / "config.yml").pipeline.datamanager.train_dataset.cameras
    pose = cameras.camera_to_worlds[most_central(cameras)]  # the viewer begins there
    ball = 0.02 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    one = torch.tensor([*3 * [math.log(0.02)], 1.0, 0.0, 0.0, 0.0, 9.0, 1.0, 0.0, 0.0])  # red, and dense
    splats = Gaussians(torch.cat([pose[:, 3] - 0.5 * pose[:, 2] + ball, one.expand(len(ball), -1)], dim=-1))
    (server.run / FILE_NAME).write_bytes(encode_splats(splats))
    page.click("Splats")
    page.wait_for("!!leaf('Show the splats')")
    page.tab.evaluate("near('Show the splats', 'input[type=checkbox]').click()")
    page.wait_for("document.body.innerText.includes('200 splats')")
    redder = (page.scene_unlike(picture) - picture) @ np.array([1.0, -0.5, -0.5])
    rows, columns = np.nonzero(redder > 60)
    assert len(rows) > 1000
    # In the middle of the picture, which the panel leaves 440 pixels of.
    assert abs(rows.mean() + 60 - 245) < 20 and abs(columns.mean() + 10 - 220) < 20
    page.tab.evaluate("near('Show the splats', 'input[type=checkbox]').click()")
    page.scene_like(picture)
    page.click("Splats")


@needs_chromium
def test_a_bad_image_gets_a_sentence_and_another_one_a_new_picture(
    page: Page, server: SimpleNamespace, tmp_path: Path, painting: Path
) -> None:
    before = page.scene()
    page.click("Another style")
    bad = tmp_path / "broken.png"
    bad.write_text("no picture")
    page.give("Upload and restyle", bad)
    page.wait_for("document.body.innerText.includes('broken.png is in no known image format')")
    page.scene_like(before)
    page.write("Image", str(painting))
    page.click("Restyle")
    page.wait_for("document.body.innerText.includes('is ready. Saved as a run of its own')")
    page.scene_unlike(before)
    assert server.process.poll() is None and "Traceback" not in server.log.read_text()


@needs_chromium
def test_a_camera_path_made_in_the_viewer_renders(
    page: Page, server: SimpleNamespace, llff_scene: Path, tmp_path: Path
) -> None:
    from nerfstudio.scripts import render

    page.click("Render")
    for _ in range(2):
        page.click("Add Keyframe")
        time.sleep(1.0)
    page.wait_for("parseFloat(near('Duration (sec)', 'input').value) > 0")  # two keyframes have come
    page.click("Generate Command")
    page.wait_for("document.body.innerText.includes('ns-render camera-path')")
    words = page.tab.evaluate("document.body.innerText.match(/ns-render camera-path.*/)[0]")
    arguments = words.split()
    assert arguments[:2] == ["ns-render", "camera-path"]
    output = arguments.index("--output-path") + 1
    arguments[output] = str(tmp_path / "pictures")
    # A sixtieth of full HD; only the command's output goes elsewhere.
    small = ["--output-format", "images", "--downscale-factor", "60"]
    before = os.getcwd()
    try:
        os.chdir(tmp_path)
        run_entrypoint(render.entrypoint, [*arguments[1:], *small])
    finally:
        os.chdir(before)
    pictures = list((tmp_path / "pictures").rglob("*.jpg"))
    path = json.loads(next((llff_scene / "camera_paths").glob("*.json")).read_text())
    assert len(pictures) == len(path["camera_path"]) > 1

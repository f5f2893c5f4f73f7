"""Viewers of splats that others wrote, from the npm registry, driven in a browser."""

import functools
import http.server
import json
import shutil
import subprocess
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from chromium import needs_chromium, open_tab

PACKAGES = ("playcanvas@2.23.3", "gltf-validator@2.0.0-dev.3.10")
"""With the versions that were tried."""
SETTLED_SECONDS = 3.0

PLAYCANVAS = """<!doctype html><meta charset="utf-8"><style>body { margin: 0 }</style><canvas></canvas>
<script type="module">
import * as pc from "./node_modules/playcanvas/build/playcanvas.mjs";
const canvas = document.querySelector("canvas");
const device = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
device.maxPixelRatio = 1;
const options = new pc.AppOptions();
options.graphicsDevice = device;
options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem, pc.RenderComponentSystem];
options.resourceHandlers = [pc.GSplatHandler, pc.ContainerHandler, pc.TextureHandler];
const app = new pc.AppBase(canvas);
app.init(options);
app.setCanvasFillMode(pc.FILLMODE_NONE);
app.setCanvasResolution(pc.RESOLUTION_FIXED, 16, 16);
app.start();
const camera = new pc.Entity();
camera.addComponent("camera", { nearClip: 0.01, farClip: 1e4 });
app.root.addChild(camera);
window.load = (kind, url) => new Promise((done, failed) => {
  const asset = new pc.Asset("scene", kind, { url });
  asset.on("load", () => {
    let scene;
    if (kind === "container") {
      scene = asset.resource.instantiateRenderEntity();
    } else {
      scene = new pc.Entity();
      scene.addComponent("gsplat", { asset });
    }
    app.root.addChild(scene);
    done();
  });
  asset.on("error", failed);
  app.assets.add(asset);
  app.assets.load(asset);
});
window.look = (columns, focal, width, height, background) => {
  app.resizeCanvas(width, height);
  device.setResolution(width, height);
  [canvas.style.width, canvas.style.height] = [`${width}px`, `${height}px`];
  camera.camera.fov = (360 / Math.PI) * Math.atan((0.5 * height) / focal);
  camera.camera.aspectRatioMode = pc.ASPECT_MANUAL;
  camera.camera.aspectRatio = width / height;
  camera.camera.clearColor = new pc.Color(...background);
  const pose = new pc.Mat4();
  pose.set(columns);
  camera.setPosition(pose.getTranslation());
  camera.setRotation(new pc.Quat().setFromMat4(pose));
};
window.app = app;
window.ready = true;
</script>
"""


@functools.lru_cache(maxsize=1)
def _missing() -> str:
    if shutil.which("npm") is None:
        return "npm isn't installed, which fetches the viewers"
    return ""


def needs_viewers(function):
    """Skips a test, with the reason, where there is no browser or no npm."""
    return needs_chromium(pytest.mark.skipif(bool(_missing()), reason=_missing())(function))


def install(folder: Path) -> None:
    """Puts the packages into a folder; skips the test where the registry can't be reached."""
    (folder / "package.json").write_text("{}")
    command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", *PACKAGES]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    if done.returncode != 0:
        pytest.skip(f"npm can't fetch the viewers: {done.stderr.strip().splitlines()[-1:]}")


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def guess_type(self, path):
        return "text/javascript" if str(path).endswith(".mjs") else super().guess_type(path)

    def log_message(self, *_):
        pass


@contextmanager
def served(folder: Path):
    """The address of a web server of a folder."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


class PlayCanvas:
    """A tab with PlayCanvas, which shows one file."""

    def __init__(self, tab) -> None:
        self.tab = tab

    def picture(self, camera, background=None):
        """What one pinhole camera sees, H × W × 3 in [0, 1], once sorting is done."""
        pose = torch.cat([camera.camera_to_worlds[0], torch.tensor([[0.0, 0.0, 0.0, 1.0]])])
        width, height = int(camera.width), int(camera.height)
        black = [0.0, 0.0, 0.0] if background is None else background.tolist()
        wanted = [pose.T.flatten().tolist(), float(camera.fy), width, height, [*black, 1.0]]
        self.tab.evaluate(f"look(...{json.dumps(wanted)})")
        before, since, end = None, time.monotonic(), time.monotonic() + 60
        while time.monotonic() < end:
            time.sleep(0.2)
            shown = self.tab.screenshot()[:height, :width]
            if before is None or not np.array_equal(shown, before):
                before, since = shown, time.monotonic()
            elif time.monotonic() - since > SETTLED_SECONDS and np.ptp(shown, axis=(0, 1)).any():
                return torch.from_numpy(shown / 255.0).float()
            elif time.monotonic() - since > SETTLED_SECONDS:  # nothing yet: PlayCanvas sorts when the camera moves
                aside = pose.clone()
                aside[0, 3] += 0.1
                for each in (aside, pose):
                    self.tab.evaluate(f"look(...{json.dumps([each.T.flatten().tolist(), *wanted[1:]])})")
                    time.sleep(0.5)
                since = time.monotonic()
        raise AssertionError("The picture never settled")


@contextmanager
def open_playcanvas(folder: Path, profile: Path, file: str):
    """PlayCanvas with a file of `folder`, in which `install` has put the packages."""
    (folder / "viewer.html").write_text(PLAYCANVAS)
    kind = "container" if file.endswith(".glb") else "gsplat"
    with served(folder) as address, open_tab(profile) as tab:
        tab.open(f"{address}/viewer.html")
        tab.wait_for("window.ready === true")
        tab.evaluate(f"load({json.dumps(kind)}, {json.dumps(file)})")
        yield PlayCanvas(tab)

"""Viewers of splats that others wrote, from the npm registry, driven in a browser."""

import functools
import http.server
import json
import shutil
import subprocess
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from chromium import needs_chromium, open_tab

PACKAGES = ("playcanvas@2.23.3", "gltf-validator@2.0.0-dev.3.10")
"""With the versions that were tried."""

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
const frame = () => new Promise((done) => app.once("frameend", done));
// Its managers are no public interface: of the version in PACKAGES. Each sorts in a worker when the camera turns, but
// drops what is asked for while a sort is under way, and then keeps the order of the camera before.
const managers = () =>
  [...app.renderer.gsplatDirector.camerasMap.values()]
    .flatMap((camera) => [...camera.layersMap.values()])
    .map((layer) => layer.gsplatManager);
const isIdle = ({ world, cpuSorter }) =>
  world.currentVersion > 0 && world.currentVersion === world.lastWorldStateVersion &&
  cpuSorter.jobsInFlight === 0 && cpuSorter.pendingSorted === null;
const idle = async () => {
  do await frame();
  while (!(managers().length > 0 && managers().every(isIdle)));
};
window.sorted = async () => {
  await idle();
  for (const manager of managers()) manager.sortNeeded = true;
  await idle();
  await frame();
};
window.ready = true;
</script>
"""


UNREACHABLE = ("ENOTFOUND", "EAI_AGAIN", "ECONNREFUSED", "ECONNRESET", "ENETUNREACH", "EHOSTUNREACH", "ETIMEDOUT")
"""What npm says where there is no network; anything else that it says is a failure."""


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
    unreachable = done.returncode != 0 and [code for code in UNREACHABLE if code in done.stderr]
    if unreachable:
        pytest.skip(f"npm's registry can't be reached ({unreachable[0]}), so there are no viewers")
    assert done.returncode == 0, done.stderr


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
        """What one pinhole camera sees, H × W × 3 in [0, 1], its splats sorted for it."""
        pose = torch.cat([camera.camera_to_worlds[0], torch.tensor([[0.0, 0.0, 0.0, 1.0]])])
        width, height = int(camera.width), int(camera.height)
        black = [0.0, 0.0, 0.0] if background is None else background.tolist()
        wanted = [pose.T.flatten().tolist(), float(camera.fy), width, height, [*black, 1.0]]
        self.tab.evaluate(f"look(...{json.dumps(wanted)})")
        self.tab.evaluate("sorted()")
        return torch.from_numpy(self.tab.screenshot()[:height, :width] / 255.0).float()


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

// Shows the voxels that the page carries. With #view=2 it opens with the third photo's camera, with #size=640x480 the
// picture has that many pixels, in the window's top left corner. `document.body.dataset.state` is "ready" when the
// picture on the screen is the final one for where the camera is.

function start(render) {
  const options = new URLSearchParams(location.hash.slice(1));
  const fixed = (options.get("size") || "").match(/^(\d+)x(\d+)$/);
  const asked = Number.parseInt(options.get("view") ?? "", 10);
  const view = asked in scene.cameras ? asked : scene.orbit.opening;
  if (!fixed) [canvas.style.width, canvas.style.height] = ["100vw", "100vh"];
  stage = new Stage(render, { view }, { ...scene.mix, divider: null }, fixed && [Number(fixed[1]), Number(fixed[2])]);
  connectControls(stage);
  stage.show(false);
}

async function main() {
  if (!("DecompressionStream" in window)) throw new Error("This browser is too old for this page; update it.");
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error("This browser shows no WebGL2; turn on hardware acceleration, or use another browser.");
  canvas.addEventListener("webglcontextlost", () => {
    fail("The graphics driver gave up on the scene; reload the page.");
  });
  start(makeRenderer(gl, readVoxels(await unpack(document.getElementById("voxels").textContent))));
  message.textContent = "";
}

function fail(text) {
  message.textContent = text;
  document.body.dataset.state = "failed";
}

window.addEventListener("error", (event) => fail(event.message)); // while it draws
main().catch((error) => fail(error.message));

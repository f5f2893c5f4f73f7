"use strict";
// Shows the voxels that the page carries. With #view=2 it opens with the third photo's camera, with #size=640x480 the
// picture has that many pixels, in the window's top left corner. `document.body.dataset.state` is "ready" when the
// picture on the screen is the final one for where the camera is.

const MOVING_SECONDS = 0.05;
const STILL_SECONDS = 0.5;
const SETTLE_MILLISECONDS = 200;
const DEGREES_PER_HEIGHT = 180;

const canvas = document.querySelector("canvas");
const message = document.getElementById("message");
const scene = JSON.parse(document.getElementById("scene").textContent);

// ------------------------------------------------------------------------------------------------------- the voxels

/** The bytes behind a base64 text of gzip. */
async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Occupancy as a byte a cell, and four bytes a voxel (colour, density), from the layout that web_page.py describes. */
function readVoxels(bytes) {
  const cells = scene.cells ** 3;
  const voxels = (scene.resolution + 1) ** 3;
  const bit = (start, i) => (bytes[start + (i >> 3)] >> (i & 7)) & 1;
  const occupancy = new Uint8Array(cells);
  for (let i = 0; i < cells; i++) occupancy[i] = 255 * bit(0, i);
  const known = (cells + 7) >> 3;
  const planes = known + ((voxels + 7) >> 3);
  const values = new Uint8Array(4 * voxels);
  const channels = [3, 0, 1, 2]; // the density comes first in the file, last in the texture
  const sums = [0, 0, 0, 0];
  for (let i = 0, n = 0; i < voxels; i++) {
    if (bit(known, i)) {
      for (let plane = 0; plane < 4; plane++) {
        sums[plane] = (sums[plane] + bytes[planes + plane * scene.known + n]) & 255;
        values[4 * i + channels[plane]] = sums[plane];
      }
      n++;
    } else {
      values[4 * i + 3] = scene.density.empty;
    }
  }
  return { occupancy, values };
}

// ---------------------------------------------------------------------------------------------------------- drawing

function compile(gl, type, source) {
  const shader = gl.createShader(type);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

function makeProgram(gl) {
  const corners =
    "#version 300 es\nvoid main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }";
  const program = gl.createProgram();
  gl.attachShader(program, compile(gl, gl.VERTEX_SHADER, corners));
  gl.attachShader(program, compile(gl, gl.FRAGMENT_SHADER, document.getElementById("shader").textContent.trim()));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}

function makeTexture(gl, unit, side, internal, format, filter, bytes) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) {
    gl.texParameteri(gl.TEXTURE_3D, axis, gl.CLAMP_TO_EDGE);
  }
  gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texImage3D(gl.TEXTURE_3D, 0, internal, side, side, side, 0, format, gl.UNSIGNED_BYTE, bytes);
  if (gl.getError() !== gl.NO_ERROR) throw new Error("This device has too little graphics memory for the scene.");
}

/** A function that draws the scene as a camera sees it, and returns how many seconds that took. */
function makeRenderer(gl, { occupancy, values }) {
  const side = scene.resolution + 1;
  if (side > gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)) {
    throw new Error("This device's graphics can't hold the scene; export it with a smaller --resolution.");
  }
  const program = makeProgram(gl);
  gl.useProgram(program);
  makeTexture(gl, 0, side, gl.RGBA8, gl.RGBA, gl.LINEAR, values);
  makeTexture(gl, 1, scene.cells, gl.R8, gl.RED, gl.NEAREST, occupancy);
  const at = (name) => gl.getUniformLocation(program, name);
  const { space, density } = scene;
  gl.uniform1i(at("u_voxels"), 0);
  gl.uniform1i(at("u_occupancy"), 1);
  gl.uniform1i(at("u_space"), ["ndc", "box", "contracted"].indexOf(space.kind));
  gl.uniform1i(at("u_num_steps"), scene.num_steps);
  gl.uniform1i(at("u_unbounded"), space.unbounded);
  gl.uniform3fv(at("u_minimum"), space.minimum);
  gl.uniform3fv(at("u_maximum"), space.maximum);
  gl.uniform2fv(at("u_focal_over_half_size"), space.focal_over_half_size);
  gl.uniform2fv(at("u_depths"), space.depths);
  gl.uniform1f(at("u_near"), space.near);
  gl.uniform1f(at("u_unit"), space.unit);
  gl.uniform1f(at("u_density_unit"), density.unit);
  gl.uniform1f(at("u_density_step"), density.step);
  gl.uniform1f(at("u_rounding"), density.rounding);
  gl.uniform3fv(at("u_background"), scene.background);
  const places = Object.fromEntries(["u_pose", "u_focal", "u_center", "u_size"].map((name) => [name, at(name)]));
  const pixel = new Uint8Array(4);
  return (pose, camera, width, height) => {
    const start = performance.now();
    canvas.width = width;
    canvas.height = height;
    gl.viewport(0, 0, width, height);
    const scale = Math.min(width / camera.width, height / camera.height); // the whole photo fits in
    gl.uniform2f(places.u_focal, scale * camera.fx, scale * camera.fy);
    gl.uniform2f(
      places.u_center,
      0.5 * width + scale * (camera.cx - 0.5 * camera.width),
      0.5 * height + scale * (camera.cy - 0.5 * camera.height),
    );
    gl.uniform2f(places.u_size, width, height);
    gl.uniformMatrix4fv(places.u_pose, false, toColumns(pose));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits for the picture
    return (performance.now() - start) / 1000;
  };
}

/** A 3 × 4 pose, by rows, as a 4 × 4 matrix by columns. */
function toColumns(pose) {
  const columns = [];
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 3; row++) columns.push(pose[row][column]);
    columns.push(column === 3 ? 1 : 0);
  }
  return columns;
}

// ---------------------------------------------------------------------------------------------------------- cameras

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Rotation about a unit vector by the right-hand rule, as rows. */
function rotation([x, y, z], degrees) {
  const angle = (degrees * Math.PI) / 180;
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const t = 1 - c;
  return [
    [c + t * x * x, t * x * y - s * z, t * x * z + s * y],
    [t * x * y + s * z, c + t * y * y, t * y * z - s * x],
    [t * x * z - s * y, t * y * z + s * x, c + t * z * z],
  ];
}

/** The opening camera, pitched about its right axis, then yawed about the scene's up axis, and moved along its sight. */
function turnedPose(turn) {
  const { target, up, opening } = scene.orbit;
  const pose = scene.cameras[opening].pose;
  const column = (i) => pose.map((row) => row[i]);
  const pitched = rotation(column(0), -turn.pitch);
  const yawed = rotation(up, turn.yaw);
  const apply = (vector) => {
    const first = pitched.map((row) => dot(row, vector));
    return yawed.map((row) => dot(row, first));
  };
  const offset = column(3).map((value, i) => turn.distance * (value - target[i]));
  const columns = [0, 1, 2].map((i) => apply(column(i)));
  columns.push(apply(offset).map((value, i) => value + target[i]));
  return [0, 1, 2].map((row) => columns.map((vector) => vector[row]));
}

const clamp = (value, [low, high]) => Math.min(Math.max(value, low), high);

// -------------------------------------------------------------------------------------------------------- the window

function start(render) {
  const options = new URLSearchParams(location.hash.slice(1));
  const fixed = (options.get("size") || "").match(/^(\d+)x(\d+)$/);
  const { orbit, cameras } = scene;
  const asked = Number.parseInt(options.get("view") ?? "", 10);
  let view = asked in cameras ? asked : orbit.opening;
  let turn = null; // null: a photo's own camera
  let [movingScale, stillScale] = [0.25, 0.25];
  let [settle, requested, coarse] = [0, false, false];

  const size = (scale) => {
    if (fixed) return [Number(fixed[1]), Number(fixed[2])];
    const dense = scale * Math.min(window.devicePixelRatio || 1, 2);
    return [window.innerWidth, window.innerHeight].map((side) => Math.max(1, Math.round(dense * side)));
  };
  const fit = (scale, seconds, wanted) => clamp(scale * Math.sqrt(wanted / Math.max(seconds, 1e-4)), [0.1, 1]);

  const draw = (moving) => {
    const scale = moving ? movingScale : stillScale;
    const pose = turn ? turnedPose(turn) : cameras[view].pose;
    const seconds = render(pose, cameras[turn ? orbit.opening : view], ...size(scale));
    movingScale = fit(scale, seconds, MOVING_SECONDS);
    stillScale = fit(scale, seconds, STILL_SECONDS);
    document.body.dataset.state = moving ? "moving" : "ready";
    if (!moving && !fixed && stillScale > 1.2 * scale) show(false); // quicker than thought: draw it finer
  };

  /** Draws soon: coarsely while the camera moves, finely once it rests; of several wishes before a frame, as the last. */
  const show = (moving) => {
    document.body.dataset.state = "moving";
    coarse = moving;
    clearTimeout(settle);
    if (moving) settle = setTimeout(() => show(false), SETTLE_MILLISECONDS);
    if (requested) return;
    requested = true;
    requestAnimationFrame(() => {
      requested = false;
      draw(coarse);
    });
  };

  const move = (yaw, pitch, zoom) => {
    const now = turn ?? { yaw: 0, pitch: 0, distance: 1 };
    const round = orbit.yaw[1] - orbit.yaw[0] >= 360;
    turn = {
      yaw: round ? (now.yaw + yaw) % 360 : clamp(now.yaw + yaw, orbit.yaw),
      pitch: clamp(now.pitch + pitch, orbit.pitch),
      distance: clamp(now.distance * zoom, orbit.distance),
    };
    show(true);
  };

  const pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const apart = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const degrees = DEGREES_PER_HEIGHT / window.innerHeight;
    if (pointers.size === 1) {
      move(-degrees * (event.clientX - before.x), degrees * (event.clientY - before.y), 1);
    } else if (pointers.size === 2) {
      move(0, 0, apart / Math.max(spread(), 1));
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? 1 : 30);
      move(0, 0, Math.exp(0.001 * pixels));
    },
    { passive: false },
  );
  const keys = {
    ArrowLeft: [5, 0, 1], ArrowRight: [-5, 0, 1], ArrowUp: [0, 5, 1], ArrowDown: [0, -5, 1],
    "+": [0, 0, 0.9], "-": [0, 0, 1.1],
  };
  canvas.addEventListener("keydown", (event) => {
    if (event.key in keys) {
      event.preventDefault();
      move(...keys[event.key]);
    }
  });
  document.getElementById("next").addEventListener("click", () => {
    view = turn ? orbit.opening : (view + 1) % cameras.length;
    turn = null;
    show(false);
  });
  window.addEventListener("resize", () => show(true));
  if (!fixed) [canvas.style.width, canvas.style.height] = ["100vw", "100vh"];
  show(false);
}

async function main() {
  if (!("DecompressionStream" in window)) throw new Error("This browser is too old for this page; update it.");
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error("This browser shows no WebGL2; turn on hardware acceleration, or use another browser.");
  canvas.addEventListener("webglcontextlost", () => {
    message.textContent = "The graphics driver gave up on the scene; reload the page.";
    document.body.dataset.state = "failed";
  });
  start(makeRenderer(gl, readVoxels(await unpack(document.getElementById("voxels").textContent))));
  message.textContent = "";
}

main().catch((error) => {
  message.textContent = error.message;
  document.body.dataset.state = "failed";
});

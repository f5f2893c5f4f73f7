// Draws the voxels with WebGL2 by raymarch.frag: a cone for each tile of pixels, then a ray a pixel from where it ends.

const TILE = 8;
const TILES_UNIT = 4;

function compile(gl, type, source) {
  const shader = gl.createShader(type);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

/** A program of raymarch.frag for some of what it can do. */
function makeProgram(gl, defined) {
  const lines = Object.entries(defined).map(([name, value]) => `#define ${name} ${value}\n`);
  const ray = document.getElementById("shader").textContent.trim().replace("\n", `\n${lines.join("")}`);
  const corners =
    "#version 300 es\nvoid main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }";
  const program = gl.createProgram();
  gl.attachShader(program, compile(gl, gl.VERTEX_SHADER, corners));
  gl.attachShader(program, compile(gl, gl.FRAGMENT_SHADER, ray));
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

/** Hands the voxels to the graphics card: the clearance, the coarse field, the style and the other one. */
function makeTextures(gl, voxels) {
  const side = scene.styles[0].resolution + 1;
  if (side > gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)) {
    throw new Error("This device's graphics can't hold the scene; export it with a smaller --resolution.");
  }
  makeTexture(gl, 0, scene.cells, gl.R8, gl.RED, gl.NEAREST, voxels.clearance);
  makeTexture(gl, 1, scene.coarse.resolution + 1, gl.RGBA8, gl.RGBA, gl.LINEAR, voxels.coarse);
  voxels.styles.forEach((texels, i) => makeTexture(gl, 2 + i, side, gl.RGBA8, gl.RGBA, gl.LINEAR, texels));
}

/** A function that draws into a texture of a pixel for each tile, behind the others' units, and then on the canvas. */
function makeTiles(gl) {
  const framebuffer = gl.createFramebuffer();
  gl.activeTexture(gl.TEXTURE0 + TILES_UNIT);
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  let size = [0, 0];
  return (width, height, draw) => {
    const needed = [width, height].map((side) => Math.ceil(side / TILE));
    if (String(needed) !== String(size)) {
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, ...needed, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
      size = needed;
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(0, 0, ...size);
    draw(true);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    draw(false);
  };
}

/** Tells the shader what stays as it is. */
function describeScene(gl, at) {
  const { space, density } = scene;
  ["u_clearance", "u_coarse", "u_style", "u_other", "u_free"].forEach((name, unit) => gl.uniform1i(at(name), unit));
  const toTexels = ({ resolution }) => [resolution / (resolution + 1), 0.5 / (resolution + 1)];
  gl.uniform2fv(at("u_style_texels"), toTexels(scene.styles[0]));
  gl.uniform2fv(at("u_coarse_texels"), toTexels(scene.coarse));
  gl.uniform3fv(at("u_minimum"), space.minimum);
  gl.uniform3fv(at("u_maximum"), space.maximum);
  gl.uniform2fv(at("u_focal_over_half_size"), space.focal_over_half_size);
  gl.uniform2fv(at("u_depths"), space.depths);
  gl.uniform1f(at("u_all_steps"), scene.num_steps);
  gl.uniform1f(at("u_near"), space.near);
  gl.uniform1f(at("u_unit"), space.unit);
  gl.uniform1f(at("u_density_unit"), density.unit * Math.LOG2E);
  gl.uniform1f(at("u_least_density"), density.unit * Math.LOG2E * Math.expm1(density.step * density.rounding));
  gl.uniform2f(at("u_density_bits"), 255 * density.step * Math.LOG2E, -density.step * Math.LOG2E);
  gl.uniform3fv(at("u_background"), scene.background);
}

const CHANGING = ["u_num_steps", "u_pose", "u_focal", "u_center", "u_size", "u_strength", "u_density_share", "u_blend", "u_divider"];

/** What raymarch.frag has to do for a look, and for tiles, which all looks share. */
function neededFor({ strength, geometry, blend, divider }, ofTiles) {
  const styles = strength === 0 ? 0 : blend === 0 ? 1 : 2;
  const hasCoarse = divider !== null || strength * geometry < 1;
  const { kind, unbounded } = scene.space;
  const always = { SPACE: kind.toUpperCase(), UNBOUNDED: unbounded, OF_TILES: Number(ofTiles), TILE };
  return ofTiles ? { ...always, STYLES: 0, HAS_COARSE: 0 } : { ...always, STYLES: styles, HAS_COARSE: Number(hasCoarse) };
}

/** A function that chooses the program for a look, or for tiles, and returns the places of what changes. */
function makeChooser(gl) {
  const known = new Map();
  return (look, ofTiles) => {
    const defined = neededFor(look, ofTiles);
    const key = JSON.stringify(defined);
    if (known.has(key)) {
      gl.useProgram(known.get(key).program);
    } else {
      const program = makeProgram(gl, defined);
      gl.useProgram(program);
      const at = (name) => gl.getUniformLocation(program, name);
      describeScene(gl, at);
      known.set(key, { program, places: Object.fromEntries(CHANGING.map((name) => [name, at(name)])) });
    }
    return known.get(key).places;
  };
}

/** A function that draws what a camera sees, in a look, with a share of the steps, and returns the seconds it took. */
function makeRenderer(gl, voxels) {
  makeTextures(gl, voxels);
  const [choose, drawTilesFirst] = [makeChooser(gl), makeTiles(gl)];
  const pixel = new Uint8Array(4);
  return ({ pose, camera }, look, steps, width, height) => {
    const start = performance.now();
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const scale = Math.min(width / camera.width, height / camera.height); // the whole photo fits in
    drawTilesFirst(width, height, (ofTiles) => {
      const places = choose(look, ofTiles);
      gl.uniform2f(places.u_focal, scale * camera.fx, scale * camera.fy);
      gl.uniform2f(
        places.u_center,
        0.5 * width + scale * (camera.cx - 0.5 * camera.width),
        0.5 * height + scale * (camera.cy - 0.5 * camera.height),
      );
      gl.uniform2f(places.u_size, width, height);
      gl.uniformMatrix4fv(places.u_pose, false, toColumns(pose));
      gl.uniform1i(places.u_num_steps, Math.round(steps * scene.num_steps));
      gl.uniform1f(places.u_strength, look.strength);
      gl.uniform1f(places.u_density_share, look.strength * look.geometry);
      gl.uniform1f(places.u_blend, look.blend);
      gl.uniform1f(places.u_divider, look.divider === null ? -1 : look.divider * width);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    });
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

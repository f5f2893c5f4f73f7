// The voxels that the page carries, in the layout that web_page.py describes, as bytes for textures.

const MOST_CLEARANCE = 255;

/** The bytes behind a base64 text of gzip. */
async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Reads one thing after another: bits, and planes of bytes that are differences from the ones before. */
function makeReader(bytes) {
  let at = 0;
  return {
    bits(count) {
      const start = at;
      at += (count + 7) >> 3;
      return (i) => (bytes[start + (i >> 3)] >> (i & 7)) & 1;
    },
    plane(length) {
      const values = bytes.subarray(at, (at += length));
      for (let i = 1; i < length; i++) values[i] += values[i - 1]; // modulo 256
      return values;
    },
  };
}

/** Four bytes a voxel: colour and density, which comes first in the file. */
function toTexels(planes, isKnown, voxels) {
  const texels = new Uint8Array(4 * voxels);
  const [density, red, green, blue] = planes;
  for (let i = 0, n = 0; i < voxels; i++) {
    if (isKnown(i)) {
      texels[4 * i] = red[n];
      texels[4 * i + 1] = green[n];
      texels[4 * i + 2] = blue[n];
      texels[4 * i + 3] = density[n];
      n++;
    } else {
      texels[4 * i + 3] = scene.density.empty;
    }
  }
  return texels;
}

/**
 * How many cells away the nearest occupied one is, along the axis where it is farthest: a chamfer transform, forwards
 * over the neighbours that come earlier in the order of cells, then backwards over the others.
 */
function clearances(isOccupied, side) {
  const padded = side + 2; // cells beyond the border are empty
  const cells = new Uint8Array(padded ** 3).fill(MOST_CLEARANCE);
  const at = (x, y, z) => ((x + 1) * padded + y + 1) * padded + z + 1;
  const forEachCell = (action) => {
    for (let x = 0, i = 0; x < side; x++) {
      for (let y = 0; y < side; y++) for (let z = 0; z < side; z++) action(at(x, y, z), i++);
    }
  };
  forEachCell((place, i) => {
    if (isOccupied(i)) cells[place] = 0;
  });
  const earlier = [];
  for (const x of [-1, 0, 1]) for (const y of [-1, 0, 1]) for (const z of [-1, 0, 1]) earlier.push((x * padded + y) * padded + z);
  earlier.length = 13; // of the 27, those before the cell itself
  const last = at(side - 1, side - 1, side - 1) + at(0, 0, 0);
  for (const [sign, start] of [[1, 0], [-1, last]]) {
    forEachCell((forwards) => {
      const place = start + sign * forwards;
      let nearest = cells[place];
      for (const step of earlier) nearest = Math.min(nearest, cells[place + sign * step] + 1);
      cells[place] = nearest;
    });
  }
  const found = new Uint8Array(side ** 3);
  forEachCell((place, i) => (found[i] = cells[place]));
  return found;
}

/** Texels of the styles and of the coarse field, and the clearances of cells. */
function readVoxels(bytes) {
  const reader = makeReader(bytes);
  const { styles, coarse, cells } = scene;
  const [voxels, coarseVoxels] = [styles[0], coarse].map((field) => (field.resolution + 1) ** 3);
  const [isOccupied, isKnown, isCoarseKnown] = [cells ** 3, voxels, coarseVoxels].map(reader.bits);
  const planesOf = (field) => [0, 1, 2, 3].map(() => reader.plane(field.known));
  const planes = styles.map(planesOf);
  for (const [density] of planes.slice(1)) {
    planes[0][0].forEach((first, i) => (density[i] += first)); // modulo 256
  }
  return {
    styles: planes.map((each) => toTexels(each, isKnown, voxels)),
    coarse: toTexels(planesOf(coarse), isCoarseKnown, coarseVoxels),
    clearance: clearances(isOccupied, cells),
  };
}

// Where the camera is: at a photo's place, turned about the opening one, or on the flight.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const clamp = (value, [low, high]) => Math.min(Math.max(value, low), high);

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

/** The pose at a place of the flight, in poses from its beginning: between two neighbours, which hardly differ. */
function flightPose(place) {
  const first = Math.floor(place) % scene.flight.length;
  const second = (first + 1) % scene.flight.length;
  const share = place - Math.floor(place);
  return scene.flight[first].map((row, i) => row.map((value, j) => value + share * (scene.flight[second][i][j] - value)));
}

/** Pose and lens of a viewpoint: { view }, { turn } or { place }. */
function cameraOf({ view, turn, place }) {
  const { cameras, orbit } = scene;
  if (turn) return { pose: turnedPose(turn), camera: cameras[orbit.opening] };
  if (place !== undefined) return { pose: flightPose(place), camera: cameras[0] };
  return { pose: cameras[view].pose, camera: cameras[view] };
}

/** A viewpoint after a turn by degrees and a zoom; from a photo or the flight it goes on from the opening camera. */
function moved(viewpoint, yaw, pitch, zoom) {
  const { orbit } = scene;
  const now = viewpoint.turn ?? { yaw: 0, pitch: 0, distance: 1 };
  const round = orbit.yaw[1] - orbit.yaw[0] >= 360;
  const turn = {
    yaw: round ? (now.yaw + yaw) % 360 : clamp(now.yaw + yaw, orbit.yaw),
    pitch: clamp(now.pitch + pitch, orbit.pitch),
    distance: clamp(now.distance * zoom, orbit.distance),
  };
  return { turn };
}

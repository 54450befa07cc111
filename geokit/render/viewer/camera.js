// Vectors, matrices (by columns, as WebGL takes them) and the camera: a turntable around a target.

const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => times(a, 1 / (length(a) || 1));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

function product(a, b) {
  const out = new Array(16).fill(0);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

// By Gauss and Jordan, with the largest pivot.
function inverse(matrix) {
  const rows = [0, 1, 2, 3].map((r) =>
    [0, 1, 2, 3].map((c) => matrix[4 * c + r]).concat([0, 1, 2, 3].map((c) => (c === r ? 1 : 0))));
  for (let k = 0; k < 4; k++) {
    let best = k;
    for (let r = k + 1; r < 4; r++) if (Math.abs(rows[r][k]) > Math.abs(rows[best][k])) best = r;
    [rows[k], rows[best]] = [rows[best], rows[k]];
    rows[k] = rows[k].map((value) => value / rows[k][k]);
    for (let r = 0; r < 4; r++) {
      if (r !== k) rows[r] = rows[r].map((value, c) => value - rows[r][k] * rows[k][c]);
    }
  }
  const out = [];
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) out.push(rows[r][4 + c]);
  return out;
}

const apply = (m, p, w = 1) => [0, 1, 2].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r] * w);

const UP = {
  x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1], "-x": [-1, 0, 0], "-y": [0, -1, 0], "-z": [0, 0, -1],
};
// The view of geokit.render.figure.
const START = { azimuth: (28.8 * Math.PI) / 180, elevation: (17 * Math.PI) / 180, angle: (28 * Math.PI) / 180 };

class Camera {
  constructor(low, high, up) {
    Object.assign(this, { low, high, up, azimuth: START.azimuth, elevation: START.elevation, aspect: 1 });
    this.tangent = Math.tan(START.angle / 2);
    this.target = times(plus(low, high), 0.5);
    this.distance = 4;
  }

  // Unit vectors: to the side, upwards, and towards the viewer.
  get frame() {
    const axis = UP[this.up], right = this.up.endsWith("x") ? [0, 0, 1] : [1, 0, 0], front = cross(right, axis);
    const ahead = plus(times(right, Math.sin(this.azimuth)), front, Math.cos(this.azimuth));
    const towards = plus(times(ahead, Math.cos(this.elevation)), axis, Math.sin(this.elevation));
    const upwards = plus(times(axis, Math.cos(this.elevation)), ahead, -Math.sin(this.elevation));
    return { side: cross(upwards, towards), upwards, towards };
  }

  get eye() {
    return plus(this.target, this.frame.towards, this.distance);
  }

  get matrix() {
    const { side, upwards, towards } = this.frame, eye = this.eye;
    const center = times(plus(this.low, this.high), 0.5);
    const reach = length(sub(center, this.target)) + 0.51 * length(sub(this.high, this.low)) + 1e-3;
    const far = this.distance + reach, near = Math.max(this.distance - reach, 1e-3 * this.distance);
    const f = 1 / this.tangent;
    const view = [
      side[0], upwards[0], towards[0], 0, side[1], upwards[1], towards[1], 0, side[2], upwards[2], towards[2], 0,
      -dot(side, eye), -dot(upwards, eye), -dot(towards, eye), 1,
    ];
    const projection = [
      f / this.aspect, 0, 0, 0, 0, f, 0, 0,
      0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
    ];
    return product(projection, view);
  }

  // The ray through a point of the canvas: x and y from -1 to 1, to the right and upwards.
  ray(x, y) {
    const { side, upwards, towards } = this.frame;
    const ahead = plus(times(side, x * this.tangent * this.aspect), upwards, y * this.tangent);
    return { origin: this.eye, direction: unit(sub(ahead, towards)) };
  }

  turn(right, upwards) {
    this.azimuth -= right;
    this.elevation = clamp(this.elevation + upwards, -Math.PI / 2, Math.PI / 2);
  }

  // By shares of the canvas's height.
  pan(right, upwards) {
    const { side, upwards: above } = this.frame, size = 2 * this.distance * this.tangent;
    this.target = plus(plus(this.target, side, -right * size), above, -upwards * size);
  }

  zoom(factor) {
    this.distance = clamp(this.distance * factor, 1e-4, 100);
  }

  fit() {
    const { side, upwards, towards } = this.frame;
    this.target = times(plus(this.low, this.high), 0.5);
    this.distance = 1e-3;
    const tangent = 0.92 * this.tangent;
    for (let corner = 0; corner < 8; corner++) {
      const at = sub([0, 1, 2].map((k) => ((corner >> k) & 1 ? this.high : this.low)[k]), this.target);
      const wide = Math.abs(dot(side, at)) / (tangent * this.aspect), high = Math.abs(dot(upwards, at)) / tangent;
      this.distance = Math.max(this.distance, dot(towards, at) + Math.max(wide, high));
    }
  }
}

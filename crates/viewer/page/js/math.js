// Vectors [x, y, z] and unit quaternions [w, x, y, z], as plain arrays. Camera axes: x right, y down, z forward.

/** @typedef {[number, number, number]} Vec3 */
/** @typedef {[number, number, number, number]} Quat */

/** @param {readonly number[]} a @param {readonly number[]} b @returns {Vec3} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** @param {readonly number[]} a @param {readonly number[]} b @returns {Vec3} */
export const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** @param {readonly number[]} a @param {number} s @returns {Vec3} */
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
/** @param {readonly number[]} a @param {readonly number[]} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @param {readonly number[]} a */
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
/** @param {readonly number[]} a @param {readonly number[]} b @returns {Vec3} */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** @param {readonly number[]} a @returns {Vec3} */
export const normalize = (a) => scale(a, 1 / Math.max(length(a), 1e-20));
/** @param {readonly number[]} a @param {readonly number[]} b @param {number} t @returns {Vec3} */
export const mix = (a, b, t) => [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t];

/** The rotation b followed by a. @param {Quat} a @param {Quat} b @returns {Quat} */
export const multiply = ([aw, ax, ay, az], [bw, bx, by, bz]) => [
  aw * bw - ax * bx - ay * by - az * bz,
  aw * bx + ax * bw + ay * bz - az * by,
  aw * by - ax * bz + ay * bw + az * bx,
  aw * bz + ax * by - ay * bx + az * bw,
];

/** @param {Quat} q @returns {Quat} */
export const conjugate = ([w, x, y, z]) => [w, -x, -y, -z];

/** @param {Quat} q @returns {Quat} */
export const unit = (q) => {
  const n = Math.hypot(...q) || 1;
  return [q[0] / n, q[1] / n, q[2] / n, q[3] / n];
};

/** @param {readonly number[]} axis unit @param {number} angle radians @returns {Quat} */
export const turn = (axis, angle) => {
  const s = Math.sin(angle / 2);
  return [Math.cos(angle / 2), axis[0] * s, axis[1] * s, axis[2] * s];
};

/** Columns of the rotation matrix: the images of the axes. @param {Quat} q @returns {[Vec3, Vec3, Vec3]} */
export const axes = ([w, x, y, z]) => [
  [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
  [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
  [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
];

/** @param {Quat} q @param {readonly number[]} v @returns {Vec3} */
export const rotate = (q, v) => {
  const [x, y, z] = axes(q);
  return add(add(scale(x, v[0]), scale(y, v[1])), scale(z, v[2]));
};

/** The quaternion whose axes are these orthonormal columns. @param {Vec3} x @param {Vec3} y @param {Vec3} z @returns {Quat} */
export const fromAxes = (x, y, z) => {
  const trace = x[0] + y[1] + z[2];
  if (trace > 0) {
    const s = 2 * Math.sqrt(trace + 1);
    return unit([s / 4, (y[2] - z[1]) / s, (z[0] - x[2]) / s, (x[1] - y[0]) / s]);
  }
  if (x[0] > y[1] && x[0] > z[2]) {
    const s = 2 * Math.sqrt(1 + x[0] - y[1] - z[2]);
    return unit([(y[2] - z[1]) / s, s / 4, (y[0] + x[1]) / s, (z[0] + x[2]) / s]);
  }
  if (y[1] > z[2]) {
    const s = 2 * Math.sqrt(1 + y[1] - x[0] - z[2]);
    return unit([(z[0] - x[2]) / s, (y[0] + x[1]) / s, s / 4, (z[1] + y[2]) / s]);
  }
  const s = 2 * Math.sqrt(1 + z[2] - x[0] - y[1]);
  return unit([(x[1] - y[0]) / s, (z[0] + x[2]) / s, (z[1] + y[2]) / s, s / 4]);
};

/** A unit vector perpendicular to v. @param {readonly number[]} v @returns {Vec3} */
export const across = (v) => {
  const axis = Math.abs(v[0]) < 0.6 ? [1, 0, 0] : [0, 1, 0];
  return normalize(cross(v, axis));
};

/** The rotation of a camera at eye that looks at target. @param {Vec3} eye @param {Vec3} target @param {Vec3} up @returns {Quat} */
export const lookAt = (eye, target, up) => {
  const forward = normalize(subtract(target, eye));
  let right = cross(forward, up);
  right = length(right) < 1e-4 ? across(forward) : normalize(right);
  return fromAxes(right, cross(forward, right), forward);
};

/** @param {Quat} a @param {Quat} b @param {number} t @returns {Quat} */
export const slerp = (a, b, t) => {
  let cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = cosine < 0 ? -1 : 1;
  cosine *= sign;
  let [from, to] = [1 - t, t];
  if (cosine < 0.9995) {
    const angle = Math.acos(cosine);
    [from, to] = [Math.sin((1 - t) * angle) / Math.sin(angle), Math.sin(t * angle) / Math.sin(angle)];
  }
  const at = (/** @type {number} */ i) => from * a[i] + sign * to * b[i];
  return unit([at(0), at(1), at(2), at(3)]);
};

/** @param {number} value @param {number} low @param {number} high */
export const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

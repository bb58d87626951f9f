// A camera path: key frames, and the camera at any time between them. Its twin is crates/runs/src/path.rs; a test compares both.
//
// Positions and fields of view follow a Catmull-Rom spline through the keys with tangents from the times of the neighbours;
// rotations are interpolated by squad (Shoemake 1987): slerp of slerps with inner quaternions.

import { clamp, conjugate, multiply, slerp, unit } from "./math.js";
import { REST, between, placedCamera } from "./similarity.js";
import { state } from "./state.js";

/** @typedef {import("./math.js").Vec3} Vec3 */
/** @typedef {import("./math.js").Quat} Quat */
/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {{ time: number, position: Vec3, rotation: Quat, fov: number }} Key */

/** Initial time between key frames, seconds. */
export const KEY_INTERVAL = 2;
/** Time between key frames below which they cannot be moved, seconds. */
const MIN_INTERVAL = 0.1;

/** Logarithm of a unit quaternion: axis times half the angle. @param {Quat} q @returns {Vec3} */
function log([w, x, y, z]) {
  const sine = Math.hypot(x, y, z);
  if (sine < 1e-9) return [0, 0, 0];
  const factor = Math.atan2(sine, w) / sine;
  return [x * factor, y * factor, z * factor];
}

/** @param {readonly number[]} v @returns {Quat} */
function exp(v) {
  const angle = Math.hypot(v[0], v[1], v[2]);
  const factor = angle < 1e-9 ? 1 : Math.sin(angle) / angle;
  return [Math.cos(angle), v[0] * factor, v[1] * factor, v[2] * factor];
}

/** @param {Quat} a @param {Quat} b the same rotation as b, on the side of a @returns {Quat} */
const near = (a, b) => (a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0 ? [-b[0], -b[1], -b[2], -b[3]] : b);

/** From the coordinates of the photographs, in which paths are saved, to the world: a path fits the scene however it has been moved. */
const worldFromPhotographs = () => state.get("scene")?.world_from_photographs ?? REST;

/** @param {number} t eased in and out: the smooth step of degree 3 */
const eased = (t) => t * t * (3 - 2 * t);

/** Why a saved path cannot be read; null if it can. @param {any} saved @returns {string | null} */
function faultOf(saved) {
  const within = (/** @type {any} */ value, /** @type {number} */ low, /** @type {number} */ high) => Number.isFinite(value) && value >= low && value <= high;
  const numbers = (/** @type {any} */ values, /** @type {number} */ count) => Array.isArray(values) && values.length === count && values.every(Number.isFinite);
  const isPlaced = (/** @type {any} */ key) => numbers(key?.position, 3) && numbers(key?.rotation, 4) && key.rotation.some(Boolean);
  if (saved?.irradia_path !== 1) return "it is not one that this page saved";
  const { keys, fps, loop, ease, closing } = saved;
  if (!Array.isArray(keys) || keys.length === 0 || !keys.every(isPlaced)) return "there are no key frames, or one has no valid pose";
  if (!keys.every(({ fov }) => within(fov, 1e-6, Math.PI - 1e-6))) return "a field of view is not between 0 and pi";
  if (keys[0].time !== 0 || !keys.every(({ time }, i) => within(time, keys[Math.max(i - 1, 0)].time, 1e6))) return "the times of key frames do not begin at 0, or decrease";
  if (!within(fps, 0.1, 240) || !within(closing, 0, 1e6)) return "frames per second are not 0.1 to 240, or closing is not 0 to 1,000,000 seconds";
  if (typeof loop !== "boolean" || typeof ease !== "boolean") return "loop or ease is neither true nor false";
  return null;
}

class Path extends EventTarget {
  /** @type {Key[]} in order of time, from 0 */
  keys = [];
  loop = false;
  ease = true;
  fps = 30;
  shown = false;
  /** Time of a loop from its last key back to its first, seconds. */
  closing = 2;

  /** Length in seconds. */
  get seconds() {
    const last = this.keys[this.keys.length - 1]?.time ?? 0;
    return last + (this.loop && this.keys.length > 1 ? this.closing : 0);
  }

  /** Adds a camera as the last key frame. @param {Camera} camera */
  add({ position, rotation, fov }) {
    const last = this.keys[this.keys.length - 1];
    this.keys.push({ time: last ? last.time + KEY_INTERVAL : 0, position, rotation, fov });
    this.changed();
  }

  /** Moves a key frame in time, between its neighbours; the first one stays at 0. @param {number} index @param {number} seconds */
  move(index, seconds) {
    if (index === 0) return;
    const [low, high] = [this.keys[index - 1].time + MIN_INTERVAL, (this.keys[index + 1]?.time ?? Infinity) - MIN_INTERVAL];
    if (low > high) return;
    this.keys[index].time = clamp(Math.round(100 * seconds) / 100, low, high);
    this.changed();
  }

  /** Removes a key frame; the path begins with the first of the others. @param {number} index */
  remove(index) {
    this.keys.splice(index, 1);
    const first = this.keys[0]?.time ?? 0;
    for (const key of this.keys) key.time -= first;
    this.changed();
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }

  /** The camera at a time. @param {number} seconds @returns {Camera} */
  at(seconds) {
    const keys = this.keys;
    const n = keys.length;
    if (n === 1) return { position: keys[0].position, rotation: keys[0].rotation, fov: keys[0].fov };
    const total = this.seconds;
    const along = clamp(seconds, 0, total) / Math.max(total, 1e-9);
    const time = (this.ease && !this.loop ? eased(along) : along) * total;
    let i = 0;
    while (i + 1 < n && keys[i + 1].time <= time) i += 1;
    if (!this.loop) i = Math.min(i, n - 2);
    // Key j with its time; beyond the ends it continues around the loop, or repeats the end.
    const key = (/** @type {number} */ j) => {
      if (!this.loop) {
        const kept = clamp(j, 0, n - 1);
        return { ...keys[kept], time: keys[kept].time };
      }
      const rounds = Math.floor(j / n);
      return { ...keys[j - rounds * n], time: keys[j - rounds * n].time + rounds * total };
    };
    const [k0, k1, k2, k3] = [key(i - 1), key(i), key(i + 1), key(i + 2)];
    const span = Math.max(k2.time - k1.time, 1e-9);
    const t = clamp((time - k1.time) / span, 0, 1);
    const spline = (/** @type {number} */ p0, /** @type {number} */ p1, /** @type {number} */ p2, /** @type {number} */ p3) => {
      const m1 = (span * (p2 - p0)) / Math.max(k2.time - k0.time, 1e-9);
      const m2 = (span * (p3 - p1)) / Math.max(k3.time - k1.time, 1e-9);
      const [t2, t3] = [t * t, t * t * t];
      return (2 * t3 - 3 * t2 + 1) * p1 + (t3 - 2 * t2 + t) * m1 + (3 * t2 - 2 * t3) * p2 + (t3 - t2) * m2;
    };
    const position = /** @type {Vec3} */ ([0, 1, 2].map((c) => spline(k0.position[c], k1.position[c], k2.position[c], k3.position[c])));
    const q1 = unit(k1.rotation);
    const q0 = near(q1, unit(k0.rotation));
    const q2 = near(q1, unit(k2.rotation));
    const q3 = near(q2, unit(k3.rotation));
    const inner = (/** @type {Quat} */ before, /** @type {Quat} */ q, /** @type {Quat} */ after) => {
      const inverse = conjugate(q);
      const [a, b] = [log(multiply(inverse, near(q, after))), log(multiply(inverse, near(q, before)))];
      return multiply(q, exp([-(a[0] + b[0]) / 4, -(a[1] + b[1]) / 4, -(a[2] + b[2]) / 4]));
    };
    const rotation = slerp(slerp(q1, q2, t), slerp(inner(q0, q1, q2), inner(q1, q2, q3), t), 2 * t * (1 - t));
    // A spline that overshoots could turn pictures upside down.
    const fov = clamp(spline(k0.fov, k1.fov, k2.fov, k3.fov), Math.min(k1.fov, k2.fov), Math.max(k1.fov, k2.fov));
    return { position, rotation, fov };
  }

  /** The format that is saved, and read by irradia render --path. */
  toJSON() {
    const photographsFromWorld = between(worldFromPhotographs(), REST);
    const keys = this.keys.map((key) => placedCamera(photographsFromWorld, key));
    return { irradia_path: 1, fps: this.fps, loop: this.loop, ease: this.ease, closing: this.closing, keys };
  }

  /** Reads what toJSON wrote. @param {any} saved */
  read(saved) {
    const fault = faultOf(saved);
    if (fault) throw new Error(`This camera path cannot be opened: ${fault}`);
    const world = worldFromPhotographs();
    this.keys = saved.keys.map((/** @type {Key} */ { time, position, rotation, fov }) => placedCamera(world, { time, position, rotation, fov }));
    [this.fps, this.loop, this.ease, this.closing] = [saved.fps, saved.loop, saved.ease, saved.closing];
    this.changed();
  }
}

export const path = new Path();

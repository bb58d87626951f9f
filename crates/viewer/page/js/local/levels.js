// Levels of detail, stored after the scene in the painters' arrays, and the choice of the one drawn while the camera moves: the twin of
// crates/viewer/src/levels.rs.

import { axes, dot, subtract } from "../math.js";

/** @typedef {import("../camera.js").Camera} Camera */
/** @typedef {import("../camera.js").Intrinsics} Intrinsics */

/** Minimum number of splats of a level per covered pixel. */
const MIN_SPLATS_PER_PIXEL = 2;
/** Number of positions used to estimate what a camera sees. */
const SAMPLE_SIZE = 4096;
/** Share of the splats in view that is left out on either side when the covered area is measured. */
const TRIMMED_FRACTION = 0.05;
/** Alignment of levels, splats: a row of WebGL2's textures. */
const ALIGNMENT = 1024;

export class Levels {
  /** Splats that have arrived, of the scene and of each level. @type {number[]} */
  loaded = [];
  /** Positions of the coarsest level, and how many splats each stands for. @type {number[][]} */
  sample = [];
  step = 1;

  /** @param {number[]} counts splats of the scene, then of its levels, the finest first */
  constructor(counts) {
    this.counts = counts;
    this.loaded = counts.map(() => 0);
    this.step = Math.max(1, Math.ceil(counts[counts.length - 1] / SAMPLE_SIZE));
    /** First splat of the scene and of each level. @type {number[]} */
    this.starts = [];
    /** Room for all of them, splats. */
    this.room = 0;
    for (const count of counts) {
      this.starts.push(this.room);
      this.room += ALIGNMENT * Math.ceil(count / ALIGNMENT);
    }
  }

  /** @param {import("./stream.js").Block} block */
  take({ level, first, count, cores }) {
    this.loaded[level] = first + count;
    if (level === 0 || level < this.counts.length - 1) return;
    const words = new Float32Array(cores.buffer);
    for (let i = 0; i < count; i += 1) if ((first + i) % this.step === 0) this.sample.push([...words.subarray(8 * i, 8 * i + 3)]);
  }

  /** The level for a moving camera, the coarsest that is dense; 0 is the scene itself. @param {Camera} camera @param {Intrinsics} k @param {number} near */
  choose(camera, k, near) {
    const coarsest = this.counts.length - 1;
    if (coarsest === 0 || this.loaded[coarsest] < this.counts[coarsest]) return 0;
    const seen = this.splatsAPixel(camera, k, near) / this.counts[coarsest];
    let level = 0;
    while (level < coarsest && seen * this.counts[level + 1] >= MIN_SPLATS_PER_PIXEL) level += 1;
    return level;
  }

  /** Splats of the coarsest level in view per pixel of the box that contains most of them.
   * @param {Camera} camera @param {Intrinsics} k @param {number} near */
  splatsAPixel({ position, rotation }, k, near) {
    const [right, down, forward] = axes(rotation);
    const [xs, ys] = [/** @type {number[]} */ ([]), /** @type {number[]} */ ([])];
    for (const mean of this.sample) {
      const offset = subtract(mean, position);
      const z = dot(forward, offset);
      if (z <= near) continue;
      const [x, y] = [(k.fx * dot(right, offset)) / z + k.cx, (k.fy * dot(down, offset)) / z + k.cy];
      if (x < 0 || y < 0 || x >= k.width || y >= k.height) continue;
      xs.push(x);
      ys.push(y);
    }
    return (xs.length * this.step) / (extent(xs) * extent(ys));
  }
}

/** @param {number[]} values pixels */
function extent(values) {
  const sorted = Float64Array.from(values).sort();
  const at = (/** @type {number} */ share) => sorted[Math.floor(sorted.length * share)] ?? 0;
  return Math.max(1, at(1 - TRIMMED_FRACTION) - at(TRIMMED_FRACTION));
}

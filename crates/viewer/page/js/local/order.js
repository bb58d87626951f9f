// A worker that keeps the splats' positions and sorts those in view by depth, farthest first.
//
// One counting pass over 16 bits of depth. The keys are the top bits of the depth's floating-point pattern, from the nearest to
// the farthest splat: evenly spaced in the logarithm, thousands of them between a depth and its double.

/** @typedef {{ count: number, positions: Float32Array, radii: Float32Array, first: number }} Block */
/** first, end: the range of splats to sort; all if absent.
 * @typedef {{ forward: number[], right: number[], down: number[], position: number[], limits: number[], near: number, first?: number, end?: number }} Look */

const KEYS = 1 << 16;

let positions = new Float32Array(0);
/** Three standard deviations along the largest axis. */
let radii = new Float32Array(0);
let count = 0;
let depths = new Float32Array(0);
let bits = new Uint32Array(0);
let inView = new Uint32Array(0);
const places = new Uint32Array(KEYS + 1);

/** @param {number} size */
function reserve(size) {
  positions = new Float32Array(3 * size);
  radii = new Float32Array(size);
  depths = new Float32Array(size);
  bits = new Uint32Array(depths.buffer);
  inView = new Uint32Array(size);
  count = 0;
}

/** The most by which the projection stretches a splat away from the axis, between two tangents and the margin to which it clamps them
 * (project.frag). @param {number} least @param {number} most */
const stretch = (least, most) => Math.hypot(1, Math.max(-least, most) + 0.15 * (most - least));

/** Indices of the splats in view, farthest first. @param {Look} look @returns {Uint32Array} */
export function order({ forward: [fx, fy, fz], right: [rx, ry, rz], down: [dx, dy, dz], position: [px, py, pz], limits, near, first = 0, end = count }) {
  const [left, most, top, bottom] = limits;
  const [wide, high] = [stretch(left, most), stretch(top, bottom)];
  let n = 0;
  let least = 0xffffffff;
  let largest = 0;
  for (let i = first, at = 3 * first; i < end; i += 1, at += 3) {
    const x = positions[at] - px;
    const y = positions[at + 1] - py;
    const z = positions[at + 2] - pz;
    const depth = fx * x + fy * y + fz * z;
    if (depth <= near) continue;
    const across = rx * x + ry * y + rz * z;
    const aside = wide * radii[i];
    if (across < left * depth - aside || across > most * depth + aside) continue;
    const along = dx * x + dy * y + dz * z;
    const above = high * radii[i];
    if (along < top * depth - above || along > bottom * depth + above) continue;
    depths[n] = depth;
    inView[n] = i;
    const key = bits[n];
    if (key < least) least = key;
    if (key > largest) largest = key;
    n += 1;
  }
  const sorted = new Uint32Array(n);
  if (n === 0) return sorted;
  const scale = (KEYS - 1) / Math.max(largest - least, 1);
  places.fill(0);
  for (let i = 0; i < n; i += 1) {
    // Farthest first: the largest pattern gets key 0.
    const key = ((largest - bits[i]) * scale) | 0;
    bits[i] = key;
    places[key + 1] += 1;
  }
  for (let key = 1; key < KEYS; key += 1) places[key] += places[key - 1];
  for (let i = 0; i < n; i += 1) sorted[places[bits[i]]++] = inView[i];
  return sorted;
}

/** @param {Block} block */
export function take(block) {
  positions.set(block.positions, 3 * block.first);
  radii.set(block.radii, block.first);
  count = Math.max(count, block.first + block.count);
}

if (typeof document === "undefined" && "onmessage" in globalThis) {
  self.onmessage = ({ data }) => {
    if (data.reserve !== undefined) reserve(data.reserve);
    else if (data.block) take(data.block);
    else if (data.look) {
      const started = performance.now();
      const sorted = order(data.look);
      const milliseconds = performance.now() - started;
      /** @type {any} */ (self).postMessage({ sorted, shown: { first: data.look.first, end: data.look.end }, milliseconds, of: count, generation: data.generation }, [sorted.buffer]);
    }
  };
}

export { reserve };

// Similarities between coordinate systems, for scenes that are moved as a whole and everything in them.

import { add, conjugate, length, multiply, rotate, scale, subtract, unit } from "./math.js";

/** @typedef {import("./math.js").Vec3} Vec3 */
/** @typedef {import("./math.js").Quat} Quat */
/** `x -> scale rotation x + translation` @typedef {{ scale: number, rotation: Quat, translation: Vec3 }} Similarity */

/** @type {Similarity} */
export const REST = { scale: 1, rotation: [1, 0, 0, 0], translation: [0, 0, 0] };

/** @param {Similarity} by @param {readonly number[]} point @returns {Vec3} */
export const placed = (by, point) => add(scale(rotate(by.rotation, point), by.scale), by.translation);

/** A camera, a view or a key frame, moved. @template {{ position: Vec3, rotation: Quat }} T @param {Similarity} by @param {T} camera @returns {T} */
export const placedCamera = (by, camera) => ({ ...camera, position: placed(by, camera.position), rotation: unit(multiply(by.rotation, camera.rotation)) });

/** The inverse of `from`, then `to`. @param {Similarity} from @param {Similarity} to @returns {Similarity} */
export function between(from, to) {
  const rotation = unit(multiply(to.rotation, conjugate(from.rotation)));
  const factor = to.scale / from.scale;
  return { scale: factor, rotation, translation: subtract(to.translation, scale(rotate(rotation, from.translation), factor)) };
}

/** @param {Similarity} by */
export const isRest = ({ scale: factor, rotation, translation }) =>
  Math.abs(factor - 1) < 1e-9 && Math.abs(Math.abs(rotation[0]) - 1) < 1e-12 && length(translation) < 1e-9;

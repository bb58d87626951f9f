// Lengths of the world in metres, or in units of the dataset if the scale is unknown. Only this file converts them: the server keeps the
// metres per unit of the scene as it was opened, and edits may have scaled the whole scene since.

import { state } from "./state.js";

/** @typedef {import("./math.js").Vec3} Vec3 */

/** From the dataset's coordinates to the scene's, which are centred and scaled. @returns {{ scale: number, center: Vec3 }} */
export const world = () => state.get("scene")?.world ?? { scale: 1, center: [0, 0, 0] };

/** The factor by which edits have scaled the whole scene. */
const editScale = () => state.get("scene")?.placement.scale ?? 1;

/** Metres per world unit; null if the scale is unknown. */
export function metresPerUnit() {
  const metres = state.get("metres");
  return metres === null ? null : metres / editScale();
}

/** The value of `metres` in the state at which a length is `metres`. @param {number} units of the world @param {number} metres */
export const openedMetres = (units, metres) => (metres / units) * editScale();

/** A distance in metres, or in units of the dataset. @param {number} units of the world */
export function distanceText(units) {
  const metres = metresPerUnit();
  if (metres === null) return `${(units / world().scale).toPrecision(4)} units`;
  const value = units * metres;
  return value < 1 ? `${(100 * value).toPrecision(4)} cm` : `${value.toPrecision(4)} m`;
}

// The camera in the page's address: everything after the # sign.

import { MODES } from "./commands.js";
import { unit } from "./math.js";
import { state } from "./state.js";

/** @typedef {import("./camera.js").Camera} Camera */

const compact = (/** @type {readonly number[]} */ values) => values.map((value) => Number(value.toPrecision(7))).join(",");

/** The address of the current view. With a token in it, it gives access to whoever receives it. */
export function shareAddress() {
  const { position, rotation, fov } = state.get("camera");
  const parts = [`p=${compact(position)}`, `q=${compact(rotation)}`, `f=${compact([fov])}`, `o=${compact(state.get("pivot"))}`];
  if (state.get("mode") !== "color") parts.push(`m=${state.get("mode")}`);
  if (state.get("view") !== null) parts.push(`v=${state.get("view")}`);
  return `${location.origin}${location.pathname}${location.search}#${parts.join("&")}`;
}

/** The values in the address, as far as they can be read. @returns {Partial<import("./state.js").Values> | null} */
export function sharedValues() {
  const given = new URLSearchParams(location.hash.slice(1));
  const numbers = (/** @type {string} */ name, /** @type {number} */ count) => {
    const values = (given.get(name) || "none").split(",").map(Number);
    return values.length === count && values.every(Number.isFinite) ? values : null;
  };
  const [position, rotation, fov] = [numbers("p", 3), numbers("q", 4), numbers("f", 1)];
  if (!position || !rotation || !fov || fov[0] <= 0.01 || fov[0] >= 3) return null;
  const camera = /** @type {Camera} */ ({ position, rotation: unit(/** @type {any} */ (rotation)), fov: fov[0] });
  const pivot = /** @type {any} */ (numbers("o", 3));
  // The server draws no other modes, and the scene may have lost the view.
  const mode = MODES.find(([name]) => name === given.get("m"))?.[0] ?? "color";
  const [view] = numbers("v", 1) ?? [];
  return { camera, ...(pivot && { pivot }), mode, view: view !== undefined && view in state.get("views") ? view : null };
}

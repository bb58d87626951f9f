// An edit may move the whole scene; the cameras of views and of this page then follow.

import { add, length, multiply, rotate, scale, subtract, unit } from "../math.js";
import { path } from "../path.js";
import { state } from "../state.js";

/** @typedef {import("../math.js").Vec3} Vec3 */
/** @typedef {import("../math.js").Quat} Quat */
/** `x -> scale rotation x + translation`, from the world of the scene as it was opened.
 * @typedef {{ scale: number, rotation: Quat, translation: Vec3 }} Placement */

/** @type {Placement} */
const NONE = { scale: 1, rotation: [1, 0, 0, 0], translation: [0, 0, 0] };

/** @param {Placement} by @param {readonly number[]} point @returns {Vec3} */
const placed = (by, point) => add(scale(rotate(by.rotation, point), by.scale), by.translation);

/** The inverse of `from`, then `to`. @param {Placement} from @param {Placement} to @returns {Placement} */
function between(from, to) {
  const [w, x, y, z] = from.rotation;
  const rotation = unit(multiply(to.rotation, [w, -x, -y, -z]));
  const factor = to.scale / from.scale;
  return { scale: factor, rotation, translation: subtract(to.translation, scale(rotate(rotation, from.translation), factor)) };
}

/** @param {Placement} by */
const isRest = ({ scale: factor, rotation, translation }) =>
  Math.abs(factor - 1) < 1e-9 && Math.abs(Math.abs(rotation[0]) - 1) < 1e-12 && length(translation) < 1e-9;

let at = NONE;
/** Whether a scene has been received. */
let seen = false;
/** @type {import("../camera.js").View[] | null} */
let original = null;

state.addEventListener("hello", () => {
  original = state.get("hello").views;
  placeViews();
});
state.addEventListener("scene", () => {
  const to = state.get("scene")?.placement ?? NONE;
  const by = between(at, to);
  const isFirst = !seen;
  [at, seen] = [to, true];
  if (isRest(by)) return;
  placeViews();
  // A page opened after the scene was moved has no camera to keep yet.
  if (!isFirst) follow(by);
});

function placeViews() {
  if (!original || (isRest(at) && state.get("views") === original)) return;
  state.set({ views: original.map((view) => ({ ...view, position: placed(at, view.position), rotation: unit(multiply(at.rotation, view.rotation)) })) });
}

/** Moves the camera with the scene, so that the picture stays the same. @param {Placement} by */
function follow(by) {
  const { camera, pivot, up, measured, metres, region, view } = state.values;
  state.set({
    camera: { ...camera, position: placed(by, camera.position), rotation: unit(multiply(by.rotation, camera.rotation)) },
    pivot: placed(by, pivot),
    up: rotate(by.rotation, up),
    measured: measured.map((point) => placed(by, point)),
    metres: metres && metres / by.scale,
    region: region && { ...region, center: placed(by, region.center), half: scale(region.half, by.scale), rotation: unit(multiply(by.rotation, region.rotation)) },
    clip: null,
    view,
  });
  const key = (/** @type {import("../path.js").Key} */ k) => ({ ...k, position: placed(by, k.position), rotation: unit(multiply(by.rotation, k.rotation)) });
  path.keys = path.keys.map(key);
  path.changed();
}

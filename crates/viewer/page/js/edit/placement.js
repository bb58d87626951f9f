// An edit may move the whole scene; the cameras of views and of this page then follow.

import { multiply, rotate, scale, unit } from "../math.js";
import { path } from "../path.js";
import { REST, between, isRest, placed, placedCamera } from "../similarity.js";
import { state } from "../state.js";

/** @typedef {import("../similarity.js").Similarity} Similarity */

/** From the world of the scene as it was opened. */
let at = REST;
/** Whether a scene has been received. */
let seen = false;
/** @type {import("../camera.js").View[] | null} */
let original = null;

state.addEventListener("hello", () => {
  original = state.get("hello").views;
  placeViews();
});
state.addEventListener("scene", () => {
  const to = state.get("scene")?.placement ?? REST;
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
  state.set({ views: original.map((view) => placedCamera(at, view)) });
}

/** Moves the camera with the scene, so that the picture stays the same. @param {Similarity} by */
function follow(by) {
  const { camera, pivot, up, measured, region, view } = state.values;
  state.set({
    camera: placedCamera(by, camera),
    pivot: placed(by, pivot),
    up: rotate(by.rotation, up),
    measured: measured.map((point) => placed(by, point)),
    region: region && { ...region, center: placed(by, region.center), half: scale(region.half, by.scale), rotation: unit(multiply(by.rotation, region.rotation)) },
    clip: null,
    view,
  });
  path.keys = path.keys.map((key) => placedCamera(by, key));
  path.changed();
}

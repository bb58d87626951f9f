// Lines over the picture: cameras, axes, pivot, clipping box, measured distance, path.

import { project, toCamera } from "./camera.js";
import { add, axes, cross, length, scale, subtract } from "./math.js";
import { pictureOf } from "./connection.js";
import { path } from "./path.js";
import { state } from "./state.js";
import { distanceText } from "./units.js";

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./camera.js").Intrinsics} Intrinsics */
/** @typedef {import("./math.js").Vec3} Vec3 */

export const AXIS_COLORS = ["#e5736f", "#6cc08b", "#6ea8fe"];
/** Pairs of corners of a box: around its lower face, around its upper one, between them. */
export const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];

/** Size of a drawn camera, as a share of the scene's radius. */
const FRUSTUM_SIZE = 0.09;
/** Depth at which lines are cut off, as a share of the scene's radius. */
const NEAR_DEPTH = 0.01;

/** @param {CanvasRenderingContext2D} context in the picture's pixels @param {Camera} camera @param {Intrinsics} k
 * @param {number} pixel the picture's pixels per CSS pixel */
export function drawOverlay(context, camera, k, pixel) {
  const scene = state.get("scene");
  const size = scene?.radius ?? 1;
  const draw = { context, camera, k, near: NEAR_DEPTH * size };
  context.lineWidth = pixel;
  const inside = state.get("view");
  for (const { view, index } of seenFrusta(camera)) {
    drawFrustum(draw, view, FRUSTUM_SIZE * size, colorOf(view.trained, state.get("scores").get(index)), view.photo ? thumbnails.get(index) : null);
  }
  if (state.get("axes") && inside === null && !(state.get("tab") === "edit" && state.get("editing")?.selected)) {
    const pivot = state.get("pivot");
    const reach = 0.06 * length(subtract(pivot, camera.position));
    for (const [i, color] of AXIS_COLORS.entries()) {
      const tip = /** @type {Vec3} */ ([0, 1, 2].map((c) => pivot[c] + (c === i ? reach : 0)));
      context.strokeStyle = color;
      line(draw, pivot, tip);
    }
  }
  const clip = state.get("clip");
  if (clip) {
    const [low, high] = clip;
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => {
      const x = i % 4 === 1 || i % 4 === 2;
      return /** @type {Vec3} */ ([x ? high[0] : low[0], i % 4 >= 2 ? high[1] : low[1], i >= 4 ? high[2] : low[2]]);
    });
    context.strokeStyle = "#e0b155";
    for (const [a, b] of EDGES) line(draw, corners[a], corners[b]);
  }
  drawMeasured(draw, pixel);
  drawPath(draw, pixel);
}

/** Cameras that are drawn: not those near the current one, which would only cover the picture; none while comparing with a photograph.
 * @param {Camera} camera */
function seenFrusta(camera) {
  if (!state.get("frusta") || state.comparison !== "none") return [];
  const near = 1.5 * FRUSTUM_SIZE * (state.get("scene")?.radius ?? 1);
  const all = state.get("views").map((view, index) => ({ view, index, apart: length(subtract(view.position, camera.position)) }));
  return all.filter(({ apart }) => apart > near).sort((a, b) => b.apart - a.apart);
}

/** The camera drawn nearest to a point of the picture, within a few pixels of it.
 * @param {Camera} camera @param {Intrinsics} k @param {number} x @param {number} y @param {number} within @returns {number | null} */
export function frustumAt(camera, k, x, y, within) {
  const size = FRUSTUM_SIZE * (state.get("scene")?.radius ?? 1);
  let best = null;
  for (const { view, index } of seenFrusta(camera)) {
    const middle = add(view.position, scale(axes(view.rotation)[2], 0.7 * size));
    const at = project(camera, k, middle);
    if (at && Math.hypot(at[0] - x, at[1] - y) < Math.max(within, (0.3 * size * k.fx) / at[2])) best = index;
  }
  return best;
}

/** Small photographs, loaded when they are first drawn. */
class Thumbnails extends EventTarget {
  /** @type {Map<number, HTMLImageElement>} */
  images = new Map();

  /** @param {number} index */
  get(index) {
    let image = this.images.get(index);
    if (!image) {
      image = new Image();
      image.onload = () => this.dispatchEvent(new Event("load"));
      image.src = pictureOf(index, "thumbnail");
      this.images.set(index, image);
    }
    return image.complete && image.naturalWidth ? image : null;
  }
}

export const thumbnails = new Thumbnails();

/** @typedef {{ context: CanvasRenderingContext2D, camera: Camera, k: Intrinsics, near: number }} Draw */

/** @param {boolean} trained @param {number | null | undefined} psnr */
function colorOf(trained, psnr) {
  if (typeof psnr === "number") return `hsl(${Math.round(Math.min(Math.max((psnr - 15) / 17, 0), 1) * 130)} 70% 60%)`;
  return trained ? "#ffffffb0" : "#e0b155d0";
}

/** @param {Draw} draw @param {Vec3} a @param {Vec3} b */
export function line({ context, camera, k, near }, a, b) {
  let [from, to] = [toCamera(camera, a), toCamera(camera, b)];
  if (from[2] < near && to[2] < near) return;
  if (from[2] < near) [from, to] = [to, from];
  if (to[2] < near) to = add(from, scale(subtract(to, from), (from[2] - near) / (from[2] - to[2])));
  context.beginPath();
  context.moveTo((k.fx * from[0]) / from[2] + k.cx, (k.fy * from[1]) / from[2] + k.cy);
  context.lineTo((k.fx * to[0]) / to[2] + k.cx, (k.fy * to[1]) / to[2] + k.cy);
  context.stroke();
}

/** @param {Draw} draw @param {import("./camera.js").View} view @param {number} size @param {string} color
 * @param {HTMLImageElement | null} image */
function drawFrustum(draw, view, size, color, image) {
  const [right, down, ahead] = axes(view.rotation);
  const corner = (/** @type {number} */ x, /** @type {number} */ y) => {
    const offset = add(scale(right, (x - view.cx) / view.fx), scale(down, (y - view.cy) / view.fy));
    return add(view.position, scale(add(offset, ahead), size));
  };
  const corners = [corner(0, 0), corner(view.width, 0), corner(view.width, view.height), corner(0, view.height)];
  const [a, b, , d] = corners.map((corner) => project(draw.camera, draw.k, corner));
  if (image && a && b && d) {
    // Three corners define an affine map; perspective moves the fourth, but little over a small picture.
    const [w, h] = [image.naturalWidth, image.naturalHeight];
    draw.context.save();
    draw.context.globalAlpha = 0.9;
    draw.context.transform((b[0] - a[0]) / w, (b[1] - a[1]) / w, (d[0] - a[0]) / h, (d[1] - a[1]) / h, a[0], a[1]);
    draw.context.drawImage(image, 0, 0);
    draw.context.restore();
  }
  draw.context.strokeStyle = color;
  for (const [i, from] of corners.entries()) {
    line(draw, view.position, from);
    line(draw, from, corners[(i + 1) % 4]);
  }
  // A tick at the top tells which way is up.
  const top = scale(add(corners[0], corners[1]), 0.5);
  line(draw, top, subtract(top, scale(cross(ahead, right), 0.12 * size)));
}

/** @param {Draw} draw @param {number} pixel */
function drawMeasured(draw, pixel) {
  const points = state.get("measured");
  const { context } = draw;
  context.strokeStyle = context.fillStyle = "#ffd866";
  if (points.length === 2) line(draw, points[0], points[1]);
  for (const point of points) {
    const at = project(draw.camera, draw.k, point);
    if (!at) continue;
    context.beginPath();
    context.arc(at[0], at[1], 4 * pixel, 0, 7);
    context.fill();
  }
  if (points.length < 2) return;
  const at = project(draw.camera, draw.k, scale(add(points[0], points[1]), 0.5));
  if (!at) return;
  context.font = `600 ${12 * pixel}px system-ui`;
  context.textAlign = "center";
  context.shadowColor = "#000";
  context.shadowBlur = 4 * pixel;
  context.fillText(distanceText(length(subtract(points[0], points[1]))), at[0], at[1] - 8 * pixel);
  context.shadowBlur = 0;
}

/** @param {Draw} draw @param {number} pixel */
function drawPath(draw, pixel) {
  if (!path.shown || path.keys.length === 0) return;
  draw.context.strokeStyle = "#6ea8fe";
  const count = Math.min(240, 24 * path.keys.length);
  let before = path.at(0).position;
  for (let i = 1; i <= count; i += 1) {
    const next = path.at((i / count) * path.seconds).position;
    line(draw, before, next);
    before = next;
  }
  for (const key of path.keys) {
    const at = project(draw.camera, draw.k, key.position);
    if (at) draw.context.strokeRect(at[0] - 3 * pixel, at[1] - 3 * pixel, 6 * pixel, 6 * pixel);
  }
}

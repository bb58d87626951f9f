// Shapes of selections as crate `edit` names them, in the coordinates of the page: the server converts them to the dataset's.

import { cross, normalize, rotate } from "../math.js";

/** @typedef {import("../camera.js").Camera} Camera */
/** @typedef {import("../camera.js").Intrinsics} Intrinsics */
/** @typedef {import("../math.js").Vec3} Vec3 */
/** @typedef {import("../math.js").Quat} Quat */
/** Pixels of a picture. @typedef {[number, number]} Point */
/** A region in the scene. @typedef {{ kind: "box" | "sphere", center: Vec3, half: Vec3, rotation: Quat }} Region */

/** Maximum number of points of a line: longer lines are thinned, since each point is compared with every splat. */
const MAX_POINTS = 400;

/** @param {Camera} camera @param {Intrinsics} k */
const viewpoint = (camera, k) => ({
  position: camera.position, rotation: camera.rotation, focal: [k.fx, k.fy], principal: [k.cx, k.cy], size: [k.width, k.height],
});

/** Thins a line, and rounds it to tenths of a pixel, which is finer than any hand. @param {Point[]} points */
function thinned(points) {
  const every = Math.ceil(points.length / MAX_POINTS);
  const kept = every > 1 ? points.filter((_, i) => i % every === 0 || i === points.length - 1) : points;
  return kept.map(([x, y]) => [Math.round(10 * x) / 10, Math.round(10 * y) / 10]);
}

/** @param {Camera} camera @param {Intrinsics} k @param {Point[]} points @param {boolean} visible only what the picture shows */
export const polygon = (camera, k, points, visible) =>
  ({ shape: "polygon", camera: viewpoint(camera, k), points: thinned(points), visible });

/** @param {Camera} camera @param {Intrinsics} k @param {Point[]} points @param {number} radius pixels @param {boolean} visible */
export const brush = (camera, k, points, radius, visible) =>
  ({ shape: "brush", camera: viewpoint(camera, k), points: thinned(points), radius, visible });

/** @param {Region} region */
export function region({ kind, center, half, rotation }) {
  if (kind === "sphere") return ball(center, half[0]);
  return { shape: "box", center, size: half.map((v) => 2 * v), rotation };
}

/** @param {Vec3} center @param {number} radius */
export const ball = (center, radius) => ({ shape: "sphere", center, radius });

/** Everything beyond a plane, on the side to which `normal` points. @param {Vec3} point @param {Vec3} normal */
export const halfSpace = (point, normal) => ({ shape: "half-space", point, normal });

/** Everything on the left of a line in the picture, drawn from `a` to `b`.
 * @param {Camera} camera @param {Intrinsics} k @param {Point} a @param {Point} b */
export function beside(camera, k, a, b) {
  const [from, to] = [a, b].map(([x, y]) => /** @type {Vec3} */ ([(x - k.cx) / k.fx, (y - k.cy) / k.fy, 1]));
  return halfSpace(camera.position, normalize(rotate(camera.rotation, cross(to, from))));
}

/** Colours within `apart` of one, channel by channel. @param {readonly number[]} color @param {number} apart */
export const colors = (color, apart) => ({ shape: "color", low: color.map((v) => v - apart), high: color.map((v) => v + apart) });

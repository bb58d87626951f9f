// The page's cameras, their intrinsics and projections.

import { axes, dot, scale, add, subtract } from "./math.js";

/** @typedef {import("./math.js").Vec3} Vec3 */
/** @typedef {import("./math.js").Quat} Quat */
/** World from camera, x right, y down, z forward; fov: vertical, radians.
 * @typedef {{ position: Vec3, rotation: Quat, fov: number }} Camera */
/** A view of the dataset.
 * @typedef {{ name: string, trained: boolean, photo: boolean, width: number, height: number, fx: number, fy: number, cx: number,
 *   cy: number, position: Vec3, rotation: Quat }} View */
/** Where a picture is on the stage, CSS pixels. @typedef {{ left: number, top: number, width: number, height: number }} Frame */
/** Pixels. @typedef {{ width: number, height: number, fx: number, fy: number, cx: number, cy: number }} Intrinsics */

/** The part of the stage with the proportions of view, as large as possible; the whole stage without a view.
 * @param {number} width @param {number} height @param {View | null} view @returns {Frame} */
export function frameOn(width, height, view) {
  if (!view) return { left: 0, top: 0, width, height };
  const factor = Math.min(width / view.width, height / view.height);
  const [w, h] = [view.width * factor, view.height * factor];
  return { left: (width - w) / 2, top: (height - h) / 2, width: w, height: h };
}

/** @param {number} width @param {number} height @param {number} fov @param {View | null} view @returns {Intrinsics} */
export function intrinsics(width, height, fov, view) {
  if (view) {
    const [sx, sy] = [width / view.width, height / view.height];
    return { width, height, fx: view.fx * sx, fy: view.fy * sy, cx: view.cx * sx, cy: view.cy * sy };
  }
  const focal = height / 2 / Math.tan(fov / 2);
  return { width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2 };
}

/** Coordinates along the camera's axes. @param {Camera} camera @param {readonly number[]} point @returns {Vec3} */
export function toCamera(camera, point) {
  const offset = subtract(point, camera.position);
  const [x, y, z] = axes(camera.rotation);
  return [dot(x, offset), dot(y, offset), dot(z, offset)];
}

/** Pixel coordinates and depth; null behind the camera.
 * @param {Camera} camera @param {Intrinsics} k @param {readonly number[]} point @returns {Vec3 | null} */
export function project(camera, k, point) {
  const [x, y, z] = toCamera(camera, point);
  return z > 1e-6 ? [(k.fx * x) / z + k.cx, (k.fy * y) / z + k.cy, z] : null;
}

/** The camera's forward direction. @param {Camera} camera */
export const forward = (camera) => axes(camera.rotation)[2];

/** A point in front of the camera. @param {Camera} camera @param {number} distance */
export const ahead = (camera, distance) => add(camera.position, scale(forward(camera), distance));

// Handles for moving, turning and scaling: three axes, three planes and the centre. Computes where they are, which one is under the
// pointer, and the motion of a drag; `overlay.js` draws them.

import { project } from "../camera.js";
import { across, add, axes, cross, dot, length, normalize, rotate, scale, subtract, turn } from "../math.js";

/** @typedef {import("../camera.js").Camera} Camera */
/** @typedef {import("../camera.js").Intrinsics} Intrinsics */
/** @typedef {import("../math.js").Vec3} Vec3 */
/** @typedef {import("../math.js").Quat} Quat */
/** @typedef {"move" | "rotate" | "scale"} Way */
/** Which handle: along or about an axis, in the plane across it, or free. @typedef {{ kind: "axis" | "plane" | "free", axis: number }} Handle */
/** Where the handles are: centre, and the directions of the axes. @typedef {{ center: Vec3, frame: Quat }} Place */
/** A turn and a scaling about `pivot`, then a shift: `x -> pivot + factor rotation (x - pivot) + shift`.
 * @typedef {{ pivot: Vec3, rotation: Quat, factor: number, shift: Vec3 }} Motion */
/** A camera with the intrinsics of its picture. @typedef {{ camera: Camera, k: Intrinsics }} Shown */

/** Length of an axis, CSS pixels. */
const AXIS_LENGTH = 78;
/** Distance of the near and the far corner of a plane's handle from the centre along each axis, as a share of the reach. */
export const PLANE_CORNERS = [0.24, 0.46];
/** Distance at which a handle is grabbed, CSS pixels. */
const GRAB_DISTANCE = 9;
/** Least sine of the angle between the view and a plane at which one can drag in the plane. */
const MIN_PLANE_SINE = 0.12;

/** @type {Quat} */
export const LEVEL = [1, 0, 0, 0];

/** @param {Vec3} pivot @returns {Motion} */
export const rest = (pivot) => ({ pivot, rotation: LEVEL, factor: 1, shift: [0, 0, 0] });

/** @param {Motion} motion @param {readonly number[]} point @returns {Vec3} */
export const moved = ({ pivot, rotation, factor, shift }, point) =>
  add(add(pivot, scale(rotate(rotation, subtract(point, pivot)), factor)), shift);

/** Length of `pixels` at a point, world units. @param {Shown} shown @param {Vec3} point @param {number} pixels of the picture */
export function unitsAt({ camera, k }, point, pixels) {
  const depth = dot(axes(camera.rotation)[2], subtract(point, camera.position));
  return (Math.max(depth, 1e-6) * pixels) / k.fx;
}

/** The length and the directions of the handles, world.
 * @param {Shown} shown @param {Place} place @param {number} pixel the picture's per CSS pixel */
export function handles(shown, { center, frame }, pixel) {
  const reach = unitsAt(shown, center, AXIS_LENGTH * pixel);
  return { reach, directions: axes(frame) };
}

/** The points of a ring about `axis`. @param {Vec3} center @param {Vec3} axis @param {number} radius @returns {Vec3[]} */
export function ring(center, axis, radius) {
  const side = across(axis);
  const other = cross(axis, side);
  return Array.from({ length: 49 }, (_, i) => {
    const angle = (i / 48) * 2 * Math.PI;
    return add(center, add(scale(side, radius * Math.cos(angle)), scale(other, radius * Math.sin(angle))));
  });
}

/** The corners of a plane's handle. @param {Vec3} center @param {Vec3[]} directions @param {number} axis across it @param {number} reach @returns {Vec3[]} */
export function planeCorners(center, directions, axis, reach) {
  const [u, v] = [directions[(axis + 1) % 3], directions[(axis + 2) % 3]];
  const [near, far] = PLANE_CORNERS;
  return [[near, near], [far, near], [far, far], [near, far]].map(([a, b]) => add(center, add(scale(u, a * reach), scale(v, b * reach))));
}

/** Distance of a point from a line of points, pixels. @param {(Vec3 | null)[]} line @param {number} x @param {number} y */
function apart(line, x, y) {
  let least = Infinity;
  for (let i = 1; i < line.length; i += 1) {
    const [a, b] = [line[i - 1], line[i]];
    if (!a || !b) continue;
    const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
    const t = Math.min(1, Math.max(0, ((x - a[0]) * dx + (y - a[1]) * dy) / Math.max(dx * dx + dy * dy, 1e-9)));
    least = Math.min(least, Math.hypot(a[0] + t * dx - x, a[1] + t * dy - y));
  }
  return least;
}

/** @param {(Vec3 | null)[]} corners @param {number} x @param {number} y */
function isInside(corners, x, y) {
  let sign = 0;
  for (const [i, a] of corners.entries()) {
    const b = corners[(i + 1) % corners.length];
    if (!a || !b) return false;
    const side = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]);
    if (side * sign < 0) return false;
    sign = side;
  }
  return true;
}

/** The handle under a point of the picture. @param {Shown} shown @param {Place} place @param {Way} way @param {number} x @param {number} y
 * @param {number} pixel @param {boolean} [coarse] a finger @returns {Handle | null} */
export function handleAt(shown, place, way, x, y, pixel, coarse = false) {
  const { reach, directions } = handles(shown, place, pixel);
  const on = (/** @type {Vec3} */ point) => project(shown.camera, shown.k, point);
  const within = (coarse ? 2 : 1) * GRAB_DISTANCE * pixel;
  const middle = on(place.center);
  if (!middle) return null;
  if (way !== "rotate" && Math.hypot(middle[0] - x, middle[1] - y) < within) return { kind: "free", axis: -1 };
  /** @type {{ handle: Handle, apart: number }[]} */
  const found = directions.map((direction, axis) => {
    const line = way === "rotate" ? ring(place.center, direction, reach).map(on) : [middle, on(add(place.center, scale(direction, reach)))];
    return { handle: { kind: "axis", axis }, apart: apart(line, x, y) };
  });
  const best = found.sort((a, b) => a.apart - b.apart)[0];
  if (best.apart < within) return best.handle;
  if (way === "move") {
    const plane = [0, 1, 2].find((axis) => isInside(planeCorners(place.center, directions, axis, reach).map(on), x, y));
    if (plane !== undefined) return { kind: "plane", axis: plane };
  }
  return null;
}

/** The ray through a point of the picture, not normalised. @param {Shown} shown @param {number} x @param {number} y @returns {Vec3} */
function ray({ camera, k }, x, y) {
  return rotate(camera.rotation, [(x - k.cx) / k.fx, (y - k.cy) / k.fy, 1]);
}

/** Where a ray meets a plane; null if it is nearly parallel to it.
 * @param {Vec3} origin @param {Vec3} direction @param {Vec3} point @param {Vec3} normal */
function meet(origin, direction, point, normal) {
  const slope = dot(direction, normal);
  if (Math.abs(slope) < MIN_PLANE_SINE * length(direction)) return null;
  const t = dot(subtract(point, origin), normal) / slope;
  return t > 0 ? add(origin, scale(direction, t)) : null;
}

/** A drag of a handle, from where it was grabbed. */
export class Drag {
  /** @param {Shown} shown @param {Place} place @param {Way} way @param {Handle} handle @param {number} x @param {number} y */
  constructor(shown, place, way, handle, x, y) {
    this.shown = shown;
    this.place = place;
    this.way = way;
    this.handle = handle;
    this.x = x;
    this.y = y;
    this.axis = handle.axis >= 0 ? axes(place.frame)[handle.axis] : axes(shown.camera.rotation)[2];
    this.angle = 0;
    this.last = this.turnedAt(x, y);
  }

  /** The motion of the drag with the pointer at a point of the picture. @param {number} x @param {number} y @returns {Motion} */
  to(x, y) {
    const motion = rest(this.place.center);
    if (this.way === "move") motion.shift = this.shift(x, y);
    if (this.way === "rotate") motion.rotation = turn(this.axis, this.turned(x, y));
    if (this.way === "scale") motion.factor = this.factor(x, y);
    return motion;
  }

  /** @param {number} x @param {number} y @returns {Vec3} */
  shift(x, y) {
    const { position } = this.shown.camera;
    const { center } = this.place;
    const [from, to] = [ray(this.shown, this.x, this.y), ray(this.shown, x, y)];
    if (this.handle.kind === "axis") {
      // The plane through the axis that faces the camera best.
      const normal = normalize(cross(this.axis, cross(subtract(center, position), this.axis)));
      const [a, b] = [meet(position, from, center, normal), meet(position, to, center, normal)];
      return a && b ? scale(this.axis, dot(subtract(b, a), this.axis)) : [0, 0, 0];
    }
    const [a, b] = [meet(position, from, center, this.axis), meet(position, to, center, this.axis)];
    return a && b ? subtract(b, a) : [0, 0, 0];
  }

  /** The angle about the axis at a point, radians; measured in the picture if the ring is seen from its side.
   * @param {number} x @param {number} y */
  turnedAt(x, y) {
    const { camera, k } = this.shown;
    const at = meet(camera.position, ray(this.shown, x, y), this.place.center, this.axis);
    if (at) {
      const offset = subtract(at, this.place.center);
      const side = across(this.axis);
      return { flat: false, angle: Math.atan2(dot(offset, cross(this.axis, side)), dot(offset, side)) };
    }
    const middle = project(camera, k, this.place.center) ?? [0, 0, 1];
    const tip = project(camera, k, add(this.place.center, scale(this.axis, unitsAt(this.shown, this.place.center, 50)))) ?? middle;
    const [ax, ay] = [tip[0] - middle[0], tip[1] - middle[1]];
    const size = Math.hypot(ax, ay) || 1;
    return { flat: true, angle: ((x - middle[0]) * ay - (y - middle[1]) * ax) / size / 80 };
  }

  /** @param {number} x @param {number} y */
  turned(x, y) {
    const now = this.turnedAt(x, y);
    if (now.flat === this.last.flat) {
      const by = now.angle - this.last.angle;
      this.angle += Math.atan2(Math.sin(by), Math.cos(by));
    }
    this.last = now;
    return this.angle;
  }

  /** @param {number} x @param {number} y */
  factor(x, y) {
    const middle = project(this.shown.camera, this.shown.k, this.place.center);
    if (!middle) return 1;
    if (this.handle.kind === "free") return Math.exp((x - this.x - (y - this.y)) / this.shown.k.height * 4);
    const tip = project(this.shown.camera, this.shown.k, add(this.place.center, scale(this.axis, unitsAt(this.shown, this.place.center, 100)))) ?? middle;
    const [ax, ay] = [tip[0] - middle[0], tip[1] - middle[1]];
    const along = (/** @type {number} */ px, /** @type {number} */ py) => (px - middle[0]) * ax + (py - middle[1]) * ay;
    return Math.max(0.01, along(x, y) / (Math.abs(along(this.x, this.y)) < 1e-6 ? 1 : along(this.x, this.y)));
  }
}

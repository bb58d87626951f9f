// What editing draws over the picture: the line of a tool, regions, the box around the selection, the handles.

import { project } from "../camera.js";
import { add, axes, scale, subtract } from "../math.js";
import { AXIS_COLORS, EDGES, line } from "../overlay.js";
import { corners } from "./pointer.js";
import { handles, moved, planeCorners, ring, unitsAt } from "./gizmo.js";
import { state } from "../state.js";

/** @typedef {import("../overlay.js").Draw} Draw */
/** @typedef {import("../math.js").Vec3} Vec3 */
/** @typedef {import("./pointer.js").Pointer} Pointer */

/** Colours of lines: of shapes that add, of shapes that subtract, and of the selection. */
const ADD_COLOR = "#6ea8fe";
const SUBTRACT_COLOR = "#e5736f";
const SELECTION_COLOR = "#ffb800";
const FREE_COLOR = "#ffffff";

/** @param {Draw} draw @param {number} pixel @param {Pointer} pointer */
export function drawEditing(draw, pixel, pointer) {
  const editing = state.get("editing");
  const isPulled = pointer.tools.tool === "box" || pointer.tools.tool === "sphere";
  if (editing?.box && !editing.before && state.get("highlight") && !isPulled) drawSelection(draw, pixel, editing.box, pointer);
  drawRegion(draw, pixel, pointer);
  drawGizmo(draw, pixel, pointer);
  drawTool(draw, pixel, pointer);
}

/** @param {Draw} draw @param {number} pixel @param {[Vec3, Vec3]} box @param {Pointer} pointer */
function drawSelection(draw, pixel, [low, high], pointer) {
  const half = /** @type {Vec3} */ (scale(subtract(high, low), 0.5));
  const all = corners({ kind: "box", center: scale(add(low, high), 0.5), half, rotation: [1, 0, 0, 0] });
  const motion = pointer.before ? null : pointer.motion;
  const { context } = draw;
  context.strokeStyle = SELECTION_COLOR;
  context.globalAlpha = motion ? 0.35 : 0.6;
  context.setLineDash([4 * pixel, 3 * pixel]);
  edges(draw, all);
  context.setLineDash([]);
  context.globalAlpha = 1;
  if (motion) edges(draw, all.map((corner) => moved(motion, corner)));
}

/** @param {Draw} draw @param {Vec3[]} all */
function edges(draw, all) {
  for (const [a, b] of EDGES) line(draw, all[a], all[b]);
}

/** @param {Draw} draw @param {number} pixel @param {Pointer} pointer */
function drawRegion(draw, pixel, pointer) {
  const region = state.get("region");
  if (!region || region.kind !== pointer.tools.tool) return;
  draw.context.strokeStyle = state.get("selectMode") === "subtract" ? SUBTRACT_COLOR : ADD_COLOR;
  draw.context.lineWidth = 1.5 * pixel;
  if (region.kind === "box") edges(draw, corners(region));
  else for (const axis of axes(region.rotation)) polyline(draw, ring(region.center, axis, region.half[0]));
  draw.context.lineWidth = pixel;
}

/** A tick on the left of a line, the side that it selects.
 * @param {CanvasRenderingContext2D} context @param {number[]} a @param {number[]} b @param {number} pixel */
function side(context, a, b, pixel) {
  const [x, y] = [b[0] - a[0], b[1] - a[1]];
  const reach = (14 * pixel) / Math.max(Math.hypot(x, y), 1);
  const [u, v] = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
  context.beginPath();
  context.moveTo(u, v);
  context.lineTo(u + reach * y, v - reach * x);
  context.stroke();
}

/** @param {Draw} draw @param {Vec3[]} points */
function polyline(draw, points) {
  for (let i = 1; i < points.length; i += 1) line(draw, points[i - 1], points[i]);
}

/** @param {Draw} draw @param {number} pixel @param {Pointer} pointer */
function drawGizmo(draw, pixel, pointer) {
  const gizmo = pointer.gizmo;
  if (!gizmo) return;
  const { context } = draw;
  const motion = pointer.before ? null : pointer.motion;
  const { frame } = gizmo.place;
  const center = motion ? moved(motion, gizmo.place.center) : gizmo.place.center;
  const { reach, directions } = handles(draw, { center, frame }, pixel);
  const middle = project(draw.camera, draw.k, center);
  if (!middle || middle[2] < draw.near) return;
  const held = pointer.drag?.handle ?? pointer.over;
  const isHeld = (/** @type {string} */ kind, /** @type {number} */ axis) => held?.kind === kind && held.axis === axis;
  context.lineCap = "round";
  for (const [axis, direction] of directions.entries()) {
    context.strokeStyle = context.fillStyle = AXIS_COLORS[axis];
    context.lineWidth = (isHeld("axis", axis) ? 4 : 2.2) * pixel;
    if (gizmo.way === "rotate") {
      // The far half of a ring is faint.
      const points = ring(center, direction, reach);
      for (let i = 1; i < points.length; i += 1) {
        const near = unitsAt(draw, points[i], 1) <= unitsAt(draw, center, 1) * 1.0001;
        context.globalAlpha = near ? 1 : 0.25;
        line(draw, points[i - 1], points[i]);
      }
      context.globalAlpha = 1;
      continue;
    }
    const tip = project(draw.camera, draw.k, add(center, scale(direction, reach)));
    line(draw, center, add(center, scale(direction, 0.94 * reach)));
    if (tip) head(context, middle, tip, pixel, gizmo.way === "scale");
    if (gizmo.way === "move") {
      const plane = planeCorners(center, directions, axis, reach).map((corner) => project(draw.camera, draw.k, corner));
      if (plane.every(Boolean)) {
        context.globalAlpha = isHeld("plane", axis) ? 0.75 : 0.35;
        outline(context, /** @type {Vec3[]} */ (plane));
        context.fill();
        context.globalAlpha = 1;
      }
    }
  }
  context.lineWidth = pixel;
  context.lineCap = "butt";
  if (gizmo.way === "rotate") return;
  context.fillStyle = FREE_COLOR;
  context.strokeStyle = "#0009";
  context.beginPath();
  context.arc(middle[0], middle[1], (isHeld("free", -1) ? 6 : 4.5) * pixel, 0, 7);
  context.fill();
  context.stroke();
}

/** The head of an arrow, or a cube. @param {CanvasRenderingContext2D} context @param {Vec3} from @param {Vec3} to @param {number} pixel @param {boolean} cube */
function head(context, from, to, pixel, cube) {
  const size = Math.hypot(to[0] - from[0], to[1] - from[1]);
  const [dx, dy] = size > 1e-6 ? [(to[0] - from[0]) / size, (to[1] - from[1]) / size] : [0, -1];
  const r = 5.5 * pixel;
  const at = (/** @type {number} */ along, /** @type {number} */ aside) => /** @type {Vec3} */ ([to[0] + along * dx - aside * dy, to[1] + along * dy + aside * dx, 0]);
  outline(context, cube ? [at(-r, -r), at(r, -r), at(r, r), at(-r, r)] : [at(1.2 * r, 0), at(-1.2 * r, r), at(-1.2 * r, -r)]);
  context.fill();
}

/** @param {CanvasRenderingContext2D} context @param {readonly (readonly number[])[]} points */
function outline(context, points) {
  context.beginPath();
  for (const [x, y] of points) context.lineTo(x, y);
  context.closePath();
}

/** @param {Draw} draw @param {number} pixel @param {Pointer} pointer */
function drawTool({ context }, pixel, { tools }) {
  const { drawn, at, tool } = tools;
  const subtracts = (drawn?.mode ?? state.get("selectMode")) === "subtract";
  const color = subtracts ? SUBTRACT_COLOR : ADD_COLOR;
  context.strokeStyle = context.fillStyle = color;
  const radius = state.get("brush") * pixel;
  if (tool === "brush" && at) {
    context.beginPath();
    context.arc(at[0], at[1], radius, 0, 7);
    context.stroke();
  }
  if (!drawn) return;
  const { points } = drawn;
  if (drawn.tool === "brush") {
    context.lineWidth = 2 * radius;
    context.lineCap = context.lineJoin = "round";
    context.globalAlpha = 0.35;
    context.beginPath();
    for (const [x, y] of points) context.lineTo(x, y);
    if (points.length === 1) context.lineTo(points[0][0] + 0.01, points[0][1]);
    context.stroke();
    context.lineWidth = pixel;
    context.lineCap = "butt";
    context.lineJoin = "miter";
    context.globalAlpha = 1;
    return;
  }
  const [a, b] = points;
  const shape = drawn.tool === "rectangle" ? [a, [b[0], a[1]], b, [a[0], b[1]]] : drawn.tool === "polygon" && at ? [...points, at] : points;
  context.lineWidth = 1.5 * pixel;
  outline(context, shape);
  context.globalAlpha = 0.16;
  context.fill();
  context.globalAlpha = 1;
  context.stroke();
  context.lineWidth = pixel;
  if (drawn.tool === "cut" && b) side(context, a, b, pixel);
  if (drawn.tool !== "polygon") return;
  for (const [x, y] of points) context.fillRect(x - 2.5 * pixel, y - 2.5 * pixel, 5 * pixel, 5 * pixel);
}

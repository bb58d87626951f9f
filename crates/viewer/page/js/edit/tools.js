// Selection tools on the stage: what is drawn with the pointer becomes a step of the selection when the pointer is released.

import { hasDialog } from "../dom.js";
import { state } from "../state.js";
import { ball, beside, brush, polygon } from "./shapes.js";
import { session } from "./session.js";

/** @typedef {import("../camera.js").Camera} Camera */
/** @typedef {import("../camera.js").Intrinsics} Intrinsics */
/** @typedef {import("./shapes.js").Point} Point */
/** @typedef {import("./session.js").Mode} Mode */

/** Tools of the stage: value, name, icon, hint. */
export const TOOLS = /** @type {const} */ ([
  ["rectangle", "Rectangle", "rectangle", "Drag a rectangle"],
  ["lasso", "Lasso", "lasso", "Drag around what to select"],
  ["polygon", "Polygon", "polygon", "Click corners; Enter, a double click or the first corner closes it"],
  ["brush", "Brush", "brush", "Paint over what to select"],
  ["cut", "Cut", "cut", "Drag a line to select everything on its left, at any distance"],
  ["box", "Box", "box", "Click a surface to place the box, then drag its handles"],
  ["sphere", "Sphere", "sphere", "Click a surface to place the sphere, then drag its handles"],
  ["color", "By colour", "dropper", "Click a splat with the colour to select"],
  ["connected", "Connected", "connected", "Click a part to select everything connected with it"],
]);
/** @typedef {typeof TOOLS[number][0]} Tool */

/** @type {readonly string[]} */
const NAMES = TOOLS.map(([name]) => name);
/** @param {string} tool @returns {tool is Tool} */
export const isEditTool = (tool) => NAMES.includes(tool);
/** Tools that draw a line of points. */
const LINE_TOOLS = ["rectangle", "lasso", "brush", "cut"];
/** Of these, the tools with two points only: the ends of a line, or opposite corners. */
const TWO_POINT_TOOLS = ["rectangle", "cut"];
/** Distance between points of a line, CSS pixels. */
const POINT_SPACING = 2;
/** Distance from the first corner at which a click closes a polygon, CSS pixels. */
const CLOSE_DISTANCE = 9;
/** Milliseconds between the presses of a double click. */
const DOUBLE_CLICK_TIME = 400;

/** How a shape changes the selection, by the modifier keys that image editors use.
 * @param {{ shiftKey: boolean, altKey: boolean }} event @returns {Mode} */
export function modeOf({ shiftKey, altKey }) {
  if (shiftKey && altKey) return "intersect";
  return shiftKey ? "add" : altKey ? "subtract" : state.get("selectMode");
}

export class Tools extends EventTarget {
  /** What is being drawn, pixels of the picture. @type {{ tool: Tool, points: Point[], camera: Camera, k: Intrinsics, mode: Mode } | null} */
  drawn = null;
  /** When the last corner was set. */
  pressed = 0;
  /** The pointer, pixels of the picture. @type {Point | null} */
  at = null;

  /** @param {import("../stage.js").Stage} stage */
  constructor(stage) {
    super();
    this.stage = stage;
    state.addEventListener("tool", () => {
      this.cancel();
      const tool = state.get("tool");
      if (tool !== "box" && tool !== "sphere") return;
      const half = 0.15 * (state.get("scene")?.radius ?? 1);
      const region = state.get("region") ?? { center: state.get("pivot"), half: [half, half, half], rotation: [1, 0, 0, 0] };
      state.set({ region: /** @type {import("./shapes.js").Region} */ ({ ...region, kind: tool }) });
    });
    state.addEventListener("camera", () => this.drawn && this.drawn.camera !== state.get("camera") && this.cancel());
    addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !hasDialog() && this.drawn?.tool === "polygon") this.finish();
    });
  }

  /** @returns {Tool | null} */
  get tool() {
    const tool = state.get("tool");
    return isEditTool(tool) && session.works ? tool : null;
  }

  cancel() {
    this.drawn = null;
    this.changed();
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }

  /** A pointer goes down on the stage. @param {Point} at pixels of the picture @param {PointerEvent} event */
  down(at, event) {
    const tool = this.tool;
    if (!tool) return;
    const mode = modeOf(event);
    const { camera, k } = this.stage.wanted;
    if (tool === "polygon") {
      const [first] = this.drawn?.points ?? [];
      const close = first && Math.hypot(first[0] - at[0], first[1] - at[1]) < CLOSE_DISTANCE * this.stage.pixel;
      const last = this.drawn?.points.at(-1);
      const again = last && event.timeStamp - this.pressed < DOUBLE_CLICK_TIME
        && Math.hypot(last[0] - at[0], last[1] - at[1]) < CLOSE_DISTANCE * this.stage.pixel;
      this.pressed = event.timeStamp;
      if (this.drawn && this.drawn.points.length > 2 && (close || again)) return this.finish();
      if (this.drawn) this.drawn.points.push(at);
      else this.drawn = { tool, points: [at], camera, k, mode };
    } else if (LINE_TOOLS.includes(tool)) {
      this.drawn = { tool, points: TWO_POINT_TOOLS.includes(tool) ? [at, at] : [at], camera, k, mode };
    }
    this.changed();
  }

  /** @param {Point} at */
  move(at) {
    this.at = at;
    const drawn = this.drawn;
    if (drawn && TWO_POINT_TOOLS.includes(drawn.tool)) drawn.points[1] = at;
    else if (drawn && LINE_TOOLS.includes(drawn.tool)) {
      const last = drawn.points[drawn.points.length - 1];
      if (Math.hypot(at[0] - last[0], at[1] - last[1]) >= POINT_SPACING * this.stage.pixel) drawn.points.push(at);
    }
    if (drawn || this.tool === "brush") this.changed();
  }

  /** The pointer is released. @param {Point} at @param {PointerEvent} event */
  up(at, event) {
    const tool = this.tool;
    if (tool && LINE_TOOLS.includes(tool)) this.finish();
    else if (tool && tool !== "polygon") this.touch(tool, at, modeOf(event));
  }

  /** Sends what has been drawn as a step of the selection. */
  finish() {
    const drawn = this.drawn;
    this.cancel();
    if (!drawn) return;
    const { tool, points, camera, k, mode } = drawn;
    const visible = state.get("visibleOnly");
    if (tool === "brush") return session.select([brush(camera, k, points, state.get("brush") * this.stage.pixel, visible)], mode);
    const [a, b] = points;
    if (tool === "cut" && Math.hypot(b[0] - a[0], b[1] - a[1]) > CLOSE_DISTANCE * this.stage.pixel) return session.select([beside(camera, k, a, b)], mode);
    const outline = /** @type {Point[]} */ (tool === "rectangle" ? [a, [b[0], a[1]], b, [a[0], b[1]]] : points);
    if (area(outline) > 9) session.select([polygon(camera, k, outline, visible)], mode);
    // A click without a drag deselects everything, as in other editors.
    else if (mode === "replace" && tool !== "polygon") session.deselect();
  }

  /** A click with a tool that needs to know what is at the point. @param {Tool} tool @param {Point} at @param {Mode} mode */
  async touch(tool, at, mode) {
    const picked = await this.stage.pickPixel(at);
    if (!picked?.point) return;
    if (tool === "box" || tool === "sphere") {
      const region = state.get("region");
      if (region) state.set({ region: { ...region, center: picked.point } });
    } else if (tool === "color" && picked.splat) {
      state.set({ dropped: { color: picked.splat.base, mode } });
    } else if (tool === "connected" && picked.splat) {
      const reach = Math.max(picked.splat.scales[0], 0.002 * (state.get("scene")?.radius ?? 1));
      // `connected` grows what is selected, so that it cannot be subtracted or intersected.
      session.select([ball(picked.splat.mean, 1.5 * reach), { shape: "connected" }], mode === "add" ? "add" : "replace");
    }
  }
}

/** Area of a polygon, square pixels. @param {Point[]} points */
function area(points) {
  let sum = 0;
  for (const [i, a] of points.entries()) {
    const b = points[(i + 1) % points.length];
    sum += a[0] * b[1] - b[0] * a[1];
  }
  return Math.abs(sum) / 2;
}

// Gives the pointer on the stage to the handles of a gizmo, to a selection tool, or else to the camera.

import { Drag, LEVEL, handleAt, rest } from "./gizmo.js";
import { add, clamp, multiply, rotate, scale } from "../math.js";
import { region } from "./shapes.js";
import { session } from "./session.js";
import { state } from "../state.js";
import { Tools } from "./tools.js";

/** @typedef {import("./gizmo.js").Motion} Motion */
/** @typedef {import("./gizmo.js").Place} Place */
/** @typedef {import("./gizmo.js").Way} Way */
/** @typedef {import("./shapes.js").Region} Region */
/** @typedef {import("./shapes.js").Point} Point */

/** Milliseconds between two selections while a region is dragged. */
const SELECT_INTERVAL = 150;

export class Pointer extends EventTarget {
  /** @type {Drag | null} */
  drag = null;
  /** The motion of the drag so far. @type {Motion | null} */
  motion = null;
  /** The region when the drag began. @type {Region | null} */
  before = null;
  /** The handle under the pointer. @type {import("./gizmo.js").Handle | null} */
  over = null;
  /** The pointer that is handled here, and its position. @type {{ id: number, x: number, y: number } | null} */
  held = null;
  selectedAt = 0;

  /** @param {import("../stage.js").Stage} stage @param {HTMLElement} element */
  constructor(stage, element) {
    super();
    this.stage = stage;
    this.element = element;
    this.tools = new Tools(stage);
    this.tools.addEventListener("change", () => this.changed());
    element.addEventListener("pointermove", (event) => this.move(event));
    element.addEventListener("pointerup", (event) => this.up(event));
    element.addEventListener("pointercancel", () => this.cancel());
    state.addEventListener("region", () => this.follow());
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }

  /** Where the handles are now, and what they do; null without handles. @returns {{ place: Place, way: Way } | null} */
  get gizmo() {
    if (state.get("tab") !== "edit" || !session.works || !state.get("sidebar")) return null;
    const way = state.get("transform");
    const [tool, region, editing] = [state.get("tool"), state.get("region"), state.get("editing")];
    if (tool === "box" || tool === "sphere") {
      if (!region) return null;
      return { place: { center: region.center, frame: region.rotation }, way: way === "none" || (way === "rotate" && tool === "sphere") ? "move" : way };
    }
    if (way === "none" || !editing?.box || editing.before) return null;
    const [low, high] = editing.box;
    return { place: { center: scale(add(low, high), 0.5), frame: LEVEL }, way };
  }

  /** @param {PointerEvent} event @returns {Point} pixels of the picture */
  at(event) {
    const rect = this.stage.frameRect;
    return [(event.offsetX - rect.left) * this.stage.pixel, (event.offsetY - rect.top) * this.stage.pixel];
  }

  /** Whether a pointer that goes down is handled here. @param {PointerEvent} event */
  claims(event) {
    if (this.held) {
      // A second finger: both move the camera.
      const { id, x, y } = this.held;
      this.cancel();
      this.stage.navigation?.pointers.set(id, { x, y });
      return false;
    }
    if (event.button !== 0) return false;
    const at = this.at(event);
    const [gizmo, shown] = [this.gizmo, this.stage.seen];
    const handle = gizmo && shown && handleAt(shown, gizmo.place, gizmo.way, ...at, this.stage.pixel, event.pointerType === "touch");
    if (gizmo && shown && handle) {
      this.drag = new Drag(shown, gizmo.place, gizmo.way, handle, ...at);
      this.before = this.tools.tool === "box" || this.tools.tool === "sphere" ? state.get("region") : null;
    } else if (this.tools.tool) {
      this.tools.down(at, event);
    } else {
      return false;
    }
    this.held = { id: event.pointerId, x: event.clientX, y: event.clientY };
    this.element.setPointerCapture(event.pointerId);
    this.element.focus({ preventScroll: true });
    this.changed();
    return true;
  }

  /** @param {PointerEvent} event */
  move(event) {
    const at = this.at(event);
    if (this.held && event.pointerId !== this.held.id) return;
    if (this.held) this.held = { id: event.pointerId, x: event.clientX, y: event.clientY };
    if (!this.drag) {
      if (!event.buttons || this.held) this.hover(at);
      return;
    }
    this.motion = this.drag.to(...at);
    if (this.before) state.set({ region: movedRegion(this.before, this.motion, this.drag) });
    this.changed();
  }

  /** @param {Point} at */
  hover(at) {
    this.tools.move(at);
    const [gizmo, shown] = [this.gizmo, this.stage.seen];
    const over = gizmo && shown ? handleAt(shown, gizmo.place, gizmo.way, ...at, this.stage.pixel) : null;
    if (over?.kind === this.over?.kind && over?.axis === this.over?.axis) return;
    this.over = over;
    this.element.classList.toggle("grabs", Boolean(over));
    this.changed();
  }

  /** @param {PointerEvent} event */
  up(event) {
    if (!this.held || event.pointerId !== this.held.id) return;
    const { drag, motion, before } = this;
    this.release();
    if (!drag) this.tools.up(this.at(event), event);
    else if (before) this.follow(true);
    else if (motion) apply(drag.way, motion, drag);
    this.changed();
  }

  release() {
    [this.held, this.drag, this.motion, this.before] = [null, null, null, null];
  }

  cancel() {
    this.release();
    this.tools.cancel();
    this.changed();
  }

  /** Selects what is in the region; at intervals while it is dragged. @param {boolean} [now] */
  follow(now = false) {
    const chosen = state.get("region");
    const tool = this.tools.tool;
    if (!chosen || chosen.kind !== tool) return;
    const time = performance.now();
    if (!now && this.drag && time < this.selectedAt + SELECT_INTERVAL) return;
    this.selectedAt = time;
    session.select([region(chosen)], state.get("selectMode"), session.live("region"));
  }
}

/** Sends the edit of a drag. @param {Way} way @param {Motion} motion @param {Drag} drag */
function apply(way, motion, drag) {
  const still = rest(motion.pivot);
  if (way === "move" && motion.shift.some((v) => v !== 0)) session.edit({ op: "move", by: motion.shift });
  if (way === "rotate" && drag.angle) session.edit({ op: "rotate", axis: drag.axis, degrees: (drag.angle * 180) / Math.PI, about: still.pivot });
  if (way === "scale" && motion.factor !== 1) session.edit({ op: "scale", factor: motion.factor, about: still.pivot });
}

/** A region after a drag: scaling along an axis changes that side alone. @param {Region} before @param {Motion} motion @param {Drag} drag @returns {Region} */
function movedRegion(before, motion, drag) {
  const factor = clamp(motion.factor, 0.01, 100);
  const axis = before.kind === "box" ? drag.handle.axis : -1;
  return {
    ...before,
    center: add(before.center, motion.shift),
    half: /** @type {Region["half"]} */ (before.half.map((v, i) => (axis < 0 || i === axis ? v * factor : v))),
    rotation: multiply(motion.rotation, before.rotation),
  };
}

/** The corners of a box, in the order of `EDGES` in the overlay. @param {Region} region @returns {import("../math.js").Vec3[]} */
export function corners({ center, half, rotation }) {
  return [0, 1, 2, 3, 4, 5, 6, 7].map((i) => {
    const x = i % 4 === 1 || i % 4 === 2 ? 1 : -1;
    return add(center, rotate(rotation, [x * half[0], (i % 4 >= 2 ? 1 : -1) * half[1], (i >= 4 ? 1 : -1) * half[2]]));
  });
}

// Orbit, fly and walk with mouse, touch, trackpad and keyboard.

import { forward } from "./camera.js";
import { hasDialog } from "./dom.js";
import { add, axes, clamp, cross, dot, length, lookAt, mix, multiply, normalize, rotate, scale, slerp, subtract, turn, unit } from "./math.js";
import { isEditTool } from "./edit/tools.js";
import { state } from "./state.js";

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./math.js").Vec3} Vec3 */

/** Radians per pixel of dragging. */
const RADIANS_PER_PIXEL = 0.006;
/** Largest angle between the view and the horizon, radians: short of the poles. */
const MAX_ELEVATION = 1.54;
/** Distance within which a pressed pointer clicks and does not drag, CSS pixels. */
export const CLICK_DISTANCE = 4;
/** Seconds of a flight from one camera to another. */
const FLIGHT_SECONDS = 0.45;
/** Keys that move, with the camera axes they move along. @type {Record<string, Vec3>} */
export const MOVES = {
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
  ArrowUp: [0, 0, 1], ArrowDown: [0, 0, -1], ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0],
};

const still = matchMedia("(prefers-reduced-motion: reduce)");

export class Navigation {
  /** clicks: not moved so far. @type {Map<number, { x: number, y: number, clicks?: boolean }>} */
  pointers = new Map();
  /** @type {Set<string>} */
  keys = new Set();
  /** Whether Shift is held. */
  fast = false;
  /** @type {{ from: Camera, to: Camera, view: number | null, pivot: Vec3 | null, at: number } | null} */
  flight = null;
  last = 0;

  /** @param {HTMLElement} element @param {(x: number, y: number) => Promise<any>} pick at pixels of the element
   * @param {(event: PointerEvent) => boolean} claimed whether a pointer is used for something else */
  constructor(element, pick, claimed) {
    this.element = element;
    this.pick = pick;
    this.claimed = claimed;
    element.addEventListener("pointerdown", (event) => this.down(event));
    element.addEventListener("pointermove", (event) => this.move(event));
    for (const kind of ["pointerup", "pointercancel"]) {
      element.addEventListener(kind, (event) => this.pointers.delete(/** @type {PointerEvent} */ (event).pointerId));
    }
    element.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    element.addEventListener("dblclick", (event) => this.setPivot(event));
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.keys.clear());
  }

  /** @param {PointerEvent} event */
  down(event) {
    if (this.claimed(event)) return;
    this.element.setPointerCapture(event.pointerId);
    this.element.focus({ preventScroll: true });
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, clicks: true });
    this.flight = null;
  }

  /** @param {PointerEvent} event */
  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
    if (Math.hypot(dx, dy) < (before.clicks ? CLICK_DISTANCE : 1e-9)) return;
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1] ?? before;
      const apart = (/** @type {{ x: number, y: number }} */ p) => Math.max(Math.hypot(p.x - other.x, p.y - other.y), 1);
      const now = { x: event.clientX, y: event.clientY };
      this.dolly(Math.log(apart(now) / apart(before)));
      this.pan(dx / 2, dy / 2);
    } else if (event.buttons & (isEditTool(state.get("tool")) ? 4 : 6) || event.shiftKey) {
      // A selection tool uses the left button: the right one turns.
      this.pan(dx, dy);
    } else {
      this.turn(dx, dy);
    }
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    this.flight = null;
    const lines = event.deltaMode === 1 ? 16 : 1;
    if (event.shiftKey) {
      this.pan(-event.deltaX * lines, -event.deltaY * lines);
    } else {
      // A pinch on a trackpad arrives as a wheel with Ctrl, in smaller steps.
      this.dolly(-event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.0015));
    }
  }

  /** Distance to the pivot, or to what is in view while flying. */
  get reach() {
    const scene = state.get("scene");
    return Math.max(length(subtract(state.get("pivot"), state.get("camera").position)), 0.02 * (scene?.radius ?? 1));
  }

  /** Changes the camera, which then is no longer in a view. @param {Partial<Camera>} change */
  place(change) {
    state.set({ camera: { ...state.get("camera"), ...change }, view: null });
  }

  /** @param {number} dx @param {number} dy pixels */
  turn(dx, dy) {
    const camera = state.get("camera");
    const up = state.get("up");
    const orbits = state.get("navigation") === "orbit";
    const sign = orbits ? 1 : -1;
    const gain = orbits ? RADIANS_PER_PIXEL : RADIANS_PER_PIXEL * 0.6;
    // Yaw about the up axis, then pitch about the camera's own right axis.
    const yaw = turn(up, -sign * dx * gain);
    const [right, , ahead] = axes(camera.rotation);
    const elevation = Math.asin(clamp(dot(ahead, up), -1, 1));
    // A positive turn about the right axis raises the view.
    const [lowest, highest] = [Math.min(0, -MAX_ELEVATION - elevation), Math.max(0, MAX_ELEVATION - elevation)];
    const both = multiply(yaw, turn(right, clamp(-sign * dy * gain, lowest, highest)));
    const rotation = unit(multiply(both, camera.rotation));
    if (!orbits) return this.place({ rotation });
    const pivot = state.get("pivot");
    this.place({ rotation, position: add(pivot, rotate(both, subtract(camera.position, pivot))) });
  }

  /** @param {number} dx @param {number} dy pixels */
  pan(dx, dy) {
    const camera = state.get("camera");
    const perPixel = (2 * this.reach * Math.tan(camera.fov / 2)) / this.element.clientHeight;
    const [right, down] = axes(camera.rotation);
    const shift = add(scale(right, -dx * perPixel), scale(down, -dy * perPixel));
    this.place({ position: add(camera.position, shift) });
    if (state.get("navigation") === "orbit") state.set({ pivot: add(state.get("pivot"), shift) });
  }

  /** @param {number} amount logarithm of the factor by which the distance to the pivot decreases */
  dolly(amount) {
    const camera = state.get("camera");
    if (state.get("navigation") === "orbit") {
      const pivot = state.get("pivot");
      const offset = scale(subtract(camera.position, pivot), Math.exp(-amount));
      const least = 1e-3 * (state.get("scene")?.radius ?? 1);
      if (length(offset) > least) this.place({ position: add(pivot, offset) });
    } else {
      this.place({ position: add(camera.position, scale(forward(camera), amount * this.pace)) });
    }
  }

  /** World units per second. */
  get pace() {
    return 0.5 * (state.get("scene")?.radius ?? 1) * state.get("speed");
  }

  /** @param {KeyboardEvent} event @param {boolean} pressed */
  key(event, pressed) {
    const within = /** @type {HTMLElement} */ (event.target);
    const writes = hasDialog() || within.matches?.("input, select, textarea, .tabs *");
    this.fast = event.shiftKey;
    if (!pressed) this.keys.delete(event.code);
    else if (!writes && !event.ctrlKey && !event.metaKey && !event.altKey && event.code in MOVES) {
      this.keys.add(event.code);
      this.flight = null;
      event.preventDefault();
    }
  }

  /** Moves by the keys held and along a flight; called before every frame. @param {number} now milliseconds */
  tick(now) {
    const seconds = Math.min((now - this.last) / 1000, 0.1);
    this.last = now;
    if (this.flight) this.fly(now);
    if (this.keys.size === 0) return;
    const camera = state.get("camera");
    if (state.get("navigation") === "orbit") {
      const pixels = 240 * seconds;
      const along = (/** @type {string[]} */ ...codes) => codes.filter((code) => this.keys.has(code)).length;
      const dx = along("KeyA", "ArrowLeft") - along("KeyD", "ArrowRight");
      if (dx) this.turn(dx * pixels, 0);
      const dy = along("KeyE") - along("KeyQ");
      if (dy) this.turn(0, dy * pixels);
      const near = along("KeyW", "ArrowUp") - along("KeyS", "ArrowDown");
      if (near) this.dolly(near * seconds * 1.2);
      return;
    }
    let step = /** @type {Vec3} */ ([0, 0, 0]);
    for (const code of this.keys) step = add(step, rotate(camera.rotation, MOVES[code]));
    if (state.get("navigation") === "walk") {
      const up = state.get("up");
      step = subtract(step, scale(up, dot(step, up)));
    }
    const by = scale(step, this.pace * seconds * (this.fast ? 4 : 1));
    this.place({ position: add(camera.position, by) });
    state.set({ pivot: add(state.get("pivot"), by) });
  }

  /** Flies to a camera. @param {Camera} to @param {{ view?: number | null, pivot?: Vec3 | null }} [more] */
  flyTo(to, { view = null, pivot = null } = {}) {
    if (still.matches) {
      state.set({ camera: to, view, ...(pivot && { pivot }) });
      return;
    }
    this.flight = { from: state.get("camera"), to, view, pivot, at: performance.now() };
  }

  /** @param {number} now */
  fly(now) {
    const flight = this.flight;
    if (!flight) return;
    const t = clamp((now - flight.at) / 1000 / FLIGHT_SECONDS, 0, 1);
    if (t >= 1) {
      this.flight = null;
      state.set({ camera: flight.to, view: flight.view, ...(flight.pivot && { pivot: flight.pivot }) });
      return;
    }
    const eased = t * t * (3 - 2 * t);
    this.place({
      position: mix(flight.from.position, flight.to.position, eased),
      rotation: slerp(flight.from.rotation, flight.to.rotation, eased),
      fov: flight.from.fov + (flight.to.fov - flight.from.fov) * eased,
    });
  }

  /** @param {MouseEvent} event */
  async setPivot(event) {
    if (state.get("tool") !== "none") return;
    const picked = await this.pick(event.offsetX, event.offsetY);
    if (!picked?.point) return;
    const camera = state.get("camera");
    state.set({ pivot: picked.point });
    this.flyTo({ ...camera, rotation: lookAt(camera.position, picked.point, state.get("up")) }, { pivot: picked.point });
  }

  /** Flies to the camera that shows the whole scene. */
  home() {
    const { camera, pivot } = homeOf();
    this.flyTo(camera, { pivot });
  }

  /** Looks at the pivot along a world axis. @param {Vec3} from */
  along(from) {
    const camera = state.get("camera");
    const pivot = state.get("pivot");
    const position = add(pivot, scale(from, this.reach));
    const up = state.get("up");
    const above = Math.abs(dot(from, up)) > 0.99 ? axes(camera.rotation)[2] : up;
    this.flyTo({ ...camera, position, rotation: lookAt(position, pivot, above) }, { pivot });
  }

  /** Jumps into a view. @param {number} index */
  enter(index) {
    const view = state.get("views")[index];
    if (!view) return;
    const camera = { position: view.position, rotation: view.rotation, fov: 2 * Math.atan(view.height / 2 / view.fy) };
    const pivot = add(view.position, scale(forward(camera), this.depthOf(camera)));
    this.flyTo(camera, { view: index, pivot });
  }

  /** Distance of the scene's centre along a camera's axis. @param {Camera} camera */
  depthOf(camera) {
    const scene = state.get("scene");
    if (!scene) return 1;
    return Math.max(dot(subtract(scene.center, camera.position), forward(camera)), 0.2 * scene.radius);
  }
}

/** The camera that shows the whole scene. @returns {{ camera: Camera, pivot: Vec3 }} */
export function homeOf() {
  const scene = state.get("scene");
  const up = scene?.up ?? [0, -1, 0];
  const pivot = scene?.center ?? [0, 0, 0];
  const fov = clamp(scene?.fov ?? 0.9, 0.2, 1.6);
  const first = scene?.first ?? state.get("views")[0]?.position ?? add(pivot, cross(up, normalize([0.3, 0.2, 0.9])));
  const offset = subtract(first, pivot);
  const flat = normalize(subtract(offset, scale(up, dot(offset, up))));
  const radius = scene?.radius ?? 3;
  const position = add(pivot, add(scale(flat, radius), scale(up, scene?.height ?? 1)));
  return { camera: { position, rotation: lookAt(position, pivot, up), fov }, pivot };
}

// A shared scene: draws it, and moves the camera about it with mouse, touch and keyboard.

import { view } from "irradia/assets.js";
import { add, axes, clamp, dot, length, mix, multiply, rotate, scale, slerp, subtract, turn, unit } from "irradia/math.js";
import { LocalRenderer, screenDensity } from "irradia/renderer.js";

/** Radians per pixel of dragging, and the largest angle between the view and the horizon. */
const RADIANS_PER_PIXEL = 0.006;
const MAX_ELEVATION = 1.54;

const stage = /** @type {HTMLElement} */ (document.getElementById("stage"));
const message = /** @type {HTMLElement} */ (document.getElementById("message"));
const { up, start } = view;
let camera = start;
let pivot = view.pivot;
let stale = true;

const renderer = new LocalRenderer(stage, () => (stale = true), (problem) => (message.textContent = problem));
renderer.load({ version: 1, background: view.background, antialias: view.antialias });
renderer.ready.then(() => {
  if (!renderer.works) message.textContent = "This browser supports neither WebGPU nor WebGL2.";
});
// For tests, and for pages that embed this one.
Object.assign(window, { irradia: { renderer, camera: () => camera, set: (to) => ((camera = to), (stale = true)) } });

/** The density of the last picture. */
let drawn = screenDensity();

/** Pixels and focal length: the picture shows at least as much in width and height as at the start. */
function intrinsics() {
  const [width, height] = [stage.clientWidth, stage.clientHeight].map((side) => Math.max(1, Math.round(side * screenDensity())));
  const vertical = height / 2 / Math.tan(camera.fov / 2);
  const focal = Math.min(vertical, (vertical * width) / height / view.aspect);
  return { width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2 };
}

const reach = () => Math.max(length(subtract(pivot, camera.position)), 0.02 * view.radius);

/** Turns about the pivot. @param {number} dx @param {number} dy pixels */
function orbit(dx, dy) {
  const yaw = turn(up, -dx * RADIANS_PER_PIXEL);
  const [right, , ahead] = axes(camera.rotation);
  const elevation = Math.asin(clamp(dot(ahead, up), -1, 1));
  const pitch = clamp(-dy * RADIANS_PER_PIXEL, Math.min(0, -MAX_ELEVATION - elevation), Math.max(0, MAX_ELEVATION - elevation));
  const both = multiply(yaw, turn(right, pitch));
  const rotation = unit(multiply(both, camera.rotation));
  const position = add(pivot, rotate(both, subtract(camera.position, pivot)));
  camera = { ...camera, position, rotation };
  stale = true;
}

/** Moves camera and pivot across the view. @param {number} dx @param {number} dy pixels */
function pan(dx, dy) {
  const [right, down] = axes(camera.rotation);
  const step = reach() / intrinsics().fy * screenDensity();
  const move = add(scale(right, -dx * step), scale(down, -dy * step));
  pivot = add(pivot, move);
  camera = { ...camera, position: add(camera.position, move) };
  stale = true;
}

/** Moves nearer to the pivot. @param {number} amount in powers of e */
function dolly(amount) {
  const offset = subtract(camera.position, pivot);
  camera = { ...camera, position: add(pivot, scale(offset, Math.exp(-amount))) };
  stale = true;
}

/** When the flight began, in milliseconds of the page; null while it does not play. @type {number | null} */
let began = null;
const play = /** @type {HTMLButtonElement} */ (document.getElementById("play"));

/** The camera of the flight after some seconds. @param {number} seconds */
function along(seconds) {
  const { keys, step } = view.path;
  const at = clamp(seconds / step, 0, keys.length - 1);
  const i = Math.min(Math.floor(at), Math.max(0, keys.length - 2));
  const [a, b] = [keys[i], keys[Math.min(i + 1, keys.length - 1)]];
  const t = at - i;
  return {
    position: mix(a.slice(0, 3), b.slice(0, 3), t),
    rotation: slerp(a.slice(3, 7), b.slice(3, 7), t),
    fov: a[7] + (b[7] - a[7]) * t,
  };
}

/** Begins or ends the flight. @param {number | null} now */
function fly(now) {
  if (began !== null && now === null) {
    // The camera stays where it is, and turns about a point in front of it.
    const ahead = axes(camera.rotation)[2];
    const distance = Math.max(dot(subtract(view.pivot, camera.position), ahead), 0.1 * view.radius);
    pivot = add(camera.position, scale(ahead, distance));
  }
  began = now;
  play.textContent = now === null ? "Play" : "Stop";
  play.setAttribute("aria-pressed", String(now !== null));
}
if (view.path) {
  play.hidden = false;
  play.addEventListener("click", () => fly(began === null ? performance.now() : null));
}
/** Whether the flight will begin by itself. */
let opens = view.path && !matchMedia("(prefers-reduced-motion: reduce)").matches;
/** Ends the flight when the page is used. */
function touch() {
  opens = false;
  fly(null);
}
for (const kind of ["pointerdown", "wheel"]) stage.addEventListener(kind, touch);

/** @type {Map<number, { x: number, y: number }>} */
const pointers = new Map();
stage.addEventListener("pointerdown", (event) => {
  stage.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
});
stage.addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = { x: event.clientX, y: event.clientY };
  const [dx, dy] = [now.x - before.x, now.y - before.y];
  const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
  if (other) {
    const apart = (/** @type {{ x: number, y: number }} */ p) => Math.max(1, Math.hypot(p.x - other.x, p.y - other.y));
    dolly(Math.log(apart(now) / apart(before)));
    pan(dx / 2, dy / 2);
  } else if (event.buttons & 6 || event.shiftKey) pan(dx, dy);
  else orbit(dx, dy);
  pointers.set(event.pointerId, now);
});
for (const kind of /** @type {const} */ (["pointerup", "pointercancel"])) stage.addEventListener(kind, (event) => pointers.delete(event.pointerId));
stage.addEventListener("contextmenu", (event) => event.preventDefault());
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  dolly(-event.deltaY * (event.deltaMode === 1 ? 16 : 1) * (event.ctrlKey ? 0.01 : 0.0015));
}, { passive: false });
stage.addEventListener("dblclick", () => {
  [camera, pivot, stale] = [start, view.pivot, true];
});
addEventListener("keydown", ({ key }) => {
  const step = 40;
  if (key.startsWith("Arrow") || ["+", "-", "Home"].includes(key)) touch();
  if (key === "ArrowLeft") orbit(step, 0);
  else if (key === "ArrowRight") orbit(-step, 0);
  else if (key === "ArrowUp") orbit(0, step);
  else if (key === "ArrowDown") orbit(0, -step);
  else if (key === "+") dolly(0.2);
  else if (key === "-") dolly(-0.2);
  else if (key === "Home") [camera, pivot, stale] = [start, view.pivot, true];
});
new ResizeObserver(() => (stale = true)).observe(stage);

/** @param {number} now */
function frame(now) {
  if (began !== null) {
    const seconds = (now - began) / 1000;
    [camera, stale] = [along(seconds), true];
    if (seconds >= (view.path.keys.length - 1) * view.path.step) fly(null);
  }
  if (stale || drawn !== screenDensity()) {
    [stale, drawn] = [false, screenDensity()];
    renderer.want(camera, intrinsics(), {});
  }
  if (renderer.draw(now) && renderer.drawn > 0) {
    message.textContent = renderer.loaded < renderer.total ? `${Math.round((100 * renderer.loaded) / renderer.total)} %` : "";
    document.querySelector(".poster")?.remove();
    if (opens && renderer.loaded >= renderer.total) {
      opens = false;
      fly(now);
    }
  }
  requestAnimationFrame(frame);
}
requestAnimationFrame(frame);

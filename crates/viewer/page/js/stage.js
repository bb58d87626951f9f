// <irr-stage>: the picture, the overlay and the comparison with photographs.

import { frameOn, intrinsics } from "./camera.js";
import { connection, pictureOf } from "./connection.js";
import { el } from "./dom.js";
import { LocalRenderer, screenDensity } from "./local/renderer.js";
import { CLICK_DISTANCE, Navigation } from "./navigation.js";
import { drawEditing } from "./edit/overlay.js";
import { Pointer } from "./edit/pointer.js";
import { isEditTool } from "./edit/tools.js";
import { drawOverlay, frustumAt, thumbnails } from "./overlay.js";
import { path } from "./path.js";
import { state } from "./state.js";

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./camera.js").Intrinsics} Intrinsics */
/** @typedef {import("./connection.js").Header} Header */

/** Modes that the page can draw locally. */
export const LOCAL_MODES = ["color", "ellipses", "rings", "points"];
/** Number of splats beyond which the server draws, unless the user chooses otherwise. */
const MAX_LOCAL_SPLATS = 3e6;
/** Maximum side of a picture that the server draws, pixels. */
const MAX_SIDE = 4096;
/** Milliseconds between the two pictures of a blink. */
const BLINK_INTERVAL = 700;

/** What lines and layout depend on, besides the camera. @type {(keyof import("./state.js").Values)[]} */
const OVERLAY_INPUTS = ["pivot", "view", "views", "frusta", "axes", "clip", "measured", "metres", "scores", "compare", "tab", "scene",
  "sidebar", "tool", "editing", "region", "transform", "selectMode", "brush", "highlight"];

export class Stage extends HTMLElement {
  /** What is on the screen now. @type {{ camera: Camera, k: Intrinsics, header: Header | null } | null} */
  shown = null;
  /** Requested pictures that have not arrived, by id. @type {Map<number, { camera: Camera, k: Intrinsics, at: number }>} */
  sent = new Map();
  ids = 0;
  /** Number of pictures received, and which of them is shown: they may be decoded in a different order. */
  received = 0;
  newest = 0;
  /** Whether a new picture is needed. */
  dirty = true;
  /** Whether lines and layout must be renewed. */
  stale = true;
  split = 0.5;
  /** Where the pointer went down. */
  pressed = { x: 0, y: 0 };
  /** Times of the pictures of the last second. */
  times = /** @type {number[]} */ ([]);
  /** Milliseconds from the change of the camera to the picture, newest last. */
  delays = /** @type {number[]} */ ([]);

  connectedCallback() {
    this.served = /** @type {HTMLCanvasElement} */ (el("canvas", { className: "served" }));
    this.context = this.served.getContext("bitmaprenderer");
    this.drawn = el("div", { className: "local", hidden: true });
    this.photo = /** @type {HTMLImageElement} */ (el("img", { className: "photo", hidden: true, alt: "" }));
    this.photo.onload = () => this.photo && (this.photo.style.opacity = "1");
    this.photo.onerror = () => this.losePhoto();
    this.overlay = /** @type {HTMLCanvasElement} */ (el("canvas", { className: "overlay", tabIndex: 0 }));
    this.overlay.setAttribute("role", "img");
    this.overlay.setAttribute("aria-label", "The scene. Drag to turn, scroll to come nearer, question mark for all keys");
    this.handle = el("button", { className: "handle", hidden: true });
    this.handle.setAttribute("aria-label", "Border between photograph and picture");
    this.empty = el("div", { className: "empty" });
    this.prepend(this.served, this.drawn, this.photo, this.overlay, this.handle, this.empty);
    const local = new LocalRenderer(this.drawn, () => (this.dirty = true), (problem) => state.set({ problem }));
    this.local = local;
    const pointer = new Pointer(this, this.overlay);
    this.pointer = pointer;
    this.navigation = new Navigation(this.overlay, (x, y) => this.pickAt(x, y), (event) => pointer.claims(event));
    new ResizeObserver(() => this.resize()).observe(this);
    for (const key of /** @type {const} */ (["camera", "view", "mode", "background", "light", "clip", "drawing", "compare", "scene", "highlight"])) {
      state.addEventListener(key, () => (this.dirty = true));
    }
    const touch = () => (this.stale = true);
    for (const key of OVERLAY_INPUTS) state.addEventListener(key, touch);
    // Lines over a served picture use its camera, so that its arrival renews them. A canvas renewed 60 times a second costs half a core
    // if the browser composes without a GPU.
    state.addEventListener("camera", () => (this.stale ||= this.drawsLocally));
    for (const source of [this, path, thumbnails, pointer]) for (const kind of ["drawing", "change", "load"]) source.addEventListener(kind, touch);
    state.addEventListener("scene", () => local.load(state.get("scene")));
    state.addEventListener("editing", () => {
      local.select(state.get("editing")?.mask ?? 0);
      this.dirty ||= this.drawsLocally;
    });
    state.watch(["view", "compare", "views"], () => this.showPhoto());
    state.watch(["tool"], () => this.classList.toggle("picking", state.get("tool") !== "none"));
    state.watch(["connection", "scene"], () => this.tellEmpty());
    connection.addEventListener("open", () => {
      this.sent.clear();
      this.dirty = true;
    });
    // A page that nobody sees takes no time from a training.
    document.addEventListener("visibilitychange", () => {
      if (document.hidden) connection.send({ do: "rest" });
      this.dirty = true;
    });
    connection.addEventListener("picture", (event) => this.receive(/** @type {CustomEvent} */ (event).detail));
    this.overlay.addEventListener("pointerdown", (event) => (this.pressed = { x: event.clientX, y: event.clientY }));
    this.overlay.addEventListener("click", (event) => this.useTool(event));
    this.handle.addEventListener("pointermove", (event) => this.dragHandle(event));
    this.handle.addEventListener("pointerdown", (event) => this.handle?.setPointerCapture(event.pointerId));
    this.handle.addEventListener("keydown", (event) => this.keyHandle(event));
    const frame = (/** @type {number} */ now) => {
      this.frame(now);
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  tellEmpty() {
    if (!this.empty) return;
    const scene = state.get("scene");
    this.empty.textContent = scene ? (scene.count === 0 ? "Nothing to draw yet" : "") : state.get("connection") === "open" ? "Waiting for the first step" : "";
  }

  resize() {
    this.density = screenDensity();
    if (this.overlay) {
      this.overlay.width = Math.round(this.clientWidth * this.density);
      this.overlay.height = Math.round(this.clientHeight * this.density);
    }
    this.dirty = this.stale = true;
  }

  /** Whether this page draws locally. */
  get drawsLocally() {
    const scene = state.get("scene");
    if (!scene?.travels || !LOCAL_MODES.includes(state.get("mode")) || state.comparison === "error") return false;
    if (!this.local?.paints(state.get("mode")) || this.light !== null) return false;
    const drawing = state.get("drawing");
    if (drawing !== "auto") return drawing === "local";
    return this.local.accelerated && scene.count <= MAX_LOCAL_SPLATS && !state.get("hello")?.live;
  }

  /** The view in whose light the scene is shown: that of the photograph it is compared with, if any. @returns {number | null} */
  get light() {
    if (!state.get("scene")?.lights) return null;
    const compares = state.comparison !== "none" && state.insideView?.trained;
    return compares ? state.get("view") : state.get("light");
  }

  /** The picture's place on the stage. */
  get frameRect() {
    return frameOn(Math.max(this.clientWidth, 1), Math.max(this.clientHeight, 1), state.insideView);
  }

  /** The request for the current picture. */
  shot() {
    const camera = state.get("camera");
    const rect = this.frameRect;
    // A larger stage gets a smaller picture, scaled.
    const density = Math.min(this.density ?? 1, MAX_SIDE / Math.max(rect.width, rect.height, 1));
    const [width, height] = [Math.max(1, Math.round(rect.width * density)), Math.max(1, Math.round(rect.height * density))];
    const k = intrinsics(width, height, camera.fov, state.insideView);
    const background = state.get("background");
    return {
      id: this.ids, position: camera.position, rotation: camera.rotation, ...k,
      mode: state.comparison === "error" ? "error" : state.get("mode"),
      view: state.get("view"),
      background: background && rgb(background),
      clip: state.get("clip"),
      highlight: state.get("highlight"),
      light: this.light,
    };
  }

  /** The camera of the current request. */
  get wanted() {
    const { width, height, fx, fy, cx, cy } = this.shot();
    return { camera: state.get("camera"), k: { width, height, fx, fy, cx, cy } };
  }

  /** The camera on the screen: for a served picture its own, so that lines and picture move together.
   * @returns {{ camera: Camera, k: Intrinsics } | null} */
  get seen() {
    if (!this.drawsLocally) return this.shown;
    return this.local?.k ? { camera: state.get("camera"), k: this.local.k } : null;
  }

  /** The picture's pixels per CSS pixel. */
  get pixel() {
    return this.shot().width / this.frameRect.width;
  }

  /** @param {number} now */
  frame(now) {
    this.navigation?.tick(now);
    // On a screen of another density, the stage may have the same size.
    if (screenDensity() !== this.density) this.resize();
    if (!this.served || !this.drawn || !this.local) return;
    const local = this.drawsLocally;
    if (this.dirty) {
      this.dirty = false;
      this.ids += 1;
      const shot = this.shot();
      const { width, height, fx, fy, cx, cy } = shot;
      const k = { width, height, fx, fy, cx, cy };
      if (local) {
        if (this.drawn.hidden) connection.send({ do: "rest" });
        this.local.want(state.get("camera"), k, shot);
        this.shown = { camera: state.get("camera"), k, header: null };
      } else if (state.get("scene")) {
        connection.send({ do: "shot", ...shot });
        this.sent.set(shot.id, { camera: state.get("camera"), k, at: performance.now() });
        if (this.sent.size > 400) this.sent.delete(this.sent.keys().next().value ?? 0);
        if (this.drawn.hidden === false) this.dispatchEvent(new Event("drawing"));
      }
      this.drawn.hidden = !local;
      this.served.hidden = local;
    }
    if (local && this.local.draw(now)) this.count(now);
    // A page at rest draws nothing.
    if (!this.stale) return;
    this.stale = false;
    this.layOut();
    this.drawOverlay();
  }

  layOut() {
    const rect = this.frameRect;
    const style = { left: `${rect.left}px`, top: `${rect.top}px`, width: `${rect.width}px`, height: `${rect.height}px` };
    for (const element of [this.drawn, this.photo]) if (element) Object.assign(element.style, style);
    if (this.served) {
      // Until a picture of the stage's new size arrives, the old one keeps its proportions; the vertical field of view stays the same.
      const k = this.shown?.header ? this.shown.k : rect;
      const width = (rect.height * k.width) / k.height;
      Object.assign(this.served.style, style, { left: `${rect.left + (rect.width - width) / 2}px`, width: `${width}px` });
    }
    if (this.handle && !this.handle.hidden) {
      Object.assign(this.handle.style, { left: `${rect.left + this.split * rect.width}px`, top: style.top, height: style.height });
    }
  }

  /** @param {{ header: Header, jpeg: Blob }} picture */
  async receive({ header, jpeg }) {
    const order = (this.received += 1);
    const bitmap = await createImageBitmap(jpeg);
    connection.send({ do: "shown", id: header.id });
    const shot = this.sent.get(header.id);
    const current = this.shown?.header?.id ?? 0;
    if (!shot || !this.served || order < this.newest) return bitmap.close();
    this.newest = order;
    this.served.width = bitmap.width;
    this.served.height = bitmap.height;
    this.context?.transferFromImageBitmap(bitmap);
    for (const id of this.sent.keys()) if (id < header.id) this.sent.delete(id);
    const now = performance.now();
    if (!header.sharp && current !== header.id) {
      this.delays.push(now - shot.at);
      if (this.delays.length > 2000) this.delays.shift();
    }
    this.shown = { camera: shot.camera, k: shot.k, header };
    this.count(now);
    this.dispatchEvent(new Event("drawing"));
  }

  /** @param {number} now */
  count(now) {
    this.times = [...this.times.filter((time) => time > now - 1000), now];
    this.dispatchEvent(new Event("drawing"));
  }

  drawOverlay() {
    const context = this.overlay?.getContext("2d");
    if (!context || !this.overlay) return;
    const shown = this.seen;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.overlay.width, this.overlay.height);
    if (!shown) return;
    const rect = this.frameRect;
    const density = this.density ?? 1;
    const factor = rect.width / shown.k.width;
    context.setTransform(density * factor, 0, 0, density * factor, rect.left * density, rect.top * density);
    drawOverlay(context, shown.camera, shown.k, 1 / factor);
    const near = 0.01 * (state.get("scene")?.radius ?? 1);
    if (this.pointer && state.get("tab") === "edit") drawEditing({ context, near, ...shown }, 1 / factor, this.pointer);
  }

  /** @param {number} x @param {number} y CSS pixels on the stage @returns {Promise<any>} */
  async pickAt(x, y) {
    const rect = this.frameRect;
    return this.pickPixel([(x - rect.left) * this.pixel, (y - rect.top) * this.pixel]);
  }

  /** @param {readonly [number, number]} at pixels of the picture @returns {Promise<any>} */
  pickPixel([x, y]) {
    return connection.pick(this.shot(), x, y);
  }

  /** @param {MouseEvent} event */
  async useTool(event) {
    const tool = state.get("tool");
    // A drag turns the view with these tools as well.
    const still = Math.hypot(event.clientX - this.pressed.x, event.clientY - this.pressed.y) < CLICK_DISTANCE;
    if (!still || isEditTool(tool)) return;
    if (tool === "none") {
      if (!this.pointer?.over) this.enterFrustum(event.offsetX, event.offsetY);
      return;
    }
    const picked = await this.pickAt(event.offsetX, event.offsetY);
    if (tool === "inspect") state.set({ picked });
    if (tool === "measure" && picked?.point) {
      const before = state.get("measured");
      state.set({ measured: [...(before.length >= 2 ? [] : before), picked.point] });
    }
  }

  /** Enters the view whose camera is drawn at a point of the stage. @param {number} x @param {number} y */
  enterFrustum(x, y) {
    const shown = this.seen;
    if (!shown) return;
    const rect = this.frameRect;
    const factor = shown.k.width / rect.width;
    const index = frustumAt(shown.camera, shown.k, (x - rect.left) * factor, (y - rect.top) * factor, 14 * factor);
    if (index !== null) this.navigation?.enter(index);
  }

  showPhoto() {
    const index = state.get("view");
    const compare = state.comparison;
    const shows = compare === "slider" || compare === "blink";
    if (!this.photo || !this.handle) return;
    this.stale = true;
    this.photo.hidden = !shows;
    this.handle.hidden = !shows || compare !== "slider";
    clearInterval(this.blinking);
    if (!shows) return;
    const address = pictureOf(/** @type {number} */ (index), "photo");
    if (this.photo.getAttribute("src") !== address) {
      // Until it is loaded, browsers show the one before it.
      this.photo.style.opacity = "0";
      this.photo.src = address;
    }
    this.clipPhoto();
    this.photo.style.visibility = "visible";
    if (compare === "blink") {
      const photo = this.photo;
      photo.style.clipPath = "none";
      this.blinking = setInterval(() => {
        photo.style.visibility = photo.style.visibility === "visible" ? "hidden" : "visible";
      }, BLINK_INTERVAL);
    }
  }

  /** Tells why the photograph cannot be shown, which an image does not know; it is requested again when it is shown the next time. */
  async losePhoto() {
    const address = this.photo?.getAttribute("src");
    if (!address) return;
    this.photo?.removeAttribute("src");
    try {
      const response = await fetch(address);
      const why = response.ok ? "" : await response.text();
      state.set({ problem: why || "The photograph was not loaded: compare again to try again" });
    } catch {
      // The connection is lost, which is told already.
    }
  }

  clipPhoto() {
    if (this.photo) this.photo.style.clipPath = `inset(0 ${100 * (1 - this.split)}% 0 0)`;
  }

  /** @param {PointerEvent} event */
  dragHandle(event) {
    if (!event.buttons) return;
    const rect = this.frameRect;
    this.stale = true;
    this.split = Math.min(1, Math.max(0, (event.clientX - this.getBoundingClientRect().left - rect.left) / rect.width));
    this.clipPhoto();
  }

  /** @param {KeyboardEvent} event */
  keyHandle(event) {
    const by = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (!by) return;
    event.stopPropagation();
    event.preventDefault();
    this.split = Math.min(1, Math.max(0, this.split + by));
    this.stale = true;
    this.clipPhoto();
  }
}

/** @param {string} hex @returns {[number, number, number]} */
export function rgb(hex) {
  const value = parseInt(hex.slice(1), 16);
  return [((value >> 16) & 255) / 255, ((value >> 8) & 255) / 255, (value & 255) / 255];
}

customElements.define("irr-stage", Stage);

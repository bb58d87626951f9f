// <irr-timeline>: the key frames of the camera path over time, and its preview.

import { clock, el } from "./dom.js";
import { icon } from "./icons.js";
import { CLICK_DISTANCE } from "./navigation.js";
import { path } from "./path.js";
import { state } from "./state.js";

/** Seconds by which an arrow key moves a key frame; with Shift, tenfold. */
const ARROW_STEP = 0.1;

class Timeline extends HTMLElement {
  seconds = 0;
  playing = false;
  /** The next frame of the preview. */
  request = 0;
  /** The camera that was shown last. @type {import("./camera.js").Camera | null} */
  camera = null;
  /** The marks of the key frames. They stay when times change, and with them the focus and the pointer that drags one.
   * @type {HTMLButtonElement[]} */
  marks = [];
  /** The dragged key frame: where the pointer went down, the time and the length of the path then, and whether it has moved.
   * @type {{ index: number, x: number, time: number, total: number, moved: boolean } | null} */
  drag = null;

  connectedCallback() {
    this.setAttribute("role", "group");
    this.setAttribute("aria-label", "Camera path");
    this.play = el("button", { type: "button", className: "icon", "aria-label": "Play the path (space)", onclick: () => this.toggle() }, icon("play"));
    this.head = el("div", { className: "head" });
    this.track = el("div", { className: "track" }, this.head);
    this.time = el("span", { className: "quiet" });
    this.append(this.play, this.track, this.time);
    this.track.addEventListener("pointerdown", (event) => this.seek(event));
    this.track.addEventListener("pointermove", (event) => event.buttons && this.seek(event));
    path.addEventListener("change", () => this.show());
    path.addEventListener("toggle", () => this.toggle());
    // Whoever moves the camera ends the preview.
    state.addEventListener("camera", () => (this.playing &&= state.get("camera") === this.camera));
    this.show();
  }

  show() {
    this.hidden = !path.shown || path.keys.length === 0;
    if (this.hidden || path.keys.length < 2) this.playing = false;
    while (this.marks.length < path.keys.length) this.addMark(this.marks.length);
    for (const mark of this.marks.splice(path.keys.length)) mark.remove();
    path.keys.forEach(({ time }, index) => {
      const mark = this.marks[index];
      mark.style.left = this.left(time);
      mark.setAttribute("aria-label", `Key frame ${index + 1} at ${time.toFixed(1)} s`);
      mark.title = `Key frame at ${time.toFixed(1)} s: ${index ? "drag it or press an arrow key to move it, " : ""}Delete removes it`;
    });
    this.tell();
  }

  /** The place of a time on the track, whose scale stays while a key frame is dragged. @param {number} seconds */
  left(seconds) {
    return `${100 * Math.min(1, seconds / Math.max(this.drag?.total ?? path.seconds, 1e-6))}%`;
  }

  /** @param {number} index of the key frame */
  addMark(index) {
    const mark = el("button", { type: "button", className: "key" });
    mark.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      if (event.button !== 0) return;
      mark.setPointerCapture(event.pointerId);
      this.drag = { index, x: event.clientX, time: path.keys[index].time, total: path.seconds, moved: false };
    });
    mark.addEventListener("pointermove", (event) => {
      if (!this.drag) return;
      event.stopPropagation();
      this.dragTo(event.clientX);
    });
    mark.addEventListener("pointerup", () => this.drag?.moved === false && this.lookFrom(index));
    mark.addEventListener("lostpointercapture", () => {
      this.drag = null;
      this.show();
    });
    // The click of a pointer comes after a drag, too.
    mark.addEventListener("click", ({ detail }) => detail === 0 && this.lookFrom(index));
    mark.addEventListener("keydown", (event) => this.keyMark(event, index));
    this.marks.push(mark);
    this.head?.before(mark);
  }

  /** @param {number} x of the pointer, CSS pixels */
  dragTo(x) {
    const { drag, track } = this;
    if (!drag || !track) return;
    drag.moved ||= Math.abs(x - drag.x) >= CLICK_DISTANCE;
    if (drag.moved) path.move(drag.index, drag.time + ((x - drag.x) / track.clientWidth) * drag.total);
  }

  /** @param {KeyboardEvent} event @param {number} index of the key frame */
  keyMark(event, index) {
    const by = { ArrowLeft: -ARROW_STEP, ArrowRight: ARROW_STEP }[event.key];
    if (!by && event.key !== "Delete" && event.key !== "Backspace") return;
    // Otherwise the key would move the camera or delete the selection.
    event.stopPropagation();
    event.preventDefault();
    this.drag = null;
    if (by) return path.move(index, path.keys[index].time + by * (event.shiftKey ? 10 : 1));
    path.remove(index);
    this.marks[Math.min(index, this.marks.length - 1)]?.focus();
  }

  /** Shows the camera of a key frame. @param {number} index */
  lookFrom(index) {
    const { position, rotation, fov } = path.keys[index];
    state.set({ camera: { position, rotation, fov }, view: null });
  }

  tell() {
    if (this.head) this.head.style.left = this.left(this.seconds);
    if (this.time) this.time.textContent = `${clock(this.seconds)} / ${clock(path.seconds)}`;
    this.play?.replaceChildren(icon(this.playing ? "pause" : "play"));
  }

  toggle() {
    if (path.keys.length < 2) return;
    this.playing = !this.playing;
    if (this.seconds >= path.seconds) this.seconds = 0;
    let last = performance.now();
    const frame = (/** @type {number} */ now) => {
      if (!this.playing) return this.tell();
      this.seconds += (now - last) / 1000;
      last = now;
      if (this.seconds >= path.seconds) {
        if (path.loop) this.seconds %= path.seconds;
        else [this.seconds, this.playing] = [path.seconds, false];
      }
      this.look();
      this.request = requestAnimationFrame(frame);
    };
    // A preview that was ended since the last frame would go on beside this one.
    cancelAnimationFrame(this.request);
    this.request = requestAnimationFrame(frame);
  }

  /** @param {PointerEvent} event */
  seek(event) {
    const box = this.track?.getBoundingClientRect();
    if (!box || path.keys.length === 0) return;
    this.seconds = (Math.min(1, Math.max(0, (event.clientX - box.left) / box.width))) * path.seconds;
    this.look();
  }

  /** Shows the camera at the current time. */
  look() {
    this.camera = path.at(this.seconds);
    state.set({ camera: this.camera, view: null });
    this.tell();
  }
}

customElements.define("irr-timeline", Timeline);

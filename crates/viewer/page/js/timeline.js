// <irr-timeline>: the key frames of the camera path over time, and its preview.

import { clock, el } from "./dom.js";
import { icon } from "./icons.js";
import { path } from "./path.js";
import { state } from "./state.js";

class Timeline extends HTMLElement {
  seconds = 0;
  playing = false;
  /** The camera that was shown last. @type {import("./camera.js").Camera | null} */
  camera = null;

  connectedCallback() {
    this.setAttribute("role", "group");
    this.setAttribute("aria-label", "Camera path");
    this.play = el("button", { type: "button", className: "icon", "aria-label": "Play the path (space)", onclick: () => this.toggle() }, icon("play"));
    this.head = el("div", { className: "head" });
    this.track = el("div", { className: "track" });
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
    const total = Math.max(path.seconds, 1e-6);
    const keys = path.keys.map((key, index) => {
      const mark = el("button", { type: "button", className: "key", title: `Key frame at ${key.time.toFixed(1)} s; delete removes it`, "aria-label": `Key frame ${index + 1}` });
      mark.style.left = `${(100 * key.time) / total}%`;
      mark.onclick = () => state.set({ camera: { position: key.position, rotation: key.rotation, fov: key.fov }, view: null });
      mark.addEventListener("pointerdown", (event) => event.stopPropagation());
      mark.addEventListener("keydown", (event) => {
        if (event.key !== "Delete" && event.key !== "Backspace") return;
        // Otherwise the key would delete the selection.
        event.stopPropagation();
        event.preventDefault();
        path.keys.splice(index, 1);
        const first = path.keys[0]?.time ?? 0;
        for (const key of path.keys) key.time -= first;
        path.changed();
      });
      return mark;
    });
    if (this.head) this.track?.replaceChildren(...keys, this.head);
    this.tell();
  }

  tell() {
    const total = path.seconds;
    if (this.head) this.head.style.left = `${(100 * Math.min(this.seconds, total)) / Math.max(total, 1e-6)}%`;
    if (this.time) this.time.textContent = `${clock(this.seconds)} / ${clock(total)}`;
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
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
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

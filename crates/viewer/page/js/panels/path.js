// The panel of the camera path: key frames, timing, files.

import { el, row, section } from "../dom.js";
import { KEY_INTERVAL, path } from "../path.js";
import { state } from "../state.js";

class PathPanel extends HTMLElement {
  connectedCallback() {
    const add = el("button", { type: "button", className: "primary", textContent: "Add this camera", onclick: () => path.add(state.get("camera")) });
    const views = el("button", { type: "button", textContent: "From the views", title: "Up to twelve of the views, evenly spaced", onclick: () => this.fromViews() });
    const clear = el("button", { type: "button", textContent: "Clear", onclick: () => {
      path.keys = [];
      path.changed();
    } });
    const seconds = el("input", { type: "number", min: "0.1", step: "0.5" });
    seconds.onchange = () => stretch(Number(seconds.value));
    const fps = el("input", { type: "number", min: "1", max: "120", step: "1" });
    fps.onchange = () => {
      path.fps = Math.min(120, Math.max(1, Math.round(Number(fps.value) || 30)));
      path.changed();
    };
    const loop = el("input", { type: "checkbox", onchange: () => {
      path.loop = loop.checked;
      path.changed();
    } });
    const ease = el("input", { type: "checkbox", onchange: () => {
      path.ease = ease.checked;
      path.changed();
    } });
    const save = el("button", { type: "button", textContent: "Save", onclick: () => this.save() });
    const file = el("input", { type: "file", accept: ".json,application/json", hidden: true, onchange: () => this.load(file) });
    const open = el("button", { type: "button", textContent: "Open", onclick: () => file.click() });
    const count = el("p", { className: "note" });
    this.append(
      section("Key frames", el("div", { className: "row wrap" }, add, views, clear), count),
      section("Timing", row("Seconds", seconds), row("Frames/s", fps),
        el("div", { className: "columns" }, el("label", { className: "check" }, loop, "Loop"), el("label", { className: "check" }, ease, "Ease in and out"))),
      section("File", el("div", { className: "row" }, save, open, file),
        el("p", { className: "note", textContent: "Render it to frames or a film: irradia render RUN --path path.json --out film.mp4" })),
    );
    const show = () => {
      count.textContent = path.keys.length ? `${path.keys.length} key frames, ${path.seconds.toFixed(1)} s` : "Fly somewhere and add the camera; the timeline appears below.";
      seconds.value = path.seconds.toFixed(1);
      seconds.disabled = path.keys.length < 2;
      fps.value = `${path.fps}`;
      [loop.checked, ease.checked, ease.disabled] = [path.loop, path.ease, path.loop];
      save.disabled = path.keys.length === 0;
    };
    path.addEventListener("change", show);
    show();
    state.watch(["tab", "sidebar"], () => {
      path.shown = state.get("tab") === "path";
      path.changed();
    });
  }

  fromViews() {
    const views = state.get("views");
    const count = Math.min(12, views.length);
    path.keys = Array.from({ length: count }, (_, i) => {
      const view = views[Math.floor((i * views.length) / count)];
      return { time: KEY_INTERVAL * i, position: view.position, rotation: view.rotation, fov: 2 * Math.atan(view.height / 2 / view.fy) };
    });
    path.changed();
  }

  save() {
    const address = URL.createObjectURL(new Blob([JSON.stringify(path, null, 1)], { type: "application/json" }));
    const link = el("a", { href: address, download: "path.json" });
    link.click();
    URL.revokeObjectURL(address);
  }

  /** @param {HTMLInputElement} input */
  async load(input) {
    const file = input.files?.[0];
    input.value = "";
    try {
      if (file) path.read(JSON.parse(await file.text()));
    } catch (error) {
      state.set({ problem: error instanceof SyntaxError ? "This file is not JSON" : String(/** @type {Error} */ (error).message) });
    }
  }
}

/** Scales all times so that the path takes `seconds`. @param {number} seconds */
function stretch(seconds) {
  const factor = seconds / path.seconds;
  if (!(factor > 0) || !Number.isFinite(factor)) return;
  for (const key of path.keys) key.time *= factor;
  path.closing *= factor;
  path.changed();
}

customElements.define("irr-path-panel", PathPanel);

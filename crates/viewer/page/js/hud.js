// Small things on the stage: status, legend, axes, comparison, hints.

import { AXIS_COLORS } from "./overlay.js";
import { axes, length, subtract } from "./math.js";
import { MODES, stage } from "./commands.js";
import { choose, el, segments, short } from "./dom.js";
import { state } from "./state.js";
import { distanceText, metresPerUnit, world } from "./units.js";

/** @typedef {import("./math.js").Vec3} Vec3 */

const RAMPS = {
  even: "linear-gradient(90deg,#440154,#472d7b,#3b528b,#2c728e,#21918c,#28ae80,#5ec962,#addc30,#fde725)",
  heat: "linear-gradient(90deg,#05050f,#730f52,#db3833,#fca638,#fffad9)",
  grey: "linear-gradient(90deg,#000,#fff)",
};

/** Milliseconds for which a message is shown. */
const MESSAGE_TIMEOUT = 5000;

class Hud extends HTMLElement {
  connectedCallback() {
    const owner = stage();
    const status = el("div", { className: "chip status" });
    const tool = el("div", { className: "chip", hidden: true, role: "status" });
    const message = el("div", { className: "chip message", hidden: true, role: "status" });
    const lost = el("div", { className: "chip lost", hidden: true, role: "alert" });
    const legend = el("div", { className: "chip legend", hidden: true });
    const compare = this.comparison();
    owner.append(
      el("div", { className: "corner top" }, lost, compare, tool, message),
      el("div", { className: "corner bottom-left" }, status),
      el("div", { className: "corner bottom-right" }, legend),
      el("div", { className: "corner top-right" }, gizmo(owner)),
    );

    owner.addEventListener("drawing", () => {
      const { shown, times, local } = owner;
      const header = shown?.header;
      const size = owner.drawsLocally ? `${local?.canvas?.width} × ${local?.canvas?.height}` : header ? `${header.width} × ${header.height}` : "";
      const where = owner.drawsLocally
        ? `here${local && local.loaded < (local.total ?? 0) ? `, ${Math.round((100 * local.loaded) / (local.total ?? 1))} % loaded` : ""}`
        : `server ${header ? header.milliseconds.toFixed(0) : "–"} ms`;
      status.textContent = `${times.length > 1 ? `${times.length} fps · ` : ""}${size} · ${where}`;
      legend.replaceChildren(...legendOf(header));
      legend.hidden = !header?.range || owner.drawsLocally;
    });
    state.watch(["connection"], () => {
      const connection = state.get("connection");
      lost.hidden = connection === "open" || connection === "connecting";
      lost.textContent = connection === "full" ? "Too many pages are open: waiting until one is closed" : "Connection lost: reconnecting";
    });
    state.watch(["tool", "measured", "metres", "scene"], () => {
      const [a, b] = state.get("measured");
      const hints = /** @type {Record<string, string>} */ ({ inspect: "Click a splat; Escape to stop", measure: "Click two points on surfaces; Escape to stop" });
      const text = hints[state.get("tool")] ?? "";
      tool.textContent = state.get("tool") === "measure" && a && b ? distanceText(length(subtract(a, b))) : text;
      tool.hidden = !text;
    });
    state.addEventListener("problem", () => {
      const text = state.get("problem");
      if (!text) return;
      message.textContent = text;
      message.hidden = false;
      clearTimeout(this.hiding);
      this.hiding = setTimeout(() => {
        message.hidden = true;
        state.set({ problem: null });
      }, MESSAGE_TIMEOUT);
    });
  }

  /** The controls that are shown while the camera is in a view. */
  comparison() {
    const name = el("span", { className: "chip" });
    const group = segments("Compare with the photograph", [
      ["none", "Picture"], ["slider", "Slider"], ["blink", "Blink"], ["error", "Error"],
    ], (compare) => state.set({ compare: /** @type {any} */ (compare) }));
    const box = el("div", { className: "compare" }, name, group);
    state.watch(["view", "views", "compare", "scores"], () => {
      const view = state.insideView;
      box.hidden = !view;
      if (!view) return;
      const psnr = state.get("scores").get(state.get("view") ?? -1);
      name.textContent = `${view.name.split("/").pop()}${typeof psnr === "number" ? ` · ${psnr.toFixed(2)} dB` : ""}`;
      group.hidden = !view.photo;
      choose(group, state.get("compare"));
    });
    return box;
  }
}

/** @param {import("./connection.js").Header | null | undefined} header */
function legendOf(header) {
  if (!header?.range) return [];
  const error = state.comparison === "error";
  const mode = error ? "error" : state.get("mode");
  const name = error ? "Mean error" : (MODES.find(([value]) => value === mode)?.[1] ?? "");
  const [low, high] = header.range;
  const metres = mode === "depth" ? metresPerUnit() : null;
  const text = (/** @type {number} */ value) => short(metres ? value * metres : Number((mode === "depth" ? value / world().scale : value).toPrecision(3)));
  const ramp = el("div", { className: "ramp" });
  ramp.style.background = error ? RAMPS.heat : mode === "alpha" ? RAMPS.grey : RAMPS.even;
  // Near is light.
  const [left, right] = mode === "depth" ? [high, low] : [low, high];
  return [ramp, el("span", { textContent: text(left) }), el("span", { textContent: metres ? `${name}, m` : name, className: "quiet" }), el("span", { textContent: text(right) })];
}

/** The six directions of the axes: a click on one looks along it. @param {import("./stage.js").Stage} owner */
function gizmo(owner) {
  const ns = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(ns, "svg");
  svg.setAttribute("viewBox", "-38 -38 76 76");
  svg.classList.add("gizmo");
  const make = (/** @type {string} */ name, /** @type {Record<string, string | number>} */ attributes) => {
    const element = document.createElementNS(ns, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
    return element;
  };
  const ends = [0, 1, 2].flatMap((axis) => [1, -1].map((sign) => {
    const from = /** @type {Vec3} */ ([0, 1, 2].map((c) => (c === axis ? sign : 0)));
    const group = make("g", { role: "button", tabindex: 0, "aria-label": `Look from ${sign > 0 ? "+" : "−"}${"xyz"[axis]}` });
    const stem = make("line", { stroke: AXIS_COLORS[axis], "stroke-width": sign > 0 ? 2 : 0 });
    const ball = make("circle", { r: sign > 0 ? 8 : 6, fill: AXIS_COLORS[axis], "fill-opacity": sign > 0 ? 1 : 0.35, stroke: AXIS_COLORS[axis] });
    const letter = make("text", {});
    letter.textContent = sign > 0 ? "xyz"[axis] : "";
    group.append(stem, ball, letter);
    const look = () => owner.navigation?.along(from);
    group.addEventListener("click", look);
    group.addEventListener("keydown", (event) => ["Enter", " "].includes(/** @type {KeyboardEvent} */ (event).key) && look());
    return { group, stem, ball, letter, from };
  }));
  svg.append(...ends.map(({ group }) => group));
  const place = () => {
    const [right, down, ahead] = axes((owner.shown?.camera ?? state.get("camera")).rotation);
    const at = (/** @type {Vec3} */ v) => [right, down, ahead].map((axis) => axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2]);
    const order = ends.map((end) => ({ end, place: at(end.from) })).sort((a, b) => b.place[2] - a.place[2]);
    for (const { end, place: [x, y] } of order) {
      const [cx, cy] = [`${28 * x}`, `${28 * y}`];
      end.ball.setAttribute("cx", cx);
      end.ball.setAttribute("cy", cy);
      end.letter.setAttribute("x", cx);
      end.letter.setAttribute("y", cy);
      end.stem.setAttribute("x2", cx);
      end.stem.setAttribute("y2", cy);
    }
    // Nearest last, so that it is on top; not reordered while an end has the keyboard focus.
    if (!svg.contains(document.activeElement)) svg.append(...order.map(({ end }) => end.group));
  };
  place();
  // With each picture, not with every change of the camera in between.
  owner.addEventListener("drawing", place);
  return svg;
}

customElements.define("irr-hud", Hud);
document.querySelector("main")?.append(document.createElement("irr-hud"));

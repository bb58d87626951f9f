// The panel of the views: thumbnails, PSNR, and a jump to each view.

import { choose, el, press, section, segments } from "../dom.js";
import { connection, pictureOf } from "../connection.js";
import { stage } from "../commands.js";
import { state } from "../state.js";

class ViewsPanel extends HTMLElement {
  order = "name";
  /** Of each view. @type {HTMLButtonElement[]} */
  entries = [];

  connectedCallback() {
    const measure = el("button", { type: "button", textContent: "Measure PSNR", title: "Renders every view and compares it with its photograph", onclick: () => connection.send({ do: "scores" }) });
    const order = segments("Order", [["name", "By name"], ["worst", "Worst first"]], (value) => {
      this.order = value;
      choose(order, value);
      this.list();
      this.mark();
    });
    choose(order, this.order);
    this.summary = el("p", { className: "note" });
    this.body = el("div", { className: "views" });
    this.append(section("Views", el("div", { className: "row wrap" }, measure, order), this.summary, this.body));
    state.addEventListener("scores", () => this.list());
    state.addEventListener("view", () => this.mark());
    // Not with the views, which move with the scene: their names and photographs are those of the greeting.
    state.watch(["hello"], () => {
      measure.disabled = !state.get("views").some((view) => view.photo);
      this.entries = state.get("views").map((view, index) => entry(view, index));
      this.list();
      this.mark();
    });
  }

  /** Shows scores and order. The entries stay, and with them the focus and how far the list is scrolled. */
  list() {
    const [views, scores] = [state.get("views"), state.get("scores")];
    const body = this.body;
    if (!body || !this.summary) return;
    for (const [index, button] of this.entries.entries()) {
      const psnr = scores.get(index);
      /** @type {Element} */ (button.lastElementChild).textContent = typeof psnr === "number" ? psnr.toFixed(2) : "";
    }
    const indices = views.map((_, index) => index);
    const score = (/** @type {number} */ index) => scores.get(index) ?? Infinity;
    if (this.order === "worst") indices.sort((a, b) => score(a) - score(b));
    const sorted = indices.map((index) => this.entries[index]);
    if (sorted.length !== body.children.length || sorted.some((button, at) => button !== body.children[at])) {
      const focused = document.activeElement;
      body.replaceChildren(...sorted);
      if (focused instanceof HTMLElement && body.contains(focused)) focused.focus({ preventScroll: true });
    }
    const mean = (/** @type {boolean} */ trained) => {
      const known = views.map((view, i) => (view.trained === trained ? scores.get(i) : null)).filter((value) => typeof value === "number");
      return known.length ? `${(known.reduce((a, b) => a + b, 0) / known.length).toFixed(2)} dB over ${known.length}` : null;
    };
    const parts = [["Held out", mean(false)], ["Trained", mean(true)]].filter(([, text]) => text).map(([name, text]) => `${name}: ${text}`);
    this.summary.textContent = parts.join(" · ") || (views.length ? "" : "No cameras are known for this scene.");
  }

  /** Marks the view that the camera is in. */
  mark() {
    for (const [index, button] of this.entries.entries()) {
      const inside = index === state.get("view");
      press(button, inside);
      if (inside) button.scrollIntoView({ block: "nearest" });
    }
  }
}

/** A button that enters a view. @param {import("../camera.js").View} view @param {number} index */
function entry(view, index) {
  const picture = view.photo
    ? el("img", { src: pictureOf(index, "thumbnail"), loading: "lazy", alt: "", width: 56, height: 38 })
    : el("span", { className: "blank" });
  return el("button", { type: "button", title: view.name, onclick: () => stage().navigation?.enter(index) }, picture,
    el("span", { className: "name" }, view.name.split("/").pop() ?? "", el("span", { className: "kind", textContent: view.trained ? "trained" : "held out" })),
    el("span"));
}

customElements.define("irr-views-panel", ViewsPanel);

// The panel of the views: thumbnails, PSNR, and a jump to each view.

import { choose, el, section, segments } from "../dom.js";
import { connection, pictureOf } from "../connection.js";
import { stage } from "../commands.js";
import { state } from "../state.js";

class ViewsPanel extends HTMLElement {
  order = "name";

  connectedCallback() {
    const measure = el("button", { type: "button", textContent: "Measure PSNR", title: "Renders every view and compares it with its photograph", onclick: () => connection.send({ do: "scores" }) });
    const order = segments("Order", [["name", "By name"], ["worst", "Worst first"]], (value) => {
      this.order = value;
      choose(order, value);
      this.list();
    });
    choose(order, this.order);
    this.summary = el("p", { className: "note" });
    this.body = el("div", { className: "views" });
    this.append(section("Views", el("div", { className: "row wrap" }, measure, order), this.summary, this.body));
    state.watch(["views", "scores"], () => this.list());
    state.watch(["view"], () => this.mark());
    state.watch(["hello"], () => (measure.disabled = !state.get("views").some((view) => view.photo)));
  }

  list() {
    const [views, scores] = [state.get("views"), state.get("scores")];
    if (!this.body || !this.summary) return;
    const indices = views.map((_, index) => index);
    const score = (/** @type {number} */ index) => scores.get(index) ?? Infinity;
    if (this.order === "worst") indices.sort((a, b) => score(a) - score(b));
    this.body.replaceChildren(...indices.map((index) => this.entry(index)));
    const mean = (/** @type {boolean} */ trained) => {
      const known = views.map((view, i) => (view.trained === trained ? scores.get(i) : null)).filter((value) => typeof value === "number");
      return known.length ? `${(known.reduce((a, b) => a + b, 0) / known.length).toFixed(2)} dB over ${known.length}` : null;
    };
    const parts = [["Held out", mean(false)], ["Trained", mean(true)]].filter(([, text]) => text).map(([name, text]) => `${name}: ${text}`);
    this.summary.textContent = parts.join(" · ") || (views.length ? "" : "No cameras are known for this scene.");
    this.mark();
  }

  /** @param {number} index */
  entry(index) {
    const view = state.get("views")[index];
    const psnr = state.get("scores").get(index);
    const picture = view.photo
      ? el("img", { src: pictureOf(index, "thumbnail"), loading: "lazy", alt: "", width: 56, height: 38 })
      : el("span", { className: "blank" });
    const button = el("button", { type: "button", title: view.name, onclick: () => stage().navigation?.enter(index) }, picture,
      el("span", { className: "name" }, view.name.split("/").pop() ?? "", el("span", { className: "kind", textContent: view.trained ? "trained" : "held out" })),
      el("span", { textContent: typeof psnr === "number" ? psnr.toFixed(2) : "" }));
    button.dataset.index = `${index}`;
    return button;
  }

  mark() {
    for (const button of this.body?.querySelectorAll("button") ?? []) {
      const inside = Number(button.dataset.index) === state.get("view");
      button.setAttribute("aria-pressed", String(inside));
      if (inside) button.scrollIntoView({ block: "nearest" });
    }
  }
}

customElements.define("irr-views-panel", ViewsPanel);

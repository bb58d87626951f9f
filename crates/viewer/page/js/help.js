// <irr-help>: all keys on one sheet.

import { COMMANDS } from "./commands.js";
import { el } from "./dom.js";

/** @type {[string, string][]} */
const POINTER = [
  ["Drag", "Turn; fly and walk: look"], ["Shift drag", "Move sideways"], ["Wheel, pinch", "Nearer, farther"], ["Two fingers", "Move and zoom"],
  ["Double click", "Pivot on the surface"], ["W A S D Q E", "Move"],
];

class Help extends HTMLElement {
  connectedCallback() {
    const group = (/** @type {string} */ name, /** @type {[string, string][]} */ rows) =>
      el("div", {}, el("h2", { textContent: name }), el("div", { className: "keys" }, ...rows.flatMap(([key, text]) => [el("kbd", { textContent: key }), el("span", { textContent: text })])));
    const named = (/** @type {string} */ key) => ({ " ": "Space", Escape: "Esc", Delete: "Del" })[key] ?? key.replaceAll("+", " ").toUpperCase();
    const groups = Object.entries(COMMANDS).map(([name, commands]) =>
      group(name, commands.filter(({ name }) => name).map(({ keys, name }) => [named(keys), name])));
    const close = el("button", { type: "button", textContent: "Close", className: "primary", onclick: () => dialog.close() });
    const dialog = el("dialog", { "aria-label": "Keys" }, el("h1", { textContent: "Keys and gestures" }),
      el("div", { className: "sheet" }, group("Pointer", POINTER), ...groups), el("p", { className: "note" }, close));
    dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
    this.append(dialog);
    this.addEventListener("open", () => dialog.showModal());
  }
}

customElements.define("irr-help", Help);

// <irr-sidebar>: the panels, one at a time.

import "./panels/display.js";
import "./panels/views.js";
import "./panels/training.js";
import "./panels/path.js";
import "./panels/edit.js";
import { el } from "./dom.js";
import { state } from "./state.js";

const TABS = [["display", "Scene"], ["views", "Views"], ["training", "Training"], ["path", "Path"], ["edit", "Edit"]];

class Sidebar extends HTMLElement {
  connectedCallback() {
    this.setAttribute("role", "complementary");
    this.setAttribute("aria-label", "Panel");
    const panels = TABS.map(([name]) => document.createElement(`irr-${name}-panel`));
    const buttons = TABS.map(([name, text], i) => {
      panels[i].id = `panel-${name}`;
      panels[i].setAttribute("role", "tabpanel");
      panels[i].setAttribute("aria-label", text);
      return el("button", { type: "button", role: "tab", textContent: text, "aria-controls": `panel-${name}`, onclick: () => state.set({ tab: name }) });
    });
    const tabs = el("div", { className: "tabs", role: "tablist" }, ...buttons);
    tabs.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      const shown = buttons.filter((button) => !button.hidden);
      const at = shown.findIndex((button) => button === document.activeElement);
      if (!by || at < 0) return;
      const next = shown[(at + by + shown.length) % shown.length];
      next.focus();
      next.click();
    });
    this.append(tabs, el("div", { className: "pane" }, ...panels));
    state.watch(["tab", "hello"], () => {
      const live = Boolean(state.get("hello")?.live || state.get("hello")?.recipe);
      const wanted = state.get("tab") === "training" && state.get("hello") && !live ? "display" : state.get("tab");
      TABS.forEach(([name], i) => {
        buttons[i].hidden = name === "training" && !live;
        buttons[i].setAttribute("aria-selected", String(name === wanted));
        buttons[i].tabIndex = name === wanted ? 0 : -1;
        panels[i].hidden = name !== wanted;
      });
    });
    state.watch(["sidebar"], () => (this.hidden = !state.get("sidebar")));
  }
}

customElements.define("irr-sidebar", Sidebar);

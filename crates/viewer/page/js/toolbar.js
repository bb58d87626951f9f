// <irr-toolbar>: what is drawn, the kind of navigation, and the page's buttons.

import { COMMANDS, MODES, offersMode, share, stage, toggleTheme } from "./commands.js";
import { choose, el, press, segments, short } from "./dom.js";
import { icon } from "./icons.js";
import { state } from "./state.js";
import { enterXr, offersXr } from "./xr.js";

class Toolbar extends HTMLElement {
  connectedCallback() {
    const title = el("span", { className: "title" });
    const modes = el("select", { "aria-label": "What is drawn", title: "What is drawn (1 to 8)" });
    for (const [value, name] of MODES) modes.append(el("option", { value, textContent: name }));
    modes.onchange = () => state.set({ mode: modes.value });
    const ways = segments("Navigation", [["orbit", "Orbit", "Turn about the pivot (O)"], ["fly", "Fly", "W A S D Q E and drag (F)"], ["walk", "Walk", "Fly at a constant height (G)"]],
      (navigation) => state.set({ navigation: /** @type {any} */ (navigation) }));
    const drawing = el("select", { "aria-label": "Where the picture is drawn", title: "Where the picture is drawn (L)" },
      el("option", { value: "auto", textContent: "Draw: auto" }), el("option", { value: "served", textContent: "On the server" }), el("option", { value: "local", textContent: "In this browser" }));
    drawing.onchange = () => state.set({ drawing: /** @type {any} */ (drawing.value) });

    const measure = button("measure", "Measure a distance (M)", () => command("m"));
    const inspect = button("inspect", "Inspect a splat (I)", () => command("i"));
    const frusta = button("frusta", "Show cameras (V)", () => command("v"));
    const panel = button("panel", "Show or hide the panel (B)", () => state.set({ sidebar: !state.get("sidebar") }));
    const vr = button("headset", "Enter VR", () => enterXr(stage()));
    vr.hidden = true;
    offersXr().then((offers) => (vr.hidden = !offers));
    this.append(
      el("span", { className: "brand", textContent: "Irradia" }), title, el("span", { className: "spring" }), modes, ways,
      el("span", { className: "divider" }), measure, inspect, frusta,
      button("home", "Home (H)", () => stage().navigation?.home()),
      el("span", { className: "divider" }), wide(drawing), vr,
      button("share", "Share this view: copies an address that contains the camera (U)", share),
      button("theme", "Dark or light theme (T)", toggleTheme),
      button("help", "Keys (?)", () => document.querySelector("irr-help")?.dispatchEvent(new Event("open"))), panel,
    );

    state.watch(["hello", "scene"], () => {
      const [hello, scene] = [state.get("hello"), state.get("scene")];
      const size = scene ? ` · ${short(scene.count)} ${scene.kind === "field" ? "parameters" : scene.kind}` : "";
      title.textContent = hello ? `${hello.title}${size}` : "";
      title.title = title.textContent;
      for (const option of modes.options) option.disabled = !offersMode(option.value);
      drawing.options[2].disabled = Boolean(scene) && !scene?.travels;
    });
    state.watch(["mode"], () => (modes.value = state.get("mode")));
    state.watch(["drawing"], () => (drawing.value = state.get("drawing")));
    state.watch(["navigation"], () => choose(ways, state.get("navigation")));
    state.watch(["tool"], () => {
      press(measure, state.get("tool") === "measure");
      press(inspect, state.get("tool") === "inspect");
    });
    state.watch(["frusta"], () => press(frusta, state.get("frusta")));
    state.watch(["sidebar"], () => press(panel, state.get("sidebar")));
  }
}

/** @param {Parameters<typeof icon>[0]} name @param {string} label @param {() => void} onclick */
function button(name, label, onclick) {
  return el("button", { type: "button", className: "icon", title: label, "aria-label": label, onclick }, icon(name));
}

/** @param {HTMLElement} element hidden on narrow screens */
function wide(element) {
  element.classList.add("wide");
  return element;
}

/** @param {string} key */
function command(key) {
  Object.values(COMMANDS).flat().find(({ keys }) => keys === key)?.run();
}

customElements.define("irr-toolbar", Toolbar);

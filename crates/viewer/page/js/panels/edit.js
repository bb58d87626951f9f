// The panel of editing: tools and measures that select, edits of the selection, the list of edits, files.

import { choose, el, press, row, section, segments } from "../dom.js";
import { ahead, forward } from "../camera.js";
import { icon } from "../icons.js";
import { length, subtract } from "../math.js";
import { TOOLS, isEditTool } from "../edit/tools.js";
import { colors, halfSpace } from "../edit/shapes.js";
import { session } from "../edit/session.js";
import { state } from "../state.js";
import { distanceText, openedMetres } from "../units.js";

/** Names of the ways to combine. @type {[import("../edit/session.js").Mode, string, string][]} */
const MODES = [["replace", "New", "Replaces the selection"], ["add", "Add", "Adds (Shift)"], ["subtract", "Subtract", "Subtracts (Alt)"], ["intersect", "Intersect", "Keeps what is in both (Shift Alt)"]];
/** What a slider selects: value, name, least, largest and first position, step, the shapes at a position, its text, and whether the
 * cameras must be known. @type {[string, string, number, number, number, number, (at: number) => object[], (at: number) => string, boolean?][]} */
const MEASURES = [
  ["floaters", "Floaters", 0.2, 3, 1, 0.02, (at) => [{ shape: "floaters", score: at }], (at) => `≥ ${at.toFixed(2)}`],
  ["subject", "Around the subject", 0.5, 4, 1, 0.05, (at) => [{ shape: "subject", margin: at }, { shape: "invert" }], (at) => `× ${at.toFixed(2)}`, true],
  ["views", "Seen by at most", 0, 20, 2, 1, (at) => [{ shape: "views", max: at }], (at) => `${at} views`, true],
  ["opacity", "Opacity below", 0.01, 1, 0.1, 0.01, (at) => [{ shape: "opacity", max: at }], (at) => at.toFixed(2)],
  ["size", "Larger than", -3, 0, -1, 0.02, (at) => [{ shape: "size", min: radius() * 10 ** at }], (at) => distanceText(radius() * 10 ** at)],
  ["small", "Smaller than", -5, -1, -3, 0.02, (at) => [{ shape: "size", max: radius() * 10 ** at }], (at) => distanceText(radius() * 10 ** at)],
  ["farther", "Farther than", -2, 1, 0, 0.01, (at) => [beyond(radius() * 10 ** at)], (at) => distanceText(radius() * 10 ** at)],
  ["needles", "Needles longer than", 0, 3, 1, 0.02, (at) => [{ shape: "elongation", min: 10 ** at }], (at) => `${(10 ** at).toFixed(1)} : 1`],
  ["clusters", "Islands of at most", 0, 5, 2, 0.1, (at) => [{ shape: "clusters", max: Math.round(10 ** at) }], (at) => `${Math.round(10 ** at)}`],
];
/** The sliders of a colour: key, name, least, largest, neutral, step. @type {[string, string, number, number, number, number][]} */
const COLORS = [
  ["exposure", "Exposure", -3, 3, 0, 0.05], ["temperature", "Temperature", -1, 1, 0, 0.02], ["tint", "Tint", -1, 1, 0, 0.02],
  ["saturation", "Saturation", 0, 2, 1, 0.02], ["contrast", "Contrast", 0, 2, 1, 0.02],
];

const radius = () => state.get("scene")?.radius ?? 1;
/** Everything in this view beyond a plane at a distance. @param {number} distance */
const beyond = (distance) => halfSpace(ahead(state.get("camera"), distance), forward(state.get("camera")));
const count = (/** @type {number} */ value) => value.toLocaleString("en");

class EditPanel extends HTMLElement {
  connectedCallback() {
    const why = el("p", { className: "note" });
    const none = section("Edit", why);
    const all = el("div", {}, this.bar(), this.selecting(), this.changing(), this.coloring(), this.scene(), this.history());
    this.append(none, all);
    state.watch(["hello"], () => {
      const editing = state.get("hello")?.editing;
      all.hidden = !editing?.works;
      none.hidden = all.hidden === false;
      why.textContent = editing?.why ?? "";
    });
    // Leaving this panel ends its tools.
    state.watch(["tab"], () => state.get("tab") !== "edit" && isEditTool(state.get("tool")) && state.set({ tool: "none" }));
  }

  bar() {
    const undo = tool("undo", "Undo (Ctrl Z)", () => session.undo());
    const redo = tool("redo", "Redo (Ctrl Shift Z)", () => session.redo());
    const before = button("Before", "Shows the scene as it was opened", () => session.compare(!state.get("editing")?.before));
    const save = button("Save", "Writes the scene and its list of edits beside the scene's file, as new files", () => session.save());
    const format = el("select", { "aria-label": "Format of the download", title: "Format of the download" });
    const download = button("Download", "The edited scene as a file", () => fetchFile(format.value));
    state.watch(["hello"], () => {
      const formats = /** @type {{ name: string, format: string }[]} */ (state.get("hello")?.formats ?? []);
      format.replaceChildren(...formats.map(({ name }) => el("option", { value: name, textContent: `.${name}` })),
        el("option", { value: "edits.toml", textContent: "edits.toml" }));
    });
    state.watch(["editing"], () => {
      const editing = state.get("editing");
      undo.disabled = !editing?.at;
      redo.disabled = !editing || editing.at === editing.total;
      before.disabled = !editing?.before && !editing?.at;
      press(before, Boolean(editing?.before));
      save.disabled = !editing?.at;
    });
    const file = el("input", { type: "file", accept: ".toml", hidden: true, "aria-label": "edits.toml" });
    file.onchange = async () => {
      const [chosen] = file.files ?? [];
      if (chosen) session.replay(await chosen.text());
      file.value = "";
    };
    const open = button("Open edits", "Applies the edits of an edits.toml file", () => file.click());
    return el("div", { className: "edit-bar" }, el("div", { className: "row" }, undo, redo, before, el("span", { className: "grow" }), save),
      el("div", { className: "row" }, format, download, el("span", { className: "grow" }), open, file));
  }

  selecting() {
    const tools = el("div", { className: "tools", role: "toolbar", "aria-label": "Selection tools" });
    for (const [name, text, image, hint] of TOOLS) {
      const made = tool(image, `${text}: ${hint}`, () => state.set({ tool: state.get("tool") === name ? "none" : name }));
      made.setAttribute("aria-label", text);
      made.dataset.tool = name;
      tools.append(made);
    }
    const modes = segments("Selection mode", MODES, (selectMode) => state.set({ selectMode }));
    const visible = check("Only visible splats", (visibleOnly) => state.set({ visibleOnly }));
    const size = slider(4, 160, 1);
    size.input.oninput = () => state.set({ brush: Number(size.input.value) });
    const brush = row("Radius", size.input, size.value);
    const apart = slider(0.01, 0.5, 0.01);
    apart.input.value = "0.1";
    const swatch = el("span", { className: "swatch" });
    const tolerance = row("Tolerance", apart.input, swatch);
    const pick = () => {
      const dropped = state.get("dropped");
      if (dropped) session.select([colors(dropped.color, Number(apart.input.value))], dropped.mode, session.live("color"));
    };
    apart.input.oninput = pick;
    state.addEventListener("dropped", () => {
      session.renew("color");
      pick();
    });
    const hint = el("p", { className: "note" });
    state.watch(["tool", "brush", "visibleOnly", "selectMode", "dropped"], () => {
      const now = state.get("tool");
      for (const made of tools.querySelectorAll("button")) press(made, made.dataset.tool === now);
      choose(modes, state.get("selectMode"));
      visible.input.checked = state.get("visibleOnly");
      visible.label.hidden = !["rectangle", "lasso", "polygon", "brush"].includes(now);
      brush.hidden = now !== "brush";
      size.input.value = `${state.get("brush")}`;
      size.value.textContent = `${state.get("brush")} px`;
      tolerance.hidden = now !== "color";
      swatch.style.background = `rgb(${(state.get("dropped")?.color ?? [0, 0, 0]).map((v) => Math.round(255 * v)).join(" ")})`;
      const chosen = TOOLS.find(([name]) => name === now);
      hint.textContent = chosen ? `${chosen[3]}. The right button turns the view.` : "";
      hint.hidden = !chosen;
    });
    return section("Select", tools, el("div", { className: "row" }, modes), visible.label, brush, tolerance, hint, this.measuring(), this.selection());
  }

  /** Selects by a measure, live. */
  measuring() {
    const which = el("select", { "aria-label": "Select by a measure" }, el("option", { value: "", textContent: "By a measure …" }),
      ...MEASURES.map(([value, textContent]) => el("option", { value, textContent })));
    state.watch(["views"], () => {
      const known = state.get("views").length > 0;
      for (const option of which.options) option.hidden = !known && Boolean(MEASURES.find(([value]) => value === option.value)?.[8]);
    });
    const at = slider(0, 1, 0.01);
    at.input.setAttribute("aria-label", "Threshold");
    const body = el("div", { className: "row" }, at.input, at.value);
    const chosen = () => MEASURES.find(([value]) => value === which.value);
    const apply = () => {
      const measure = chosen();
      if (!measure) return;
      at.value.textContent = measure[7](Number(at.input.value));
      const shapes = measure[6](Number(at.input.value));
      // A step that inverts would also invert the previous selection.
      session.select(shapes, shapes.length > 1 ? "replace" : state.get("selectMode"), session.live("measure"));
    };
    which.onchange = () => {
      const measure = chosen();
      body.hidden = !measure;
      if (!measure) return;
      const [, name, min, max, first, step] = measure;
      Object.assign(at.input, { min: `${min}`, max: `${max}`, step: `${step}` });
      at.input.value = `${first}`;
      at.input.setAttribute("aria-label", name);
      session.renew("measure");
      apply();
    };
    at.input.oninput = apply;
    body.hidden = true;
    return el("div", { className: "measure" }, el("div", { className: "row" }, which), body);
  }

  /** The number of selected splats, and commands that change the whole selection. */
  selection() {
    const summary = el("p", { className: "count", role: "status" });
    const highlight = check("Highlight", (highlight) => state.set({ highlight }));
    const all = button("All", "Selects everything (Ctrl A)", () => session.select([{ shape: "all" }], "replace"));
    const invert = button("Invert", "Selects what is not selected (Ctrl I)", () => session.select([{ shape: "invert" }], "add"));
    const grow = button("Grow", "Adds what is close", () => session.select([{ shape: "grow", by: 0.01 * radius() }], "add"));
    const connected = button("Connected", "Adds what is connected with the selection", () => session.select([{ shape: "connected" }], "add"));
    const none = button("None", "Selects nothing (Ctrl D)", () => session.deselect());
    state.watch(["editing", "highlight"], () => {
      const editing = state.get("editing");
      const some = Boolean(editing?.selected);
      summary.textContent = editing ? `${count(editing.selected)} of ${count(editing.of)} selected` : "";
      for (const made of [grow, connected, none, invert]) made.disabled = !some;
      highlight.input.checked = state.get("highlight");
      this.classList.toggle("busy", Boolean(editing?.busy));
    });
    return el("div", {}, el("div", { className: "fill" }, all, none, invert, grow, connected),
      el("div", { className: "row" }, summary, highlight.label));
  }

  changing() {
    const edits = [
      button("Delete", "Deletes the selection (Delete)", () => session.edit({ op: "delete" })),
      button("Keep", "Deletes everything else", () => session.edit({ op: "keep" })),
      button("Duplicate", "Adds a copy and selects it", () => session.edit({ op: "duplicate", by: [0, 0, 0] })),
      button("Hide", "Leaves the selection out of pictures and files", () => session.edit({ op: "hide" })),
      button("Lock", "Locks the selection, so that it cannot be selected", () => session.edit({ op: "lock" })),
      button("Split off", "Moves the selection into a separate scene, which Save writes", () => session.edit({ op: "split", name: "part" })),
    ];
    const show = button("", "Shows what is hidden", () => session.edit({ op: "show" }, true));
    const unlock = button("", "Makes locked splats selectable again", () => session.edit({ op: "unlock" }, true));
    const ways = segments("Handles", [["none", "Off"], ["move", "Move"], ["rotate", "Rotate"], ["scale", "Scale"]],
      (transform) => state.set({ transform: /** @type {any} */ (transform) }));
    state.watch(["editing", "transform"], () => {
      const editing = state.get("editing");
      for (const made of edits) made.disabled = !editing?.selected;
      show.textContent = `Show ${count(editing?.hidden ?? 0)} hidden`;
      unlock.textContent = `Unlock ${count(editing?.locked ?? 0)}`;
      [show.hidden, unlock.hidden] = [!editing?.hidden, !editing?.locked];
      choose(ways, state.get("transform"));
    });
    return section("Selection", el("div", { className: "buttons" }, ...edits), el("div", { className: "row wrap" }, show, unlock),
      line("Handles", ways));
  }

  coloring() {
    const of = el("span", { className: "quiet" });
    const sliders = COLORS.map(([key, name, min, max, neutral, step]) => ({ key, neutral, name, ...slider(min, max, step) }));
    const whole = () => !state.get("editing")?.selected;
    const values = () => Object.fromEntries(sliders.map(({ key, input }) => [key, Number(input.value)]));
    const opacity = slider(0, 2, 0.02);
    for (const { input } of sliders) input.oninput = () => session.edit({ op: "recolor", ...values() }, whole(), session.live("recolor"));
    opacity.input.oninput = () => session.edit({ op: "opacity", factor: Number(opacity.input.value) }, whole(), session.live("opacity"));
    state.watch(["editing"], () => {
      // Sliders show the last edit; after another action they return to neutral.
      if (!session.isLive("recolor")) for (const { input, neutral } of sliders) input.value = `${neutral}`;
      if (!session.isLive("opacity")) opacity.input.value = "1";
      for (const { input, value } of sliders) value.textContent = Number(input.value).toFixed(2);
      opacity.value.textContent = `× ${Number(opacity.input.value).toFixed(2)}`;
      of.textContent = whole() ? "Applies to the whole scene" : "Applies to the selection";
    });
    return section("Colour", ...sliders.map(({ name, input, value }) => row(name, input, value)), row("Opacity", opacity.input, opacity.value), el("p", { className: "note" }, of));
  }

  scene() {
    const found = button("Find", "Finds the up axis and the ground from the cameras and the densest plane", () => session.edit({ op: "upright" }, true));
    state.watch(["views"], () => (found.hidden = state.get("views").length === 0));
    const view = button("This view's up", "Turns the scene so that the up axis of the Scene panel points up in its file", () => session.edit({ op: "upright", up: state.get("up") }, true));
    const known = el("input", { type: "number", min: "0", step: "any", placeholder: "metres", "aria-label": "Metres between the points" });
    const measure = button("Measure", "Click two points (M)", () => state.set({ tool: "measure", measured: [] }));
    const set = button("Set scale", "Scales the scene to metres", () => {
      const [a, b] = state.get("measured");
      const metres = Number(known.value);
      if (!(metres > 0)) return;
      state.set({ metres: openedMetres(length(subtract(a, b)), metres) });
      session.edit({ op: "set-length", from: a, to: b, length: metres }, true);
    });
    const other = el("input", { type: "file", hidden: true, "aria-label": "Scene to merge" });
    other.onchange = async () => {
      const [chosen] = other.files ?? [];
      if (chosen) await session.merge(chosen);
      other.value = "";
    };
    const merge = button("Merge", "Adds the splats of another scene and selects them", () => other.click());
    const number = el("input", { type: "number", min: "1", step: "1000", "aria-label": "Number of splats to keep" });
    const reduce = button("Reduce", "Keeps the splats that cover the most", () => {
      if (Number(number.value) >= 1) session.edit({ op: "reduce", count: Math.round(Number(number.value)) }, true);
    });
    state.watch(["measured", "editing"], () => {
      set.disabled = state.get("measured").length < 2;
      const of = state.get("editing")?.of ?? 0;
      if (document.activeElement !== number) number.value = `${Math.round(of / 2)}`;
    });
    return section("Scene", line("Upright", found, view), line("Scale", measure), el("div", { className: "row" }, known, set), row("Splats", number, reduce), line("Another scene", merge, other));
  }

  history() {
    const list = el("ol", { className: "history", "aria-label": "History of edits" });
    const saved = el("p", { className: "note", role: "status" });
    state.watch(["editing"], () => {
      const editing = state.get("editing");
      if (!editing) return;
      const entry = (/** @type {number} */ at, /** @type {string} */ text, /** @type {string} */ kind) => {
        const made = el("button", { type: "button", className: kind, textContent: text, onclick: () => session.go(at) });
        if (at === editing.at) made.setAttribute("aria-current", "step");
        made.classList.toggle("undone", at > editing.at);
        return el("li", {}, made);
      };
      const opened = editing.first === 0 ? [entry(0, "Opened", "edit")] : [];
      list.replaceChildren(...opened, ...editing.entries.map(({ text, kind }, i) => entry(editing.first + i + 1, text, kind)));
      const current = list.querySelector("[aria-current]");
      if (current instanceof HTMLElement) list.scrollTop = current.offsetTop - list.clientHeight / 2;
      saved.textContent = editing.saved ?? "";
      saved.hidden = !editing.saved;
    });
    return section("History", list, saved);
  }
}

/** @param {string} text @param {string} title @param {() => void} onclick */
const button = (text, title, onclick) => el("button", { type: "button", textContent: text, title, onclick });

/** @param {Parameters<typeof icon>[0]} name @param {string} label @param {() => void} onclick */
const tool = (name, label, onclick) => el("button", { type: "button", className: "icon", title: label, "aria-label": label, onclick }, icon(name));

/** A row of controls that have their own names. @param {string} label @param {...Node} controls */
const line = (label, ...controls) => el("div", { className: "row" }, el("span", { className: "label", textContent: label }), ...controls);

/** @param {number} min @param {number} max @param {number} step */
function slider(min, max, step) {
  const input = el("input", { type: "range", min: `${min}`, max: `${max}`, step: `${step}`, className: "grow" });
  return { input, value: el("span", { className: "value" }) };
}

/** @param {string} text @param {(on: boolean) => void} change */
function check(text, change) {
  const input = el("input", { type: "checkbox", onchange: () => change(input.checked) });
  return { input, label: el("label", { className: "check" }, input, text) };
}

/** @param {string} name of a format */
function fetchFile(name) {
  el("a", { href: `download/${name}${location.search}`, download: "" }).click();
}

customElements.define("irr-edit-panel", EditPanel);

// The panel of the scene: what is drawn and how, clipping, measuring, the splat under the pointer.

import { el, facts, row, section, segments, short } from "../dom.js";
import { connection } from "../connection.js";
import { add, length, lookAt, scale, subtract } from "../math.js";
import { stage } from "../commands.js";
import { state } from "../state.js";
import { distanceText, metresPerUnit, openedMetres, world } from "../units.js";

/** @typedef {import("../math.js").Vec3} Vec3 */

class DisplayPanel extends HTMLElement {
  connectedCallback() {
    this.append(this.about(), this.picture(), this.camera(), this.clipping(), this.measuring(), this.inspecting());
  }

  about() {
    const body = el("div");
    let drawn = "";
    const tell = () => {
      const scene = state.get("scene");
      const warnings = state.get("hello")?.warnings ?? [];
      if (!scene) return;
      body.replaceChildren(
        facts([
          ["Kind", scene.kind], [scene.kind === "field" ? "Parameters" : "Splats", scene.count.toLocaleString("en")],
          ...(scene.kind === "field" ? [] : /** @type {[string, string][]} */ ([["Harmonics", `degree ${scene.sh_degree}`]])),
          ["Views", `${state.get("views").length}`], ["Drawn", drawn],
        ]),
        ...warnings.map((/** @type {string} */ text) => el("p", { className: "note", textContent: text })),
      );
    };
    state.watch(["scene", "hello"], tell);
    stage().addEventListener("drawing", () => {
      const now = drawnBy();
      if (now === drawn) return;
      drawn = now;
      tell();
    });
    return section("Scene", body);
  }

  picture() {
    const background = el("input", { type: "color", "aria-label": "Background" });
    background.oninput = () => state.set({ background: background.value });
    const own = el("button", { type: "button", textContent: "Scene's own", onclick: () => state.set({ background: null }) });
    state.watch(["scene", "background"], () => {
      const hex = (/** @type {number} */ v) => Math.round(v * 255).toString(16).padStart(2, "0");
      background.value = state.get("background") ?? `#${(state.get("scene")?.background ?? [0, 0, 0]).map(hex).join("")}`;
      own.disabled = state.get("background") === null;
    });
    const light = el("select", { className: "grow", onchange: () => state.set({ light: light.value === "" ? null : Number(light.value) }) });
    const lights = row("Light", light);
    lights.title = "Shows the scene in the light of one photograph, with the exposure that the training has learned";
    state.watch(["scene", "views", "light"], () => {
      const views = state.get("views");
      lights.hidden = !state.get("scene")?.lights;
      if (light.options.length !== 1 + views.filter((view) => view.trained).length) {
        const own = views.flatMap((view, index) => view.trained ? [el("option", { value: `${index}`, textContent: view.name })] : []);
        light.replaceChildren(el("option", { value: "", textContent: "The mean of the photographs" }), ...own);
      }
      light.value = `${state.get("light") ?? ""}`;
    });
    const frusta = check("Cameras", (on) => state.set({ frusta: on }));
    const axes = check("Pivot axes", (on) => state.set({ axes: on }));
    state.watch(["frusta"], () => (frusta.input.checked = state.get("frusta")));
    state.watch(["axes"], () => (axes.input.checked = state.get("axes")));
    return section("Picture", row("Background", background, own), lights, el("div", { className: "columns" }, frusta.label, axes.label));
  }

  camera() {
    const fov = el("input", { type: "range", min: "10", max: "110", step: "1", className: "grow" });
    const degrees = el("span", { className: "value" });
    fov.oninput = () => state.set({ camera: { ...state.get("camera"), fov: (Number(fov.value) * Math.PI) / 180 }, view: null });
    const speed = el("input", { type: "range", min: "-2", max: "2", step: "0.1", className: "grow" });
    speed.oninput = () => state.set({ speed: 2 ** Number(speed.value) });
    const ups = segments("Up axis", [["mean", "Cameras", "The mean of the cameras' up axes"], ["x", "x"], ["y", "y"], ["z", "z"], ["flip", "Flip"]], (value) => {
      const up = state.get("up");
      /** @type {Record<string, Vec3>} */
      const axes = { mean: state.get("scene")?.up ?? up, x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1], flip: scale(up, -1) };
      state.set({ up: axes[value] });
      stage().navigation?.flyTo({ ...levelled(axes[value]) });
    });
    state.watch(["camera"], () => {
      const value = Math.round((state.get("camera").fov * 180) / Math.PI);
      fov.value = `${value}`;
      degrees.textContent = `${value}°`;
    });
    state.watch(["speed"], () => (speed.value = `${Math.log2(state.get("speed"))}`));
    return section("Camera", row("Field of view", fov, degrees), row("Speed", speed), row("Up", ups));
  }

  clipping() {
    const on = check("Show only what is in the box", (on) => {
      const scene = state.get("scene");
      if (!on || !scene) return state.set({ clip: null });
      const half = 0.8 * scene.radius;
      const corner = (/** @type {number} */ sign) => /** @type {Vec3} */ (scene.center.map((c) => c + sign * half));
      state.set({ clip: [corner(-1), corner(1)] });
    });
    const sliders = [0, 1, 2].flatMap((axis) => [0, 1].map((side) => {
      const input = el("input", { type: "range", min: "-1", max: "1", step: "0.01", className: "grow" });
      input.oninput = () => {
        const [scene, clip] = [state.get("scene"), state.get("clip")];
        if (!scene || !clip) return;
        const value = scene.center[axis] + Number(input.value) * 1.6 * scene.radius;
        const next = /** @type {[Vec3, Vec3]} */ ([[...clip[0]], [...clip[1]]]);
        next[side][axis] = value;
        next[1 - side][axis] = side ? Math.min(next[0][axis], value) : Math.max(next[1][axis], value);
        state.set({ clip: next });
      };
      return { input, axis, side };
    }));
    const rows = sliders.map(({ input, axis, side }) => row(`${"xyz"[axis]} ${side ? "to" : "from"}`, input));
    const body = el("div", {}, ...rows);
    state.watch(["clip", "scene"], () => {
      const [scene, clip] = [state.get("scene"), state.get("clip")];
      on.input.checked = clip !== null;
      on.input.disabled = scene?.kind === "field";
      body.hidden = clip === null;
      if (scene && clip) for (const { input, axis, side } of sliders) input.value = `${(clip[side][axis] - scene.center[axis]) / (1.6 * scene.radius)}`;
    });
    return section("Clipping box", on.label, body);
  }

  measuring() {
    const start = el("button", { type: "button", textContent: "Measure", onclick: () => state.set({ tool: state.get("tool") === "measure" ? "none" : "measure", measured: [] }) });
    const result = el("span", { className: "grow" });
    const known = el("input", { type: "number", min: "0", step: "any", placeholder: "metres", "aria-label": "True length in metres" });
    const set = el("button", { type: "button", textContent: "Set scale", onclick: () => {
      const [a, b] = state.get("measured");
      const metres = openedMetres(length(subtract(a, b)), Number(known.value));
      if (!(metres > 0)) return;
      if (state.get("hello")?.keeps_unit) connection.send({ do: "unit", metres });
      else state.set({ metres });
    } });
    const kept = el("p", { className: "note" });
    const truth = row("True length", known, set);
    state.watch(["tool", "measured", "metres", "scene"], () => {
      const [a, b] = state.get("measured");
      start.setAttribute("aria-pressed", String(state.get("tool") === "measure"));
      result.textContent = a && b ? distanceText(length(subtract(a, b))) : state.get("tool") === "measure" ? "Click two points" : "";
      truth.hidden = !(a && b);
      const metres = metresPerUnit();
      kept.textContent = metres ? `One unit is ${short(metres * world().scale)} m` : "The scale is unknown";
    });
    return section("Measure", el("div", { className: "row" }, start, result), truth, kept);
  }

  inspecting() {
    const start = el("button", { type: "button", textContent: "Inspect", onclick: () => state.set({ tool: state.get("tool") === "inspect" ? "none" : "inspect" }) });
    const body = el("div");
    state.watch(["tool"], () => start.setAttribute("aria-pressed", String(state.get("tool") === "inspect")));
    state.watch(["picked"], () => {
      const picked = /** @type {any} */ (state.get("picked"));
      const splat = picked?.splat;
      const list = (/** @type {readonly number[]} */ values) => values.map((value) => value.toPrecision(3)).join("  ");
      const unit = 1 / world().scale;
      // In the dataset's coordinates, to one ten-thousandth of the scene.
      const digits = Math.min(9, Math.max(0, Math.ceil(4 - Math.log10(unit * (state.get("scene")?.radius || 1)))));
      const place = (/** @type {Vec3} */ point) => add(scale(point, unit), world().center).map((value) => value.toFixed(digits)).join("  ");
      body.replaceChildren(!picked ? el("p", { className: "note", textContent: "Click a splat to see its size, opacity, colour and depth." }) : facts([
        ["Depth", short(picked.depth && Number((unit * picked.depth).toPrecision(6)))],
        ["Point", picked.point ? place(picked.point) : "–"],
        ...(splat ? /** @type {[string, string][]} */ ([
          ["Splat", `number ${splat.index}, one of ${splat.of} in this pixel`], ["Share of the pixel", `${(100 * splat.weight).toFixed(1)} %`], ["Mean", place(splat.mean)],
          ["Sizes (1 σ)", list(scale(splat.scales, unit))], ["Opacity", splat.opacity.toFixed(3)], ["Colour", list(splat.color)],
        ]) : []),
      ]));
    });
    return section("Inspect", el("div", { className: "row" }, start), body);
  }
}

/** Where the picture is drawn, and with what. */
function drawnBy() {
  const { local, drawsLocally } = stage();
  if (!local || !drawsLocally) return "on the server";
  return `here, by ${local.api}${local.api === "WebGL2" && local.reason ? ` (${local.reason})` : ""}`;
}

/** The camera with its horizon perpendicular to `up`. @param {Vec3} up */
function levelled(up) {
  const camera = state.get("camera");
  return { ...camera, rotation: lookAt(camera.position, state.get("pivot"), up) };
}

/** @param {string} text @param {(on: boolean) => void} change */
function check(text, change) {
  const input = el("input", { type: "checkbox", onchange: () => change(input.checked) });
  return { input, label: el("label", { className: "check" }, input, text) };
}

customElements.define("irr-display-panel", DisplayPanel);

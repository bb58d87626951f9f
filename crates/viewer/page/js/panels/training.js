// The panel of a training: its progress, curves and controls, and the recipe with a search.

import "../chart.js";
import { clock, el, facts, section, short } from "../dom.js";
import { train } from "../commands.js";
import { state } from "../state.js";

/** @typedef {import("../chart.js").Chart} Chart */

/** Milliseconds between two updates of the curves. */
const UPDATE_INTERVAL = 1000;
const PHASES = { preparing: "Preparing", training: "Training", paused: "Paused", finished: "Finished" };

class TrainingPanel extends HTMLElement {
  connectedCallback() {
    const live = el("div", { hidden: true }, this.progress(), this.curves());
    this.append(live, this.recipe());
    state.watch(["hello"], () => (live.hidden = !state.get("hello")?.live));
  }

  progress() {
    const bar = el("div");
    const body = el("div");
    const button = (/** @type {string} */ text, /** @type {string} */ action, /** @type {string} */ hint) =>
      el("button", { type: "button", textContent: text, title: hint, onclick: () => train(action) });
    const pause = button("Pause", "pause", "Pause after this step (P)");
    const resume = button("Resume", "resume", "Resume (P)");
    const step = button("One step", "step", "One step, then pause");
    const save = button("Save now", "save", "Write a checkpoint");
    const stop = button("Stop and finish", "stop", "Stop, save, evaluate; resume later with irradia train --resume");
    stop.onclick = () => confirm("Stop the training and finish? It can be resumed later.") && train("stop");
    const plan = el("div", { className: "plan", role: "img" });
    const said = el("p", { className: "note lines", role: "status" });
    state.watch(["train"], () => {
      const now = state.get("train");
      if (!now) return;
      const left = now.left ?? [0, 0];
      const rest = left[1] > 1.3 * left[0] ? `${clock(left[0])} to ${clock(left[1])}` : clock(Math.sqrt(left[0] * left[1]));
      const stage = now.stages.at(-1)?.[1] ?? "";
      bar.style.width = `${(100 * now.step) / Math.max(now.total, 1)}%`;
      body.replaceChildren(facts([
        ["State", PHASES[/** @type {keyof typeof PHASES} */ (now.phase)]], ["Step", `${now.step} of ${now.total}`], ["Stage", stage],
        ["Speed", `${now.rate.toFixed(1)} steps/s`], ["Left", now.phase === "finished" ? "–" : rest],
        ["Loss", short(now.loss)], ["PSNR, training views", now.psnr ? `${now.psnr.toFixed(2)} dB` : "–"],
        now.parameters ? ["Parameters", now.parameters.toLocaleString("en")] : ["Splats", now.splats.toLocaleString("en")],
        ["Memory", now.memory ? `${(now.memory / 2 ** 20).toFixed(0)} MB` : "–"],
      ]));
      const [paused, over] = [now.phase === "paused", now.phase === "finished"];
      pause.hidden = paused;
      resume.hidden = !paused;
      for (const control of [pause, resume, step, save, stop]) control.disabled = over;
      const saved = now.saved === null ? "" : `Checkpoint of step ${now.saved}`;
      const lines = [...now.warnings, saved].filter(Boolean).join("\n");
      // Screen readers read it out whenever it is set.
      if (said.textContent !== lines) said.textContent = lines;
      showPlan(plan, state.get("hello")?.plan, now.step / Math.max(now.total, 1), stage);
    });
    return section("Training", el("div", { className: "progress" }, bar), plan, el("div", { className: "row" }), body,
      el("div", { className: "row wrap" }, pause, resume, step, save, stop), said);
  }

  curves() {
    const loss = /** @type {Chart} */ (document.createElement("irr-chart"));
    const psnr = /** @type {Chart} */ (document.createElement("irr-chart"));
    const splats = /** @type {Chart} */ (document.createElement("irr-chart"));
    let shownAt = 0;
    state.watch(["train", "theme", "tab", "sidebar"], () => {
      const now = state.get("train");
      const recent = performance.now() - shownAt < UPDATE_INTERVAL && now?.phase === "training";
      if (!now || recent || state.get("tab") !== "training" || !state.get("sidebar")) return;
      shownAt = performance.now();
      const of = (/** @type {string} */ key) => now.curve.filter((/** @type {any} */ point) => typeof point[key] === "number")
        .map((/** @type {any} */ point) => /** @type {[number, number]} */ ([point.step, point[key]]));
      loss.show([{ name: "Loss", color: "--accent", points: of("loss") }], now.total, true);
      psnr.show([{ name: "Held-out PSNR", color: "--good", points: of("psnr") }], now.total, false);
      splats.show([{ name: "Splats", color: "--quiet", points: of("splats") }], now.total, false);
      evaluated.hidden = of("psnr").length === 0;
    });
    const evaluated = section("Held-out PSNR, dB", psnr);
    return el("div", {}, section("Loss", loss), evaluated, section("Splats", splats));
  }

  recipe() {
    const find = el("input", { type: "text", placeholder: "Find a key", className: "grow", "aria-label": "Find a key of the recipe" });
    const text = el("pre", { className: "recipe", tabIndex: 0 });
    const show = () => {
      const lines = String(state.get("hello")?.recipe ?? "").split("\n");
      const wanted = find.value.trim().toLowerCase();
      text.textContent = lines.filter((line) => !wanted || line.startsWith("[") || line.toLowerCase().includes(wanted)).join("\n");
    };
    find.oninput = show;
    state.watch(["hello"], show);
    return section("Recipe", el("div", { className: "row" }, find), text);
  }
}

/** Shows the stages in proportion to their steps, with a mark at the current step.
 * @param {HTMLElement} plan @param {any} outline @param {number} done
 * @param {string} stage */
function showPlan(plan, outline, done, stage) {
  if (!outline) return;
  const parts = outline.stages.map((/** @type {any} */ { name, from, to }) => {
    const part = el("div", { textContent: name, title: `${name}: ${Math.round(100 * from)} to ${Math.round(100 * to)} %` });
    part.style.flexGrow = `${to - from}`;
    part.style.flexBasis = "0";
    return part;
  });
  const now = el("div", { className: "now" });
  now.style.left = `${100 * Math.min(done, 1)}%`;
  plan.setAttribute("aria-label", `Stage ${stage}, ${Math.round(100 * done)} % of the plan`);
  plan.replaceChildren(...parts, now);
}

customElements.define("irr-training-panel", TrainingPanel);

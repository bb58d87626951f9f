// Helpers that create elements. Text is always set as text, never as markup.

/** @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag @param {Record<string, any>} [properties] @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[T]} */
export function el(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes("-") || name === "role" || name === "for") element.setAttribute(name, value);
    else /** @type {any} */ (element)[name] = value;
  }
  element.append(...children);
  return element;
}

/** Whether a dialog is open, behind which no key acts: a click beside its controls takes the focus out of it. */
export const hasDialog = () => document.querySelector("dialog[open]") !== null;

/** Marks a button as pressed or not. @param {HTMLElement} button @param {boolean} pressed */
export const press = (button, pressed) => button.setAttribute("aria-pressed", String(pressed));

/** A row of a form. @param {string} label @param {...Node} controls */
export function row(label, ...controls) {
  const [first] = controls;
  const text = el("label", { textContent: label });
  if (first instanceof HTMLElement && controls.length > 0) {
    first.id ||= `control-${(count += 1)}`;
    text.htmlFor = first.id;
  }
  return el("div", { className: "row" }, text, ...controls);
}
let count = 0;

/** A section of a panel. @param {string} title @param {...Node} children */
export const section = (title, ...children) => el("section", {}, el("h2", { textContent: title }), ...children);

/** A list of names and values. @param {[string, string][]} facts */
export const facts = (facts) =>
  el("dl", { className: "facts" }, ...facts.flatMap(([name, value]) => [el("dt", { textContent: name }), el("dd", { textContent: value, title: value })]));

/** A group of buttons of which one is pressed. @template {string} T
 * @param {string} label @param {[T, string, string?][]} choices value, text, hint @param {(value: T) => void} choose */
export function segments(label, choices, choose) {
  const group = el("div", { className: "segments", role: "group", "aria-label": label });
  for (const [value, text, hint] of choices) {
    const button = el("button", { type: "button", textContent: text, title: hint ?? "", onclick: () => choose(value) });
    button.dataset.value = value;
    group.append(button);
  }
  return group;
}

/** @param {HTMLElement} group @param {string} value */
export function choose(group, value) {
  for (const button of group.querySelectorAll("button")) press(button, button.dataset.value === value);
}

/** A number with three or four significant digits. @param {number | null | undefined} value */
export function short(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e6 || size < 1e-3)) return value.toExponential(2);
  return value.toLocaleString("en", { maximumSignificantDigits: size >= 1000 ? 7 : 4 });
}

/** Seconds as 1:05 or 1:02:03. @param {number} seconds */
export function clock(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  const [h, m, s] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  const two = (/** @type {number} */ n) => `${n}`.padStart(2, "0");
  return h ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
}

// The commands of the page with their keys: the toolbar, the keyboard and the help sheet use this list.

import { connection } from "./connection.js";
import { hasDialog } from "./dom.js";
import { session } from "./edit/session.js";
import { MOVES } from "./navigation.js";
import { path } from "./path.js";
import { shareAddress } from "./share.js";
import { state } from "./state.js";

/** @typedef {import("./math.js").Vec3} Vec3 */

/** What is drawn: value, name, key. @type {[string, string, string][]} */
export const MODES = [
  ["color", "Colour", "1"], ["depth", "Depth", "2"], ["alpha", "Alpha", "3"], ["normals", "Normals", "4"],
  ["count", "Splats per pixel", "5"], ["ellipses", "Ellipses", "6"], ["rings", "Rings", "7"], ["points", "Points", "8"],
];
/** Modes that need splats. */
const SPLAT_MODES = ["count", "ellipses", "rings", "points"];
/** Whether the scene can be drawn in a mode. @param {string} mode */
export const offersMode = (mode) => state.get("scene")?.kind !== "field" || !SPLAT_MODES.includes(mode);

/** @returns {import("./stage.js").Stage} */
export const stage = () => /** @type {any} */ (document.querySelector("irr-stage"));
const navigation = () => stage().navigation;

/** The next view, or the previous one. @param {number} by */
function step(by) {
  const count = state.get("views").length;
  if (!count) return;
  const at = navigation()?.flight?.view ?? state.get("view");
  navigation()?.enter(at === null ? (by > 0 ? 0 : count - 1) : (at + by + count) % count);
}

/** @param {string} action */
export const train = (action) => connection.send({ do: "train", action });

/** @param {"measure" | "inspect"} tool */
const toggleTool = (tool) => state.set({ tool: state.get("tool") === tool ? "none" : tool, ...(tool === "measure" && { measured: [] }) });

/** @param {import("./edit/tools.js").Tool} tool */
const toggleEditTool = (tool) => state.set({ tab: "edit", sidebar: true, tool: state.get("tool") === tool ? "none" : tool });

/** Deletes the selection, if there is one. */
const remove = () => {
  if (state.get("editing")?.selected) session.edit({ op: "delete" });
};

/** Copies the address of the current view to the clipboard. */
export async function share() {
  const address = shareAddress();
  history.replaceState(null, "", address);
  try {
    await navigator.clipboard.writeText(address);
    state.set({ problem: "The address of this view was copied to the clipboard" });
  } catch {
    state.set({ problem: "The address bar now contains this view" });
  }
}

export function toggleTheme() {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const now = state.get("theme") || (dark ? "dark" : "light");
  state.set({ theme: now === "dark" ? "light" : "dark" });
}

/** @typedef {{ keys: string, name: string, run: () => void }} Command */
/** @type {Record<string, Command[]>} */
export const COMMANDS = {
  Camera: [
    { keys: "h", name: "Home", run: () => navigation()?.home() },
    { keys: "x", name: "Look along x (shift: from the other side)", run: () => navigation()?.along([1, 0, 0]) },
    { keys: "X", name: "", run: () => navigation()?.along([-1, 0, 0]) },
    { keys: "y", name: "Look along y", run: () => navigation()?.along([0, 1, 0]) },
    { keys: "Y", name: "", run: () => navigation()?.along([0, -1, 0]) },
    { keys: "z", name: "Look along z", run: () => navigation()?.along([0, 0, 1]) },
    { keys: "Z", name: "", run: () => navigation()?.along([0, 0, -1]) },
    { keys: "o", name: "Orbit", run: () => state.set({ navigation: "orbit" }) },
    { keys: "f", name: "Fly", run: () => state.set({ navigation: "fly" }) },
    { keys: "g", name: "Walk", run: () => state.set({ navigation: "walk" }) },
    { keys: "]", name: "Next view", run: () => step(1) },
    { keys: "[", name: "Previous view", run: () => step(-1) },
  ],
  Picture: [
    ...MODES.map(([mode, name, key]) => ({ keys: key, name, run: () => offersMode(mode) && state.set({ mode }) })),
    { keys: "c", name: "Compare with the photograph", run: () => {
      const next = /** @type {const} */ ({ none: "slider", slider: "blink", blink: "error", error: "none" });
      state.set({ compare: next[state.get("compare")] });
    } },
    { keys: "l", name: "Draw here or on the server", run: () => state.set({ drawing: stage().drawsLocally ? "served" : "local" }) },
    { keys: "v", name: "Show cameras", run: () => state.set({ frusta: !state.get("frusta") }) },
  ],
  Tools: [
    { keys: "m", name: "Measure a distance", run: () => toggleTool("measure") },
    { keys: "i", name: "Inspect a splat", run: () => toggleTool("inspect") },
    { keys: "k", name: "Set a key frame", run: () => {
      state.set({ tab: "path" });
      path.add(state.get("camera"));
    } },
    { keys: " ", name: "Play the path", run: () => path.dispatchEvent(new Event("toggle")) },
    { keys: "p", name: "Pause or resume the training", run: () => train(state.get("train")?.phase === "paused" ? "resume" : "pause") },
  ],
  Edit: [
    { keys: "Ctrl+z", name: "Undo", run: () => session.undo() },
    { keys: "Ctrl+Shift+z", name: "Redo", run: () => session.redo() },
    { keys: "Ctrl+y", name: "", run: () => session.redo() },
    { keys: "r", name: "Select with a rectangle", run: () => toggleEditTool("rectangle") },
    { keys: "n", name: "Select with the lasso", run: () => toggleEditTool("lasso") },
    { keys: "j", name: "Select with the brush", run: () => toggleEditTool("brush") },
    { keys: "Ctrl+a", name: "Select all", run: () => session.select([{ shape: "all" }], "replace") },
    { keys: "Ctrl+i", name: "Invert the selection", run: () => session.select([{ shape: "invert" }], "add") },
    { keys: "Ctrl+d", name: "Select nothing", run: () => session.deselect() },
    { keys: "Delete", name: "Delete the selection", run: remove },
    { keys: "Backspace", name: "", run: remove },
  ],
  Page: [
    { keys: "b", name: "Show or hide the panel", run: () => state.set({ sidebar: !state.get("sidebar") }) },
    { keys: "t", name: "Dark or light theme", run: toggleTheme },
    { keys: "u", name: "Share this view", run: share },
    { keys: "?", name: "This sheet", run: () => document.querySelector("irr-help")?.dispatchEvent(new Event("open")) },
    { keys: "Escape", name: "Leave the view or the tool", run: () => state.set({ tool: "none", view: null, compare: "none" }) },
  ],
};

addEventListener("keydown", (event) => {
  const target = /** @type {HTMLElement} */ (event.target);
  if (event.altKey || hasDialog() || target.matches("input:not([type=range]):not([type=checkbox]), select")) return;
  if (event.key === " " && target.matches("button, [role=button], input")) return;
  // These keys go by their position on the keyboard, whatever its layout.
  if (event.code in MOVES && !event.ctrlKey && !event.metaKey) return;
  const held = event.ctrlKey || event.metaKey ? (event.shiftKey ? "Ctrl+Shift+" : "Ctrl+") : "";
  const key = held ? held + event.key.toLowerCase() : event.key;
  const command = Object.values(COMMANDS).flat().find(({ keys }) => keys === key);
  // Without a scene to edit, the keys of editing are left to the browser.
  if (!command || (COMMANDS.Edit.includes(command) && !session.works)) return;
  event.preventDefault();
  command.run();
});

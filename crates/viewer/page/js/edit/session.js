// This page's requests to the editing session, which all pages share. The answers are in `state.editing`.

import { connection } from "../connection.js";
import { state } from "../state.js";

/** @typedef {import("../math.js").Vec3} Vec3 */
/** One entry of the list. @typedef {{ kind: "select" | "edit", text: string }} Entry */
/** What the server tells about the session: the version of the scene with its selection, as in the headers of pictures; how many splats are selected, of how many, and the box around nearly all of them; the list from
 * entry `first` on, of which the first `at` entries are made; the gesture of the last one made.
 * @typedef {{ version: number, selected: number, of: number, hidden: number, locked: number, box: [Vec3, Vec3] | null, at: number, first: number,
 *   total: number, entries: Entry[], gesture: number, before: boolean, busy: boolean, mask: number, saved: string | null }} Editing */
/** How a shape changes the selection. @typedef {"replace" | "add" | "subtract" | "intersect"} Mode */

/** Maximum bytes of a request, as in message.rs: beyond it the server ends the connection. */
const MAX_REQUEST = 16 * 2 ** 20;
/** Maximum bytes of a scene to merge, as in serve.rs: while a larger one is sent, a browser does not read the reason of a refusal. */
const MAX_SCENE = 2 ** 30;

class Session {
  /** The latest gesture number; it starts at random, so that the gestures of two pages differ. */
  gestures = Math.floor(Math.random() * 2 ** 30) * 2 ** 20;
  /** The gesture of the latest request of this page. */
  newest = 0;
  /** @type {Map<string, number>} */
  held = new Map();

  /** A new number for requests that belong together, such as the moves of one slider: a request with the gesture of the last entry
   * replaces it. */
  gesture() {
    return (this.gestures += 1);
  }

  /** The gesture of a control, a new one if something else has been done since. @param {string} name */
  live(name) {
    const known = this.held.get(name) ?? 0;
    const gesture = known && known === this.newest ? known : this.gesture();
    this.held.set(name, gesture);
    return gesture;
  }

  /** Makes the next use of a control a new gesture. @param {string} name */
  renew(name) {
    this.held.delete(name);
  }

  /** Whether a control made the last entry of the list. @param {string} name */
  isLive(name) {
    const known = this.held.get(name);
    return Boolean(known) && known === this.newest && (known === state.get("editing")?.gesture || this.pending);
  }

  /** Whether the answer to the newest request is still on its way. */
  pending = false;

  /** @param {object} request */
  send(request) {
    this.newest = /** @type {{ gesture?: number }} */ (request).gesture ?? 0;
    this.pending = true;
    connection.send(request);
  }

  /** Selects by shapes; of several, all but the first change the selection so far.
   * @param {object[]} shapes as crate `edit` names them, in the page's coordinates @param {Mode} mode @param {number} [gesture] */
  select(shapes, mode, gesture = this.gesture()) {
    const first = mode === "replace" ? "add" : mode;
    const steps = shapes.map((shape, i) => ({ mode: i ? "add" : first, ...shape }));
    this.send({ do: "select", gesture, replace: mode === "replace", steps });
  }

  deselect() {
    if (state.get("editing")?.selected) this.send({ do: "deselect" });
  }

  /** @param {object} op as crate `edit` names it, in the page's coordinates @param {boolean} [whole] the whole scene, not the selection
   * @param {number} [gesture] */
  edit(op, whole = false, gesture = this.gesture()) {
    this.send({ do: "edit", gesture, whole, edit: op });
  }

  /** @param {string} list an `edits.toml` */
  replay(list) {
    const request = { do: "replay", list };
    const bytes = new Blob([JSON.stringify(request)]).size;
    if (bytes <= MAX_REQUEST) return this.send(request);
    const size = `${(bytes / 2 ** 20).toFixed(0)} MiB`;
    state.set({ problem: `This list of edits takes ${size}, and a page sends at most 16: make its edits with irradia edit --edits` });
  }

  /** Adds the splats of another scene. @param {File} file of any splat format */
  async merge(file) {
    try {
      if (file.size > MAX_SCENE) throw new Error(`${file.name} is larger than 1 GiB: merge it with irradia edit`);
      const response = await fetch(`merge/${encodeURIComponent(file.name)}${location.search}`, { method: "POST", body: file });
      const text = await response.text();
      if (!response.ok) throw new Error(text);
      this.edit({ op: "merge", file: JSON.parse(text).name }, true);
    } catch (error) {
      state.set({ problem: error instanceof Error ? error.message : String(error) });
    }
  }

  undo() {
    this.send({ do: "undo" });
  }

  redo() {
    this.send({ do: "redo" });
  }

  /** Undoes or redoes entries until the first `at` of the list are made. @param {number} at */
  go(at) {
    this.send({ do: "go", at });
  }

  /** Shows the scene as it was opened, or as it is now. @param {boolean} before */
  compare(before) {
    connection.send({ do: "compare", before });
  }

  save() {
    connection.send({ do: "save" });
  }

  /** Whether the scene can be edited. */
  get works() {
    return state.get("hello")?.editing?.works === true;
  }
}

export const session = new Session();
state.addEventListener("editing", () => (session.pending &&= state.get("editing")?.busy === true));

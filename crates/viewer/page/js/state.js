// The state of the page in one object, with an event for each change.

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./camera.js").View} View */
/** @typedef {import("./math.js").Vec3} Vec3 */
/** @typedef {import("./similarity.js").Similarity} Similarity */

/** What the server tells about the scene.
 * @typedef {{ version: number, step: number | null, kind: string, count: number, sh_degree: number, travels: boolean, lights: boolean,
 *   placement: Similarity, world_from_photographs: Similarity, world: { scale: number, center: Vec3 }, antialias: boolean, background: Vec3,
 *   center: Vec3, up: Vec3, radius: number, height: number, first: Vec3 | null, fov: number }} Scene */

/**
 * @typedef {object} Values
 * @property {Scene | null} scene
 * @property {View[]} views
 * @property {Camera} camera
 * @property {Vec3} pivot
 * @property {Vec3} up
 * @property {number | null} view index of the view that the camera is in, exactly
 * @property {string} mode what is drawn
 * @property {"auto" | "served" | "local"} drawing where it is drawn
 * @property {"orbit" | "fly" | "walk"} navigation
 * @property {string | null} background as #rrggbb; the scene's own if null
 * @property {number | null} light index of the view in whose light the scene is shown; the mean of all if null
 * @property {[Vec3, Vec3] | null} clip
 * @property {"none" | "slider" | "blink" | "error"} compare
 * @property {boolean} frusta
 * @property {boolean} axes
 * @property {boolean} sidebar
 * @property {string} tab
 * @property {string} theme
 * @property {number} speed factor on the speed of flying
 * @property {"none" | "measure" | "inspect" | import("./edit/tools.js").Tool} tool
 * @property {import("./edit/session.js").Mode} selectMode
 * @property {number} brush radius, CSS pixels
 * @property {boolean} visibleOnly whether tools select only what the picture shows
 * @property {boolean} highlight whether selected splats are tinted
 * @property {"none" | "move" | "rotate" | "scale"} transform
 * @property {import("./edit/shapes.js").Region | null} region
 * @property {{ color: Vec3, mode: import("./edit/session.js").Mode } | null} dropped the colour under the eyedropper
 * @property {import("./edit/session.js").Editing | null} editing
 * @property {Vec3[]} measured
 * @property {number | null} metres per world unit of the scene as it was opened; `units.js` converts lengths
 * @property {object | null} picked
 * @property {any} train
 * @property {any} hello
 * @property {Map<number, number | null>} scores
 * @property {string} connection
 * @property {string | null} problem
 */

/** Values that are saved between visits. */
const SAVED_KEYS = ["drawing", "navigation", "frusta", "axes", "sidebar", "tab", "theme", "speed", "brush", "visibleOnly"];
const STORAGE_KEY = "irradia-viewer";

class State extends EventTarget {
  constructor() {
    super();
    /** @type {Values} */
    this.values = {
      scene: null, views: [], camera: { position: [0, 0, -3], rotation: [1, 0, 0, 0], fov: 0.9 }, pivot: [0, 0, 0], up: [0, -1, 0],
      view: null, mode: "color", drawing: "auto", navigation: "orbit", background: null, light: null, clip: null, compare: "none",
      frusta: false, axes: true, sidebar: innerWidth > 720, tab: "display", theme: "", speed: 1, tool: "none", measured: [],
      metres: null, selectMode: "replace", brush: 24, visibleOnly: false, highlight: true, transform: "none", region: null, dropped: null,
      editing: null, picked: null, train: null, hello: null, scores: new Map(), connection: "connecting", problem: null,
    };
    try {
      const kept = JSON.parse(localStorage.getItem(STORAGE_KEY) ?? "{}");
      for (const key of SAVED_KEYS) if (key in kept) Object.assign(this.values, { [key]: kept[key] });
      if (innerWidth <= 720) this.values.sidebar = false;
    } catch {
      // Without stored values, or with those of another version, the page uses its defaults.
    }
  }

  /** @template {keyof Values} K @param {K} key @returns {Values[K]} */
  get(key) {
    return this.values[key];
  }

  /** Changes values, then dispatches an event named after each. @param {Partial<Values>} changes */
  set(changes) {
    const changed = /** @type {(keyof Values)[]} */ (Object.keys(changes)).filter((key) => this.values[key] !== changes[key]);
    Object.assign(this.values, changes);
    for (const key of changed) this.dispatchEvent(new Event(key));
    if (changed.some((key) => SAVED_KEYS.includes(key))) this.keep();
  }

  /** Calls back now, and whenever one of the values changes. @param {(keyof Values)[]} keys @param {() => void} call */
  watch(keys, call) {
    for (const key of keys) this.addEventListener(key, call);
    call();
  }

  keep() {
    try {
      const values = /** @type {any} */ (this.values);
      localStorage.setItem(STORAGE_KEY, JSON.stringify(Object.fromEntries(SAVED_KEYS.map((key) => [key, values[key]]))));
    } catch {
      // A private window may have no storage.
    }
  }

  /** The view that the camera is in, exactly. @returns {View | null} */
  get insideView() {
    const index = this.values.view;
    return index === null ? null : (this.values.views[index] ?? null);
  }

  /** How the picture is compared now: `compare` is kept for the next view with a photograph. @returns {Values["compare"]} */
  get comparison() {
    return this.insideView?.photo ? this.values.compare : "none";
  }
}

export const state = new State();

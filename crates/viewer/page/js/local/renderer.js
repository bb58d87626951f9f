// Draws splats in the browser: loads them, keeps to the time per picture, and lets WebGPU paint or, if that is missing, WebGL2.

import { openMask, openSplats } from "./assets.js";
import { Levels } from "./levels.js";
import { readSplats } from "./stream.js";
import { WebGl } from "./webgl.js";
import { WebGpu } from "./webgpu.js";

/** @typedef {import("../camera.js").Camera} Camera */
/** @typedef {import("../camera.js").Intrinsics} Intrinsics */
/** @typedef {import("../math.js").Vec3} Vec3 */
/** How to paint, besides the camera; clip: a box, world; highlight: whether selected splats are tinted; measured: whether painting
 * waits for the picture, so that its time can be measured.
 * @typedef {{ near: number, background: Vec3, antialias: boolean, clip: [Vec3, Vec3] | null, highlight: boolean, mode: string, measured: boolean }} Options */

const NEAR = 0.01;
/** The mode that both paint; only WebGL2 paints the others. */
const COLOR_MODE = "color";
/** Milliseconds after which a camera is at rest. */
const REST_DELAY = 100;
/** Milliseconds for a picture of a moving camera. */
const FRAME_BUDGET = 33;
/** Milliseconds to wait until a newer version is complete. */
const MAX_WAIT = 1500;
/** Milliseconds until a selection that came before its splats is requested again. */
const RETRY_DELAY = 100;
/** Milliseconds within which a second loss of WebGL2 means that the GPU cannot draw the scene. */
const MIN_LIFE = 30000;
/** Largest number of device pixels per CSS pixel. */
const MAX_DENSITY = 2;

/** Device pixels per CSS pixel of pictures on the current screen. */
export const screenDensity = () => Math.min(devicePixelRatio || 1, MAX_DENSITY);

export class LocalRenderer {
  /** The current painter; null before the first one is open, and if there is none. @type {WebGpu | WebGl | null} */
  painter = null;
  /** @type {WebGpu | null} */
  gpu = null;
  /** Undefined until it is needed; null if it cannot paint. @type {WebGl | null | undefined} */
  webGl = undefined;
  /** When WebGL2 was lost, milliseconds. */
  lostAt = -Infinity;
  /** Why WebGPU does not paint; empty if it does. */
  reason = "";
  opened = false;
  /** Whether only WebGL2 may paint. */
  holds = false;
  /** Number of splats of the scene, and of those that have arrived. */
  total = 0;
  loaded = 0;
  levels = new Levels([0]);
  /** The level of detail that is drawn; 0 is the scene itself. */
  level = 0;
  version = 0;
  /** The server that numbers versions and selections. */
  server = "";
  /** Whether the splats of `version` are being fetched. */
  streaming = false;
  /** Whether the splats of `version` have begun to arrive, and when. */
  begun = false;
  beganAt = 0;
  /** Whether some version has been shown completely. */
  complete = false;
  /** @type {Intrinsics | null} */
  k = null;
  /** @type {{ camera: Camera, shot: any } | null} */
  wanted = null;
  /** @type {{ camera: Camera, shot: any } | null} */
  painted = null;
  changedAt = 0;
  /** Grows whenever a new picture would differ from the last. */
  edition = 0;
  /** Whether there is something newer to paint for the camera that was painted last. */
  fresh = false;
  /** Whether the canvas shows the newest picture of a camera at rest, in full size. */
  sharp = false;
  /** Share of the sides drawn while moving. */
  share = 1;
  painting = false;
  finished = false;
  /** The selection to show, and the one that is shown. */
  mask = 0;
  masked = 0;

  /** @param {HTMLElement} element gets the canvas @param {() => void} dirty @param {(problem: string) => void} report */
  constructor(element, dirty, report) {
    this.element = element;
    this.dirty = dirty;
    this.report = report;
    this.ready = this.open();
  }

  async open() {
    try {
      this.gpu = await WebGpu.open(() => this.change(), (reason) => this.withoutGpu(reason));
    } catch (error) {
      this.reason = message(error);
    }
    this.opened = true;
    this.use(this.painterOf());
  }

  openWebGl() {
    if (this.webGl === undefined) this.webGl = WebGl.open(() => this.change(), (lost) => this.reopen(lost));
    return this.webGl;
  }

  /** Opens WebGL2 anew when its context is lost, as on telephones while the page is in the background. @param {WebGl} lost */
  reopen(lost) {
    const now = performance.now();
    if (now < this.lostAt + MIN_LIFE) return this.giveUp(lost, "the GPU was lost");
    this.lostAt = now;
    if (this.webGl === lost) this.webGl = undefined;
    if (this.painter === lost) this.use(this.painterOf(this.wanted?.shot.mode));
  }

  /** Whether it can paint at all; false until a painter is open. */
  get works() {
    return this.gpu !== null || Boolean(this.webGl);
  }

  get accelerated() {
    return this.painter?.accelerated ?? false;
  }

  get api() {
    return this.painter?.api ?? "";
  }

  get canvas() {
    return this.painter?.canvas ?? null;
  }

  /** Number of splats in the current picture. */
  get drawn() {
    return this.painter?.drawn ?? 0;
  }

  get busy() {
    return this.painting || Boolean(this.painter?.busy);
  }

  /** Whether it can paint in a mode. @param {string} mode */
  paints(mode) {
    return this.works && this.painterOf(mode) !== null;
  }

  /** @param {string | undefined} mode */
  painterOf(mode = COLOR_MODE) {
    // Nothing paints until it is known whether there is WebGPU.
    if (!this.opened) return null;
    return this.gpu && mode === COLOR_MODE && !this.holds ? this.gpu : this.openWebGl();
  }

  /** Lets only WebGL2 paint, or again both. @param {boolean} holds */
  holdWebGl(holds) {
    this.holds = holds;
    this.use(this.painterOf(this.wanted?.shot.mode));
    return this.webGl ?? null;
  }

  /** Switches to another painter, which loads the scene from the start; its canvas is shown with its first picture.
   * @param {WebGpu | WebGl | null} painter */
  use(painter) {
    if (painter === this.painter) return;
    this.painter = painter;
    this.abort?.abort();
    [this.version, this.loaded, this.total, this.begun, this.masked] = [0, 0, 0, false, 0];
    this.change();
    this.dirty();
  }

  /** @param {string} reason */
  withoutGpu(reason) {
    if (!this.gpu) return;
    this.reason = reason;
    const lost = this.gpu;
    this.gpu = null;
    if (this.painter === lost) this.use(this.openWebGl());
    lost.gpu.device.destroy();
  }

  /** Stops using a painter that fails, unless it is out of use already: a frame fails after its device is lost.
   * @param {WebGpu | WebGl | null} painter @param {unknown} error */
  giveUp(painter, error) {
    if (painter !== null && painter === this.gpu) return this.withoutGpu(message(error));
    if (painter === null || painter !== this.webGl) return;
    this.webGl = null;
    if (this.painter === painter) this.use(null);
    this.report(message(error));
  }

  /** Notes that a new picture would differ from the last. */
  change() {
    this.sharp = false;
    this.fresh = true;
    this.edition += 1;
  }

  /** Paints the same picture again. */
  redraw() {
    this.changedAt = performance.now();
    this.change();
    this.dirty();
  }

  /** Sets the version of the scene to load, once local drawing is wanted. @param {import("../state.js").Scene | null} scene */
  load(scene) {
    this.scene = scene;
  }

  /** Notes which server is connected. Another one numbers versions and selections anew: its scene is loaded in any case, as is one that
   * was still arriving when the connection broke; the old one is shown until then. @param {string} server */
  connect(server) {
    if (server === this.server && !this.streaming) return;
    this.server = server;
    this.abort?.abort();
    [this.version, this.masked, this.scene] = [0, 0, null];
  }

  /** @param {WebGpu | WebGl} painter @param {import("../state.js").Scene} scene */
  async fetch(painter, scene) {
    if (this.version === scene.version) return;
    this.version = scene.version;
    this.abort?.abort();
    const abort = new AbortController();
    this.abort = abort;
    this.streaming = true;
    try {
      await painter.ready.catch((error) => this.giveUp(painter, error));
      const response = await openSplats(abort.signal);
      await readSplats(response, (header) => abort.signal.aborted || this.begin(painter, header), (block) => abort.signal.aborted || this.take(painter, block));
      if (!abort.signal.aborted) this.streaming = false;
    } catch (error) {
      if (abort.signal.aborted) return;
      [this.version, this.streaming] = [0, false];
      this.report(message(error));
    }
  }

  /** @param {WebGpu | WebGl} painter @param {import("./stream.js").Header} header */
  begin(painter, { counts, degree }) {
    this.complete ||= this.total > 0 && this.loaded === this.total;
    this.beganAt = performance.now();
    [this.loaded, this.total, this.masked, this.begun, this.level] = [0, counts[0], 0, true, 0];
    this.levels = new Levels(counts);
    try {
      painter.begin(this.levels, degree);
    } catch (error) {
      this.giveUp(painter, error);
    }
    // No block follows that would renew the picture.
    if (counts[0] === 0) this.redraw();
  }

  /** @param {WebGpu | WebGl} painter @param {import("./stream.js").Block} block */
  take(painter, block) {
    this.levels.take(block);
    painter.take(block);
    // Levels do not change the picture of a camera at rest.
    if (block.level > 0) return;
    this.loaded = block.first + block.count;
    this.changedAt = performance.now();
    this.change();
    this.aim();
    this.dirty();
    this.fetchMask();
  }

  /** Shows a selection by its number, 0 for none. @param {number} mask */
  select(mask) {
    this.mask = mask;
    this.fetchMask();
  }

  /** Fetches the selection once all splats have arrived. */
  async fetchMask() {
    const painter = this.painter;
    if (!painter || !this.begun || this.masked === this.mask || this.fetching || this.loaded < this.total) return;
    // Another version is loaded once it is wanted.
    if (this.version !== this.scene?.version) return;
    this.fetching = true;
    const { mask, abort } = this;
    let answered = true;
    try {
      const bits = mask ? await openMask(this.version) : new Uint8Array(0);
      if (bits && abort === this.abort && painter === this.painter) {
        painter.select(bits);
        this.masked = mask;
        this.redraw();
      }
    } catch (error) {
      // The next state of the session, with which every connection begins, requests it again.
      answered = false;
      this.report(message(error));
    }
    this.fetching = false;
    if (this.masked !== this.mask && (answered || mask !== this.mask)) setTimeout(() => this.fetchMask(), RETRY_DELAY);
  }

  /** @param {Camera} camera @param {Intrinsics} k @param {any} shot */
  want(camera, k, shot) {
    this.use(this.painterOf(shot.mode));
    this.wanted = { camera, shot };
    this.k = k;
    this.changedAt = performance.now();
    this.sharp = false;
    this.edition += 1;
    if (this.painter && this.scene) this.fetch(this.painter, this.scene);
    this.aim();
  }

  /** Tells the painter the next camera. */
  aim() {
    if (this.wanted && this.k) this.painter?.aim(this.wanted.camera, this.k, NEAR, this.level);
  }

  /** Draws another level of detail from now on. @param {number} level */
  useLevel(level) {
    if (level === this.level) return;
    this.level = level;
    this.aim();
  }

  /** The level for a moving camera: 0 if individual splats are shown, or selected ones are tinted.
   * @param {{ camera: Camera, shot: any }} wanted @param {Intrinsics} k */
  levelOf({ camera, shot }, k) {
    const plain = (shot.mode ?? COLOR_MODE) === COLOR_MODE && !(shot.highlight && this.masked);
    return plain ? this.levels.choose(camera, scaled(k, this.share), NEAR) : 0;
  }

  /** Paints if something has changed; returns whether there is a new picture. @param {number} now */
  draw(now) {
    const { painter, wanted, k } = this;
    if (painter && wanted && k && this.begun && !this.painting && !this.sharp) this.paint(painter, wanted, k, now);
    const { finished } = this;
    this.finished = false;
    return finished;
  }

  /** @param {WebGpu | WebGl} painter @param {{ camera: Camera, shot: any }} wanted @param {Intrinsics} k @param {number} now */
  async paint(painter, wanted, k, now) {
    // A newer version replaces the picture when it is complete: a part of it would flicker at each edit.
    if (this.loaded < this.total && this.complete && now < this.beganAt + MAX_WAIT) return;
    const rests = now - this.changedAt >= REST_DELAY;
    this.useLevel(rests ? 0 : this.levelOf(wanted, k));
    const moving = !rests || painter.busy;
    if (moving && !this.fresh && this.painted === wanted) return;
    const { edition } = this;
    const started = performance.now();
    const end = (/** @type {boolean} */ isThere) => {
      const spent = performance.now() - started;
      if (moving) this.share = Math.min(1, Math.max(0.25, this.share * Math.min(1.15, Math.max(0.7, Math.sqrt(FRAME_BUDGET / spent)))));
      if (!isThere || painter !== this.painter) return;
      if (painter.canvas !== this.element.firstChild) this.element.replaceChildren(painter.canvas);
      painter.present();
      this.sharp = !moving && edition === this.edition;
      this.painted = wanted;
      this.finished = true;
    };
    this.fresh = false;
    const painted = painter.paint(wanted.camera, scaled(k, moving ? this.share : 1), this.options(wanted.shot, moving || !painter.accelerated));
    if (typeof painted === "boolean") return end(painted);
    this.painting = true;
    try {
      end(await painted);
    } catch (error) {
      this.giveUp(painter, error);
    }
    this.painting = false;
  }

  /** @param {any} shot @param {boolean} measured @returns {Options} */
  options({ background, clip, highlight, mode }, measured) {
    return {
      near: NEAR,
      background: background ?? this.scene?.background ?? [0, 0, 0],
      antialias: Boolean(this.scene?.antialias),
      clip: clip ?? null,
      highlight: Boolean(highlight && this.masked),
      mode: mode ?? COLOR_MODE,
      measured,
    };
  }

  /** Paints one eye of a headset, with WebGL2. @param {WebGLFramebuffer | null} to @param {{ x: number, y: number, width: number, height: number }} port
   * @param {Camera} camera @param {Float32Array} projection column by column */
  eye(to, port, camera, projection) {
    const { width, height } = port;
    const [fx, fy] = [(projection[0] * width) / 2, (projection[5] * height) / 2];
    this.k = { width, height, fx, fy, cx: ((1 - projection[8]) * width) / 2, cy: ((1 + projection[9]) * height) / 2 };
    this.wanted = { camera, shot: this.wanted?.shot ?? {} };
    this.level = 0;
    if (this.webGl && this.scene) this.fetch(this.webGl, this.scene);
    this.aim();
    this.webGl?.eye(to, port, camera, this.k, this.options({}, false));
  }
}

/** @param {Intrinsics} k @param {number} share of its sides @returns {Intrinsics} */
function scaled(k, share) {
  const [width, height] = [Math.max(1, Math.round(k.width * share)), Math.max(1, Math.round(k.height * share))];
  const [x, y] = [width / k.width, height / k.height];
  return { width, height, fx: k.fx * x, fy: k.fy * y, cx: k.cx * x, cy: k.cy * y };
}

/** @param {unknown} error */
const message = (error) => (error instanceof Error ? error.message : String(error));

// Draws splats with WebGL2: one pass projects every splat into a texture, another blends a quad for each, farthest first.

import { axes } from "../math.js";
import { openMask, openSplats, orderWorker, shader } from "./assets.js";
import { readSplats } from "./stream.js";

/** @typedef {import("../camera.js").Camera} Camera */
/** @typedef {import("../camera.js").Intrinsics} Intrinsics */
/** @typedef {import("../math.js").Vec3} Vec3 */

/** Splats per row of the textures, as the shaders have it. */
const ROW = 1024;
/** Splats an instance, as the shader has it: of one splat each, instances cost a software rasteriser 4 microseconds apiece. */
const BATCH = 128;
const NEAR = 0.01;
const SHAPES = ["color", "ellipses", "rings", "points"];
/** Milliseconds after which a camera is at rest. */
const REST = 100;
/** Milliseconds of a moving picture. */
const BUDGET = 33;
/** Milliseconds for which a newer version may be awaited whole. */
const PATIENCE = 1500;
/** Milliseconds until a selection that came before its splats is asked for again. */
const RETRY = 100;

export class LocalRenderer {
  works = false;
  accelerated = false;
  /** @type {WebGL2RenderingContext | null} */
  gl = null;
  /** Splats of the scene, and their degree. */
  total = 0;
  degree = 0;
  /** @type {{ camera: Camera, shot: any } | null} */
  painted = null;
  fresh = false;
  /** Splats that have arrived. */
  loaded = 0;
  version = 0;
  /** @type {Intrinsics | undefined} */
  k;
  /** @type {{ camera: Camera, shot: any } | null} */
  wanted = null;
  changedAt = 0;
  /** Share of the sides drawn while moving. */
  share = 1;
  sharp = false;
  busy = false;
  generation = 0;
  /** The selection to show, and the one that is shown. */
  mask = 0;
  masked = 0;
  /** Whether some version has been shown whole, and when the present one began to arrive. */
  complete = false;
  beganAt = 0;
  sortMilliseconds = 0;
  drawn = 0;

  /** @param {HTMLCanvasElement} canvas @param {() => void} dirty @param {(problem: string) => void} report */
  constructor(canvas, dirty, report) {
    this.canvas = canvas;
    this.dirty = dirty;
    this.report = report;
    const options = { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true, powerPreference: "high-performance" };
    const gl = /** @type {WebGL2RenderingContext | null} */ (canvas.getContext("webgl2", options));
    if (!gl) return;
    this.gl = gl;
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const device = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    this.accelerated = !/swiftshader|llvmpipe|software|basic render/i.test(device);
    this.works = true;
    this.worker = orderWorker();
    this.worker.onmessage = ({ data }) => this.ordered(data);
    this.ready = this.prepare(gl);
    canvas.addEventListener("webglcontextlost", () => {
      this.works = false;
      this.dirty();
    });
  }

  /** @param {WebGL2RenderingContext} gl */
  async prepare(gl) {
    const [projectVert, projectFrag, splatVert, splatFrag, shapeFrag] = await Promise.all(["project.vert", "project.frag", "splat.vert", "splat.frag", "shape.frag"].map(shader));
    this.projecting = program(gl, projectVert, projectFrag);
    this.blending = program(gl, splatVert, splatFrag);
    this.shaping = program(gl, splatVert, shapeFrag);
    this.empty = gl.createVertexArray();
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint16Array.from({ length: 6 * BATCH }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  /** Shows a selection by its number, 0 for none. @param {number} mask */
  select(mask) {
    this.mask = mask;
    this.fetchMask();
  }

  /** Fetches the selection once all splats are here. */
  async fetchMask() {
    const gl = this.gl;
    if (!gl || !this.selected || this.masked === this.mask || this.fetching || this.loaded < this.total) return;
    this.fetching = true;
    const [mask, generation] = [this.mask, this.generation];
    try {
      const bits = mask ? await openMask(this.version) : new Uint8Array(0);
      if (bits && generation === this.generation) {
        const bytes = new Uint8Array(ROW * Math.max(1, Math.ceil(this.total / ROW)));
        for (let i = 0; i < this.total && i < 8 * bits.length; i += 1) bytes[i] = (bits[i >> 3] >> (i & 7)) & 1;
        gl.bindTexture(gl.TEXTURE_2D, this.selected);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, bytes.length / ROW, gl.RED_INTEGER, gl.UNSIGNED_BYTE, bytes);
        this.masked = mask;
        this.redraw();
      }
    } catch (error) {
      this.report(String(error));
      this.masked = mask;
    }
    this.fetching = false;
    if (this.masked !== this.mask) setTimeout(() => this.fetchMask(), RETRY);
  }

  /** Paints the same picture again. */
  redraw() {
    this.changedAt = performance.now();
    this.sharp = false;
    this.fresh = true;
    this.dirty();
  }

  /** Loads a version of the scene, once local drawing is wanted. @param {import("../state.js").Scene | null} scene */
  load(scene) {
    this.scene = scene;
  }

  /** @param {import("../state.js").Scene} scene */
  async fetch(scene) {
    const gl = this.gl;
    if (!gl || this.version === scene.version) return;
    this.version = scene.version;
    this.abort?.abort();
    this.abort = new AbortController();
    await this.ready;
    try {
      const response = await openSplats(this.abort.signal);
      await readSplats(response, (header) => this.begin(gl, header), (block) => this.take(gl, block));
    } catch (error) {
      if (!(error instanceof DOMException && error.name === "AbortError")) {
        this.version = 0;
        this.report(String(error));
      }
    }
  }

  /** @param {WebGL2RenderingContext} gl @param {import("./stream.js").Header} header */
  begin(gl, { count, degree }) {
    const rows = Math.max(1, Math.ceil(count / ROW));
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      this.works = false;
      this.dirty();
      throw new Error("there are more splats than this browser can draw");
    }
    for (const texture of [this.cores, this.bands, this.selected, this.place, this.look, this.order]) if (texture) gl.deleteTexture(texture);
    this.cores = texture(gl, 2 * ROW, rows);
    this.bands = texture(gl, Math.max(1, degree) * ROW, degree ? rows : 1);
    this.selected = texture(gl, ROW, rows, gl.R8UI);
    this.masked = 0;
    this.place = texture(gl, ROW, rows);
    this.look = texture(gl, ROW, rows);
    this.order = texture(gl, ROW, rows, gl.R32UI);
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.place, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT1, gl.TEXTURE_2D, this.look, 0);
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    this.complete ||= this.total > 0 && this.loaded === this.total;
    this.beganAt = performance.now();
    [this.loaded, this.total, this.degree, this.drawn] = [0, count, degree, 0];
    this.generation += 1;
    this.worker?.postMessage({ reserve: count });
  }

  /** @param {WebGL2RenderingContext} gl @param {import("./stream.js").Block} block */
  take(gl, { first, count, cores, bands }) {
    const rows = Math.ceil(count / ROW);
    upload(gl, this.cores, first / ROW, 2 * ROW, rows, cores);
    if (this.degree) upload(gl, this.bands, first / ROW, this.degree * ROW, rows, bands);
    const words = new Float32Array(cores.buffer);
    const halves = new Uint16Array(cores.buffer);
    const positions = new Float32Array(3 * count);
    const radii = new Float32Array(count);
    for (let i = 0; i < count; i += 1) {
      positions.set(words.subarray(8 * i, 8 * i + 3), 3 * i);
      const largest = Math.max(half(halves[16 * i + 6]), half(halves[16 * i + 7]), half(halves[16 * i + 8]));
      radii[i] = 3.4 * Math.exp(largest);
    }
    this.worker?.postMessage({ block: { first, count, positions, radii } }, [positions.buffer, radii.buffer]);
    this.loaded = first + count;
    this.changedAt = performance.now();
    this.sharp = false;
    this.sort();
    this.dirty();
    this.fetchMask();
  }

  /** @param {Camera} camera @param {Intrinsics} k @param {any} shot */
  want(camera, k, shot) {
    if (this.scene) this.fetch(this.scene);
    this.wanted = { camera, shot };
    this.k = k;
    this.changedAt = performance.now();
    this.sharp = false;
    this.sort();
  }

  /** Asks the worker for the order of the present camera, one question at a time. */
  sort() {
    if (this.busy || !this.wanted || !this.k || !this.loaded) return;
    this.busy = true;
    const { camera } = this.wanted;
    const [right, down, forward] = axes(camera.rotation);
    const { fx, fy, cx, cy, width, height } = this.k;
    const limits = [-cx / fx, (width - cx) / fx, -cy / fy, (height - cy) / fy];
    this.asked = this.wanted;
    this.worker?.postMessage({ look: { right, down, forward, position: camera.position, limits, near: NEAR }, generation: this.generation });
  }

  /** @param {{ sorted: Uint32Array, milliseconds: number, generation: number }} answer */
  ordered({ sorted, milliseconds, generation }) {
    this.busy = false;
    this.sortMilliseconds = milliseconds;
    const gl = this.gl;
    if (!gl || generation !== this.generation) return this.sort();
    const whole = Math.floor(sorted.length / ROW);
    gl.bindTexture(gl.TEXTURE_2D, this.order ?? null);
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, whole, gl.RED_INTEGER, gl.UNSIGNED_INT, sorted);
    const rest = sorted.subarray(whole * ROW);
    if (rest.length) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, rest.length, 1, gl.RED_INTEGER, gl.UNSIGNED_INT, rest);
    this.drawn = sorted.length;
    this.sharp = false;
    this.fresh = true;
    if (this.asked !== this.wanted) this.sort();
  }

  /** Draws if something has changed; whether it has. @param {number} now */
  draw(now) {
    const gl = this.gl;
    if (!gl || !this.wanted || !this.k || !this.target || !this.projecting || this.sharp) return false;
    // A newer version replaces the picture when it is whole: half of it would flicker at each edit.
    if (this.loaded < this.total && this.complete && now < this.beganAt + PATIENCE) return false;
    const moving = now - this.changedAt < REST || this.busy;
    if (moving && !this.fresh && this.painted === this.wanted) return false;
    const started = performance.now();
    this.paint(moving ? this.share : 1);
    if (!this.accelerated || moving) {
      // Waits for the picture, to know what it costs.
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      const spent = performance.now() - started;
      if (moving) this.share = Math.min(1, Math.max(0.25, this.share * Math.min(1.15, Math.max(0.7, Math.sqrt(BUDGET / spent)))));
    }
    this.sharp = !moving;
    this.fresh = false;
    this.painted = this.wanted;
    return true;
  }

  /** Paints the wanted picture with a share of its sides. @param {number} share */
  paint(share) {
    const { gl, k, wanted } = this;
    if (!gl || !k || !wanted) return;
    const scene = this.scene;
    const [width, height] = [Math.max(1, Math.round(k.width * share)), Math.max(1, Math.round(k.height * share))];
    if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
    this.project(gl, wanted.camera, { ...k, width, height, fx: (k.fx * width) / k.width, fy: (k.fy * height) / k.height, cx: (k.cx * width) / k.width, cy: (k.cy * height) / k.height }, wanted.shot.clip, Boolean(wanted.shot.highlight));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    const [r, g, b] = wanted.shot.background ?? scene?.background ?? [0, 0, 0];
    gl.clearColor(r, g, b, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.blend(gl, width, height, Math.max(0, SHAPES.indexOf(wanted.shot.mode)));
  }

  /** Paints one eye of a headset. @param {WebGLFramebuffer | null} to @param {{ x: number, y: number, width: number, height: number }} port
   * @param {Camera} camera @param {Float32Array} projection column by column */
  eye(to, { x, y, width, height }, camera, projection) {
    const gl = this.gl;
    if (!gl) return;
    const [fx, fy] = [(projection[0] * width) / 2, (projection[5] * height) / 2];
    const k = { width, height, fx, fy, cx: ((1 - projection[8]) * width) / 2, cy: ((1 + projection[9]) * height) / 2 };
    this.wanted = { camera, shot: this.wanted?.shot ?? {} };
    this.k = k;
    this.sort();
    this.project(gl, camera, k, null, false);
    gl.bindFramebuffer(gl.FRAMEBUFFER, to);
    gl.viewport(x, y, width, height);
    this.blend(gl, width, height, 0);
  }

  /** @param {WebGL2RenderingContext} gl @param {Camera} camera @param {Intrinsics} k @param {[Vec3, Vec3] | null} clip
   * @param {boolean} highlight whether selected splats are tinted */
  project(gl, camera, k, clip, highlight) {
    const projecting = this.projecting;
    if (!projecting || !this.total) return;
    const [x, y, z] = axes(camera.rotation);
    const at = projecting.at;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target ?? null);
    gl.viewport(0, 0, ROW, Math.max(1, Math.ceil(this.loaded / ROW)));
    gl.disable(gl.BLEND);
    gl.useProgram(projecting.program);
    bind(gl, 0, this.cores, at("u_cores"));
    bind(gl, 1, this.bands, at("u_bands"));
    bind(gl, 2, this.selected, at("u_selected"));
    gl.uniform1i(at("u_highlight"), this.masked && highlight ? 1 : 0);
    gl.uniform1i(at("u_degree"), this.degree ?? 0);
    gl.uniform1i(at("u_count"), this.loaded);
    // Column by column: the camera's axes are the rows of camera from world.
    gl.uniformMatrix3fv(at("u_rotation"), false, [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]]);
    gl.uniform3fv(at("u_position"), camera.position);
    gl.uniform2f(at("u_focal"), k.fx, k.fy);
    gl.uniform2f(at("u_principal"), k.cx, k.cy);
    const [mx, my] = [(0.15 * k.width) / k.fx, (0.15 * k.height) / k.fy];
    gl.uniform4f(at("u_limits"), -(k.cx / k.fx + mx), (k.width - k.cx) / k.fx + mx, -(k.cy / k.fy + my), (k.height - k.cy) / k.fy + my);
    gl.uniform1f(at("u_near"), NEAR);
    gl.uniform1i(at("u_antialias"), this.scene?.antialias ? 1 : 0);
    gl.uniform3fv(at("u_low"), clip?.[0] ?? [-3e38, -3e38, -3e38]);
    gl.uniform3fv(at("u_high"), clip?.[1] ?? [3e38, 3e38, 3e38]);
    gl.bindVertexArray(this.empty ?? null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** @param {WebGL2RenderingContext} gl @param {number} width @param {number} height @param {number} shape */
  blend(gl, width, height, shape) {
    const blending = shape ? this.shaping : this.blending;
    if (!blending) return;
    const at = blending.at;
    gl.useProgram(blending.program);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    bind(gl, 0, this.place, at("u_place"));
    bind(gl, 1, this.look, at("u_look"));
    bind(gl, 2, this.order, at("u_order"));
    gl.uniform1i(at("u_drawn"), this.drawn);
    gl.uniform2f(at("u_size"), width, height);
    gl.uniform1i(at("u_shape"), shape);
    gl.bindVertexArray(this.quads ?? null);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.drawn / BATCH));
    gl.bindVertexArray(null);
  }
}

/** @param {number} bits of a half-precision number */
function half(bits) {
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  const value = exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024);
  return bits & 0x8000 ? -value : value;
}

/** @param {WebGL2RenderingContext} gl @param {number} width @param {number} height @param {number} [format] */
function texture(gl, width, height, format = gl.RGBA32UI) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return made;
}

/** Writes whole rows; the last one is padded. @param {WebGL2RenderingContext} gl @param {WebGLTexture | null | undefined} to
 * @param {number} first @param {number} width texels @param {number} rows @param {Uint8Array} bytes */
function upload(gl, to, first, width, rows, bytes) {
  const words = new Uint32Array(4 * width * rows);
  words.set(new Uint32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4));
  gl.bindTexture(gl.TEXTURE_2D, to ?? null);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, width, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
}

/** @param {WebGL2RenderingContext} gl @param {number} unit @param {WebGLTexture | null | undefined} from @param {WebGLUniformLocation | null} at */
function bind(gl, unit, from, at) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, from ?? null);
  gl.uniform1i(at, unit);
}

/** @param {WebGL2RenderingContext} gl @param {string} vertex @param {string} fragment */
function program(gl, vertex, fragment) {
  const linked = /** @type {WebGLProgram} */ (gl.createProgram());
  for (const [kind, text] of /** @type {const} */ ([[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]])) {
    const compiled = /** @type {WebGLShader} */ (gl.createShader(kind));
    gl.shaderSource(compiled, text);
    gl.compileShader(compiled);
    if (!gl.getShaderParameter(compiled, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(compiled) ?? "a shader does not compile");
    gl.attachShader(linked, compiled);
  }
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(linked) ?? "a program does not link");
  /** @type {Map<string, WebGLUniformLocation | null>} */
  const known = new Map();
  const at = (/** @type {string} */ name) => {
    if (!known.has(name)) known.set(name, gl.getUniformLocation(linked, name));
    return known.get(name) ?? null;
  };
  return { program: linked, at };
}

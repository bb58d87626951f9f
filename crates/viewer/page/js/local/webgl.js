// Draws splats with WebGL2: one pass projects every splat into a texture, another blends a quad for each, farthest first.

import { axes } from "../math.js";
import { orderWorker, shader } from "./assets.js";
import { Levels } from "./levels.js";

/** @typedef {import("./renderer.js").Camera} Camera */
/** @typedef {import("./renderer.js").Intrinsics} Intrinsics */
/** @typedef {import("./renderer.js").Options} Options */

/** Splats per row of the textures, as in the shaders. */
const ROW = 1024;
/** Splats per instance, as in the shader: with one splat each, a software rasteriser takes 4 microseconds per instance. */
const BATCH = 128;
const SHAPES = ["color", "ellipses", "rings", "points"];

export class WebGl {
  api = "WebGL2";
  /** Whether the worker is sorting. */
  busy = false;
  /** Number of splats of the scene and of those that have arrived; then their degree, and the number in view. */
  total = 0;
  loaded = 0;
  levels = new Levels([0]);
  degree = 0;
  drawn = 0;
  generation = 0;
  /** The range of the splats that were sorted: the scene, or a level of detail. */
  shown = { first: 0, end: 0 };
  /** The camera for which the splats are to be sorted, and the one for which they are being sorted.
   * @type {{ camera: Camera, k: Intrinsics, near: number, level: number } | null} */
  wanted = null;
  /** @type {{ camera: Camera, k: Intrinsics, near: number, level: number } | null} */
  asked = null;

  /** @param {WebGL2RenderingContext} gl @param {() => void} changed called when a new picture would differ from the last
   * @param {(lost: WebGl) => void} lose called when the context is lost */
  constructor(gl, changed, lose) {
    this.gl = gl;
    this.canvas = /** @type {HTMLCanvasElement} */ (gl.canvas);
    this.changed = changed;
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const device = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    this.accelerated = !/swiftshader|llvmpipe|software|basic render/i.test(device);
    this.worker = orderWorker();
    this.worker.onmessage = ({ data }) => this.ordered(data);
    this.ready = this.prepare(gl);
    this.canvas.addEventListener("webglcontextlost", () => {
      this.worker.terminate();
      lose(this);
    });
  }

  /** Null if the browser has no WebGL2. @param {() => void} changed @param {(lost: WebGl) => void} lose */
  static open(changed, lose) {
    const options = { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true, powerPreference: "high-performance" };
    const gl = /** @type {WebGL2RenderingContext | null} */ (document.createElement("canvas").getContext("webgl2", options));
    return gl && new WebGl(gl, changed, lose);
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

  /** @param {Uint8Array} bits of the selected splats */
  select(bits) {
    const gl = this.gl;
    const bytes = new Uint8Array(ROW * Math.max(1, Math.ceil(this.total / ROW)));
    for (let i = 0; i < this.total && i < 8 * bits.length; i += 1) bytes[i] = (bits[i >> 3] >> (i & 7)) & 1;
    gl.bindTexture(gl.TEXTURE_2D, this.selected ?? null);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, bytes.length / ROW, gl.RED_INTEGER, gl.UNSIGNED_BYTE, bytes);
  }

  /** Makes room; throws if there is too little. @param {Levels} levels @param {number} degree */
  begin(levels, degree) {
    const gl = this.gl;
    const count = levels.counts[0];
    const rows = Math.max(1, levels.room / ROW);
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("there are more splats than this browser can draw");
    for (const texture of [this.cores, this.bands, this.selected, this.place, this.look, this.order]) if (texture) gl.deleteTexture(texture);
    this.cores = texture(gl, 2 * ROW, rows);
    this.bands = texture(gl, Math.max(1, degree) * ROW, degree ? rows : 1);
    this.selected = texture(gl, ROW, rows, gl.R8UI);
    this.place = texture(gl, ROW, rows);
    this.look = texture(gl, ROW, rows);
    this.order = texture(gl, ROW, rows, gl.R32UI);
    if (this.target) gl.deleteFramebuffer(this.target);
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.place, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT1, gl.TEXTURE_2D, this.look, 0);
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    [this.total, this.degree, this.loaded, this.drawn] = [count, degree, 0, 0];
    [this.levels, this.shown] = [levels, { first: 0, end: 0 }];
    this.generation += 1;
    this.worker.postMessage({ reserve: levels.room });
  }

  /** @param {import("./stream.js").Block} block */
  take({ level, first: within, count, cores, bands }) {
    const gl = this.gl;
    const first = this.levels.starts[level] + within;
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
    this.worker.postMessage({ block: { first, count, positions, radii } }, [positions.buffer, radii.buffer]);
    this.loaded = this.levels.loaded[0];
  }

  /** Asks the worker for the order of splats for a camera, one request at a time.
   * @param {Camera} camera @param {Intrinsics} k @param {number} near @param {number} level of detail */
  aim(camera, k, near, level) {
    this.wanted = { camera, k, near, level };
    this.sort();
  }

  sort() {
    if (this.busy || !this.wanted || !this.loaded) return;
    this.busy = true;
    this.asked = this.wanted;
    const { camera, k, near, level } = this.asked;
    const [right, down, forward] = axes(camera.rotation);
    const { fx, fy, cx, cy, width, height } = k;
    const limits = [-cx / fx, (width - cx) / fx, -cy / fy, (height - cy) / fy];
    const first = this.levels.starts[level];
    const end = first + this.levels.loaded[level];
    this.worker.postMessage({ look: { right, down, forward, position: camera.position, limits, near, first, end }, generation: this.generation });
  }

  /** @param {{ sorted: Uint32Array, shown: { first: number, end: number }, generation: number }} answer */
  ordered({ sorted, shown, generation }) {
    this.busy = false;
    const gl = this.gl;
    if (generation !== this.generation) return this.sort();
    const whole = Math.floor(sorted.length / ROW);
    gl.bindTexture(gl.TEXTURE_2D, this.order ?? null);
    if (whole) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, whole, gl.RED_INTEGER, gl.UNSIGNED_INT, sorted);
    const rest = sorted.subarray(whole * ROW);
    if (rest.length) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, rest.length, 1, gl.RED_INTEGER, gl.UNSIGNED_INT, rest);
    this.drawn = sorted.length;
    this.shown = shown;
    this.changed();
    if (this.asked !== this.wanted) this.sort();
  }

  /** Paints immediately. @param {Camera} camera @param {Intrinsics} k @param {Options} options */
  paint(camera, k, options) {
    const { gl, canvas } = this;
    const { width, height } = k;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.project(gl, camera, k, options);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    const [r, g, b] = options.background;
    gl.clearColor(r, g, b, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    this.blend(gl, width, height, Math.max(0, SHAPES.indexOf(options.mode)));
    // Waits for the picture, to measure its cost.
    if (options.measured) gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    return true;
  }

  /** Nothing to do: pictures are painted directly on the canvas. */
  present() {}

  /** Paints one eye of a headset. @param {WebGLFramebuffer | null} to @param {{ x: number, y: number }} port its corner, pixels
   * @param {Camera} camera @param {Intrinsics} k @param {Options} options */
  eye(to, port, camera, k, options) {
    const gl = this.gl;
    this.project(gl, camera, k, options);
    gl.bindFramebuffer(gl.FRAMEBUFFER, to);
    gl.viewport(port.x, port.y, k.width, k.height);
    this.blend(gl, k.width, k.height, 0);
  }

  /** @param {WebGL2RenderingContext} gl @param {Camera} camera @param {Intrinsics} k @param {Options} options */
  project(gl, camera, k, { near, antialias, clip, highlight }) {
    const projecting = this.projecting;
    if (!projecting || !this.total) return;
    const [x, y, z] = axes(camera.rotation);
    const at = projecting.at;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target ?? null);
    const { first, end } = this.shown;
    gl.viewport(0, first / ROW, ROW, Math.max(1, Math.ceil((end - first) / ROW)));
    gl.disable(gl.BLEND);
    gl.useProgram(projecting.program);
    bind(gl, 0, this.cores, at("u_cores"));
    bind(gl, 1, this.bands, at("u_bands"));
    bind(gl, 2, this.selected, at("u_selected"));
    gl.uniform1i(at("u_highlight"), highlight ? 1 : 0);
    gl.uniform1i(at("u_degree"), this.degree);
    gl.uniform1i(at("u_count"), end);
    // Column by column: the camera's axes are the rows of camera from world.
    gl.uniformMatrix3fv(at("u_rotation"), false, [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]]);
    gl.uniform3fv(at("u_position"), camera.position);
    gl.uniform2f(at("u_focal"), k.fx, k.fy);
    gl.uniform2f(at("u_principal"), k.cx, k.cy);
    gl.uniform2f(at("u_size"), k.width, k.height);
    const [mx, my] = [(0.15 * k.width) / k.fx, (0.15 * k.height) / k.fy];
    gl.uniform4f(at("u_limits"), -(k.cx / k.fx + mx), (k.width - k.cx) / k.fx + mx, -(k.cy / k.fy + my), (k.height - k.cy) / k.fy + my);
    gl.uniform1f(at("u_near"), near);
    gl.uniform1i(at("u_antialias"), antialias ? 1 : 0);
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

// Draws splats with WebGPU, in the same way as the program.

import { shader } from "./assets.js";
import { GROUP, Gpu, Words, Work } from "./device.js";
import { Frame } from "./frame.js";
import { Levels } from "./levels.js";

/** Bytes of a splat without its higher bands, and of each of its bands, in words. */
const CORE = 8;
const BAND = 4;

/** @typedef {import("./renderer.js").Camera} Camera */
/** @typedef {import("./renderer.js").Intrinsics} Intrinsics */

export class WebGpu {
  api = "WebGPU";
  accelerated = true;
  /** Never busy between pictures: each is drawn as a whole. */
  busy = false;
  ready = Promise.resolve();
  /** Number of splats of the scene, of those to draw, and of those unpacked. */
  total = 0;
  drawn = 0;
  unpacked = 0;
  degree = 0;
  levels = new Levels([0]);
  /** The level of detail to draw. */
  level = 0;
  /** The tint, clipping box and level with which the splats were unpacked. */
  dressed = "";
  /** Width and height of the last picture. */
  painted = [1, 1];
  /** Grows with each selection. */
  selection = 0;

  /** @param {Gpu} gpu @param {Record<string, import("./device.js").Kernel>} kernels @param {GPURenderPipeline} presenting
   * @param {GPUTextureFormat} format @param {() => void} changed */
  constructor(gpu, kernels, presenting, format, changed) {
    this.gpu = gpu;
    this.changed = changed;
    this.unpack = kernels.unpack;
    this.frame = new Frame(gpu, kernels);
    this.presenting = presenting;
    this.canvas = document.createElement("canvas");
    this.context = /** @type {GPUCanvasContext} */ (this.canvas.getContext("webgpu"));
    this.context.configure({ device: gpu.device, format, alphaMode: "opaque" });
    const array = (/** @type {string} */ label, /** @type {number} */ words = 0) => new Words(gpu, label, words);
    this.cores = array("cores");
    this.bands = array("bands");
    this.selected = array("selected splats");
    this.params = array("unpacking", 12);
    this.size = array("size", 2);
  }

  /** Opens the device and compiles the kernels; throws if that fails.
   * @param {() => void} changed called when a new picture would differ from the last
   * @param {(reason: string) => void} fail called when the device fails later */
  static async open(changed, fail) {
    const gpu = await Gpu.open(fail);
    const format = navigator.gpu.getPreferredCanvasFormat();
    const present = async () => {
      const module = gpu.device.createShaderModule({ label: "present", code: await shader("present.wgsl") });
      return gpu.device.createRenderPipelineAsync({ label: "present", layout: "auto", vertex: { module }, fragment: { module, targets: [{ format }] } });
    };
    try {
      const [kernels, presenting] = await Promise.all([gpu.kernels(), present()]);
      return new WebGpu(gpu, kernels, presenting, format, changed);
    } catch (error) {
      gpu.device.destroy();
      throw error;
    }
  }

  /** Makes room; throws if there is too little. @param {Levels} levels @param {number} degree */
  begin(levels, degree) {
    const count = levels.counts[0];
    [this.total, this.degree, this.drawn, this.unpacked, this.dressed] = [count, degree, 0, 0, ""];
    [this.levels, this.level] = [levels, 0];
    this.cores.reserve(CORE * levels.room);
    this.bands.reserve(BAND * degree * levels.room);
    this.selected.reserve(Math.ceil(count / 32));
    this.frame.reserve({ count, stride: count, degree });
  }

  /** @param {import("./stream.js").Block} block */
  take({ level, first, cores, bands }) {
    const at = this.levels.starts[level] + first;
    this.cores.write(CORE * at, cores);
    if (this.degree) this.bands.write(BAND * this.degree * at, bands);
    this.drawn = this.levels.loaded[this.level];
  }

  /** @param {Uint8Array} bits of the selected splats */
  select(bits) {
    const whole = new Uint8Array(4 * Math.ceil(this.total / 32));
    whole.set(bits.subarray(0, whole.length));
    this.selected.write(0, whole);
    this.selection += 1;
  }

  /** Sets the level. Kernels sort, so that the camera need not be known in advance.
   * @param {Camera} _camera @param {Intrinsics} _k @param {number} _near @param {number} level */
  aim(_camera, _k, _near, level) {
    [this.level, this.drawn] = [level, this.levels.loaded[level]];
    this.changed();
  }

  /** Paints; resolves when `present` can show the picture, to whether there is one.
   * @param {import("./renderer.js").Camera} camera @param {import("./renderer.js").Intrinsics} k @param {import("./renderer.js").Options} options */
  async paint(camera, k, { near, background, antialias, clip, highlight }) {
    const { gpu, drawn } = this;
    this.dress(clip, highlight);
    if (!(await this.frame.draw({ camera, k, near, background, antialias }, drawn))) return false;
    this.painted = [k.width, k.height];
    await gpu.queue.onSubmittedWorkDone();
    return true;
  }

  /** Unpacks the splats that have arrived since, or all of them if tint, clipping box or level have changed.
   * @param {import("./renderer.js").Options["clip"]} clip @param {boolean} highlight */
  dress(clip, highlight) {
    const { gpu, frame, drawn, level } = this;
    const wanted = JSON.stringify([clip, highlight && this.selection, level]);
    const first = wanted === this.dressed ? this.unpacked : 0;
    [this.dressed, this.unpacked] = [wanted, drawn];
    if (first === drawn) return;
    const words = new Uint32Array(12);
    const floats = new Float32Array(words.buffer);
    floats.set(clip?.[0] ?? [-3e38, -3e38, -3e38], 0);
    floats.set(clip?.[1] ?? [3e38, 3e38, 3e38], 4);
    [words[3], words[7]] = [first, drawn];
    words.set([this.total, this.degree, highlight ? 1 : 0, this.levels.starts[level]], 8);
    this.params.write(0, words);
    const work = new Work(gpu);
    work.run(this.unpack, [this.params, this.cores, this.bands, this.selected, frame.geometry, frame.harmonics], Math.ceil((drawn - first) / GROUP));
    work.submit();
  }

  /** Brings the last picture to the canvas, which holds it until the browser has composed the page. */
  present() {
    const { device, queue } = this.gpu;
    const [width, height] = this.painted;
    if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
    this.size.write(0, Uint32Array.of(width, height));
    const encoder = device.createCommandEncoder();
    const view = this.context.getCurrentTexture().createView();
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] });
    pass.setPipeline(this.presenting);
    const entries = [this.size, this.frame.planes].map(({ buffer }, binding) => ({ binding, resource: { buffer } }));
    pass.setBindGroup(0, device.createBindGroup({ layout: this.presenting.getBindGroupLayout(0), entries }));
    pass.draw(3);
    pass.end();
    queue.submit([encoder.finish()]);
  }
}

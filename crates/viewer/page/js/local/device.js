// Compute with WebGPU: a device, arrays, kernels. The twin of crates/compute/src/gpu.

import { shader } from "./assets.js";

/** Threads of a workgroup. */
export const GROUP = 256;
/** Maximum number of workgroups along one axis. */
const MAX_WORKGROUPS = 65535;
/** Maximum number of storage arrays that a kernel binds: those of `blend`. */
const BINDINGS = 9;

/** An open device. */
export class Gpu {
  /** Buffers that were replaced by larger ones: recorded work may still use them. @type {GPUBuffer[]} */
  outgrown = [];

  /** @param {GPUDevice} device @param {(reason: string) => void} fail called when the device fails or is lost */
  constructor(device, fail) {
    this.device = device;
    this.queue = device.queue;
    this.largest = device.limits.maxStorageBufferBindingSize;
    device.lost.then(({ message }) => fail(`the GPU was lost: ${message}`));
    device.addEventListener("uncapturederror", ({ error }) => fail(error.message));
  }

  /** Opens the fastest adapter; throws if there is none that can draw splats. @param {(reason: string) => void} fail */
  static async open(fail) {
    if (!navigator.gpu) throw new Error("this browser has no WebGPU, or offers it only to pages of this machine and over https");
    const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter) throw new Error("there is no GPU for WebGPU");
    // WebGL2's rasteriser is three times faster there (SwiftShader, 4,000 splats): threads of a workgroup take turns at each barrier.
    if (isSoftware(adapter.info)) throw new Error("WebGPU runs on the CPU, where WebGL2 is faster");
    const { maxStorageBufferBindingSize, maxBufferSize, maxStorageBuffersPerShaderStage } = adapter.limits;
    if (maxStorageBuffersPerShaderStage < BINDINGS) throw new Error(`the GPU binds only ${maxStorageBuffersPerShaderStage} of ${BINDINGS} arrays`);
    const device = await adapter.requestDevice({ requiredLimits: {
      maxStorageBuffersPerShaderStage: BINDINGS,
      maxStorageBufferBindingSize: Math.min(maxStorageBufferBindingSize, maxBufferSize),
      maxBufferSize,
    } });
    return new Gpu(device, fail);
  }

  /** The program's own kernels by name, and those of the page. @returns {Promise<Record<string, Kernel>>} */
  async kernels() {
    const [text, unpack] = await Promise.all([shader("kernels.json"), shader("unpack.wgsl")]);
    /** @type {{ parts: string[], kernels: Record<string, number[]> }} */
    const { parts, kernels } = JSON.parse(text);
    const sources = Object.entries(kernels).map(([name, numbers]) => /** @type {const} */ ([name, numbers.map((number) => parts[number]).join("")]));
    const compiled = [...sources, /** @type {const} */ (["unpack", unpack])].map(async ([name, code]) => {
      const module = this.device.createShaderModule({ label: name, code });
      const pipeline = await this.device.createComputePipelineAsync({ label: name, layout: "auto", compute: { module, entryPoint: "main" } });
      return /** @type {const} */ ([name, new Kernel(pipeline)]);
    });
    return Object.fromEntries(await Promise.all(compiled));
  }
}

/** @param {GPUAdapterInfo} info */
const isSoftware = ({ vendor, architecture, description, isFallbackAdapter }) =>
  isFallbackAdapter || /swiftshader|llvmpipe|software|basic render/i.test(`${vendor} ${architecture} ${description}`);

/** A compiled kernel. */
export class Kernel {
  /** @param {GPUComputePipeline} pipeline */
  constructor(pipeline) {
    this.pipeline = pipeline;
    this.layout = pipeline.getBindGroupLayout(0);
  }
}

/** Memory on the device, in words of 32 bits, that grows and never shrinks. */
export class Words {
  words = 0;

  /** @param {Gpu} gpu @param {string} label @param {number} [words] */
  constructor(gpu, label, words = 0) {
    this.gpu = gpu;
    this.label = label;
    this.buffer = this.make(words);
  }

  /** @param {number} words */
  make(words) {
    const size = 4 * Math.max(words, 4);
    if (size > this.gpu.largest) throw new Error(`the GPU's largest array has ${Math.floor(this.gpu.largest / 1e6)} MB: ${this.label} needs ${Math.ceil(size / 1e6)} MB`);
    this.words = words;
    const usage = GPUBufferUsage.STORAGE | GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_SRC | GPUBufferUsage.COPY_DST;
    return this.gpu.device.createBuffer({ label: this.label, size, usage });
  }

  /** Makes room for `words`. If there was too little, all words are zero afterwards. @param {number} words */
  reserve(words) {
    if (words <= this.words) return;
    this.gpu.outgrown.push(this.buffer);
    // A quarter more: the number of intersections changes from frame to frame.
    this.buffer = this.make(Math.max(words, Math.min(Math.ceil(1.25 * words), Math.floor(this.gpu.largest / 4))));
  }

  /** Writes values from word `at` on, before any work that is submitted later.
   * @param {number} at @param {ArrayBufferView<ArrayBuffer>} values */
  write(at, values) {
    this.gpu.queue.writeBuffer(this.buffer, 4 * at, values);
  }
}

/** A recording of kernels that run one after another and are submitted together. */
export class Work {
  /** @type {GPUComputePassEncoder | undefined} */
  pass;

  /** @param {Gpu} gpu */
  constructor(gpu) {
    this.gpu = gpu;
    this.encoder = gpu.device.createCommandEncoder();
  }

  /** Runs a kernel with `groups` workgroups on arrays, in the order of its bindings.
   * @param {Kernel} kernel @param {Words[]} arrays @param {number} groups */
  run({ pipeline, layout }, arrays, groups) {
    if (groups === 0) return;
    const entries = arrays.map(({ buffer }, binding) => ({ binding, resource: { buffer } }));
    this.pass ??= this.encoder.beginComputePass();
    this.pass.setPipeline(pipeline);
    this.pass.setBindGroup(0, this.gpu.device.createBindGroup({ layout, entries }));
    const rows = Math.ceil(groups / MAX_WORKGROUPS);
    this.pass.dispatchWorkgroups(Math.ceil(groups / rows), rows);
  }

  /** Sets the first words of an array to zero. @param {Words} array @param {number} words */
  clear(array, words) {
    this.end().clearBuffer(array.buffer, 0, 4 * words);
  }

  /** Ends the pass of kernels; returns the encoder, for commands between passes. */
  end() {
    this.pass?.end();
    this.pass = undefined;
    return this.encoder;
  }

  submit() {
    this.gpu.queue.submit([this.end().finish()]);
    for (const buffer of this.gpu.outgrown.splice(0)) buffer.destroy();
  }
}

// Frames with WebGPU, by the program's own kernels: the twin of crates/splat/src/gpu/frame.rs.

import { axes, dot } from "../math.js";
import { GROUP, Words, Work } from "./device.js";
import { Scan, Sort } from "./sort.js";

/** @typedef {import("../camera.js").Camera} Camera */
/** @typedef {import("../camera.js").Intrinsics} Intrinsics */
/** @typedef {import("../math.js").Vec3} Vec3 */
/** Number of splats, stride of their planes, SH degree. @typedef {{ count: number, stride: number, degree: number }} Shape */
/** @typedef {{ camera: Camera, k: Intrinsics, near: number, background: Vec3, antialias: boolean }} View */

/** Width and height of a tile, pixels. */
const TILE = 16;
/** Planes of a frame: red, green, blue, alpha, depth. */
const FRAME_PLANES = 5;
/** Planes of the geometry: means, quaternions, ln scales, opacity logit. */
const GEOMETRY = 11;
/** Words of `View` in view.wgsl. */
const VIEW_WORDS = 44;
/** Bits of `View.flags`. */
const ANTIALIAS = 1;
const CLAMP = 4;

/** Tangents to which means are clamped: those of the borders of the image plus a margin, as in `ViewParams::tangent_limits`.
 * @param {number} size @param {number} focal @param {number} principal pixels @returns {[number, number]} */
const tangentLimits = (size, focal, principal) => {
  const margin = (0.15 * size) / focal;
  return [-(principal / focal + margin), (size - principal) / focal + margin];
};

export class Frame {
  /** @type {Shape} */
  shape = { count: 0, stride: 0, degree: 0 };

  /** @param {import("./device.js").Gpu} gpu @param {Record<string, import("./device.js").Kernel>} kernels */
  constructor(gpu, kernels) {
    this.gpu = gpu;
    this.kernels = kernels;
    const array = (/** @type {string} */ label, /** @type {number} */ words = 0) => new Words(gpu, label, words);
    this.view = array("view", VIEW_WORDS);
    this.geometry = array("geometry");
    this.harmonics = array("harmonics");
    this.filter = array("filter");
    this.footprints = array("footprints");
    this.visible = array("visible splats");
    this.touched = array("touched tiles");
    this.found = array("found", 4);
    this.order = array("order of splats");
    this.firsts = array("first slots");
    this.slots = array("slots");
    this.splatOfSlot = array("splats of slots");
    this.ranges = array("ranges of tiles");
    this.firstSegments = array("first segments");
    this.tileOfSegment = array("tiles of segments");
    this.reached = array("reached segments");
    this.states = array("states of pixels");
    this.planes = array("frame");
    this.places = array("places of visible splats");
    this.depths = array("depths");
    this.counts = array("counts of tiles");
    this.tiles = array("tiles");
    this.segmentCounts = array("counts of segments");
    this.scan = new Scan(gpu, kernels);
    this.scanParams = [0, 1, 2].map(() => array("scan parameters", 4));
    this.sortDepths = new Sort(gpu, kernels);
    this.sortTiles = new Sort(gpu, kernels);
    this.mapped = gpu.device.createBuffer({ label: "found", size: 16, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
  }

  /** Makes room for splats; the caller fills `geometry` and `harmonics`. @param {Shape} shape */
  reserve(shape) {
    const { stride, degree } = shape;
    this.shape = shape;
    this.geometry.reserve(GEOMETRY * stride);
    this.harmonics.reserve(3 * (degree + 1) ** 2 * stride);
    this.footprints.reserve(12 * stride);
    for (const array of [this.visible, this.touched, this.places, this.depths, this.order, this.counts, this.firsts]) array.reserve(stride);
  }

  /** Renders the first `drawn` splats into `planes`; resolves to false if other splats were loaded meanwhile.
   *
   * The number of entries is read back once, after projection, so that arrays are as large as needed and nothing is dropped.
   * @param {View} view @param {number} drawn */
  async draw(view, drawn) {
    const { gpu, kernels, shape } = this;
    const groups = (/** @type {number} */ items) => Math.ceil(items / GROUP);
    this.view.write(0, viewWords(view, shape, drawn, [0, 0]));
    const project = new Work(gpu);
    project.clear(this.found, 2);
    project.run(kernels.project, [this.view, this.geometry, this.harmonics, this.filter, this.footprints, this.visible, this.touched, this.found], groups(drawn));
    this.scan.run(project, this.scanParams[0], this.visible, this.places, drawn);
    project.run(kernels.compact, [this.view, this.visible, this.places, this.footprints, this.depths, this.order], groups(drawn));
    project.end().copyBufferToBuffer(this.found.buffer, 0, this.mapped, 0, 16);
    project.submit();
    await this.mapped.mapAsync(GPUMapMode.READ);
    const [visible, entries] = new Uint32Array(this.mapped.getMappedRange().slice(0));
    this.mapped.unmap();
    if (this.shape !== shape) return false;

    const { width, height } = view.k;
    const tiles = Math.ceil(width / TILE) * Math.ceil(height / TILE);
    this.view.write(0, viewWords(view, shape, drawn, [visible, entries]));
    for (const array of [this.tiles, this.slots, this.splatOfSlot]) array.reserve(entries);
    // After the tiles, a range for entries that belong to none.
    this.ranges.reserve(2 * (tiles + 1));
    for (const array of [this.segmentCounts, this.firstSegments, this.reached]) array.reserve(tiles + 1);
    this.planes.reserve(FRAME_PLANES * width * height);

    const blend = new Work(gpu);
    this.sortDepths.run(blend, this.depths, this.order, visible, 32);
    blend.run(kernels.count, [this.view, this.order, this.touched, this.counts, this.places], groups(visible));
    this.scan.run(blend, this.scanParams[1], this.counts, this.firsts, visible);
    blend.run(kernels.emit, [this.view, this.order, this.firsts, this.touched, this.footprints, this.tiles, this.slots, this.splatOfSlot], groups(visible));
    this.sortTiles.run(blend, this.tiles, this.slots, entries, 32 - Math.clz32(tiles));
    blend.clear(this.ranges, 2 * (tiles + 1));
    blend.run(kernels.ranges, [this.view, this.tiles, this.ranges], groups(entries));
    blend.run(kernels.segments, [this.view, this.ranges, this.segmentCounts], groups(tiles + 1));
    this.scan.run(blend, this.scanParams[2], this.segmentCounts, this.firstSegments, tiles + 1);
    blend.run(kernels.blend, [this.view, this.ranges, this.slots, this.splatOfSlot, this.footprints, this.firstSegments, this.tileOfSegment, this.reached, this.states, this.planes], tiles);
    blend.submit();
    return true;
  }
}

/** The words of `View` in view.wgsl. @param {View} view @param {Shape} shape @param {number} drawn splats
 * @param {[number, number]} found visible splats, entries of tiles */
function viewWords({ camera, k, near, background, antialias }, { stride, degree }, drawn, found) {
  const words = new Uint32Array(VIEW_WORDS);
  const { width, height, fx, fy, cx, cy } = k;
  const rows = axes(camera.rotation).flatMap((axis) => [...axis, -dot(axis, camera.position)]);
  new Float32Array(words.buffer).set([
    ...rows, ...camera.position, near, fx, fy, cx, cy, ...tangentLimits(width, fx, cx), ...tangentLimits(height, fy, cy), ...background, 0,
  ]);
  const flags = (antialias ? ANTIALIAS : 0) | CLAMP;
  words.set([width, height, Math.ceil(width / TILE), Math.ceil(height / TILE), drawn, stride, degree, drawn, ...found, 0, 0, flags, 0, 0, 0], 28);
  return words;
}

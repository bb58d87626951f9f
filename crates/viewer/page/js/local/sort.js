// Prefix sums and a stable radix sort with WebGPU: the twins of crates/compute/src/gpu/scan.rs and sort.rs.

import { Words } from "./device.js";

/** @typedef {import("./device.js").Gpu} Gpu */
/** @typedef {import("./device.js").Kernel} Kernel */
/** @typedef {import("./device.js").Work} Work */

/** Words of a block of a prefix sum. */
const SCAN_BLOCK = 2048;
/** Keys of a block of the sort. */
const SORT_BLOCK = 2048;
/** Bits of a digit. */
const DIGIT_BITS = 8;
const DIGITS = 1 << DIGIT_BITS;
/** Number of digits per workgroup that sums counts. */
const DIGITS_PER_GROUP = 8;

/** Exclusive prefix sums of words. */
export class Scan {
  /** @param {Gpu} gpu @param {Record<string, Kernel>} kernels */
  constructor(gpu, kernels) {
    this.kernels = kernels;
    this.sums = new Words(gpu, "sums of blocks");
  }

  /** `before[i]` becomes the sum of the words of `values` before `i`. Each run in a submission needs its own `params`, of four words.
   * @param {Work} work @param {Words} params @param {Words} values @param {Words} before @param {number} count */
  run(work, params, values, before, count) {
    const blocks = Math.ceil(count / SCAN_BLOCK);
    params.write(0, Uint32Array.of(count, blocks));
    this.sums.reserve(blocks + 1);
    const { scan_blocks, scan_sums, scan_apply } = this.kernels;
    work.run(scan_blocks, [params, values, this.sums], blocks);
    work.run(scan_sums, [params, this.sums], Math.min(blocks, 1));
    work.run(scan_apply, [params, values, this.sums, before], blocks);
  }
}

/** A stable sort of words as keys, with one word each as value. */
export class Sort {
  /** @param {Gpu} gpu @param {Record<string, Kernel>} kernels */
  constructor(gpu, kernels) {
    this.kernels = kernels;
    this.passes = Array.from({ length: 32 / DIGIT_BITS }, () => new Words(gpu, "sort parameters", 4));
    this.counts = new Words(gpu, "counts of digits");
    this.other = [new Words(gpu, "sorted keys"), new Words(gpu, "sorted values")];
  }

  /** Sorts the first `count` keys by their lowest bits, and their values with them. Once per submission.
   * @param {Work} work @param {Words} keys @param {Words} values @param {number} count @param {number} bits */
  run(work, keys, values, count, bits) {
    const blocks = Math.ceil(count / SORT_BLOCK);
    // After the blocks, the totals.
    this.counts.reserve((blocks + 1) * DIGITS);
    for (const array of this.other) array.reserve(count);
    // An even number, so that the result ends up in the same arrays.
    const passes = 2 * Math.ceil(bits / DIGIT_BITS / 2);
    const { sort_count, sort_starts, sort_scatter } = this.kernels;
    let [from, to] = [[keys, values], this.other];
    this.passes.slice(0, passes).forEach((params, i) => {
      params.write(0, Uint32Array.of(count, blocks, DIGIT_BITS * i));
      work.run(sort_count, [params, from[0], this.counts], blocks);
      work.run(sort_starts, [params, this.counts], DIGITS / DIGITS_PER_GROUP);
      work.run(sort_scatter, [params, from[0], from[1], this.counts, to[0], to[1]], blocks);
      [from, to] = [to, from];
    });
  }
}

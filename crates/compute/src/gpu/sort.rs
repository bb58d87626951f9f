use super::{Array, Gpu, Kernel, PART_ALIGN, Work};
use crate::shaders::{SORT, SORT_SIZES};

/// Keys of a block.
const BLOCK: usize = 2048;
/// Bits of a digit.
const DIGIT_BITS: u32 = 8;
const BUCKETS: usize = 1 << DIGIT_BITS;
/// Digits per workgroup of the kernel that sums counts.
const DIGITS_PER_GROUP: usize = 8;

/// A stable radix sort of words, each with a word as its value; only the device needs to know their number.
#[derive(Debug)]
pub struct Sort {
    kernels: [Kernel; 3],
    sizes: Kernel,
    /// Parts of `params`, one per pass.
    passes: Vec<Array>,
    params: Array,
    counts: Array,
    other: [Array; 2],
}

impl Sort {
    /// Compiles the kernels, for keys below `2^bits`.
    pub fn new(gpu: &Gpu, bits: u32) -> Self {
        let passes = passes(bits);
        let params = Array::zeros(gpu, "sort parameters", passes * PART_ALIGN);
        let part = |i| params.part(i * PART_ALIGN, 4);
        for pass in 0..passes {
            part(pass).write(gpu, 2, &[DIGIT_BITS * pass as u32]);
        }
        Self {
            kernels: SORT.each_ref().map(|shader| Kernel::new(gpu, shader)),
            sizes: Kernel::new(gpu, &SORT_SIZES),
            passes: (0..passes).map(part).collect(),
            params,
            counts: Array::zeros(gpu, "counts of digits", 0),
            other: ["sorted keys", "sorted values"].map(|label| Array::zeros(gpu, label, 0)),
        }
    }

    /// Sorts the keys, together with their values, by the lowest `bits` bits of the keys. The number of keys is the first word of `count`,
    /// and at most `max_count`.
    pub fn run(&mut self, work: &mut Work, keys: &Array, values: &Array, count: &Array, max_count: usize, bits: u32) {
        let (gpu, blocks) = (work.gpu(), max_count.div_ceil(BLOCK));
        // The totals follow the blocks.
        self.counts.reserve(gpu, (blocks + 1) * BUCKETS);
        for other in &mut self.other {
            other.reserve(gpu, max_count);
        }
        work.run(&self.sizes, &[count, &self.params], 1);
        let [count_digits, starts, scatter] = &self.kernels;
        let [other_keys, other_values] = &self.other;
        for (i, params) in self.passes[..passes(bits)].iter().enumerate() {
            let (from, to) = match i % 2 {
                0 => ([keys, values], [other_keys, other_values]),
                _ => ([other_keys, other_values], [keys, values]),
            };
            work.run(count_digits, &[params, from[0], &self.counts], blocks);
            work.run(starts, &[params, &self.counts], BUCKETS / DIGITS_PER_GROUP);
            work.run(scatter, &[params, from[0], from[1], &self.counts, to[0], to[1]], blocks);
        }
    }
}

/// Number of passes: even, so that the result ends up in the original arrays.
fn passes(bits: u32) -> usize {
    bits.div_ceil(DIGIT_BITS).next_multiple_of(2) as usize
}

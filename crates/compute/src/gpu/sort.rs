use super::{Array, Gpu, Kernel, PART, Scan, Work};
use crate::shaders::{SORT, SORT_SIZES};

/// Keys of a block.
const BLOCK: usize = 4096;
/// Counts of digits that one workgroup sums up.
const FEW: usize = 4096;
/// Bits of a digit.
const DIGIT: u32 = 4;

/// A stable radix sort of words with a word each, as many as the device knows.
#[derive(Debug)]
pub struct Sort {
    kernels: [Kernel; 2],
    sizes: Kernel,
    scan: Scan,
    /// Parts of `params`: of each pass, then of the prefix sums of few counts of digits, and of many.
    passes: Vec<Array>,
    scans: [Array; 2],
    params: Array,
    counts: Array,
    starts: Array,
    other: [Array; 2],
}

impl Sort {
    /// Compiles, for keys below `2^bits`.
    pub fn new(gpu: &Gpu, bits: u32) -> Self {
        let passes = passes(bits);
        let params = Array::zeros(gpu, "sort parameters", (passes + 2) * PART);
        let part = |i| params.part(i * PART, 4);
        for pass in 0..passes {
            part(pass).write(gpu, 2, &[DIGIT * pass as u32]);
        }
        Self {
            kernels: SORT.each_ref().map(|shader| Kernel::new(gpu, shader)),
            sizes: Kernel::new(gpu, &SORT_SIZES),
            scan: Scan::new(gpu),
            passes: (0..passes).map(part).collect(),
            scans: [passes, passes + 1].map(part),
            params,
            counts: Array::zeros(gpu, "counts of digits", 0),
            starts: Array::zeros(gpu, "starts of digits", 0),
            other: ["sorted keys", "sorted values"].map(|label| Array::zeros(gpu, label, 0)),
        }
    }

    /// Sorts keys, and their values alike, by their lowest `bits` bits. Their number is the first word of `count` and at most `most`.
    pub fn run(&mut self, work: &mut Work, keys: &Array, values: &Array, count: &Array, most: usize, bits: u32) {
        let (gpu, blocks) = (work.gpu(), most.div_ceil(BLOCK));
        let digits = 1 << DIGIT;
        let counts = digits * blocks;
        self.counts.reserve(gpu, counts + 1);
        self.starts.reserve(gpu, counts);
        for other in &mut self.other {
            other.reserve(gpu, most);
        }
        work.run(&self.sizes, &[count, &self.params], 1);
        let [count_digits, scatter] = &self.kernels;
        let [other_keys, other_values] = &self.other;
        for (i, params) in self.passes[..passes(bits)].iter().enumerate() {
            let (from, to) = match i % 2 {
                0 => ([keys, values], [other_keys, other_values]),
                _ => ([other_keys, other_values], [keys, values]),
            };
            work.run(count_digits, &[params, from[0], &self.counts], blocks);
            let starts = match counts <= FEW {
                true => {
                    self.scan.run_in_place(work, &self.scans[0], &self.counts);
                    &self.counts
                }
                false => {
                    self.scan
                        .run_sized(work, &self.scans[1], &self.counts, &self.starts, counts);
                    &self.starts
                }
            };
            work.run(scatter, &[params, from[0], from[1], starts, to[0], to[1]], blocks);
        }
    }
}

/// An even number, so that what is sorted ends where it was.
fn passes(bits: u32) -> usize {
    bits.div_ceil(DIGIT).next_multiple_of(2) as usize
}

use super::{Array, Gpu, Kernel, Scan, Work};
use crate::shaders::SORT;

/// Keys of a block.
const BLOCK: usize = 4096;
/// Counts of digits that one workgroup sums up.
const FEW: usize = 4096;
/// Bits of a digit.
const DIGIT: u32 = 4;

/// A stable radix sort of words with a word each.
#[derive(Debug)]
pub struct Sort {
    kernels: [Kernel; 2],
    scan: Scan,
    passes: Vec<Pass>,
    counts: Array,
    starts: Array,
    other: [Array; 2],
}

/// What a pass over one digit has of its own, since all passes are submitted together.
#[derive(Debug)]
struct Pass {
    params: Array,
    scan: Array,
}

impl Sort {
    /// Compiles, for keys below `2^bits`.
    pub fn new(gpu: &Gpu, bits: u32) -> Self {
        // An even number, so that what is sorted ends where it was.
        let passes = bits.div_ceil(DIGIT).next_multiple_of(2);
        Self {
            kernels: SORT.each_ref().map(|shader| Kernel::new(gpu, shader)),
            scan: Scan::new(gpu),
            passes: (0..passes)
                .map(|_| Pass {
                    params: Array::zeros(gpu, "sort parameters", 4),
                    scan: Scan::params(gpu),
                })
                .collect(),
            counts: Array::zeros(gpu, "counts of digits", 0),
            starts: Array::zeros(gpu, "starts of digits", 0),
            other: ["sorted keys", "sorted values"].map(|label| Array::zeros(gpu, label, 0)),
        }
    }

    /// Sorts the first `count` keys, and their values alike, by their lowest `bits` bits. Once per submission.
    pub fn run(&mut self, work: &mut Work, keys: &Array, values: &Array, count: usize, bits: u32) {
        let (gpu, blocks) = (work.gpu(), count.div_ceil(BLOCK));
        let digits = 1 << DIGIT;
        let counts = digits * blocks;
        self.counts.reserve(gpu, counts + 1);
        self.starts.reserve(gpu, counts);
        for other in &mut self.other {
            other.reserve(gpu, count);
        }
        let [count_digits, scatter] = &self.kernels;
        let [other_keys, other_values] = &self.other;
        let passes = bits.div_ceil(DIGIT).next_multiple_of(2) as usize;
        for (i, pass) in self.passes[..passes].iter().enumerate() {
            let shift = DIGIT * i as u32;
            pass.params.write(gpu, 0, &[count as u32, blocks as u32, shift]);
            let (from, to) = match i % 2 {
                0 => ([keys, values], [other_keys, other_values]),
                _ => ([other_keys, other_values], [keys, values]),
            };
            work.run(count_digits, &[&pass.params, from[0], &self.counts], blocks);
            let starts = match counts <= FEW {
                true => {
                    self.scan.run_in_place(work, &pass.scan, &self.counts, counts);
                    &self.counts
                }
                false => {
                    self.scan.run(work, &pass.scan, &self.counts, &self.starts, counts);
                    &self.starts
                }
            };
            work.run(scatter, &[&pass.params, from[0], from[1], starts, to[0], to[1]], blocks);
        }
    }
}

use super::{Array, Gpu, Kernel, Work};
use crate::shaders::SCAN;

/// Words of a block.
const BLOCK: usize = 2048;

/// Exclusive prefix sums of words, in three kernels: the sums of blocks, the sums before each block, the sums before each word.
#[derive(Debug)]
pub struct Scan {
    kernels: [Kernel; 3],
    sums: Array,
}

impl Scan {
    /// Compiles the kernels.
    pub fn new(gpu: &Gpu) -> Self {
        Self {
            kernels: SCAN.each_ref().map(|shader| Kernel::new(gpu, shader)),
            sums: Array::zeros(gpu, "sums of blocks", 0),
        }
    }

    /// An array for the parameters of one [`Scan::run`] in a submission.
    pub fn params(gpu: &Gpu) -> Array {
        Array::zeros(gpu, "scan parameters", 4)
    }

    /// `before[i]` becomes the sum of the words of `values` before `i`, for `i < count`. Each run in a submission needs its own `params`.
    pub fn run(&mut self, work: &mut Work, params: &Array, values: &Array, before: &Array, count: usize) {
        let (gpu, blocks) = (work.gpu(), count.div_ceil(BLOCK));
        params.write(gpu, 0, &[count as u32, blocks as u32]);
        self.sums.reserve(gpu, blocks + 1);
        let [of_blocks, of_sums, apply] = &self.kernels;
        work.run(of_blocks, &[params, values, &self.sums], blocks);
        work.run(of_sums, &[params, &self.sums], usize::from(blocks > 0));
        work.run(apply, &[params, values, &self.sums, before], blocks);
    }
}

//! Image rows laid out for SIMD: zeros on either side for windows that extend beyond the border, and every row aligned to a
//! cache line.

use irradia_compute::simd::Scalar;

/// Width of the widest vector; row widths are rounded up to a multiple of it.
pub(super) const BLOCK: usize = 16;

/// Rows of equal width.
#[derive(Default)]
pub(super) struct Rows<T> {
    data: Vec<T>,
    /// Start of the first row: the first cache line of the allocation.
    start: usize,
    stride: usize,
    /// Columns, rounded up.
    width: usize,
    /// Requested columns.
    used: usize,
}

impl<T: Scalar> Rows<T> {
    /// Reshapes to `rows` rows of zeros of at least `used` columns, unless they have that width already.
    pub(super) fn reshape(&mut self, rows: usize, used: usize) {
        // The exact width is compared, not the rounded one: the padding may still hold values of the previous width.
        if self.used == used {
            return;
        }
        let width = used.next_multiple_of(BLOCK);
        // An odd number of cache lines: rows a power of two apart would evict one another from the L1 cache.
        let stride = (((width + 2 * BLOCK) / BLOCK) | 1) * BLOCK;
        self.data = vec![T::default(); rows * stride + 64];
        let aligned = self.data.as_ptr().align_offset(64);
        self.start = if aligned < 64 { aligned } else { 0 };
        (self.stride, self.width, self.used) = (stride, width, used);
    }

    /// Row `row` with [`BLOCK`] zeros before its first column and after its last.
    #[inline(always)]
    pub(super) fn padded(&self, row: usize) -> &[T] {
        let from = self.start + row * self.stride;
        &self.data[from..from + self.width + 2 * BLOCK]
    }

    /// The columns of row `row`, in blocks.
    #[inline(always)]
    pub(super) fn blocks(&self, row: usize) -> &[[T; BLOCK]] {
        let from = self.start + row * self.stride + BLOCK;
        self.data[from..from + self.width].as_chunks().0
    }

    /// The columns of `N` rows starting at `row`, mutable.
    #[inline(always)]
    pub(super) fn columns_mut<const N: usize>(&mut self, row: usize) -> [&mut [T]; N] {
        let from = self.start + row * self.stride;
        let mut rows = self.data[from..from + N * self.stride].chunks_exact_mut(self.stride);
        let width = self.width;
        std::array::from_fn(|_| &mut rows.next().expect("N rows")[BLOCK..BLOCK + width])
    }
}

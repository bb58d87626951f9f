//! Arrays of four, which compilers turn into NEON or SSE2.

use super::{INDEX_BITS, Lanes};

/// Four lanes; always available.
#[derive(Clone, Copy)]
pub(super) struct Arrays;

impl Lanes for Arrays {
    type V = [u32; 4];
    const LANES: usize = 4;
    const STEP: usize = 2;
    const OFFSET_ROWS: bool = false;
    #[inline(always)]
    fn set(self, value: u32) -> [u32; 4] {
        [value; 4]
    }
    #[inline(always)]
    fn load(self, from: &[u32]) -> [u32; 4] {
        *from.first_chunk().expect("a whole vector")
    }
    #[inline(always)]
    fn store(self, v: [u32; 4], to: &mut [u32]) {
        *to.first_chunk_mut().expect("room for a vector") = v;
    }
    #[inline(always)]
    fn add_products(self, sums: [u32; 4], columns: [u32; 4], row: u32) -> [u32; 4] {
        // Factors of at most 16 bits, for which vectors have a multiplication.
        let product = |a: u32, b: u32| u32::from(a as u16) * u32::from(b as u16);
        std::array::from_fn(|i| sums[i] + product(columns[i], row) + product(columns[i] >> 16, row >> 16))
    }
    #[inline(always)]
    fn key(self, product: [u32; 4], index: u32) -> [u32; 4] {
        product.map(|product| product << INDEX_BITS | index)
    }
    #[inline(always)]
    fn max(self, a: [u32; 4], b: [u32; 4]) -> [u32; 4] {
        std::array::from_fn(|i| a[i].max(b[i]))
    }
    #[inline(always)]
    fn min(self, a: [u32; 4], b: [u32; 4]) -> [u32; 4] {
        std::array::from_fn(|i| a[i].min(b[i]))
    }
}

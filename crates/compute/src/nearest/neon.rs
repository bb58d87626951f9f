//! NEON with dot products (16 products per instruction), available on every 64-bit ARM processor since 2018, on Apple's since the M1.
//! Every `unsafe` block below runs instructions that are available because only [`detect`] creates the token.

use super::{INDEX_BITS, Lanes};
use std::arch::aarch64::*;
use std::arch::{asm, is_aarch64_feature_detected};

/// Proof of NEON with dot products.
#[derive(Clone, Copy)]
pub(super) struct Neon(());

/// The token, if this processor has the instructions.
pub(super) fn detect() -> Option<Neon> {
    is_aarch64_feature_detected!("dotprod").then_some(Neon(()))
}

impl Lanes for Neon {
    type V = uint32x4_t;
    const LANES: usize = 4;
    const STEP: usize = 4;
    const OFFSET_ROWS: bool = false;
    #[inline(always)]
    fn set(self, value: u32) -> uint32x4_t {
        // SAFETY: the token proves the instruction set, here and below.
        unsafe { vdupq_n_u32(value) }
    }
    #[inline(always)]
    fn load(self, from: &[u32]) -> uint32x4_t {
        let from: &[u32; 4] = from.first_chunk().expect("a whole vector");
        // SAFETY: the array is as long as the load.
        unsafe { vld1q_u32(from.as_ptr()) }
    }
    #[inline(always)]
    fn store(self, v: uint32x4_t, to: &mut [u32]) {
        let to: &mut [u32; 4] = to.first_chunk_mut().expect("room for a vector");
        // SAFETY: the array is as long as the store.
        unsafe { vst1q_u32(to.as_mut_ptr(), v) }
    }
    #[inline(always)]
    fn add_products(self, mut sums: uint32x4_t, columns: uint32x4_t, row: u32) -> uint32x4_t {
        // SAFETY: the instruction reads and writes these registers only. `vdotq_u32` is not stable in Rust
        // (rust-lang/rust#117224).
        unsafe {
            asm!(
                ".arch_extension dotprod",
                "udot {sums:v}.4s, {columns:v}.16b, {row:v}.16b",
                sums = inout(vreg) sums,
                columns = in(vreg) columns,
                row = in(vreg) vdupq_n_u32(row),
                options(pure, nomem, nostack, preserves_flags),
            );
        }
        sums
    }
    #[inline(always)]
    fn key(self, product: uint32x4_t, index: u32) -> uint32x4_t {
        unsafe { vorrq_u32(vshlq_n_u32::<{ INDEX_BITS as i32 }>(product), vdupq_n_u32(index)) }
    }
    #[inline(always)]
    fn max(self, a: uint32x4_t, b: uint32x4_t) -> uint32x4_t {
        unsafe { vmaxq_u32(a, b) }
    }
    #[inline(always)]
    fn min(self, a: uint32x4_t, b: uint32x4_t) -> uint32x4_t {
        unsafe { vminq_u32(a, b) }
    }
}

//! AVX-512 VNNI (64 products per instruction) and AVX2 (16). Every `unsafe` block below calls an intrinsic whose instructions are
//! available because only [`nearest`] creates the tokens, after detecting them.

use super::{BYTES, INDEX_BITS, Lanes, Nearest, search};
use crate::Level;
use std::arch::x86_64::*;

/// Proof of AVX-512 F, BW, VL and VNNI.
#[derive(Clone, Copy)]
struct Vnni(());

/// Proof of AVX2.
#[derive(Clone, Copy)]
struct Avx2(());

/// As [`super::nearest`]. AVX-512 without VNNI would gain little over AVX2, so AVX2 is used instead.
pub(super) fn nearest(level: Level, a: &[[u8; BYTES]], b: &[[u8; BYTES]]) -> [Vec<Nearest>; 2] {
    #[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512vnni,avx2")]
    fn vnni(a: &[[u8; BYTES]], b: &[[u8; BYTES]]) -> [Vec<Nearest>; 2] {
        search(Vnni(()), a, b)
    }
    #[target_feature(enable = "avx2")]
    fn avx2(a: &[[u8; BYTES]], b: &[[u8; BYTES]]) -> [Vec<Nearest>; 2] {
        search(Avx2(()), a, b)
    }
    if matches!(level, Level::Avx512(_)) && is_x86_feature_detected!("avx512vnni") {
        // SAFETY: the level proves AVX-512 F, BW and VL and AVX2; VNNI is detected.
        return unsafe { vnni(a, b) };
    }
    // SAFETY: both levels prove AVX2.
    unsafe { avx2(a, b) }
}

/// Implements [`Lanes`] for one width from its intrinsics.
macro_rules! integer_lanes {
    ($token:ident, $vector:ident, $lanes:literal, step: $step:literal, offset: $offset:literal,
     $set1:ident, $loadu:ident, $storeu:ident, $or:ident, $shift:ident, $max:ident, $min:ident,
     products: |$sums:ident, $columns:ident, $row:ident| $products:expr) => {
        impl Lanes for $token {
            type V = $vector;
            const LANES: usize = $lanes;
            const STEP: usize = $step;
            const OFFSET_ROWS: bool = $offset;
            #[inline(always)]
            fn set(self, value: u32) -> $vector {
                // SAFETY: the token proves the instruction set, here and below.
                unsafe { $set1(value as i32) }
            }
            #[inline(always)]
            fn load(self, from: &[u32]) -> $vector {
                let from: &[u32; $lanes] = from.first_chunk().expect("a whole vector");
                // SAFETY: the array is as long as the unaligned load.
                unsafe { $loadu(from.as_ptr().cast()) }
            }
            #[inline(always)]
            fn store(self, v: $vector, to: &mut [u32]) {
                let to: &mut [u32; $lanes] = to.first_chunk_mut().expect("room for a vector");
                // SAFETY: the array is as long as the unaligned store.
                unsafe { $storeu(to.as_mut_ptr().cast(), v) }
            }
            #[inline(always)]
            fn add_products(self, $sums: $vector, $columns: $vector, row: u32) -> $vector {
                let $row = self.set(row);
                unsafe { $products }
            }
            #[inline(always)]
            fn key(self, product: $vector, index: u32) -> $vector {
                let index = self.set(index);
                unsafe { $or($shift::<{ INDEX_BITS as _ }>(product), index) }
            }
            #[inline(always)]
            fn max(self, a: $vector, b: $vector) -> $vector {
                unsafe { $max(a, b) }
            }
            #[inline(always)]
            fn min(self, a: $vector, b: $vector) -> $vector {
                unsafe { $min(a, b) }
            }
        }
    };
}

integer_lanes!(Vnni, __m512i, 16, step: 4, offset: true,
    _mm512_set1_epi32, _mm512_loadu_si512, _mm512_storeu_si512, _mm512_or_si512, _mm512_slli_epi32,
    _mm512_max_epu32, _mm512_min_epu32,
    // Unsigned columns times signed rows.
    products: |sums, columns, row| _mm512_dpbusd_epi32(sums, columns, row));

integer_lanes!(Avx2, __m256i, 8, step: 2, offset: false,
    _mm256_set1_epi32, _mm256_loadu_si256, _mm256_storeu_si256, _mm256_or_si256, _mm256_slli_epi32,
    _mm256_max_epu32, _mm256_min_epu32,
    // Bytes widened to 16 bits: `maddubs` would saturate.
    products: |sums, columns, row| _mm256_add_epi32(sums, _mm256_madd_epi16(columns, row)));

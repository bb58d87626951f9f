//! AVX2 and AVX-512 lanes. Every `unsafe` block below calls an intrinsic whose instructions are available because every value
//! derives from a token that only `detect` creates.

use super::{EXP2, Kernel, Lanes, Mask, Simd};
use std::arch::x86_64::*;
use std::fmt::{Debug, Formatter, Result};
use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

/// Proof of AVX-512 F, DQ, BW, VL and FMA.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Avx512(());

/// Proof of AVX2 and FMA.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Avx2(());

/// Sixteen `f32`.
#[derive(Clone, Copy)]
#[repr(transparent)]
pub struct F32x16(__m512);

/// Eight `f32`.
#[derive(Clone, Copy)]
#[repr(transparent)]
pub struct F32x8(__m256);

/// Sixteen booleans in a mask register.
#[derive(Clone, Copy, Debug)]
pub struct Mask16(__mmask16);

/// Eight booleans, all bits of a lane set or clear.
#[derive(Clone, Copy)]
pub struct Mask8(__m256);

impl Avx512 {
    pub(super) fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma"))
        .then_some(Self(()))
    }

    #[inline]
    pub(super) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        #[target_feature(enable = "avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")]
        fn with_features<K: Kernel>(simd: Avx512, kernel: K) -> K::Output {
            kernel.run(simd)
        }
        // SAFETY: `self` exists only where `detect` found these features.
        unsafe { with_features(self, kernel) }
    }
}

impl Avx2 {
    pub(super) fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(()))
    }

    #[inline]
    pub(super) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        #[target_feature(enable = "avx2,fma")]
        fn with_features<K: Kernel>(simd: Avx2, kernel: K) -> K::Output {
            kernel.run(simd)
        }
        // SAFETY: `self` exists only where `detect` found these features.
        unsafe { with_features(self, kernel) }
    }
}

/// Implements the lane traits for one width from its intrinsics.
macro_rules! float_lanes {
    ($simd:ident, $vector:ident, $mask:ident, $lanes:literal,
     $set1:ident, $loadu:ident, $storeu:ident, $add:ident, $sub:ident, $mul:ident, $div:ident,
     $fmadd:ident, $sqrt:ident, $min:ident, $max:ident,
     abs: |$abs_v:ident| $abs:expr, neg: |$neg_v:ident| $neg:expr, floor: |$floor_v:ident| $floor:expr,
     lt: |$lt_a:ident, $lt_b:ident| $lt:expr, le: |$le_a:ident, $le_b:ident| $le:expr,
     select: |$sel_m:ident, $sel_a:ident, $sel_b:ident| $select:expr,
     exp2: |$exp_v:ident| $exp2:expr, recip: |$recip_v:ident| $recip:expr, sum: |$sum_v:ident| $sum:expr, sums: $sums:ident,
     transpose: $transpose:ident) => {
        impl Simd for $simd {
            type F = $vector;
            const LANES: usize = $lanes;
            #[inline(always)]
            fn splat(self, value: f64) -> $vector {
                self.set(value as f32)
            }
            #[inline(always)]
            fn set(self, value: f32) -> $vector {
                // SAFETY: the token proves the instruction set.
                $vector(unsafe { $set1(value) })
            }
            #[inline(always)]
            fn load(self, from: &[f32]) -> $vector {
                let from: &[f32; $lanes] = from.first_chunk().expect("a whole vector");
                // SAFETY: the token proves the instruction set; the array is as long as the unaligned load.
                $vector(unsafe { $loadu(from.as_ptr()) })
            }
            #[inline(always)]
            fn prefetch<T>(self, place: &T) {
                // SAFETY: SSE is part of x86-64; a prefetch of any address has no effect but on caches.
                unsafe { _mm_prefetch::<_MM_HINT_T0>((&raw const *place).cast()) }
            }
            #[inline(always)]
            fn transpose(self, from: &[f32], stride: usize, to: &mut [f32], to_stride: usize) {
                let mut square = [self.splat(0.0); $lanes];
                for i in 0..$lanes {
                    square[i] = self.load(&from[i * stride..]);
                }
                let transposed = $transpose(square);
                for j in 0..$lanes {
                    transposed[j].store(&mut to[j * to_stride..]);
                }
            }
        }

        impl Lanes for $vector {
            type Scalar = f32;
            type Mask = $mask;
            type Simd = $simd;
            #[inline(always)]
            fn simd(self) -> $simd {
                $simd(())
            }
            #[inline(always)]
            fn store(self, to: &mut [f32]) {
                let to: &mut [f32; $lanes] = to.first_chunk_mut().expect("room for a vector");
                // SAFETY: the vector proves the instruction set; the array is as long as the unaligned store.
                unsafe { $storeu(to.as_mut_ptr(), self.0) }
            }
            // SAFETY, for every block below: a vector exists only where its instruction set does.
            #[inline(always)]
            fn mul_add(self, b: Self, c: Self) -> Self {
                $vector(unsafe { $fmadd(self.0, b.0, c.0) })
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                $vector(unsafe { $sqrt(self.0) })
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                $vector(unsafe { $min(self.0, other.0) })
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                $vector(unsafe { $max(self.0, other.0) })
            }
            #[inline(always)]
            fn abs(self) -> Self {
                let $abs_v = self.0;
                $vector(unsafe { $abs })
            }
            #[inline(always)]
            fn floor(self) -> Self {
                let $floor_v = self.0;
                $vector(unsafe { $floor })
            }
            #[inline(always)]
            fn lt(self, other: Self) -> $mask {
                let ($lt_a, $lt_b) = (self.0, other.0);
                $mask(unsafe { $lt })
            }
            #[inline(always)]
            fn le(self, other: Self) -> $mask {
                let ($le_a, $le_b) = (self.0, other.0);
                $mask(unsafe { $le })
            }
            #[inline(always)]
            fn select(self, mask: $mask, other: Self) -> Self {
                let ($sel_m, $sel_a, $sel_b) = (mask.0, self.0, other.0);
                $vector(unsafe { $select })
            }
            #[inline(always)]
            fn exp2_in_range(self) -> Self {
                let $exp_v = self;
                $exp2
            }
            #[inline(always)]
            fn recip(self) -> Self {
                // An estimate of 12 or 14 bits and one Newton step: 4 instructions where a division blocks the
                // divider for 16 cycles (AVX-512).
                let $recip_v = self.0;
                let estimate = $vector(unsafe { $recip });
                estimate * (-self).mul_add(estimate, self.splat(2.0))
            }
            #[inline(always)]
            fn sum(self) -> f32 {
                let $sum_v = self.0;
                unsafe { $sum }
            }
            #[inline(always)]
            fn sums<const N: usize>(vectors: &[Self; N], to: &mut [f32; N]) {
                $sums(vectors, to)
            }
        }

        impl Debug for $vector {
            fn fmt(&self, f: &mut Formatter<'_>) -> Result {
                let mut values = [0.0; $lanes];
                self.store(&mut values);
                values.fmt(f)
            }
        }
        impl Neg for $vector {
            type Output = Self;
            #[inline(always)]
            fn neg(self) -> Self {
                let $neg_v = self.0;
                // SAFETY: as above.
                $vector(unsafe { $neg })
            }
        }
        float_lanes!(@operator $vector Add add $add);
        float_lanes!(@operator $vector Sub sub $sub);
        float_lanes!(@operator $vector Mul mul $mul);
        float_lanes!(@operator $vector Div div $div);
        float_lanes!(@assign $vector AddAssign add_assign $add);
        float_lanes!(@assign $vector SubAssign sub_assign $sub);
        float_lanes!(@assign $vector MulAssign mul_assign $mul);
    };
    (@operator $vector:ident $trait:ident $method:ident $intrinsic:ident) => {
        impl $trait for $vector {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                // SAFETY: a vector exists only where its instruction set does.
                $vector(unsafe { $intrinsic(self.0, other.0) })
            }
        }
    };
    (@assign $vector:ident $trait:ident $method:ident $intrinsic:ident) => {
        impl $trait for $vector {
            #[inline(always)]
            fn $method(&mut self, other: Self) {
                // SAFETY: a vector exists only where its instruction set does.
                self.0 = unsafe { $intrinsic(self.0, other.0) };
            }
        }
    };
}

const ROUND_NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;
const ROUND_DOWN: i32 = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;

float_lanes!(
    Avx512, F32x16, Mask16, 16,
    _mm512_set1_ps, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_add_ps, _mm512_sub_ps, _mm512_mul_ps, _mm512_div_ps,
    _mm512_fmadd_ps, _mm512_sqrt_ps, _mm512_min_ps, _mm512_max_ps,
    abs: |v| _mm512_abs_ps(v),
    neg: |v| _mm512_xor_ps(v, _mm512_set1_ps(-0.0)),
    floor: |v| _mm512_roundscale_ps::<ROUND_DOWN>(v),
    lt: |a, b| _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b),
    le: |a, b| _mm512_cmp_ps_mask::<_CMP_LE_OQ>(a, b),
    select: |mask, a, b| _mm512_mask_blend_ps(mask, b, a),
    exp2: |v| exp2_16(v),
    recip: |v| _mm512_rcp14_ps(v),
    sum: |v| {
        let half = _mm256_add_ps(_mm512_castps512_ps256(v), _mm512_extractf32x8_ps::<1>(v));
        sum_of_8(half)
    },
    sums: sums_of_16,
    transpose: transpose_16
);

float_lanes!(
    Avx2, F32x8, Mask8, 8,
    _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_add_ps, _mm256_sub_ps, _mm256_mul_ps, _mm256_div_ps,
    _mm256_fmadd_ps, _mm256_sqrt_ps, _mm256_min_ps, _mm256_max_ps,
    abs: |v| _mm256_andnot_ps(_mm256_set1_ps(-0.0), v),
    neg: |v| _mm256_xor_ps(v, _mm256_set1_ps(-0.0)),
    floor: |v| _mm256_round_ps::<ROUND_DOWN>(v),
    lt: |a, b| _mm256_cmp_ps::<_CMP_LT_OQ>(a, b),
    le: |a, b| _mm256_cmp_ps::<_CMP_LE_OQ>(a, b),
    select: |mask, a, b| _mm256_blendv_ps(b, a, mask),
    exp2: |v| exp2_8(v),
    recip: |v| _mm256_rcp_ps(v),
    sum: |v| sum_of_8(v),
    sums: sums_of_8,
    transpose: transpose_8
);

#[inline(always)]
fn polynomial<V: Lanes>(f: V) -> V {
    let mut p = f.splat(f64::from(EXP2[5]));
    for k in (0..5).rev() {
        p = p.mul_add(f, f.splat(f64::from(EXP2[k])));
    }
    p
}

#[inline(always)]
fn exp2_16(v: F32x16) -> F32x16 {
    // SAFETY: the vector proves the instruction set.
    unsafe {
        let n = _mm512_roundscale_ps::<ROUND_NEAREST>(v.0);
        F32x16(_mm512_scalef_ps(polynomial(v - F32x16(n)).0, n))
    }
}

#[inline(always)]
fn exp2_8(v: F32x8) -> F32x8 {
    // SAFETY: the vector proves the instruction set.
    unsafe {
        let n = _mm256_round_ps::<ROUND_NEAREST>(v.0);
        let exponent = _mm256_slli_epi32::<23>(_mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127)));
        polynomial(v - F32x8(n)) * F32x8(_mm256_castsi256_ps(exponent))
    }
}

/// ((0+4)+(2+6)) + ((1+5)+(3+7)): also the summation order of [`sums_of_8`].
#[inline(always)]
unsafe fn sum_of_8(v: __m256) -> f32 {
    // SAFETY: called only where AVX2 is available.
    unsafe {
        let four = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps::<1>(v));
        let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
        _mm_cvtss_f32(_mm_add_ss(two, _mm_shuffle_ps::<1>(two, two)))
    }
}

/// Sums of four vectors by transposing within 128-bit lanes: 3 adds and 6 shuffles instead of 12 and 12 one at a time.
#[inline(always)]
unsafe fn sums_of_four_quads(a: __m128, b: __m128, c: __m128, d: __m128) -> __m128 {
    // SAFETY: SSE is part of x86-64.
    unsafe {
        let ab = _mm_add_ps(_mm_movelh_ps(a, b), _mm_movehl_ps(b, a)); // a0+a2 a1+a3 b0+b2 b1+b3
        let cd = _mm_add_ps(_mm_movelh_ps(c, d), _mm_movehl_ps(d, c));
        _mm_add_ps(
            _mm_shuffle_ps::<0b10_00_10_00>(ab, cd),
            _mm_shuffle_ps::<0b11_01_11_01>(ab, cd),
        )
    }
}

/// A macro, since a function taking a closure would not inherit the instruction set (see `unroll!`).
macro_rules! sums_in_fours {
    ($vectors:ident, $to:ident, |$v:ident| $quad:expr) => {{
        let (chunks, rest) = $to.as_chunks_mut::<4>();
        assert!(rest.is_empty(), "a multiple of four");
        for (i, to) in chunks.iter_mut().enumerate() {
            // SAFETY: a vector proves the instruction set; `to` is as long as the store.
            unsafe {
                let [a, b, c, d] = $crate::unroll!(k in 4 => {
                    let $v = $vectors[4 * i + k].0;
                    $quad
                });
                _mm_storeu_ps(to.as_mut_ptr(), sums_of_four_quads(a, b, c, d));
            }
        }
    }};
}

#[inline(always)]
fn sums_of_8<const N: usize>(vectors: &[F32x8; N], to: &mut [f32; N]) {
    sums_in_fours!(vectors, to, |v| _mm_add_ps(
        _mm256_castps256_ps128(v),
        _mm256_extractf128_ps::<1>(v)
    ));
}

#[inline(always)]
fn sums_of_16<const N: usize>(vectors: &[F32x16; N], to: &mut [f32; N]) {
    sums_in_fours!(vectors, to, |v| {
        let half = _mm256_add_ps(_mm512_castps512_ps256(v), _mm512_extractf32x8_ps::<1>(v));
        _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps::<1>(half))
    });
}

/// Transposes within blocks of four by four, then transposes the blocks.
#[inline(always)]
fn transpose_16(mut rows: [F32x16; 16]) -> [F32x16; 16] {
    // SAFETY: a vector proves the instruction set.
    unsafe {
        for r in (0..16).step_by(4) {
            let [a, b, c, d] = [rows[r].0, rows[r + 1].0, rows[r + 2].0, rows[r + 3].0];
            let ab = [_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b)];
            let cd = [_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d)];
            for k in 0..2 {
                let (ab, cd) = (_mm512_castps_pd(ab[k]), _mm512_castps_pd(cd[k]));
                rows[r + 2 * k] = F32x16(_mm512_castpd_ps(_mm512_unpacklo_pd(ab, cd)));
                rows[r + 2 * k + 1] = F32x16(_mm512_castpd_ps(_mm512_unpackhi_pd(ab, cd)));
            }
        }
        for c in 0..4 {
            let [a, b, c_, d] = [rows[c].0, rows[c + 4].0, rows[c + 8].0, rows[c + 12].0];
            let even = [_mm512_shuffle_f32x4::<0x88>(a, b), _mm512_shuffle_f32x4::<0x88>(c_, d)];
            let odd = [_mm512_shuffle_f32x4::<0xdd>(a, b), _mm512_shuffle_f32x4::<0xdd>(c_, d)];
            rows[c] = F32x16(_mm512_shuffle_f32x4::<0x88>(even[0], even[1]));
            rows[c + 4] = F32x16(_mm512_shuffle_f32x4::<0x88>(odd[0], odd[1]));
            rows[c + 8] = F32x16(_mm512_shuffle_f32x4::<0xdd>(even[0], even[1]));
            rows[c + 12] = F32x16(_mm512_shuffle_f32x4::<0xdd>(odd[0], odd[1]));
        }
    }
    rows
}

/// As [`transpose_16`].
#[inline(always)]
fn transpose_8(mut rows: [F32x8; 8]) -> [F32x8; 8] {
    // SAFETY: a vector proves the instruction set.
    unsafe {
        for r in (0..8).step_by(4) {
            let [a, b, c, d] = [rows[r].0, rows[r + 1].0, rows[r + 2].0, rows[r + 3].0];
            let ab = [_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b)];
            let cd = [_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d)];
            for k in 0..2 {
                let (ab, cd) = (_mm256_castps_pd(ab[k]), _mm256_castps_pd(cd[k]));
                rows[r + 2 * k] = F32x8(_mm256_castpd_ps(_mm256_unpacklo_pd(ab, cd)));
                rows[r + 2 * k + 1] = F32x8(_mm256_castpd_ps(_mm256_unpackhi_pd(ab, cd)));
            }
        }
        for c in 0..4 {
            let (a, b) = (rows[c].0, rows[c + 4].0);
            rows[c] = F32x8(_mm256_permute2f128_ps::<0x20>(a, b));
            rows[c + 4] = F32x8(_mm256_permute2f128_ps::<0x31>(a, b));
        }
    }
    rows
}

impl Mask for Mask16 {
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        Mask16(self.0 & other.0)
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        Mask16(self.0 | other.0)
    }
    #[inline(always)]
    fn and_not(self, other: Self) -> Self {
        Mask16(self.0 & !other.0)
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        u32::from(self.0)
    }
}

impl Mask for Mask8 {
    // SAFETY, for every block below: a mask exists only where AVX2 does.
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        Mask8(unsafe { _mm256_and_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        Mask8(unsafe { _mm256_or_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn and_not(self, other: Self) -> Self {
        Mask8(unsafe { _mm256_andnot_ps(other.0, self.0) })
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        unsafe { _mm256_movemask_ps(self.0) as u32 }
    }
}

impl Debug for Mask8 {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        write!(f, "{:08b}", self.bits())
    }
}

//! Lanes without intrinsics: arrays of four `f32`, and one `f64`.

use super::{EXP2, Lanes, Mask, Simd};
use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

/// Arrays of four `f32`; always available.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Portable;

/// One `f64` at a time: for tests, where double precision makes finite differences accurate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Double;

const N: usize = 4;

/// Four `f32`.
#[derive(Clone, Copy, Debug)]
#[repr(align(16))]
pub struct Four([f32; N]);

/// Four booleans.
#[derive(Clone, Copy, Debug)]
pub struct FourMask([bool; N]);

impl Four {
    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Four(std::array::from_fn(|i| f(self.0[i], other.0[i])))
    }
    #[inline(always)]
    fn each(self, f: impl Fn(f32) -> f32) -> Self {
        Four(self.0.map(f))
    }
}

impl Simd for Portable {
    type F = Four;
    const LANES: usize = N;
    #[inline(always)]
    fn splat(self, value: f64) -> Four {
        Four([value as f32; N])
    }
    #[inline(always)]
    fn set(self, value: f32) -> Four {
        Four([value; N])
    }
    #[inline(always)]
    fn load(self, from: &[f32]) -> Four {
        Four(*from.first_chunk().expect("a whole vector"))
    }
}

impl Mask for FourMask {
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        FourMask(std::array::from_fn(|i| self.0[i] & other.0[i]))
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        FourMask(std::array::from_fn(|i| self.0[i] | other.0[i]))
    }
    #[inline(always)]
    fn and_not(self, other: Self) -> Self {
        FourMask(std::array::from_fn(|i| self.0[i] & !other.0[i]))
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        (0..N).map(|i| u32::from(self.0[i]) << i).sum()
    }
}

impl Lanes for Four {
    type Scalar = f32;
    type Mask = FourMask;
    type Simd = Portable;
    #[inline(always)]
    fn simd(self) -> Portable {
        Portable
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        *to.first_chunk_mut().expect("room for a vector") = self.0;
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        // Without an FMA instruction `f32::mul_add` is a library call, fifty times slower than a product and a sum.
        if cfg!(any(target_feature = "fma", target_arch = "aarch64")) {
            Four(std::array::from_fn(|i| self.0[i].mul_add(b.0[i], c.0[i])))
        } else {
            self * b + c
        }
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.each(f32::sqrt)
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.each(f32::abs)
    }
    #[inline(always)]
    fn floor(self) -> Self {
        self.each(f32::floor)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> FourMask {
        FourMask(std::array::from_fn(|i| self.0[i] < other.0[i]))
    }
    #[inline(always)]
    fn le(self, other: Self) -> FourMask {
        FourMask(std::array::from_fn(|i| self.0[i] <= other.0[i]))
    }
    #[inline(always)]
    fn select(self, mask: FourMask, other: Self) -> Self {
        Four(std::array::from_fn(|i| if mask.0[i] { self.0[i] } else { other.0[i] }))
    }
    #[inline(always)]
    fn exp2_in_range(self) -> Self {
        // Adding and subtracting 1.5 * 2^23 rounds to the nearest integer without a library call.
        const MAGIC: f32 = 12_582_912.0;
        let n = self.each(|v| (v + MAGIC) - MAGIC);
        let f = self - n;
        let mut p = Four([EXP2[5]; N]);
        for k in (0..5).rev() {
            p = p.mul_add(f, Four([EXP2[k]; N]));
        }
        p.zip(n, |p, n| {
            p * f32::from_bits(((n as i32).wrapping_add(127) << 23) as u32)
        })
    }
    #[inline(always)]
    fn recip(self) -> Self {
        self.each(|v| 1.0 / v)
    }
    #[inline(always)]
    fn sum(self) -> f32 {
        (self.0[0] + self.0[2]) + (self.0[1] + self.0[3])
    }
}

impl Simd for Double {
    type F = f64;
    const LANES: usize = 1;
    #[inline(always)]
    fn splat(self, value: f64) -> f64 {
        value
    }
    #[inline(always)]
    fn set(self, value: f64) -> f64 {
        value
    }
    #[inline(always)]
    fn load(self, from: &[f64]) -> f64 {
        from[0]
    }
}

impl Mask for bool {
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        self & other
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        self | other
    }
    #[inline(always)]
    fn and_not(self, other: Self) -> Self {
        self & !other
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        u32::from(self)
    }
}

impl Lanes for f64 {
    type Scalar = f64;
    type Mask = bool;
    type Simd = Double;
    #[inline(always)]
    fn simd(self) -> Double {
        Double
    }
    #[inline(always)]
    fn store(self, to: &mut [f64]) {
        to[0] = self;
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        self * b + c
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        f64::min(self, other)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        f64::max(self, other)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        f64::abs(self)
    }
    #[inline(always)]
    fn floor(self) -> Self {
        f64::floor(self)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> bool {
        self < other
    }
    #[inline(always)]
    fn le(self, other: Self) -> bool {
        self <= other
    }
    #[inline(always)]
    fn select(self, mask: bool, other: Self) -> Self {
        if mask { self } else { other }
    }
    #[inline(always)]
    fn exp2_in_range(self) -> Self {
        f64::exp2(self)
    }
    #[inline(always)]
    fn recip(self) -> Self {
        1.0 / self
    }
    #[inline(always)]
    fn sum(self) -> f64 {
        self
    }
}

macro_rules! lane_operators {
    ($($operator:ident $method:ident $assign:ident $assign_method:ident $symbol:tt;)*) => {$(
        impl $operator for Four {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                self.zip(other, |a, b| a $symbol b)
            }
        }
        impl $assign for Four {
            #[inline(always)]
            fn $assign_method(&mut self, other: Self) {
                *self = *self $symbol other;
            }
        }
    )*};
}
lane_operators! {
    Add add AddAssign add_assign +;
    Sub sub SubAssign sub_assign -;
    Mul mul MulAssign mul_assign *;
}

impl Div for Four {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
}

impl Neg for Four {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        self.each(|v| -v)
    }
}

//! Lanes without run-time dispatch: four `f32`, in the vector registers that every processor of the architecture has if glam supports
//! them, and one `f64`.

use super::{EXP2, Lanes, Mask, Simd};
use glam::{BVec4A, Vec4};
use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

/// Four `f32`; always available.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Portable;

/// One `f64` at a time: for tests, where double precision makes finite differences accurate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Double;

/// Four `f32`. With a plain array, which the compiler has to vectorise, `irradia-splat` took twice as long to compile.
#[derive(Clone, Copy, Debug)]
pub struct Four(Vec4);

/// Four booleans.
#[derive(Clone, Copy, Debug)]
pub struct FourMask(BVec4A);

impl Four {
    #[inline(always)]
    fn each(self, f: impl Fn(f32) -> f32) -> Self {
        Four(Vec4::from_array(self.0.to_array().map(f)))
    }
}

impl Simd for Portable {
    type F = Four;
    const LANES: usize = 4;
    #[inline(always)]
    fn splat(self, value: f64) -> Four {
        self.set(value as f32)
    }
    #[inline(always)]
    fn set(self, value: f32) -> Four {
        Four(Vec4::splat(value))
    }
    #[inline(always)]
    fn load(self, from: &[f32]) -> Four {
        Four(Vec4::from_array(*from.first_chunk().expect("a whole vector")))
    }
}

impl Mask for FourMask {
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        FourMask(self.0 & other.0)
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        FourMask(self.0 | other.0)
    }
    #[inline(always)]
    fn and_not(self, other: Self) -> Self {
        FourMask(self.0 & !other.0)
    }
    #[inline(always)]
    fn bits(self) -> u32 {
        self.0.bitmask()
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
        *to.first_chunk_mut().expect("room for a vector") = self.0.to_array();
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        // Without an FMA instruction `f32::mul_add` is a library call, fifty times slower than a product and a sum.
        if cfg!(any(target_feature = "fma", target_arch = "aarch64")) {
            Four(self.0.mul_add(b.0, c.0))
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
        Four(self.0.min(other.0))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Four(self.0.max(other.0))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Four(self.0.abs())
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Four(self.0.floor())
    }
    #[inline(always)]
    fn lt(self, other: Self) -> FourMask {
        FourMask(self.0.cmplt(other.0))
    }
    #[inline(always)]
    fn le(self, other: Self) -> FourMask {
        FourMask(self.0.cmple(other.0))
    }
    #[inline(always)]
    fn select(self, mask: FourMask, other: Self) -> Self {
        Four(Vec4::select(mask.0, self.0, other.0))
    }
    #[inline(always)]
    fn exp2_in_range(self) -> Self {
        // Adding 1.5 * 2^23 rounds to the nearest integer without a library call, and leaves it in the last bits.
        let magic = Portable.set(12_582_912.0);
        let rounded = self + magic;
        let f = self - (rounded - magic);
        let mut p = Portable.set(EXP2[5]);
        for k in (0..5).rev() {
            p = p.mul_add(f, Portable.set(EXP2[k]));
        }
        p * rounded.each(|n| f32::from_bits(n.to_bits().wrapping_add(127) << 23))
    }
    #[inline(always)]
    fn recip(self) -> Self {
        Portable.set(1.0) / self
    }
    #[inline(always)]
    fn sum(self) -> f32 {
        let [a, b, c, d] = self.0.to_array();
        (a + c) + (b + d)
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
                Four(self.0 $symbol other.0)
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
        Four(self.0 / other.0)
    }
}

impl Neg for Four {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Four(-self.0)
    }
}

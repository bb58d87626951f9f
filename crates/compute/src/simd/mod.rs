//! SIMD written once: code generic over [`Simd`] runs on AVX-512, AVX2, portable four-lane arrays (which compilers turn
//! into NEON, SSE2 or WebAssembly SIMD) and, for tests in double precision, on plain `f64`.
//!
//! A value of a [`Simd`] type proves that the processor supports it, and only [`Level`] creates one, so everything here
//! is safe to call. [`Level::run`] runs a [`Kernel`]; every function between the kernel and a lane operation must be
//! `#[inline(always)]`, or it is compiled without the wide instructions.
//!
//! Crates such as `fearless_simd` offer the same safety, but not double precision from the same source, which lets finite
//! differences check the very code that trains.

mod portable;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

pub use portable::{Double, Portable};
#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2, Avx512};

/// A vector instruction set; a value proves that this processor supports it.
pub trait Simd: Copy + Send + Sync + 'static {
    /// A vector of floats.
    type F: Lanes<Simd = Self>;
    /// Floats per vector.
    const LANES: usize;
    /// Sets all lanes to the constant `value`.
    fn splat(self, value: f64) -> Self::F;
    /// Sets all lanes to `value`.
    fn set(self, value: <Self::F as Lanes>::Scalar) -> Self::F;
    /// Loads the first `LANES` values of `from`.
    ///
    /// # Panics
    /// When `from` is shorter.
    fn load(self, from: &[<Self::F as Lanes>::Scalar]) -> Self::F;
    /// Prefetches the cache line of `place`, which will be read soon.
    #[inline(always)]
    fn prefetch<T>(self, _place: &T) {}
    /// Sets lane `i` to `f(i)`.
    #[inline(always)]
    fn lanes(self, f: impl Fn(usize) -> <Self::F as Lanes>::Scalar) -> Self::F {
        let mut values = [<Self::F as Lanes>::Scalar::default(); 16];
        for i in 0..Self::LANES {
            values[i] = f(i);
        }
        self.load(&values)
    }
    /// Transposes a square of `LANES` by `LANES`: `to[j * to_stride + i] = from[i * stride + j]`.
    ///
    /// # Panics
    /// When a row does not fit.
    #[inline(always)]
    fn transpose(
        self,
        from: &[<Self::F as Lanes>::Scalar],
        stride: usize,
        to: &mut [<Self::F as Lanes>::Scalar],
        to_stride: usize,
    ) {
        for j in 0..Self::LANES {
            for i in 0..Self::LANES {
                to[j * to_stride + i] = from[i * stride + j];
            }
        }
    }
}

/// The scalar type of a lane.
pub trait Scalar:
    Copy
    + Default
    + Debug
    + PartialOrd
    + Send
    + Sync
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + 'static
{
    /// From double precision, rounded.
    fn from_f64(value: f64) -> Self;
    /// To double precision.
    fn to_f64(self) -> f64;
    /// Converts an integer from 0 to 2^22, without checks or saturation, so that loops over arrays vectorise.
    fn to_u32(self) -> u32;
}

impl Scalar for f32 {
    #[inline(always)]
    fn from_f64(value: f64) -> Self {
        value as f32
    }
    #[inline(always)]
    fn to_f64(self) -> f64 {
        f64::from(self)
    }
    #[inline(always)]
    fn to_u32(self) -> u32 {
        // Adding 2^23 leaves the integer in the mantissa.
        (self + 8_388_608.0).to_bits() & 0x7f_ffff
    }
}

impl Scalar for f64 {
    #[inline(always)]
    fn from_f64(value: f64) -> Self {
        value
    }
    #[inline(always)]
    fn to_f64(self) -> f64 {
        self
    }
    #[inline(always)]
    fn to_u32(self) -> u32 {
        self as u32
    }
}

/// A vector of floats. Comparisons with NaN are false, as in IEEE 754.
pub trait Lanes:
    Copy
    + Debug
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
{
    /// The type of a lane.
    type Scalar: Scalar;
    /// One boolean per lane.
    type Mask: Mask;
    /// The instruction set.
    type Simd: Simd<F = Self>;
    /// The token of the vector's instruction set.
    fn simd(self) -> Self::Simd;
    /// Sets all lanes to the constant `value`; `self` serves only as proof.
    #[inline(always)]
    fn splat(self, value: f64) -> Self {
        self.simd().splat(value)
    }
    /// Stores the lanes at the front of `to`.
    ///
    /// # Panics
    /// When `to` is shorter than a vector.
    fn store(self, to: &mut [Self::Scalar]);
    /// `self * b + c`, fused where the processor supports it.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// The smaller; when either is NaN the result is one of the two.
    fn min(self, other: Self) -> Self;
    /// The larger; when either is NaN the result is one of the two.
    fn max(self, other: Self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// Rounds towards minus infinity.
    fn floor(self) -> Self;
    /// `self < other`.
    fn lt(self, other: Self) -> Self::Mask;
    /// `self <= other`.
    fn le(self, other: Self) -> Self::Mask;
    /// `self` in the lanes where `mask` is set, `other` elsewhere.
    fn select(self, mask: Self::Mask, other: Self) -> Self;
    /// `2^self`. Relative error below 2.5e-7 for `self >= -126`; lower values are clamped to -126. Not valid for `self > 127`.
    #[inline(always)]
    fn exp2(self) -> Self {
        self.max(self.splat(-126.0)).exp2_in_range()
    }
    /// As [`Lanes::exp2`], but unspecified below -126: saves an instruction where such lanes are masked anyway.
    fn exp2_in_range(self) -> Self;
    /// `e^self` as a power of two; results are clamped to 2^-126 and 2^126, hence finite for any finite `self`.
    #[inline(always)]
    fn exp(self) -> Self {
        (self * self.splat(std::f64::consts::LOG2_E))
            .min(self.splat(126.0))
            .exp2()
    }
    /// `1 / self`, within two units in the last place.
    fn recip(self) -> Self;
    /// Sum of the lanes, in a fixed order.
    fn sum(self) -> Self::Scalar;
    /// Writes the lane sums of several vectors; N must be a multiple of four.
    #[inline(always)]
    fn sums<const N: usize>(vectors: &[Self; N], to: &mut [Self::Scalar; N]) {
        for i in 0..N {
            to[i] = vectors[i].sum();
        }
    }
    /// Applies `f` to each lane in turn: for functions that do not merit a vector version.
    #[inline(always)]
    fn map(self, f: impl Fn(Self::Scalar) -> Self::Scalar) -> Self {
        let mut values = [Self::Scalar::default(); 16];
        self.store(&mut values);
        for value in values.iter_mut().take(Self::Simd::LANES) {
            *value = f(*value);
        }
        self.simd().load(&values)
    }
    /// `self` in the lanes where `mask` is set, zero elsewhere.
    #[inline(always)]
    fn masked(self, mask: Self::Mask) -> Self {
        self.select(mask, self.splat(0.0))
    }
}

/// One boolean per lane.
pub trait Mask: Copy + Debug {
    /// Lanes set in both.
    fn and(self, other: Self) -> Self;
    /// Lanes set in either.
    fn or(self, other: Self) -> Self;
    /// Lanes set here and not in `other`.
    fn and_not(self, other: Self) -> Self;
    /// Lane `i` in bit `i`.
    fn bits(self) -> u32;
    /// Whether no lane is set.
    #[inline(always)]
    fn none(self) -> bool {
        self.bits() == 0
    }
}

/// Unrolls `[f(0), f(1), ..]`: `unroll!(i in 3 => a[i] + b[i])`.
///
/// The closures that `array::from_fn` and `map` take are separate functions and do not inherit the target features of the
/// enclosing function; unless the compiler inlines them, every lane operation becomes a call.
#[macro_export]
macro_rules! unroll {
    ($i:ident in 2 => $value:expr) => {
        $crate::unroll!(@ $i, $value, 0, 1)
    };
    ($i:ident in 3 => $value:expr) => {
        $crate::unroll!(@ $i, $value, 0, 1, 2)
    };
    ($i:ident in 4 => $value:expr) => {
        $crate::unroll!(@ $i, $value, 0, 1, 2, 3)
    };
    ($i:ident in 5 => $value:expr) => {
        $crate::unroll!(@ $i, $value, 0, 1, 2, 3, 4)
    };
    ($i:ident in 6 => $value:expr) => {
        $crate::unroll!(@ $i, $value, 0, 1, 2, 3, 4, 5)
    };
    ($i:ident in 7 => $value:expr) => {
        $crate::unroll!(@ $i, $value, 0, 1, 2, 3, 4, 5, 6)
    };
    ($i:ident in 10 => $value:expr) => {
        $crate::unroll!(@ $i, $value, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9)
    };
    ($i:ident in 9 => $value:expr) => {
        $crate::unroll!(@ $i, $value, 0, 1, 2, 3, 4, 5, 6, 7, 8)
    };
    (@ $i:ident, $value:expr, $($at:literal),*) => {
        [$({ let $i: usize = $at; $value }),*]
    };
}

/// A computation that is generic over the instruction set.
pub trait Kernel {
    /// The result.
    type Output;
    /// Runs the kernel; must be `#[inline(always)]`.
    fn run<S: Simd>(self, simd: S) -> Self::Output
    where
        S::F: Lanes<Scalar = f32>;
}

/// The instruction set to use, chosen at run time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// AVX-512 F, DQ, BW and VL: 16 lanes.
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512),
    /// AVX2 and FMA: 8 lanes.
    #[cfg(target_arch = "x86_64")]
    Avx2(Avx2),
    /// Arrays of four, which compilers turn into NEON or SSE2.
    Portable(Portable),
}

impl Level {
    /// The widest level this processor supports; `IRRADIA_SIMD=avx2` or `portable` selects a narrower one (tests, benchmarks).
    pub fn detect() -> Self {
        static LEVEL: std::sync::OnceLock<Level> = std::sync::OnceLock::new();
        *LEVEL.get_or_init(|| {
            let limit = std::env::var("IRRADIA_SIMD").unwrap_or_default();
            Self::all()
                .into_iter()
                .find(|level| limit.is_empty() || level.name() == limit)
                .unwrap_or(Level::Portable(Portable))
        })
    }

    /// Every level this processor supports, widest first.
    pub fn all() -> Vec<Self> {
        let mut levels = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            levels.extend(Avx512::detect().map(Level::Avx512));
            levels.extend(Avx2::detect().map(Level::Avx2));
        }
        levels.push(Level::Portable(Portable));
        levels
    }

    /// `avx512`, `avx2` or `portable`.
    pub fn name(self) -> &'static str {
        match self {
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(_) => "avx512",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(_) => "avx2",
            Level::Portable(_) => "portable",
        }
    }

    /// Runs `kernel`, compiled for this level.
    #[inline]
    pub fn run<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(simd) => simd.run(kernel),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(simd) => simd.run(kernel),
            Level::Portable(simd) => kernel.run(simd),
        }
    }
}

/// Coefficients of the polynomial for `2^f`, f in \[-0.5, 0.5\], from degree 0 up. Minimax in relative error
/// (Remez exchange): 7.5e-8, half a unit in the last place of `f32`. Degree 4 would have 2.6e-6, visible in the golden files.
pub(crate) const EXP2: [f32; 6] = [
    1.000_000_1,
    0.693_146_97,
    0.240_221_2,
    0.055_507_13,
    0.009_675_541,
    0.001_327_647_2,
];

#[cfg(test)]
mod tests {
    use super::*;

    struct Everything;
    impl Kernel for Everything {
        type Output = ();
        #[inline(always)]
        fn run<S: Simd>(self, simd: S)
        where
            S::F: Lanes<Scalar = f32>,
        {
            let mut out = [0.0f32; 16];
            let a = simd.lanes(|i| i as f32 - 3.5);
            let b = simd.splat(2.0);
            let mut check = |got: S::F, want: &dyn Fn(f32) -> f32, what: &str| {
                got.store(&mut out);
                for i in 0..S::LANES {
                    let w = want(i as f32 - 3.5);
                    assert!(
                        (out[i] - w).abs() <= 2e-7 * w.abs(),
                        "{what} lane {i}: {}, expected {w}",
                        out[i]
                    );
                }
            };
            check(a + b, &|x| x + 2.0, "add");
            check(a - b, &|x| x - 2.0, "sub");
            check(a * b, &|x| x * 2.0, "mul");
            check(a / b, &|x| x / 2.0, "div");
            check(-a, &|x| -x, "neg");
            check(a.mul_add(b, a), &|x| x * 2.0 + x, "mul_add");
            check(a.abs().sqrt(), &|x| x.abs().sqrt(), "abs, sqrt");
            check(a.min(b), &|x| x.min(2.0), "min");
            check(a.max(b), &|x| x.max(2.0), "max");
            check(a.floor(), &f32::floor, "floor");
            check((a + b + b).recip(), &|x| 1.0 / (x + 4.0), "recip");
            check(a.exp2(), &f32::exp2, "exp2");
            check(a.select(a.lt(b), b), &|x| x.min(2.0), "lt, select");
            check(a.map(|x| x + 1.0), &|x| x + 1.0, "map");
            let expected: u32 = (0..S::LANES).filter(|i| *i as f32 - 3.5 <= 2.0).map(|i| 1 << i).sum();
            assert_eq!(a.le(b).bits(), expected);
            assert_eq!(a.lt(b).and_not(a.lt(simd.splat(0.0))).and(a.le(b)).bits() & 0b1111, 0);
            assert!(a.lt(simd.splat(-100.0)).or(a.lt(simd.splat(-200.0))).none());
            let n = S::LANES as f32;
            assert_eq!(a.sum(), n * (n - 1.0) / 2.0 - 3.5 * n);
            let many = [a, b, a, b, b, b, b, a];
            let mut sums = [0.0; 8];
            S::F::sums(&many, &mut sums);
            assert_eq!(sums, many.map(S::F::sum));
            let square: Vec<f32> = (0..20 * 16).map(|i| i as f32).collect();
            let mut transposed = [f32::NAN; 18 * 16];
            simd.transpose(&square, 20, &mut transposed, 18);
            for (i, j) in (0..S::LANES).flat_map(|i| (0..S::LANES).map(move |j| (i, j))) {
                assert_eq!(transposed[j * 18 + i], square[i * 20 + j], "row {i}, column {j}");
            }
            let nan = simd.splat(f64::NAN);
            assert!(nan.lt(b).none() && nan.le(b).none());
            assert_eq!(simd.splat(-1000.0).exp2().sum(), simd.splat(-126.0).exp2().sum());
        }
    }

    #[test]
    fn every_level_matches_scalar_arithmetic() {
        for level in Level::all() {
            level.run(Everything);
        }
    }

    #[test]
    fn exp2_is_within_two_units_in_the_last_place() {
        struct Sweep;
        impl Kernel for Sweep {
            type Output = f64;
            #[inline(always)]
            fn run<S: Simd>(self, simd: S) -> f64
            where
                S::F: Lanes<Scalar = f32>,
            {
                let mut worst = 0.0f64;
                for i in 0..20_000 {
                    let x = -20.0 * (i as f32) / 20_000.0;
                    let mut out = [0.0; 16];
                    simd.set(x).exp2().store(&mut out);
                    worst = worst.max((f64::from(out[0]) / f64::from(x).exp2() - 1.0).abs());
                }
                worst
            }
        }
        for level in Level::all() {
            let worst = level.run(Sweep);
            // 7.5e-8 from the polynomial and one unit in the last place (1.2e-7) from rounding.
            assert!(worst < 2.5e-7, "{}: {worst}", level.name());
        }
    }
}

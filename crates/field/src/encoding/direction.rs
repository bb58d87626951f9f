//! Encodings of the unit viewing direction: spherical harmonics of degree 0 to 3, or the frequencies of NeRF.

use super::Frequency;
use crate::Num;
use crate::mlp::PANEL;
use irradia_compute::simd::{Lanes, Simd};
use irradia_compute::unroll;
use irradia_scene::sh::{C0, C1, C2, C3};
use serde::{Deserialize, Serialize};

/// How directions are encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum DirectionEncoding {
    /// The sixteen real harmonics of four bands (Instant-NGP).
    Harmonics,
    /// Sines and cosines (NeRF, L = 4).
    Frequency(Frequency),
}

impl DirectionEncoding {
    /// Number of features.
    pub fn features(&self) -> usize {
        match self {
            Self::Harmonics => 16,
            Self::Frequency(f) => f.features(),
        }
    }

    /// Encodes a panel of unit directions `[3, 32]` to the first rows of `to [rows, 32]`.
    #[inline(always)]
    pub fn encode<S: Simd>(&self, simd: S, directions: &[Num<S>], to: &mut [Num<S>]) {
        match self {
            Self::Harmonics => {
                for s in (0..PANEL).step_by(S::LANES) {
                    let b = harmonics(unroll!(c in 3 => simd.load(&directions[c * PANEL + s..])));
                    for k in 0..16 {
                        b[k].store(&mut to[k * PANEL + s..]);
                    }
                }
            }
            Self::Frequency(f) => f.encode(simd, directions, to),
        }
    }
}

/// The sixteen harmonics at the unit direction `[x, y, z]`, in the order and signs of [`irradia_scene::sh`].
#[inline(always)]
pub fn harmonics<F: Lanes>([x, y, z]: [F; 3]) -> [F; 16] {
    let k = x.simd();
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (two, three, four) = (k.splat(2.0), k.splat(3.0), k.splat(4.0));
    [
        k.splat(C0),
        k.splat(-C1) * y,
        k.splat(C1) * z,
        k.splat(-C1) * x,
        k.splat(C2[0]) * x * y,
        k.splat(C2[1]) * y * z,
        k.splat(C2[2]) * (two * zz - xx - yy),
        k.splat(C2[3]) * x * z,
        k.splat(C2[4]) * (xx - yy),
        k.splat(C3[0]) * y * (three * xx - yy),
        k.splat(C3[1]) * x * y * z,
        k.splat(C3[2]) * y * (four * zz - xx - yy),
        k.splat(C3[3]) * z * (two * zz - three * (xx + yy)),
        k.splat(C3[4]) * x * (four * zz - xx - yy),
        k.splat(C3[5]) * z * (xx - yy),
        k.splat(C3[6]) * x * (xx - three * yy),
    ]
}

/// The VJP of [`harmonics`] as polynomials in x, y and z, without the unit-sphere constraint.
#[inline(always)]
pub fn harmonics_vjp<F: Lanes>([x, y, z]: [F; 3], v: &[F; 16]) -> [F; 3] {
    let k = x.simd();
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (xy, yz, xz) = (x * y, y * z, x * z);
    let (two, three, four, six) = (k.splat(2.0), k.splat(3.0), k.splat(4.0), k.splat(6.0));
    let a: [F; 5] = unroll!(i in 5 => k.splat(C2[i]) * v[4 + i]);
    let b: [F; 7] = unroll!(i in 7 => k.splat(C3[i]) * v[9 + i]);
    let c1 = k.splat(C1);
    [
        -c1 * v[3]
            + a[0] * y
            + a[3] * z
            + two * x * (a[4] - a[2])
            + six * b[0] * xy
            + b[1] * yz
            + two * (b[5] * xz - b[2] * xy)
            - six * b[3] * xz
            + b[4] * (four * zz - three * xx - yy)
            + three * b[6] * (xx - yy),
        -c1 * v[1] + a[0] * x + a[1] * z - two * y * (a[4] + a[2])
            + three * b[0] * (xx - yy)
            + b[1] * xz
            + b[2] * (four * zz - xx - three * yy)
            - six * b[3] * yz
            - two * (b[4] * xy + b[5] * yz)
            - six * b[6] * xy,
        c1 * v[2]
            + a[1] * y
            + a[3] * x
            + four * a[2] * z
            + b[1] * xy
            + k.splat(8.0) * (b[2] * yz + b[4] * xz)
            + three * b[3] * (two * zz - xx - yy)
            + b[5] * (xx - yy),
    ]
}

//! View-dependent colour: real spherical harmonics of the unit direction from the camera's centre to the mean.

use irradia_compute::simd::Lanes;
use irradia_compute::unroll;
use irradia_scene::sh::{C0, C1, C2, C3};

/// Number of basis functions of a degree-3 expansion.
pub(super) const MAX_COEFFICIENTS: usize = 16;

/// The basis at the unit direction `[x, y, z]`; entries above `degree` are zero.
#[inline(always)]
pub(super) fn basis<F: Lanes>(degree: u32, [x, y, z]: [F; 3]) -> [F; MAX_COEFFICIENTS] {
    macro_rules! k {
        ($v:expr) => {
            x.splat($v)
        };
    }
    let mut b = [k!(0.0); MAX_COEFFICIENTS];
    b[0] = k!(C0);
    if degree >= 1 {
        b[1] = k!(-C1) * y;
        b[2] = k!(C1) * z;
        b[3] = k!(-C1) * x;
    }
    if degree >= 2 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[4] = k!(C2[0]) * x * y;
        b[5] = k!(C2[1]) * y * z;
        b[6] = k!(C2[2]) * (k!(2.0) * zz - xx - yy);
        b[7] = k!(C2[3]) * x * z;
        b[8] = k!(C2[4]) * (xx - yy);
        if degree >= 3 {
            b[9] = k!(C3[0]) * y * (k!(3.0) * xx - yy);
            b[10] = k!(C3[1]) * x * y * z;
            b[11] = k!(C3[2]) * y * (k!(4.0) * zz - xx - yy);
            b[12] = k!(C3[3]) * z * (k!(2.0) * zz - k!(3.0) * (xx + yy));
            b[13] = k!(C3[4]) * x * (k!(4.0) * zz - xx - yy);
            b[14] = k!(C3[5]) * z * (xx - yy);
            b[15] = k!(C3[6]) * x * (xx - k!(3.0) * yy);
        }
    }
    b
}

/// The gradient of the direction, given `v_basis`: the VJP of [`basis`].
#[inline(always)]
pub(super) fn basis_vjp<F: Lanes>(degree: u32, [x, y, z]: [F; 3], v: &[F; MAX_COEFFICIENTS]) -> [F; 3] {
    macro_rules! k {
        ($v:expr) => {
            x.splat($v)
        };
    }
    let mut g = [k!(0.0); 3];
    if degree >= 1 {
        g = [k!(-C1) * v[3], k!(-C1) * v[1], k!(C1) * v[2]];
    }
    if degree >= 2 {
        let w: [F; 5] = unroll!(i in 5 => k!(C2[i]) * v[4 + i]);
        g[0] += w[0] * y + w[3] * z + k!(2.0) * x * (w[4] - w[2]);
        g[1] += w[0] * x + w[1] * z - k!(2.0) * y * (w[4] + w[2]);
        g[2] += w[1] * y + w[3] * x + k!(4.0) * w[2] * z;
    }
    if degree >= 3 {
        let w: [F; 7] = unroll!(i in 7 => k!(C3[i]) * v[9 + i]);
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (xy, yz, xz) = (x * y, y * z, x * z);
        g[0] += k!(6.0) * w[0] * xy + w[1] * yz - k!(2.0) * w[2] * xy - k!(6.0) * w[3] * xz
            + w[4] * (k!(4.0) * zz - k!(3.0) * xx - yy)
            + k!(2.0) * w[5] * xz
            + k!(3.0) * w[6] * (xx - yy);
        g[1] += k!(3.0) * w[0] * (xx - yy) + w[1] * xz + w[2] * (k!(4.0) * zz - xx - k!(3.0) * yy)
            - k!(6.0) * w[3] * yz
            - k!(2.0) * w[4] * xy
            - k!(2.0) * w[5] * yz
            - k!(6.0) * w[6] * xy;
        g[2] += w[1] * xy
            + k!(8.0) * w[2] * yz
            + k!(3.0) * w[3] * (k!(2.0) * zz - xx - yy)
            + k!(8.0) * w[4] * xz
            + w[5] * (xx - yy);
    }
    g
}

/// Unit direction from `center` to `mean`, and the inverse of the distance.
#[inline(always)]
pub(super) fn direction<F: Lanes>(mean: [F; 3], center: [F; 3]) -> ([F; 3], F) {
    let d: [F; 3] = unroll!(i in 3 => mean[i] - center[i]);
    let inv = d[0].splat(1.0) / super::project::dot(d, d).max(d[0].splat(1e-24)).sqrt();
    (unroll!(i in 3 => d[i] * inv), inv)
}

/// The gradient of the mean through [`direction`].
#[inline(always)]
pub(super) fn direction_vjp<F: Lanes>(d: [F; 3], inv: F, v_d: [F; 3]) -> [F; 3] {
    let along = super::project::dot(d, v_d);
    unroll!(i in 3 => (v_d[i] - d[i] * along) * inv)
}

//! From a 3D Gaussian to its footprint on the image, and back: EWA splatting (Zwicker et al. 2001) as 3DGS uses it
//! (Kerbl et al. 2023, section 4).
//!
//! Symbols: `m` mean in the world, `x = R m + t` in the camera, `q` unit quaternion, `s` standard deviations,
//! `J` Jacobian of the projection, `U = J R Rot(q)` (2x3), `V = U diag(s)`, `cov = V V^T + dilation`,
//! `conic = cov^-1 = [A B; B C]`. J is that of a pinhole, or of a lens ([`super::lens`]). All functions are generic over lanes:
//! vectors of `f32` in training, `f64` in tests.

use super::lens::LensAt;
use super::view::ViewLanes;
use irradia_compute::simd::{Lanes, Mask, Scalar};
use irradia_compute::unroll;
use std::f64::consts::{LN_2, LOG2_E};

/// Pixels squared added to the diagonal of the 2D covariance (Inria code, "low-pass filter").
pub const DILATION: f64 = 0.3;
/// Minimum alpha for a fragment to be drawn (Inria code).
pub const ALPHA_MIN: f64 = 1.0 / 255.0;
/// Floor of the ratio under the root of the antialiasing compensation: 0.005 squared (gsplat).
const COMPENSATION_FLOOR: f64 = 0.005 * 0.005;

/// Splats' geometry, one splat per lane.
#[derive(Clone, Copy)]
pub(super) struct Geometry<F> {
    pub mean: [F; 3],
    pub quat: [F; 4],
    pub log_scale: [F; 3],
    pub opacity_logit: F,
}

/// The gradient of the camera, without the part through the viewing direction: `x = R m + t` with the entries of R taken as
/// independent.
#[derive(Clone, Copy)]
pub(super) struct CameraTerms<F> {
    pub rotation: [[F; 3]; 3],
    pub translation: [F; 3],
}

/// The footprint.
#[derive(Clone, Copy)]
pub(super) struct Footprint<F> {
    /// Pixel coordinates of the centre.
    pub xy: [F; 2],
    /// Along +Z, or for wide lenses the distance.
    pub depth: F,
    /// `[A, B, C]` of `sigma = (A dx^2 + C dy^2) / 2 + B dx dy`.
    pub conic: [F; 3],
    /// After the antialiasing compensation, if enabled.
    pub opacity: F,
    /// Half size of the bounding box outside which alpha is below 1/255, pixels.
    pub extent: [F; 2],
}

/// Gradients of a [`Footprint`]'s fields that the image depends on.
#[derive(Clone, Copy)]
pub(super) struct FootprintGradient<F> {
    pub xy: [F; 2],
    pub depth: F,
    pub conic: [F; 3],
    pub opacity: F,
}

/// Intermediate values shared by forward and backward.
struct Intermediate<F: Lanes> {
    x: [F; 3],
    inv_z: F,
    /// Clamped tangents and whether the clamp is active.
    tangent: [F; 2],
    q: [F; 4],
    inv_q_norm: F,
    rot: [[F; 3]; 3],
    /// After the 3D filter.
    scale: [F; 3],
    /// Variance along each axis before the 3D filter divided by that after it.
    fraction: [F; 3],
    /// The lens at the mean; `None` for a pinhole.
    lens: Option<LensAt<F>>,
    /// Rows of J R.
    jr: [[F; 3]; 2],
    v: [[F; 3]; 2],
    /// Before dilation: a, b, c and the determinant.
    cov: [F; 3],
    det: F,
    /// After dilation.
    cov_dilated: [F; 3],
    det_dilated: F,
    sigmoid: F,
    /// sqrt of the product of `fraction`: the factor of the 3D filter on opacity.
    thinning: F,
}

#[inline(always)]
pub(super) fn dot<F: Lanes>(a: [F; 3], b: [F; 3]) -> F {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

#[inline(always)]
fn intermediate<F: Lanes>(view: &ViewLanes<F>, g: &Geometry<F>, filter: Option<F>) -> Intermediate<F> {
    let one = view.near.splat(1.0);
    let two = view.near.splat(2.0);
    let x = unroll!(i in 3 => dot(view.r[i], g.mean) + view.t[i]);
    let inv_z = one / x[2];
    let tangent = unroll!(i in 2 => (x[i] * inv_z).min(view.limits[i][1]).max(view.limits[i][0]));
    let inv_q_norm =
        one / (g.quat[0] * g.quat[0] + g.quat[1] * g.quat[1] + g.quat[2] * g.quat[2] + g.quat[3] * g.quat[3]).sqrt();
    let q = unroll!(n in 4 => g.quat[n] * inv_q_norm);
    let [w, i, j, k] = q;
    let rot = [
        [
            one - two * (j * j + k * k),
            two * (i * j - w * k),
            two * (i * k + w * j),
        ],
        [
            two * (i * j + w * k),
            one - two * (i * i + k * k),
            two * (j * k - w * i),
        ],
        [
            two * (i * k - w * j),
            two * (j * k + w * i),
            one - two * (i * i + j * j),
        ],
    ];
    let own_scale = unroll!(k in 3 => g.log_scale[k].exp());
    // Mip-Splatting (Yu et al. 2024), eq. 8: convolution with an isotropic Gaussian, preserving mass.
    let (scale, fraction, thinning) = match filter {
        Some(variance) => {
            let scale: [F; 3] = unroll!(k in 3 => own_scale[k].mul_add(own_scale[k], variance).sqrt());
            let ratio: [F; 3] = unroll!(k in 3 => own_scale[k] / scale[k]);
            (
                scale,
                unroll!(k in 3 => ratio[k] * ratio[k]),
                ratio[0] * ratio[1] * ratio[2],
            )
        }
        None => (own_scale, [one; 3], one),
    };
    let lens = view.lens.as_ref().map(|lens| lens.at(x, view.f, view.c));
    let jr = match &lens {
        Some(lens) => {
            unroll!(r in 2 => unroll!(c in 3 => dot(lens.jacobian[r], [view.r[0][c], view.r[1][c], view.r[2][c]])))
        }
        // J = [[fx/z, 0, -fx tx/z], [0, fy/z, -fy ty/z]] with the clamped tangents tx, ty.
        None => {
            let j_scale = unroll!(r in 2 => view.f[r] * inv_z);
            unroll!(r in 2 => unroll!(c in 3 => j_scale[r] * (view.r[r][c] - tangent[r] * view.r[2][c])))
        }
    };
    let u: [[F; 3]; 2] = unroll!(r in 2 => unroll!(c in 3 => dot(jr[r], [rot[0][c], rot[1][c], rot[2][c]])));
    let v: [[F; 3]; 2] = unroll!(r in 2 => unroll!(c in 3 => u[r][c] * scale[c]));
    let cov = [dot(v[0], v[0]), dot(v[0], v[1]), dot(v[1], v[1])];
    // |V0 x V1|^2 (Lagrange) instead of a c - b^2: the difference of two large products loses needles to rounding.
    let cross = [
        v[0][1] * v[1][2] - v[0][2] * v[1][1],
        v[0][2] * v[1][0] - v[0][0] * v[1][2],
        v[0][0] * v[1][1] - v[0][1] * v[1][0],
    ];
    let det = dot(cross, cross);
    let dilation = one.splat(DILATION);
    let det_dilated = det + dilation * (cov[0] + cov[2]) + dilation * dilation;
    let sigmoid = one / (one + (-g.opacity_logit).exp());
    Intermediate {
        x,
        inv_z,
        tangent,
        q,
        inv_q_norm,
        rot,
        scale,
        fraction,
        lens,
        jr,
        v,
        cov,
        det,
        cov_dilated: [cov[0] + dilation, cov[1], cov[2] + dilation],
        det_dilated,
        sigmoid,
        thinning,
    }
}

/// Projects; the mask holds the lanes that may touch the image. Lanes outside it hold unspecified numbers. `filter` is the
/// variance of the 3D smoothing filter, world units squared.
#[inline(always)]
pub(super) fn project<F: Lanes>(
    view: &ViewLanes<F>,
    g: &Geometry<F>,
    filter: Option<F>,
    antialias: bool,
) -> (Footprint<F>, F::Mask) {
    let at = intermediate(view, g, filter);
    let own_opacity = at.sigmoid * at.thinning;
    let inv_det = at.inv_z.splat(1.0) / at.det_dilated;
    let [a, b, c] = at.cov_dilated;
    let opacity = if antialias {
        own_opacity * (at.det * inv_det).max(inv_det.splat(COMPENSATION_FLOOR)).sqrt()
    } else {
        own_opacity
    };
    let (xy, depth) = match &at.lens {
        Some(lens) => (lens.xy, lens.depth),
        None => (unroll!(i in 2 => view.f[i] * at.x[i] * at.inv_z + view.c[i]), at.x[2]),
    };
    // alpha >= 1/255 inside d^T conic d <= 2 ln(255 opacity), whose box has half sizes sqrt(2 ln(255 opacity) cov_ii).
    let reach = (opacity * opacity.splat(1.0 / ALPHA_MIN)).map(|v| Scalar::from_f64(2.0 * v.to_f64().max(1.0).ln()));
    let extent = [(reach * a).sqrt(), (reach * c).sqrt()];
    let zero = reach.splat(0.0);
    let half = reach.splat(0.5);
    let mut visible = view.near.lt(depth).and(reach.splat(ALPHA_MIN).le(opacity));
    if let Some(lens) = &at.lens {
        visible = visible.and(lens.visible);
    }
    for i in 0..2 {
        // Some pixel centre (0.5 .. size - 0.5) must lie within the box; NaN fails both.
        let low = (xy[i] - extent[i]).le(view.size[i] - half);
        let high = half.le(xy[i] + extent[i]);
        let is_close = (zero - view.margin).le(xy[i]).and(xy[i].le(view.size[i] + view.margin));
        visible = visible.and(low).and(high).and(is_close);
    }
    visible = visible
        .and(zero.lt(at.det_dilated))
        .and(at.det_dilated.lt(zero.splat(1e30)));
    (
        Footprint {
            xy,
            depth,
            conic: [c * inv_det, -b * inv_det, a * inv_det],
            opacity,
            extent,
        },
        visible,
    )
}

/// `[a, b, c]` of `log2 alpha = a dx^2 + b dx dy + c dy^2 + log2 opacity`, from the conic.
#[inline(always)]
pub(super) fn quadratic<F: Lanes>(conic: [F; 3]) -> [F; 3] {
    let half = conic[0].splat(-0.5 * LOG2_E);
    [conic[0] * half, conic[1] * (half + half), conic[2] * half]
}

/// The gradient of a footprint from the sums of blending: the moments 1, dx, dy, dx^2, dx dy, dy^2 of v_p / ln 2, where
/// dx = pixel - centre.
#[inline(always)]
pub(super) fn footprint_gradient<F: Lanes>(
    [a, b, c]: [F; 3],
    log2_opacity: F,
    moments: [F; 6],
    v_depth: F,
) -> FootprintGradient<F> {
    let ln_2 = a.splat(LN_2);
    let [s, sx, sy, sxx, sxy, syy] = moments;
    let [sx, sy] = [sx * ln_2, sy * ln_2];
    let two = a.splat(2.0);
    // ln 2 of the moments and log2(e) of the quadratic cancel in the conic and in the opacity.
    let half = a.splat(-0.5);
    FootprintGradient {
        xy: [-(two * a * sx + b * sy), -(b * sx + two * c * sy)],
        depth: v_depth,
        conic: [half * sxx, -sxy, half * syy],
        opacity: s * (-log2_opacity).exp2(),
    }
}

/// The vector-Jacobian product of [`project`].
#[inline(always)]
pub(super) fn project_vjp<F: Lanes>(
    view: &ViewLanes<F>,
    g: &Geometry<F>,
    filter: Option<F>,
    antialias: bool,
    v_out: &FootprintGradient<F>,
) -> (Geometry<F>, CameraTerms<F>) {
    let at = intermediate(view, g, filter);
    let one = at.inv_z.splat(1.0);
    let two = one.splat(2.0);
    let inv_det = one / at.det_dilated;
    let [a, b, c] = at.cov_dilated;

    // conic = cov^-1: v_cov = -conic v_conic conic, with b counted twice.
    let [qa, qb, qc] = [c * inv_det, -b * inv_det, a * inv_det];
    let [ga, gb, gc] = [v_out.conic[0], v_out.conic[1] * one.splat(0.5), v_out.conic[2]];
    let left = [
        qa * ga + qb * gb,
        qa * gb + qb * gc,
        qb * ga + qc * gb,
        qb * gb + qc * gc,
    ];
    let mut v_cov = [
        -(left[0] * qa + left[1] * qb),
        -two * (left[0] * qb + left[1] * qc),
        -(left[2] * qb + left[3] * qc),
    ];

    // Opacity, with its compensation sqrt(det / det_dilated).
    let own_opacity = at.sigmoid * at.thinning;
    let v_own_opacity = if antialias {
        let ratio = at.det * inv_det;
        let floor = one.splat(COMPENSATION_FLOOR);
        let compensation = ratio.max(floor).sqrt();
        let v_ratio = (v_out.opacity * own_opacity * one.splat(0.5) / compensation).masked(floor.lt(ratio));
        let v_det = v_ratio * inv_det;
        let v_det_dilated = -v_det * ratio;
        v_cov[0] += v_det * at.cov[2] + v_det_dilated * c;
        v_cov[2] += v_det * at.cov[0] + v_det_dilated * a;
        v_cov[1] -= two * b * (v_det + v_det_dilated);
        v_out.opacity * compensation
    } else {
        v_out.opacity
    };

    // cov = V V^T, V = U diag(s), U = (J R) Rot.
    let v_v: [[F; 3]; 2] = [
        unroll!(k in 3 => two * v_cov[0] * at.v[0][k] + v_cov[1] * at.v[1][k]),
        unroll!(k in 3 => two * v_cov[2] * at.v[1][k] + v_cov[1] * at.v[0][k]),
    ];
    let v_log_filtered = unroll!(k in 3 => v_v[0][k] * at.v[0][k] + v_v[1][k] * at.v[1][k]);
    let v_log_thinning = v_own_opacity * own_opacity;
    let v_log_scale: [F; 3] = match filter {
        Some(_) => unroll!(k in 3 => v_log_filtered[k] * at.fraction[k] + v_log_thinning * (one - at.fraction[k])),
        None => v_log_filtered,
    };
    let v_u: [[F; 3]; 2] = unroll!(r in 2 => unroll!(k in 3 => v_v[r][k] * at.scale[k]));
    let v_rot: [[F; 3]; 3] = unroll!(j in 3 => unroll!(k in 3 => at.jr[0][j] * v_u[0][k] + at.jr[1][j] * v_u[1][k]));
    let v_jr: [[F; 3]; 2] = unroll!(r in 2 => unroll!(j in 3 => dot(v_u[r], at.rot[j])));

    let (v_x, mut v_r) = match &at.lens {
        Some(lens) => {
            let v_jacobian = unroll!(r in 2 => unroll!(i in 3 => dot(v_jr[r], view.r[i])));
            let v_r = unroll!(i in 3 => unroll!(c in 3 => {
                lens.jacobian[0][i] * v_jr[0][c] + lens.jacobian[1][i] * v_jr[1][c]
            }));
            (lens.vjp(v_out.xy, v_out.depth, v_jacobian), v_r)
        }
        None => pinhole_vjp(view, &at, v_out, v_jr),
    };
    let v_mean = unroll!(j in 3 => dot(v_x, [view.r[0][j], view.r[1][j], view.r[2][j]]));
    for i in 0..3 {
        for j in 0..3 {
            v_r[i][j] = v_x[i].mul_add(g.mean[j], v_r[i][j]);
        }
    }

    // Rot(q), then the normalisation of q.
    let [w, i, j, k] = at.q;
    let m = v_rot;
    let v_q = [
        two * (k * (m[1][0] - m[0][1]) + j * (m[0][2] - m[2][0]) + i * (m[2][1] - m[1][2])),
        two * (j * (m[0][1] + m[1][0]) + k * (m[0][2] + m[2][0]) + w * (m[2][1] - m[1][2])
            - two * i * (m[1][1] + m[2][2])),
        two * (i * (m[0][1] + m[1][0]) + k * (m[1][2] + m[2][1]) + w * (m[0][2] - m[2][0])
            - two * j * (m[0][0] + m[2][2])),
        two * (i * (m[0][2] + m[2][0]) + j * (m[1][2] + m[2][1]) + w * (m[1][0] - m[0][1])
            - two * k * (m[0][0] + m[1][1])),
    ];
    let along = v_q[0] * w + v_q[1] * i + v_q[2] * j + v_q[3] * k;
    let v_quat = unroll!(n in 4 => (v_q[n] - at.q[n] * along) * at.inv_q_norm);

    let geometry = Geometry {
        mean: v_mean,
        quat: v_quat,
        log_scale: v_log_scale,
        opacity_logit: v_log_thinning * (one - at.sigmoid),
    };
    let camera = CameraTerms {
        rotation: v_r,
        translation: v_x,
    };
    (geometry, camera)
}

/// The gradients of the mean in the camera and of R, from that of `J R` and of the footprint.
#[inline(always)]
fn pinhole_vjp<F: Lanes>(
    view: &ViewLanes<F>,
    at: &Intermediate<F>,
    v_out: &FootprintGradient<F>,
    v_jr: [[F; 3]; 2],
) -> ([F; 3], [[F; 3]; 3]) {
    let zero = at.inv_z.splat(0.0);
    // J R: row r is f_r / z (R_r - tangent_r R_2).
    let mut v_x = [zero; 3];
    let mut v_r = [[zero; 3]; 3];
    for r in 0..2 {
        let j_scale = view.f[r] * at.inv_z;
        for c in 0..3 {
            v_r[r][c] = j_scale * v_jr[r][c];
            v_r[2][c] -= at.tangent[r] * v_r[r][c];
        }
        let v_j_scale = dot(v_jr[r], view.r[r]) - at.tangent[r] * dot(v_jr[r], view.r[2]);
        v_x[2] -= v_j_scale * j_scale * at.inv_z;
        let v_tangent = -j_scale * dot(v_jr[r], view.r[2]);
        let tangent = at.x[r] * at.inv_z;
        let [lowest, highest] = view.limits[r];
        let v_tangent = v_tangent.masked(lowest.lt(tangent).and(tangent.lt(highest)));
        // The pixel position also depends on the tangent, unclamped.
        let v_free = v_tangent + v_out.xy[r] * view.f[r];
        v_x[r] += v_free * at.inv_z;
        v_x[2] -= v_free * tangent * at.inv_z;
    }
    v_x[2] += v_out.depth;
    (v_x, v_r)
}

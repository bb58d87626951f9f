//! Regularisers on splat parameters, independent of the image, and their gradients.
//!
//! Symbols: `o` opacity, `s` standard deviations in a unit of length, each averaged over the splats visible in the frame or over
//! all: `opacity o + opacity_square o^2 + scale mean(s) + covariance |Sigma|_F^2`. The first and third are those of 3DGS-MCMC
//! (Kheradmand et al. 2024, eq. 10), the others CurriculumGS's (`|Sigma|_F^2` is the sum of `s^4`).

use crate::render::CHUNK;
use crate::{SplatGradients, Splats};
use irradia_compute::Planes;
use irradia_compute::simd::{Kernel, Lanes, Level, Mask, Simd};
use irradia_compute::unroll;
use irradia_scene::Camera;
use rayon::prelude::*;
use std::f32::consts::LN_2;

/// Weights of the terms.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Regularizers {
    /// Weight of the opacity.
    pub opacity: f32,
    /// Weight of the squared opacity.
    pub opacity_square: f32,
    /// Weight of the mean standard deviation.
    pub scale: f32,
    /// Weight of the squared Frobenius norm of the covariance.
    pub covariance: f32,
}

impl Regularizers {
    /// Whether all weights are zero.
    pub fn is_zero(&self) -> bool {
        *self == Self::default()
    }

    /// Weights of a splat's own opacity, its square, the sum of its standard deviations and that of their fourth powers, with lengths in
    /// world units and a weight of `per_splat` for each splat in the averages.
    pub(crate) fn per_splat(&self, unit: f64, per_splat: f64) -> [f64; 4] {
        [
            f64::from(self.opacity) * per_splat,
            f64::from(self.opacity_square) * per_splat,
            f64::from(self.scale) * per_splat / (3.0 * unit),
            f64::from(self.covariance) * per_splat / unit.powi(4),
        ]
    }
}

/// The splats over which the terms are averaged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Regularized {
    /// Those visible in the frame.
    #[default]
    Visible,
    /// All; for splats that are not visible these are the only gradients (3DGS-MCMC).
    All,
}

/// Adds the gradients to `gradients`. `unit` is the unit of length, world units. For splats that are not visible,
/// [`Regularized::All`] writes the gradients of ln scales and opacity logits, which were unspecified; the other columns remain
/// unspecified, and the splats inactive.
pub fn add_gradients(
    level: Level,
    splats: &Splats,
    weights: &Regularizers,
    of: Regularized,
    unit: f32,
    gradients: &mut SplatGradients,
) {
    let counted = match of {
        Regularized::Visible => gradients.counts.iter().map(|n| *n as usize).sum(),
        Regularized::All => splats.len(),
    };
    if counted == 0 {
        return;
    }
    let SplatGradients {
        splats: v_splats,
        active,
        counts,
        ..
    } = gradients;
    let [x, y, z] = v_splats.log_scales.planes_mut();
    x.par_chunks_mut(CHUNK)
        .zip(y.par_chunks_mut(CHUNK))
        .zip(z.par_chunks_mut(CHUNK))
        .zip(v_splats.opacity_logits.plane_mut(0).par_chunks_mut(CHUNK))
        .zip(counts)
        .enumerate()
        .filter(|(_, (_, count))| **count > 0 || of == Regularized::All)
        .for_each(|(chunk, ((((x, y), z), v_logits), _))| {
            level.run(AddGradients {
                splats,
                weights,
                all: of == Regularized::All,
                unit,
                per_splat: 1.0 / counted as f64,
                active,
                first: chunk * CHUNK,
                v_log_scales: [x, y, z],
                v_logits,
            });
        });
}

/// [`add_gradients`] for one chunk of splats.
struct AddGradients<'a> {
    splats: &'a Splats,
    weights: &'a Regularizers,
    /// Whether splats that are not active are included.
    all: bool,
    unit: f32,
    per_splat: f64,
    active: &'a [f32],
    first: usize,
    v_log_scales: [&'a mut [f32]; 3],
    v_logits: &'a mut [f32],
}

impl Kernel for AddGradients<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let weights = WeightLanes::new(simd, self.weights, f64::from(self.unit), self.per_splat);
        let zero = simd.splat(0.0);
        for at in (0..self.v_logits.len()).step_by(S::LANES) {
            let i = self.first + at;
            let active = zero.lt(simd.load(&self.active[i..]));
            if active.none() && !self.all {
                continue;
            }
            let log_scale = unroll!(c in 3 => simd.load(&self.splats.log_scales.plane(c)[i..]));
            let logit = simd.load(&self.splats.opacity_logits.plane(0)[i..]);
            let (_, v_log_scale, v_logit) = regularizer(&weights, log_scale, logit);
            for c in 0..3 {
                let to = &mut self.v_log_scales[c][at..];
                (simd.load(to).masked(active) + v_log_scale[c]).store(to);
            }
            let to = &mut self.v_logits[at..];
            (simd.load(to).masked(active) + v_logit).store(to);
        }
    }
}

struct WeightLanes<F> {
    opacity: F,
    opacity_square: F,
    scale: F,
    covariance: F,
}

impl<F: Lanes> WeightLanes<F> {
    #[inline(always)]
    fn new<S: Simd<F = F>>(simd: S, weights: &Regularizers, unit: f64, per_splat: f64) -> Self {
        let [opacity, opacity_square, scale, covariance] =
            weights.per_splat(unit, per_splat).map(|weight| simd.splat(weight));
        Self {
            opacity,
            opacity_square,
            scale,
            covariance,
        }
    }
}

/// One splat's term of the loss and its gradients.
#[inline(always)]
fn regularizer<F: Lanes>(w: &WeightLanes<F>, log_scale: [F; 3], logit: F) -> (F, [F; 3], F) {
    let one = logit.splat(1.0);
    let s = unroll!(c in 3 => log_scale[c].exp());
    let squares = unroll!(c in 3 => s[c] * s[c]);
    let o = one / (one + (-logit).exp());
    let frobenius = squares[0] * squares[0] + squares[1] * squares[1] + squares[2] * squares[2];
    let value = w.opacity * o + w.opacity_square * o * o + w.scale * (s[0] + s[1] + s[2]) + w.covariance * frobenius;
    let four = one.splat(4.0);
    let v_log_scale = unroll!(c in 3 => w.scale * s[c] + w.covariance * four * squares[c] * squares[c]);
    let v_o = w.opacity + (w.opacity_square + w.opacity_square) * o;
    (value, v_log_scale, v_o * o * (one - o))
}

/// Raises the smaller standard deviations until no covariance has a condition number above `limit`.
pub fn cap_condition(splats: &mut Splats, limit: f32) {
    // The condition number of the covariance is the squared ratio of the standard deviations.
    let span = 0.5 * limit.max(1.0).ln();
    for_each_size(&mut splats.log_scales, |_, sizes| {
        let low = sizes.iter().fold(f32::MIN, |most, v| most.max(**v)) - span;
        for v in sizes {
            if *v < low {
                *v = low;
            }
        }
    });
}

/// Calls `change(splat, ln scales)` for every splat, on all cores.
fn for_each_size(log_scales: &mut Planes, change: impl Fn(usize, [&mut f32; 3]) + Sync) {
    let n = log_scales.len();
    let [x, y, z] = log_scales.planes_mut().map(|plane: &mut [f32]| &mut plane[..n]);
    x.par_chunks_mut(CHUNK)
        .zip(y.par_chunks_mut(CHUNK))
        .zip(z.par_chunks_mut(CHUNK))
        .enumerate()
        .with_min_len(8)
        .for_each(|(chunk, ((x, y), z))| {
            for (i, ((x, y), z)) in x.iter_mut().zip(y).zip(z).enumerate() {
                change(chunk * CHUNK + i, [x, y, z]);
            }
        });
}

/// How large a splat may be, as seen from a camera. A footprint is the affine approximation of a splat's projection at its centre. Of a
/// large splat beside the camera, at a depth `Z` near 0, that approximation has a standard deviation of `s f / Z` at a distance of
/// `X f / Z` from the image, whatever `Z` is: above `s / X` = 0.3 it covers the image as a veil, although the splat itself does not enter
/// the view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AngleCap {
    /// Position of the camera, world.
    pub center: [f32; 3],
    /// Largest standard deviation, relative to the distance from the camera.
    pub largest: f32,
}

/// The highest [`AngleCap::largest`] for photographs of wide lenses that are not cut into faces. The approximations of a footprint for a
/// lens and for a pinhole differ where the splat is large: renders through a fisheye then look right, and those through a pinhole show
/// veils. `synth`'s room by a fisheye of 190 degrees, held-out views by a pinhole, 1,500 steps: 32.3 dB without a cap, 36.2, 37.3 and 38.0
/// with 0.25, 0.15 and 0.1; antialiased 39.3 with 0.1, 39.7 with 0.05.
const MAX_WIDE_LENS_RATIO: f32 = 0.1;

impl AngleCap {
    /// The cap for a step whose photograph was taken by `camera`: `largest`, or less if its lens is wide; `None` if that is 0 and its lens
    /// is not wide.
    pub fn of(camera: &Camera, largest: f32) -> Option<Self> {
        let given = if largest > 0.0 { largest } else { f32::INFINITY };
        let allowed = if camera.intrinsics.lens.is_wide() {
            MAX_WIDE_LENS_RATIO
        } else {
            f32::INFINITY
        };
        let largest = given.min(allowed);
        largest.is_finite().then(|| Self {
            center: camera.pose.position.to_array(),
            largest,
        })
    }
}

/// Lowers standard deviations that are too large for their distance.
pub fn cap_angle(splats: &mut Splats, cap: &AngleCap) {
    let (means, of_distance) = (&splats.means, cap.largest.ln());
    for_each_size(&mut splats.log_scales, |i, sizes| {
        let square: f32 = (0..3).map(|c| (means.get(c, i) - cap.center[c]).powi(2)).sum();
        // The exponent of the number, its binary logarithm rounded down, spares nearly all splats the logarithm.
        let exponent = (square.to_bits() >> 23) as f32 - 127.0;
        let size = sizes.iter().fold(f32::MIN, |most, v| most.max(**v));
        if size <= 0.5 * LN_2 * exponent + of_distance {
            return;
        }
        let largest = 0.5 * square.ln() + of_distance;
        // A splat at the camera itself has no finite limit.
        for v in sizes {
            if largest.is_finite() && *v > largest {
                *v = largest;
            }
        }
    });
}

/// Minimum size of the largest `fraction` of `sizes`; `None` if that is all of them.
pub(crate) fn size_limit(mut sizes: Vec<f32>, fraction: f32) -> Option<f32> {
    let frozen = ((1.0 - fraction) * sizes.len() as f32).round() as usize;
    if frozen == 0 || sizes.is_empty() {
        return None;
    }
    let at = frozen.min(sizes.len() - 1);
    Some(*sizes.select_nth_unstable_by(at, f32::total_cmp).1)
}

/// Freezes position and shape of all but the largest `fraction` of the visible splats. Their opacity and colour are still
/// trained: floaters in front of the cameras must be able to fade (fern without points, 800 steps: 23.9 dB with everything frozen).
/// `of` tells whether splats that are not visible have gradients.
pub fn freeze_small(splats: &Splats, fraction: f32, of: Regularized, gradients: &mut SplatGradients) {
    let n = splats.len();
    let [x, y, z] = [0, 1, 2].map(|c| splats.log_scales.plane(c));
    let size = |i: usize| f32::MIN.max(x[i]).max(y[i]).max(z[i]);
    let active_chunks = gradients.counts.par_iter().enumerate().filter(|(_, count)| **count > 0);
    let active = &gradients.active;
    let sizes: Vec<f32> = active_chunks
        .flat_map_iter(|(chunk, _)| {
            let range = chunk * CHUNK..n.min((chunk + 1) * CHUNK);
            range.filter(|i| active[*i] != 0.0).map(size)
        })
        .collect();
    let Some(limit) = size_limit(sizes, fraction) else {
        return;
    };
    // One byte per splat: reading three planes of sizes for each of ten planes of gradients takes longer.
    let mut small = vec![false; n];
    let counts = &gradients.counts;
    let has_gradients = |chunk: usize| of == Regularized::All || counts[chunk] > 0;
    small.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, small)| {
        if has_gradients(chunk) {
            for (at, small) in small.iter_mut().enumerate() {
                *small = size(chunk * CHUNK + at) < limit;
            }
        }
    });
    let shape = &mut gradients.splats;
    for column in [&mut shape.means, &mut shape.quats, &mut shape.log_scales] {
        let stride = column.stride();
        for plane in column.as_mut_slice().chunks_mut(stride) {
            let chunks = plane[..n]
                .par_chunks_mut(CHUNK)
                .zip(small.par_chunks(CHUNK))
                .enumerate();
            chunks.for_each(|(chunk, (gradients, small))| {
                if has_gradients(chunk) {
                    for (gradient, small) in gradients.iter_mut().zip(small) {
                        *gradient = if *small { 0.0 } else { *gradient };
                    }
                }
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use irradia_compute::simd::Double;
    use irradia_scene::{Intrinsics, Lens, Pose, Rng};
    use irradia_testkit::finite_differences::FiniteDifferences;

    #[test]
    fn gradients_match_finite_differences() {
        let mut rng = Rng::new(8, 8);
        for weights in [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
            [0.1, 0.7, 0.3, 0.2],
        ] {
            let [opacity, opacity_square, scale, covariance] = weights;
            let weights = Regularizers {
                opacity,
                opacity_square,
                scale,
                covariance,
            };
            let w = WeightLanes::new(Double, &weights, 1.7, 0.25);
            let x: [f64; 4] = std::array::from_fn(|_| f64::from(rng.range(-2.0, 1.0)));
            let (_, v_log_scale, v_logit) = regularizer(&w, [x[0], x[1], x[2]], x[3]);
            let gradient = [v_log_scale[0], v_log_scale[1], v_log_scale[2], v_logit];
            // For values near 1: 1e-10 of curvature, 1e-11 of rounding.
            let differences = FiniteDifferences {
                absolute: 1e-8,
                ..FiniteDifferences::relative_to_max(1e-5, 0.0)
            };
            let value = |x: &[f64]| regularizer(&w, [x[0], x[1], x[2]], x[3]).0;
            differences.check(&format!("{weights:?}"), &x, &gradient, 0..4, value);
        }
    }

    #[test]
    fn invisible_splats_are_regularised_only_with_all() {
        let weights = Regularizers {
            opacity: 1.0,
            scale: 3.0,
            ..Regularizers::default()
        };
        let n = 21;
        let splats = Splats::zeros(n, 0);
        for level in Level::all() {
            for (of, counted) in [(Regularized::Visible, 7.0), (Regularized::All, 21.0)] {
                let mut gradients = SplatGradients {
                    splats: Splats::zeros(n, 0),
                    active: vec![0.0; splats.stride()],
                    counts: vec![7],
                    ..Default::default()
                };
                // Invisible splats hold the values of an earlier frame.
                gradients.splats.log_scales.as_mut_slice().fill(f32::NAN);
                gradients.splats.opacity_logits.as_mut_slice().fill(f32::NAN);
                for i in (0..n).step_by(3) {
                    gradients.active[i] = 1.0;
                    gradients.splats.opacity_logits.set(0, i, 0.5);
                    (0..3).for_each(|c| gradients.splats.log_scales.set(c, i, 0.5));
                }
                add_gradients(level, &splats, &weights, of, 2.0, &mut gradients);
                for i in (0..n).filter(|i| i % 3 == 0 || of == Regularized::All) {
                    // Opacity 1/2, whose slope is 1/4; s = 1, in units of 2 and over 3 axes: 1/2.
                    let own = if i % 3 == 0 { 0.5 } else { 0.0 };
                    let (logit, log_scale) = (own + 0.25 / counted, own + 0.5 / counted);
                    assert!(
                        (gradients.splats.opacity_logits.get(0, i) - logit).abs() < 1e-6,
                        "{of:?} {i}"
                    );
                    let got = gradients.splats.log_scales.get(1, i);
                    assert!((got - log_scale).abs() < 1e-6, "{of:?} {i}: {got}");
                    assert_eq!(gradients.active[i] != 0.0, i % 3 == 0, "visibility is unchanged");
                }
            }
        }
    }

    #[test]
    fn the_condition_number_is_capped() {
        let mut splats = Splats::zeros(1, 0);
        splats.log_scales.set(0, 0, -9.0);
        cap_condition(&mut splats, 100.0);
        let s: [f32; 3] = std::array::from_fn(|c| splats.log_scales.get(c, 0));
        assert_eq!((s[1], s[2]), (0.0, 0.0));
        assert!((s[0] + 10.0f32.ln()).abs() < 1e-6);
    }

    #[test]
    fn the_size_as_seen_from_a_camera_is_capped() {
        let mut splats = Splats::zeros(3, 0);
        let places = [[1.0, 0.0, 2.0], [1.0, 0.0, 12.0], [1.0, 0.0, 0.0]];
        for (i, place) in places.into_iter().enumerate() {
            (0..3).for_each(|c| splats.means.set(c, i, place[c]));
        }
        splats.log_scales.set(1, 0, -3.0);
        let cap = AngleCap {
            center: [1.0, 0.0, 0.0],
            largest: 0.1,
        };
        cap_angle(&mut splats, &cap);
        let scale = |c: usize, i: usize| splats.log_scales.get(c, i);
        assert!((scale(0, 0) - 0.2f32.ln()).abs() < 1e-6, "a tenth of two");
        assert_eq!((scale(1, 0), scale(0, 1)), (-3.0, 0.0), "small enough");
        assert_eq!(scale(2, 2), 0.0, "at the camera");
    }

    #[test]
    fn caps_hold_at_all_distances_and_are_tighter_for_wide_lenses() {
        let pose = Pose {
            rotation: Quat::IDENTITY,
            position: Vec3::ZERO,
        };
        let mut camera = Camera::new(pose, Intrinsics::from_fov_x(8, 8, 1.0));
        assert_eq!(AngleCap::of(&camera, 0.0), None);
        let cap = AngleCap::of(&camera, 0.3).expect("a cap");
        // Distances from 1e-9 to 1e9, standard deviations up to a third more and less than allowed.
        let distances: Vec<f32> = (0..400).map(|i| 10f32.powf(0.045 * i as f32 - 9.0)).collect();
        let mut splats = Splats::zeros(distances.len(), 0);
        for (i, distance) in distances.iter().enumerate() {
            splats.means.set(1, i, *distance);
            let given = (0.3 * distance).ln();
            (0..3).for_each(|c| splats.log_scales.set(c, i, given + 0.1 * (i as f32 + c as f32).sin()));
        }
        let before = splats.clone();
        cap_angle(&mut splats, &cap);
        for (i, distance) in distances.iter().enumerate() {
            for c in 0..3 {
                let expected = before.log_scales.get(c, i).min((0.3 * distance).ln());
                assert!((splats.log_scales.get(c, i) - expected).abs() < 1e-5, "{distance}");
            }
        }
        camera.intrinsics.lens = Lens::Equirectangular;
        for (largest, expected) in [(0.0, 0.1), (0.3, 0.1), (0.05, 0.05)] {
            assert_eq!(AngleCap::of(&camera, largest).expect("a cap").largest, expected);
        }
    }

    #[test]
    fn small_splats_keep_their_shape_and_still_fade() {
        let mut splats = Splats::zeros(10, 0);
        for i in 0..10 {
            splats.log_scales.set(1, i, i as f32);
        }
        let mut gradients = SplatGradients {
            splats: Splats::zeros(10, 0),
            active: vec![1.0; splats.stride()],
            counts: vec![9],
            ..Default::default()
        };
        for i in 0..10 {
            gradients.splats.means.set(2, i, 1.0);
            gradients.splats.opacity_logits.set(0, i, 1.0);
        }
        gradients.active[9] = 0.0;
        freeze_small(&splats, 1.0 / 3.0, Regularized::Visible, &mut gradients);
        let moved: Vec<usize> = (0..9).filter(|i| gradients.splats.means.get(2, *i) != 0.0).collect();
        assert_eq!(moved, [6, 7, 8], "a third of the nine visible ones");
        assert!((0..10).all(|i| gradients.splats.opacity_logits.get(0, i) == 1.0));
    }
}

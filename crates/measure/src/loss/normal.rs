//! Angle between the normals of the rendered depth and given normals, such as a network's estimate. (DN-Splatter, Turkulainen et al. 2024,
//! compares the normals of splats instead; normals of the depth involve all splats that a pixel shows.)
//!
//! Symbols, for each sample: D the rendered expected depth, accumulated depth A over alpha, at four pixels left (l), right (r), above (u)
//! and below (d); P = D ((x - cx) / fx, (y - cy) / fy, 1) the points there; m the given normal.
//!
//! ```text
//! n = (P_d - P_u) x (P_r - P_l), normalised;   loss = mean of 1 - n m
//! ```
//!
//! The loss constrains neither scale nor absolute depth. Samples at depth edges do not count.

use super::{DepthGradient, DepthPlanes};
use glam::{DVec3, Vec2};
use irradia_compute::simd::Scalar;
use irradia_scene::Intrinsics;

/// A sample is at a depth edge if two opposite depths differ by more than this fraction of the smaller one.
const EDGE_THRESHOLD: f64 = 0.2;

/// The known normal at a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NormalSample {
    /// Column and row.
    pub pixel: [u32; 2],
    /// Unit vector towards the camera, in the camera's axes (x right, y down, z forward).
    pub normal: [f32; 3],
}

/// Computes the loss and its gradient.
#[derive(Clone, Copy, Debug)]
pub struct NormalLoss {
    /// Pixels less opaque than this do not count, since their depth is unreliable. 0.5 by default.
    pub min_alpha: f32,
}

impl Default for NormalLoss {
    fn default() -> Self {
        Self { min_alpha: 0.5 }
    }
}

impl NormalLoss {
    /// The loss of `frame`, which `camera` sees; `weight` times its gradient is added to `gradient`. The four depths of a sample are
    /// `reach` pixels from it; samples whose pixels are not all in the image do not count.
    ///
    /// # Panics
    /// When the lengths differ: a bug in the caller.
    pub fn evaluate(
        &self,
        frame: DepthPlanes,
        camera: &Intrinsics,
        samples: &[NormalSample],
        reach: u32,
        weight: f32,
        gradient: &mut DepthGradient,
    ) -> f64 {
        self.run(frame, camera, samples, reach, f64::from(weight), gradient)
    }

    // Single-threaded: a view has a few thousand samples, which take less than a millisecond.
    fn run<T: Scalar>(
        &self,
        frame: DepthPlanes<T>,
        camera: &Intrinsics,
        samples: &[NormalSample],
        reach: u32,
        weight: f64,
        gradient: &mut DepthGradient<T>,
    ) -> f64 {
        frame.assert_lengths(gradient, frame.depth.len());
        let stencil = |sample: &NormalSample| self.stencil(frame, camera, sample, reach);
        let counted: Vec<Stencil> = samples.iter().filter_map(stencil).collect();
        let mut sum = 0.0;
        for at in &counted {
            sum += 1.0 - at.normal().0.dot(at.given);
            let v = at.vjp(weight / counted.len() as f64);
            for ((pixel, rendered), v) in at.pixels.iter().zip(at.depths).zip(v) {
                let opacity = frame.alpha[*pixel].to_f64();
                let (v_d, v_a) = (&mut gradient.depth[*pixel], &mut gradient.alpha[*pixel]);
                *v_d = *v_d + T::from_f64(v / opacity);
                *v_a = *v_a + T::from_f64(-v * rendered / opacity);
            }
        }
        sum / counted.len().max(1) as f64
    }

    fn stencil<T: Scalar>(
        &self,
        frame: DepthPlanes<T>,
        camera: &Intrinsics,
        sample: &NormalSample,
        reach: u32,
    ) -> Option<Stencil> {
        let [x, y] = sample.pixel;
        let (left, upper) = (x.checked_sub(reach)?, y.checked_sub(reach)?);
        let (right, lower) = (x.checked_add(reach)?, y.checked_add(reach)?);
        if right >= camera.width || lower >= camera.height {
            return None;
        }
        let places = [[left, y], [right, y], [x, upper], [x, lower]];
        let pixels = places.map(|[x, y]| y as usize * camera.width as usize + x as usize);
        let mut depths = [0.0; 4];
        for (depth_at, pixel) in depths.iter_mut().zip(pixels) {
            let opacity = frame.alpha.get(pixel)?.to_f64();
            *depth_at = frame.depth[pixel].to_f64() / opacity;
            let usable = opacity >= f64::from(self.min_alpha) && *depth_at > 0.0 && depth_at.is_finite();
            if !usable {
                return None;
            }
        }
        let is_edge = |a: f64, b: f64| (a - b).abs() > EDGE_THRESHOLD * a.min(b);
        let ray = |[x, y]: [u32; 2]| camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).as_dvec3();
        let given = DVec3::from_array(sample.normal.map(f64::from));
        let counts = !is_edge(depths[0], depths[1]) && !is_edge(depths[2], depths[3]) && given.is_finite();
        counts.then(|| Stencil {
            pixels,
            depths,
            rays: places.map(ray),
            given,
        })
    }
}

/// The inputs of a sample; arrays are in the order left, right, above, below.
struct Stencil {
    pixels: [usize; 4],
    depths: [f64; 4],
    rays: [DVec3; 4],
    given: DVec3,
}

impl Stencil {
    /// The vectors from the left point to the right one, and from the upper point to the lower one.
    fn sides(&self) -> [DVec3; 2] {
        let [l, r, u, d] = [0, 1, 2, 3].map(|i| self.rays[i] * self.depths[i]);
        [r - l, d - u]
    }

    /// The normal, and the length of the cross product of the sides.
    fn normal(&self) -> (DVec3, f64) {
        let [across, down] = self.sides();
        let product = down.cross(across);
        let length = product.length().max(f64::MIN_POSITIVE);
        (product / length, length)
    }

    /// `weight` times the gradient of 1 - n m with respect to the four depths.
    fn vjp(&self, weight: f64) -> [f64; 4] {
        let [across, down] = self.sides();
        let (normal, length) = self.normal();
        let v_normal = -weight * self.given;
        let v_product = (v_normal - normal * normal.dot(v_normal)) / length;
        let (v_down, v_across) = (across.cross(v_product), v_product.cross(down));
        let v_points = [-v_across, v_across, -v_down, v_down];
        [0, 1, 2, 3].map(|i| self.rays[i].dot(v_points[i]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::picture::depth_gradient;
    use irradia_scene::Rng;
    use irradia_testkit::finite_differences::{FiniteDifferences, sample_indices};

    const SIDE: u32 = 12;

    fn camera() -> Intrinsics {
        Intrinsics::from_fov_x(SIDE, SIDE, 0.9)
    }

    /// Accumulated depths and opacities of the plane `normal * P = -distance`.
    fn plane(normal: DVec3, distance: f64, opacity: impl Fn(usize) -> f64) -> [Vec<f64>; 2] {
        let k = camera();
        let depth = |i: u32| {
            let at = [
                f64::from(i % SIDE) + 0.5 - f64::from(k.cx),
                f64::from(i / SIDE) + 0.5 - f64::from(k.cy),
            ];
            -distance / normal.dot(DVec3::new(at[0] / f64::from(k.fx), at[1] / f64::from(k.fy), 1.0))
        };
        let alpha: Vec<f64> = (0..(SIDE * SIDE) as usize).map(opacity).collect();
        let depths = (0..SIDE * SIDE).zip(&alpha).map(|(i, a)| depth(i) * a).collect();
        [depths, alpha]
    }

    fn samples(normal: DVec3) -> Vec<NormalSample> {
        let normal = normal.as_vec3().to_array();
        (0..SIDE * SIDE)
            .map(|i| NormalSample {
                pixel: [i % SIDE, i / SIDE],
                normal,
            })
            .collect()
    }

    fn value(depth: &[f64], alpha: &[f64], samples: &[NormalSample]) -> (f64, [Vec<f64>; 2]) {
        depth_gradient(depth.len(), 0.0, |gradient| {
            NormalLoss::default().run(DepthPlanes { depth, alpha }, &camera(), samples, 2, 1.0, gradient)
        })
    }

    #[test]
    fn a_plane_has_its_normal_whatever_its_distance_and_opacity() {
        let normal = DVec3::new(0.3, -0.4, -0.8).normalize();
        for distance in [1.0, 50.0] {
            let [depth, alpha] = plane(normal, distance, |i| 0.6 + 0.02 * (i % 20) as f64);
            let (loss, [v_depth, v_alpha]) = value(&depth, &alpha, &samples(normal));
            // Given normals are in single precision.
            assert!(loss.abs() < 1e-6, "{loss}");
            assert!(v_depth.iter().chain(&v_alpha).all(|v| v.abs() < 1e-5));
            // A right angle between the two.
            let other = normal.cross(DVec3::X).normalize();
            assert!((value(&depth, &alpha, &samples(other)).0 - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn gradients_match_finite_differences() {
        let mut rng = Rng::new(4, 4);
        let normal = DVec3::new(-0.2, 0.3, -0.9).normalize();
        let [mut depth, alpha] = plane(normal, 3.0, |i| 0.55 + 0.03 * (i % 15) as f64);
        depth
            .iter_mut()
            .for_each(|d| *d *= 1.0 + 0.01 * f64::from(rng.normal()));
        let given = samples(DVec3::new(0.1, 0.5, -0.8).normalize());
        let (loss, [v_depth, v_alpha]) = value(&depth, &alpha, &given);
        assert!(loss > 0.05, "{loss}");
        // For this seed no sample is within a step of an edge, and no opacity within a step of the threshold.
        let differences = FiniteDifferences::relative_to_max(1e-6, 1e-5);
        let by_depth = |d: &[f64]| value(d, &alpha, &given).0;
        differences.check("depth", &depth, &v_depth, sample_indices(depth.len()), by_depth);
        let by_alpha = |a: &[f64]| value(&depth, a, &given).0;
        differences.check("alpha", &alpha, &v_alpha, sample_indices(alpha.len()), by_alpha);
    }

    #[test]
    fn edges_transparent_pixels_and_borders_do_not_count() {
        let normal = DVec3::NEG_Z;
        let [mut depth, alpha] = plane(normal, 2.0, |i| if i / 12 < 6 { 0.4 } else { 1.0 });
        // A wall twice as far in the right half.
        (0..depth.len()).filter(|i| i % 12 >= 6).for_each(|i| depth[i] *= 2.0);
        let tilted = samples(DVec3::new(0.0, 0.6, -0.8));
        let (_, [v_depth, v_alpha]) = value(&depth, &alpha, &tilted);
        assert!(
            v_depth
                .iter()
                .zip(&v_alpha)
                .take(6 * 12)
                .all(|(d, a)| *d == 0.0 && *a == 0.0)
        );
        assert!(v_depth.iter().any(|v| *v != 0.0));
        let none = [
            NormalSample {
                pixel: [0, 11],
                normal: [0.0, 0.0, -1.0],
            },
            NormalSample {
                pixel: [u32::MAX, 3],
                normal: [0.0, 0.0, -1.0],
            },
        ];
        assert_eq!(value(&depth, &alpha, &none).0, 0.0);
    }
}

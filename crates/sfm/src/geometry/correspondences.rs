//! Corresponding points of two photographs and the costs of models over them, in SIMD.

use glam::{DMat3, DVec2};
use irradia_compute::simd::{Kernel, Lanes, Level, Mask, Simd};
use irradia_compute::unroll;
use std::marker::PhantomData;

/// Padding of the planes: a multiple of every vector's length.
const LANE_MULTIPLE: usize = 16;

/// Corresponding points of two photographs.
#[derive(Clone, Debug, Default)]
pub struct Correspondences {
    /// `[N]` the points in the first and in the second photograph, on an image plane each, about 1 in magnitude.
    pub points: Vec<[DVec2; 2]>,
    /// x and y in the first, x and y in the second, padded with NaN, which is an outlier for every model.
    planes: [Vec<f32>; 4],
}

impl Correspondences {
    /// From pairs of points.
    pub fn new(points: Vec<[DVec2; 2]>) -> Self {
        let padded = points.len().next_multiple_of(LANE_MULTIPLE);
        let plane = |value: fn(&[DVec2; 2]) -> f64| {
            let mut plane: Vec<f32> = points.iter().map(|p| value(p) as f32).collect();
            plane.resize(padded, f32::NAN);
            plane
        };
        let planes = [
            plane(|p| p[0].x),
            plane(|p| p[0].y),
            plane(|p| p[1].x),
            plane(|p| p[1].y),
        ];
        Self { points, planes }
    }

    /// MSAC cost and number of inliers of an epipolar matrix (`b^T m a = 0`) by the Sampson distance.
    pub fn epipolar_cost(&self, m: &DMat3, threshold: f64) -> (f64, usize) {
        self.cost::<Epipolar>(m, threshold)
    }

    /// `[N]` whether each is an inlier of an epipolar matrix by the Sampson distance.
    pub fn epipolar_inliers(&self, m: &DMat3, threshold: f64) -> Vec<bool> {
        let is_inlier = |p: &[DVec2; 2]| sampson_squared(m, *p) < threshold * threshold;
        self.points.iter().map(is_inlier).collect()
    }

    /// MSAC cost and number of inliers of a homography (`b ~ m a`) by the distance in the second photograph.
    pub fn transfer_cost(&self, m: &DMat3, threshold: f64) -> (f64, usize) {
        self.cost::<Transfer>(m, threshold)
    }

    fn cost<R: Residual>(&self, m: &DMat3, threshold: f64) -> (f64, usize) {
        let sums = Level::detect().run(Cost {
            planes: &self.planes,
            model: m.to_cols_array(),
            residual: PhantomData::<R>,
            inverse: 1.0 / (threshold * threshold),
        });
        let padding = (self.planes[0].len() - self.points.len()) as f64;
        (sums.0 - padding, sums.1)
    }
}

/// Squared residuals of a two-view model `m`, which is stored column by column.
trait Residual {
    fn squared<F: Lanes<Scalar = f32>>(m: &[F; 9], x: F, y: F, u: F, v: F) -> F;
}

struct Epipolar;

impl Residual for Epipolar {
    #[inline(always)]
    fn squared<F: Lanes<Scalar = f32>>(m: &[F; 9], x: F, y: F, u: F, v: F) -> F {
        let a = m[0].mul_add(x, m[3].mul_add(y, m[6]));
        let b = m[1].mul_add(x, m[4].mul_add(y, m[7]));
        let c = m[2].mul_add(x, m[5].mul_add(y, m[8]));
        let d = m[0].mul_add(u, m[1].mul_add(v, m[2]));
        let e = m[3].mul_add(u, m[4].mul_add(v, m[5]));
        let algebraic = a.mul_add(u, b.mul_add(v, c));
        algebraic * algebraic / a.mul_add(a, b.mul_add(b, d.mul_add(d, e * e)))
    }
}

struct Transfer;

impl Residual for Transfer {
    #[inline(always)]
    fn squared<F: Lanes<Scalar = f32>>(m: &[F; 9], x: F, y: F, u: F, v: F) -> F {
        let a = m[0].mul_add(x, m[3].mul_add(y, m[6]));
        let b = m[1].mul_add(x, m[4].mul_add(y, m[7]));
        let c = m[2].mul_add(x, m[5].mul_add(y, m[8]));
        let (dx, dy) = (a / c - u, b / c - v);
        dx.mul_add(dx, dy * dy)
    }
}

struct Cost<'a, R> {
    planes: &'a [Vec<f32>; 4],
    model: [f64; 9],
    residual: PhantomData<R>,
    /// 1 / threshold^2.
    inverse: f64,
}

impl<R: Residual> Kernel for Cost<'_, R> {
    type Output = (f64, usize);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> (f64, usize)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let [x, y, u, v] = self.planes;
        let model = self.model;
        let m = unroll!(i in 9 => simd.splat(model[i]));
        let one = simd.splat(1.0);
        let inverse = simd.splat(self.inverse);
        let mut sum = simd.splat(0.0);
        let mut inliers = 0;
        for i in (0..x.len()).step_by(S::LANES) {
            let squared = R::squared(
                &m,
                simd.load(&x[i..]),
                simd.load(&y[i..]),
                simd.load(&u[i..]),
                simd.load(&v[i..]),
            ) * inverse;
            let inside = squared.lt(one);
            sum += squared.select(inside, one);
            inliers += inside.bits().count_ones();
        }
        (f64::from(sum.sum()), inliers as usize)
    }
}

/// The squared Sampson distance of `b^T m a = 0`, in the squared units of the points.
pub fn sampson_squared(m: &DMat3, [a, b]: [DVec2; 2]) -> f64 {
    let (line_b, line_a) = (*m * a.extend(1.0), m.transpose() * b.extend(1.0));
    let algebraic = b.extend(1.0).dot(line_b);
    algebraic * algebraic / (line_b.truncate().length_squared() + line_a.truncate().length_squared())
}

/// The squared distance of `m a` from `b`.
pub fn transfer_squared(m: &DMat3, [a, b]: [DVec2; 2]) -> f64 {
    let p = *m * a.extend(1.0);
    (p.truncate() / p.z - b).length_squared()
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    #[test]
    fn lanes_count_what_the_scalar_residuals_count() {
        let mut rng = Rng::new(5, 0);
        let mut number = |scale: f64| scale * f64::from(rng.normal());
        let m = DMat3::from_cols_array(&std::array::from_fn(|_| number(1.0)));
        let points: Vec<[DVec2; 2]> = (0..77)
            .map(|_| {
                [
                    DVec2::new(number(0.5), number(0.5)),
                    DVec2::new(number(0.5), number(0.5)),
                ]
            })
            .collect();
        let all = Correspondences::new(points.clone());
        type Squared = fn(&DMat3, [DVec2; 2]) -> f64;
        for (got, squared, threshold) in [
            (all.epipolar_cost(&m, 0.2), sampson_squared as Squared, 0.2f64),
            (all.transfer_cost(&m, 0.8), transfer_squared, 0.8),
        ] {
            let residuals: Vec<f64> = points.iter().map(|p| squared(&m, *p) / threshold.powi(2)).collect();
            assert_eq!(got.1, residuals.iter().filter(|r| **r < 1.0).count());
            assert!(got.1 > 5, "a test of few inliers says little");
            let cost: f64 = residuals.iter().map(|r| r.min(1.0)).sum();
            // f32 lanes: 1e-7 of 77 summands.
            assert!((got.0 - cost).abs() < 1e-3, "{} {cost}", got.0);
        }
    }
}

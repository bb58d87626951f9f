//! The affine shape of a feature: the ellipse as which a tilted disc appears (Baumberg 2000; Mikolajczyk and Schmid, "Scale and affine
//! invariant interest point detectors", 2004).

use super::extrema::Extremum;
use super::scale_space::{FIRST_SCALE, Plane, gaussian, sigma_of};

/// Side of a patch, px: the extent of a descriptor at any angle, plus a margin.
const PATCH_SIDE: usize = 40;
/// Standard deviation of the feature in its patch, px.
const PATCH_SIGMA: f32 = 1.6;
/// Standard deviation of the window whose gradients determine the shape, in sigmas of the feature (VLFeat).
const INTEGRATION_SCALE: f32 = 3.0;
/// Maximum number of steps.
const MAX_ITERATIONS: usize = 8;
/// The shape has converged once the ratio of the axes of the gradients' second moments is below this.
const MAX_CONVERGED_RATIO: f32 = 1.1;
/// Maximum ratio of an ellipse's axes.
const MAX_AXIS_RATIO: f32 = 6.0;
/// A blur of less than this makes no difference and is skipped, px.
const MIN_BLUR_SIGMA: f32 = 0.4;
/// Number of sigmas at which a blur is truncated.
const BLUR_EXTENT_SIGMAS: f32 = 3.0;
/// Factor by which a level may be more blurred than requested: levels are discrete, and slightly too much is closer than far too
/// little.
const BLUR_TOLERANCE: f32 = 1.12;

/// The surroundings of `extremum` as seen from the front, up to a rotation, and the extremum in this patch.
pub(super) fn frontal_patch(octaves: &[Vec<Plane>], extremum: &Extremum) -> (Plane, Extremum) {
    let centre = Extremum {
        x: 0.5 * PATCH_SIDE as f32,
        y: 0.5 * PATCH_SIDE as f32,
        sigma: PATCH_SIGMA,
        ..*extremum
    };
    let mut shape = Ellipse::DISC;
    let mut patch = shape.patch(octaves, extremum);
    for _ in 0..MAX_ITERATIONS {
        let Some(next) = shape.adapted(second_moments(&patch)) else {
            break;
        };
        if next.ratio() > MAX_AXIS_RATIO {
            return (Ellipse::DISC.patch(octaves, extremum), centre);
        }
        shape = next;
        patch = shape.patch(octaves, extremum);
    }
    (patch, centre)
}

/// An ellipse with the area of the unit disc.
#[derive(Clone, Copy, Debug)]
struct Ellipse {
    /// Direction of the long axis.
    axis: [f32; 2],
    /// Half of the long axis.
    long: f32,
}

impl Ellipse {
    const DISC: Self = Self {
        axis: [1.0, 0.0],
        long: 1.0,
    };

    fn ratio(&self) -> f32 {
        self.long * self.long
    }

    /// The ellipse in whose patch the second moments, now `[xx, xy, yy]`, become equal; `None` if they nearly are.
    fn adapted(&self, [xx, xy, yy]: [f32; 3]) -> Option<Self> {
        let det = xx * yy - xy * xy;
        let [short, long] = eigenvalues([xx, xy, yy]);
        if det <= 1e-6 * (0.5 * (xx + yy)).powi(2) || long < MAX_CONVERGED_RATIO * MAX_CONVERGED_RATIO * short {
            return None;
        }
        // C' = B M^-1 B^T, where B holds the patch's axes in the photograph.
        let scale = 1.0 / det.sqrt();
        let inverse = [yy * scale, -xy * scale, xx * scale];
        let ([c, s], a, b) = (self.axis, self.long, 1.0 / self.long);
        let columns = [[c * a, -s * b], [s * a, c * b]];
        let product = |i: usize, j: usize| {
            let ([p, q], [r, t]) = (columns[i], columns[j]);
            p * r * inverse[0] + (p * t + q * r) * inverse[1] + q * t * inverse[2]
        };
        let shape @ [xx, xy, yy] = [product(0, 0), product(0, 1), product(1, 1)];
        let angle = 0.5 * xy.atan2(0.5 * (xx - yy));
        Some(Self {
            axis: [angle.cos(), angle.sin()],
            long: eigenvalues(shape)[1].sqrt(),
        })
    }

    /// The patch in which the ellipse around `extremum` is a disc.
    fn patch(&self, octaves: &[Vec<Plane>], extremum: &Extremum) -> Plane {
        let sigma = extremum.sigma;
        let (octave, level) = find_level(octaves, extremum.octave, sigma / self.long);
        let plane = &octaves[octave][level];
        // Pixels of the plane per pixel of the extremum's octave.
        let resolution_ratio = (1u32 << (extremum.octave - octave)) as f32;
        let blur = sigma_of(level + FIRST_SCALE) / resolution_ratio;
        let step = sigma / PATCH_SIGMA;
        let [c, s] = self.axis;
        let (along, across) = (step * self.long, step / self.long);
        let mut to = Plane::new(PATCH_SIDE, PATCH_SIDE);
        for (j, row) in to.rows_mut().enumerate() {
            let v = (j as f32 + 0.5 - 0.5 * PATCH_SIDE as f32) * across;
            for (i, value) in row[..PATCH_SIDE].iter_mut().enumerate() {
                let u = (i as f32 + 0.5 - 0.5 * PATCH_SIDE as f32) * along;
                *value = bilinear(
                    plane,
                    (extremum.x + c * u - s * v) * resolution_ratio,
                    (extremum.y + s * u + c * v) * resolution_ratio,
                );
            }
        }
        let remaining_blur = |step: f32| {
            (PATCH_SIGMA * PATCH_SIGMA - (blur / step) * (blur / step))
                .max(0.0)
                .sqrt()
        };
        let [x, y] = [along, across].map(remaining_blur);
        blur_rows(&mut to, x);
        blur_columns(&mut to, y);
        to
    }
}

/// Eigenvalues of the symmetric matrix `[xx, xy, yy]`, ascending.
fn eigenvalues([xx, xy, yy]: [f32; 3]) -> [f32; 2] {
    let (mean, half) = (0.5 * (xx + yy), 0.5 * (xx - yy));
    let spread = (half * half + xy * xy).sqrt();
    [mean - spread, mean + spread]
}

/// The octave and index of the most blurred level whose blur is at most about `sigma` pixels of octave `from`.
fn find_level(octaves: &[Vec<Plane>], from: usize, sigma: f32) -> (usize, usize) {
    let wanted = BLUR_TOLERANCE * sigma;
    for octave in (0..=from).rev() {
        let resolution_ratio = (1u32 << (from - octave)) as f32;
        for level in (0..octaves[octave].len()).rev() {
            if sigma_of(level + FIRST_SCALE) <= wanted * resolution_ratio {
                return (octave, level);
            }
        }
    }
    (0, 0)
}

/// The bilinearly interpolated value at `(x, y)`; the border is repeated outside.
fn bilinear(plane: &Plane, x: f32, y: f32) -> f32 {
    let x = (x - 0.5).clamp(0.0, plane.width as f32 - 1.001);
    let y = (y - 0.5).clamp(0.0, plane.height as f32 - 1.001);
    let (i, j) = (x as usize, y as usize);
    let (u, v) = (x - i as f32, y - j as f32);
    let (above, below) = (plane.row(j), plane.row(j + 1));
    let top = above[i] + (above[i + 1] - above[i]) * u;
    let bottom = below[i] + (below[i + 1] - below[i]) * u;
    top + (bottom - top) * v
}

fn blur_rows(plane: &mut Plane, sigma: f32) {
    if sigma < MIN_BLUR_SIGMA {
        return;
    }
    let taps = gaussian(sigma, BLUR_EXTENT_SIGMAS);
    for row in plane.rows_mut() {
        let old: [f32; PATCH_SIDE] = std::array::from_fn(|i| row[i]);
        for (i, value) in row[..PATCH_SIDE].iter_mut().enumerate() {
            *value = taps[0] * old[i];
            for (r, tap) in taps.iter().enumerate().skip(1) {
                *value += tap * (old[i.saturating_sub(r)] + old[(i + r).min(PATCH_SIDE - 1)]);
            }
        }
    }
}

fn blur_columns(plane: &mut Plane, sigma: f32) {
    if sigma < MIN_BLUR_SIGMA {
        return;
    }
    let taps = gaussian(sigma, BLUR_EXTENT_SIGMAS);
    let old = plane.clone();
    for (j, row) in plane.rows_mut().enumerate() {
        for (value, centre) in row.iter_mut().zip(old.row(j)) {
            *value = taps[0] * centre;
        }
        for (r, tap) in taps.iter().enumerate().skip(1) {
            let (before, after) = (old.row(j.saturating_sub(r)), old.row((j + r).min(PATCH_SIDE - 1)));
            for ((value, a), b) in row.iter_mut().zip(before).zip(after) {
                *value += tap * (a + b);
            }
        }
    }
}

/// The second moments `[xx, xy, yy]` of a patch's gradients in a Gaussian window.
fn second_moments(patch: &Plane) -> [f32; 3] {
    let scale = 0.5 / (INTEGRATION_SCALE * PATCH_SIGMA).powi(2);
    let weights: [f32; PATCH_SIDE] = std::array::from_fn(|i| {
        let from_middle = i as f32 + 0.5 - 0.5 * PATCH_SIDE as f32;
        (-scale * from_middle * from_middle).exp()
    });
    let mut moments = [0.0; 3];
    for j in 1..PATCH_SIDE - 1 {
        let [above, row, below] = [j - 1, j, j + 1].map(|j| patch.row(j));
        for i in 1..PATCH_SIDE - 1 {
            let weight = weights[i] * weights[j];
            let (gx, gy) = (row[i + 1] - row[i - 1], below[i] - above[i]);
            moments[0] += weight * gx * gx;
            moments[1] += weight * gx * gy;
            moments[2] += weight * gy * gy;
        }
    }
    moments
}

//! After blending: how much light a lens loses towards the corners, the same in all of its photographs.
//!
//! The polynomial of Goldman ("Vignette and Exposure Calibration and Compensation", 2010) and of panorama programs:
//! `y = x (1 + a u + b u^2 + c u^3)`, `u` the squared distance from the principal point, 1 at the corners of a centred image; here on
//! sRGB-encoded colours. A scene can darken the corners of a photograph, and nothing else, only by veils in front of the camera. The
//! vignette belongs to the lens, not to a photograph: held-out views have it as well.

use super::per_view::PerViewAdam;
use super::{Occupant, pixel_chunks, sum_of};
use crate::tensor_file::{NamedTensor, TensorSource, to_bytes};
use irradia_scene::{Dataset, Image, Intrinsics};
use rayon::prelude::*;
use safetensors::SafeTensors;

/// Parameters of a lens: a, b, c.
const N: usize = 3;
/// Maximum relative difference of proportions, and of focal lengths, between images by the same lens.
const LENS_TOLERANCE: f32 = 0.03;
/// The minimum gain.
const MIN_GAIN: f32 = 0.05;
/// Rows whose gradients are summed together: a fixed number, so that the sum does not depend on threads.
const ROWS_PER_TASK: usize = 16;

/// The properties by which lenses are told apart, independent of the image's size and orientation.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Lens {
    /// The shorter side divided by the longer one.
    proportion: f32,
    /// Focal length divided by the longer side.
    focal: f32,
}

impl Lens {
    fn from_intrinsics(k: &Intrinsics) -> Self {
        let (short, long) = (k.width.min(k.height) as f32, k.width.max(k.height) as f32);
        Self {
            proportion: short / long,
            focal: k.fx.max(k.fy) / long,
        }
    }

    fn matches(self, other: Self) -> bool {
        let near = |a: f32, b: f32| (a - b).abs() <= LENS_TOLERANCE * a;
        near(self.proportion, other.proportion) && near(self.focal, other.focal)
    }

    /// Whether the image is the face of a cube, whose corners are not those of a lens.
    fn is_cube_face(self) -> bool {
        self.proportion == 1.0 && (self.focal - 0.5).abs() < 1e-3
    }
}

/// A curve of gains for each lens of a capture, initially 1 everywhere.
#[derive(Clone, Debug, PartialEq)]
pub struct Vignette {
    lenses: Vec<Lens>,
    /// `[lenses][N]`.
    curves: Vec<[f32; N]>,
    adam: PerViewAdam<N>,
}

impl Vignette {
    /// Name of the file beside the scene.
    pub const FILE: &str = "vignette.safetensors";

    /// For the lenses of the training photographs; `None` if all of these are faces of cubes.
    pub fn new(dataset: &Dataset) -> Option<Self> {
        let mut lenses: Vec<Lens> = Vec::new();
        for view in &dataset.train {
            let lens = Lens::from_intrinsics(&dataset.views[*view].camera.intrinsics);
            if !lens.is_cube_face() && !lenses.iter().any(|other| other.matches(lens)) {
                lenses.push(lens);
            }
        }
        (!lenses.is_empty()).then(|| Self::untrained(lenses))
    }

    fn untrained(lenses: Vec<Lens>) -> Self {
        Self {
            curves: vec![[0.0; N]; lenses.len()],
            adam: PerViewAdam::new(lenses.len()),
            lenses,
        }
    }

    /// From the file of [`Occupant::export`].
    ///
    /// # Errors
    /// One line, when it is damaged.
    pub fn from_file(bytes: &[u8]) -> Result<Self, String> {
        let file = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let read = |name: &str, each: usize| {
            let values = TensorSource::new(&file, "").f32s(name);
            let values = values.filter(|values| values.len() % each == 0 && values.iter().all(|v| v.is_finite()));
            values.ok_or(format!("{name} is missing or has the wrong length"))
        };
        let (lenses, curves) = (read("lenses", 2)?, read("curves", N)?);
        if lenses.len() / 2 != curves.len() / N {
            return Err(format!("{} lenses, {} curves", lenses.len() / 2, curves.len() / N));
        }
        let lens = |[proportion, focal]: &[f32; 2]| Lens {
            proportion: *proportion,
            focal: *focal,
        };
        let mut vignette = Self::untrained(lenses.as_chunks().0.iter().map(lens).collect());
        vignette.curves.copy_from_slice(curves.as_chunks::<N>().0);
        Ok(vignette)
    }

    /// The gain at the corners of the lens that changes them most, in sRGB-encoded colours; `None` before the first step.
    pub fn corner_gain(&self) -> Option<f32> {
        let trained = self.curves.iter().filter(|curve| **curve != [0.0; N]);
        let change = |corner_gain: f32| (corner_gain - 1.0).abs();
        let corners = trained.map(|curve| gain(*curve, 1.0));
        corners.max_by(|a, b| change(*a).total_cmp(&change(*b)))
    }

    fn curves(&self) -> NamedTensor {
        NamedTensor::f32s("curves", vec![self.curves.len(), N], self.curves.as_flattened())
    }

    fn lens_of(&self, k: &Intrinsics) -> Option<usize> {
        let lens = Lens::from_intrinsics(k);
        self.lenses.iter().position(|other| other.matches(lens))
    }

    /// `color` `[3, H, W]` as the lens of `k` shows it, at most 1; unchanged if the lens is unknown.
    pub fn apply(&self, k: &Intrinsics, color: &[f32], to: &mut Vec<f32>) {
        to.clear();
        to.extend_from_slice(color);
        let Some(lens) = self.lens_of(k) else {
            return;
        };
        let (curve, width) = (self.curves[lens], k.width as usize);
        pixel_chunks(to, ROWS_PER_TASK * width)
            .enumerate()
            .for_each(|(piece, planes)| {
                for plane in planes {
                    for (row, values) in plane.chunks_mut(width).enumerate() {
                        for (value, u) in values.iter_mut().zip(squared_radii(k, piece * ROWS_PER_TASK + row)) {
                            *value = apply_gain(*value, gain(curve, u));
                        }
                    }
                }
            });
    }

    /// `image` `[H, W, 3]` as the lens of `k` shows it, as [`Self::apply`] does with planes.
    pub fn apply_to(&self, k: &Intrinsics, mut image: Image) -> Image {
        if let Some(lens) = self.lens_of(k) {
            let curve = self.curves[lens];
            for (row, values) in image.data.chunks_mut(3 * k.width as usize).enumerate() {
                for (pixel, u) in values.as_chunks_mut::<3>().0.iter_mut().zip(squared_radii(k, row)) {
                    *pixel = pixel.map(|value| apply_gain(value, gain(curve, u)));
                }
            }
        }
        image
    }

    /// The vector-Jacobian product of [`Self::apply`]: `v` `[3, H, W]` becomes the gradient of `color`; returns that of the curve.
    /// Where the output is saturated, only gradients that darken it pass.
    fn vjp(&self, lens: usize, k: &Intrinsics, color: &[f32], v: &mut [f32]) -> [f32; N] {
        let (curve, width) = (self.curves[lens], k.width as usize);
        let pixels = color.len() / 3;
        let sums: Vec<[f64; N]> = pixel_chunks(v, ROWS_PER_TASK * width)
            .enumerate()
            .map(|(piece, planes)| {
                let mut total = [0.0f64; N];
                for (c, plane) in planes.into_iter().enumerate() {
                    for (row, v) in plane.chunks_mut(width).enumerate() {
                        let row = piece * ROWS_PER_TASK + row;
                        let color = &color[c * pixels + row * width..][..width];
                        let mut sum = [0.0f32; N];
                        for ((v, x), u) in v.iter_mut().zip(color).zip(squared_radii(k, row)) {
                            let gain = gain(curve, u);
                            let v_y = if x * gain > 1.0 { v.max(0.0) } else { *v };
                            let v_gain = if gain > MIN_GAIN { v_y * x } else { 0.0 };
                            sum[0] += v_gain * u;
                            sum[1] += v_gain * u * u;
                            sum[2] += v_gain * u * u * u;
                            *v = v_y * gain;
                        }
                        for (total, sum) in total.iter_mut().zip(sum) {
                            *total += f64::from(sum);
                        }
                    }
                }
                total
            })
            .collect();
        sum_of(&sums)
    }

    /// The vector-Jacobian product of [`Self::apply`] for a trained curve: `v` `[3, H, W]` becomes the gradient of `color`.
    pub(crate) fn backward(&self, k: &Intrinsics, color: &[f32], v: &mut [f32]) {
        if let Some(lens) = self.lens_of(k) {
            self.vjp(lens, k, color, v);
        }
    }

    /// The vector-Jacobian product of [`Self::apply`], and a step of Adam at `rate`.
    pub fn step(&mut self, k: &Intrinsics, color: &[f32], v: &mut [f32], rate: f32) {
        let Some(lens) = self.lens_of(k) else {
            return;
        };
        let gradient = self.vjp(lens, k, color, v);
        let change = self.adam.step(lens, gradient, [rate; N]);
        for (value, change) in self.curves[lens].iter_mut().zip(change) {
            *value += change;
        }
    }
}

/// The gain at the squared distance `u`.
fn gain([a, b, c]: [f32; N], u: f32) -> f32 {
    (1.0 + u * (a + u * (b + u * c))).max(MIN_GAIN)
}

/// `value` as the photograph shows it where the gain is `gain`.
fn apply_gain(value: f32, gain: f32) -> f32 {
    (value * gain).min(1.0)
}

/// Squared distances of the pixels of `row` from the principal point, 1 at half a diagonal.
fn squared_radii(k: &Intrinsics, row: usize) -> impl Iterator<Item = f32> {
    let unit = 4.0 / (k.width as f32 * k.width as f32 + k.height as f32 * k.height as f32);
    let (dy, cx) = (row as f32 + 0.5 - k.cy, k.cx);
    (0..k.width).map(move |x| {
        let dx = x as f32 + 0.5 - cx;
        unit * (dx * dx + dy * dy)
    })
}

impl Occupant for Vignette {
    fn name(&self) -> &'static str {
        "vignette"
    }

    fn tensors(&self) -> Vec<NamedTensor> {
        std::iter::once(self.curves()).chain(self.adam.tensors()).collect()
    }

    fn restore(&mut self, tensors: TensorSource) -> Result<(), String> {
        self.curves = tensors.rows::<N>("curves", self.curves.len())?;
        self.adam.restore(tensors, "")
    }

    fn export(&self) -> Option<Vec<u8>> {
        let lenses: Vec<f32> = self
            .lenses
            .iter()
            .flat_map(|lens| [lens.proportion, lens.focal])
            .collect();
        let lenses = NamedTensor::f32s("lenses", vec![self.lenses.len(), 2], &lenses);
        Some(to_bytes(&[lenses, self.curves()], ("irradia_vignette", "1".into())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::free_space;
    use irradia_scene::Rng;

    const WIDTH: u32 = 7;
    const HEIGHT: u32 = 37;

    /// A photograph by each of the lenses: width, height, focal length divided by the longer side.
    fn dataset(lenses: &[(u32, u32, f32)]) -> Dataset {
        let mut data = free_space::tests::dataset(0, None);
        let view = data.views[0].clone();
        let by = |(width, height, focal): &(u32, u32, f32)| {
            let mut view = view.clone();
            let mut k = Intrinsics::from_fov_x(*width, *height, 1.0);
            (k.fx, k.fy) = (focal * *width.max(height) as f32, focal * *width.max(height) as f32);
            view.camera.intrinsics = k;
            view
        };
        data.views = lenses.iter().map(by).collect();
        data.train = (0..lenses.len()).collect();
        data
    }

    fn example() -> (Vignette, Intrinsics, Vec<f32>, Vec<f32>) {
        let data = dataset(&[(WIDTH, HEIGHT, 1.2)]);
        let mut vignette = Vignette::new(&data).expect("a lens");
        vignette.curves[0] = [-0.2, 0.1, -0.15];
        let mut k = data.views[0].camera.intrinsics;
        (k.cx, k.cy) = (3.0, 17.0);
        let mut rng = Rng::new(3, 3);
        let pixels = (WIDTH * HEIGHT) as usize;
        let color = (0..3 * pixels).map(|_| rng.range(0.0, 0.9)).collect();
        let weights = (0..3 * pixels).map(|_| rng.range(-1.0, 1.0)).collect();
        (vignette, k, color, weights)
    }

    fn loss(vignette: &Vignette, k: &Intrinsics, color: &[f32], weights: &[f32]) -> f64 {
        let mut y = Vec::new();
        vignette.apply(k, color, &mut y);
        y.iter().zip(weights).map(|(y, w)| f64::from(*y) * f64::from(*w)).sum()
    }

    #[test]
    fn corners_darken_and_the_principal_point_stays() {
        let mut vignette = Vignette::new(&dataset(&[(9, 5, 1.0)])).unwrap();
        assert_eq!(vignette.corner_gain(), None);
        let mut k = Intrinsics::from_fov_x(9, 5, 1.0);
        (k.fx, k.fy) = (9.0, 9.0);
        vignette.curves[0] = [-0.1, -0.1, -0.1];
        let mut y = Vec::new();
        vignette.apply(&k, &[0.5; 135], &mut y);
        let image = vignette.apply_to(&k, Image::new(9, 5, 3, vec![0.5; 135]));
        assert!((0..45).all(|i| image.data[3 * i..][..3] == [y[i], y[45 + i], y[90 + i]]));
        assert_eq!(y[2 * 9 + 4], 0.5);
        let u = (16.0 + 4.0) / (4.5f32 * 4.5 + 2.5 * 2.5);
        let expected = 0.5 * (1.0 - 0.1 * (u + u * u + u * u * u));
        assert!((y[0] - expected).abs() < 1e-6 && (y[134] - expected).abs() < 1e-6);
        assert!((vignette.corner_gain().unwrap() - 0.7).abs() < 1e-6);
        vignette.apply(&k.resized(9, 9), &[0.5; 243], &mut y);
        assert_eq!(y, [0.5; 243], "another lens");
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let (vignette, k, color, weights) = example();
        let mut v = weights.clone();
        let of_curve = vignette.vjp(0, &k, &color, &mut v);
        // The gain is linear in its parameters, so that a large step costs only rounding.
        let h = 1e-2f32;
        for i in 0..N {
            let moved = |by: f32| {
                let mut moved = vignette.clone();
                moved.curves[0][i] += by;
                loss(&moved, &k, &color, &weights)
            };
            let expected = (moved(h) - moved(-h)) / f64::from(2.0 * h);
            assert!(
                (f64::from(of_curve[i]) - expected).abs() < 1e-2,
                "{i}: {} {expected}",
                of_curve[i]
            );
        }
        for i in [0, 100, 500, 3 * (WIDTH * HEIGHT) as usize - 1] {
            let moved = |by: f32| {
                let mut moved = color.clone();
                moved[i] += by;
                loss(&vignette, &k, &moved, &weights)
            };
            let expected = (moved(h) - moved(-h)) / f64::from(2.0 * h);
            assert!((f64::from(v[i]) - expected).abs() < 1e-3, "{i}: {} {expected}", v[i]);
        }
    }

    #[test]
    fn saturated_pixels_only_darken() {
        let mut vignette = Vignette::new(&dataset(&[(4, 4, 1.0)])).unwrap();
        vignette.curves[0] = [0.5, 0.0, 0.0];
        let mut k = Intrinsics::from_fov_x(4, 4, 1.0);
        (k.fx, k.fy) = (4.0, 4.0);
        let mut y = Vec::new();
        vignette.apply(&k, &[0.9; 48], &mut y);
        assert_eq!(y[0], 1.0);
        let mut v = [-1.0; 48];
        assert!(vignette.vjp(0, &k, &[0.9; 48], &mut v)[0] > -0.5 * 48.0);
        assert_eq!(v[0], 0.0);
    }

    #[test]
    fn the_curve_of_a_lens_is_found() {
        let (truth, k, color, _) = example();
        let mut found = Vignette::untrained(truth.lenses.clone());
        let (mut wanted, mut y) = (Vec::new(), Vec::new());
        truth.apply(&k, &color, &mut wanted);
        for step in 0..6000 {
            found.apply(&k, &color, &mut y);
            let mut v: Vec<f32> = y.iter().zip(&wanted).map(|(y, w)| y - w).collect();
            found.step(&k, &color, &mut v, 0.01 * 0.1f32.powf(step as f32 / 6000.0));
        }
        found.apply(&k, &color, &mut y);
        let worst = y.iter().zip(&wanted).map(|(y, w)| (y - w).abs()).fold(0.0, f32::max);
        assert!(worst < 0.003, "{worst} {:?}", found.curves);
    }

    #[test]
    fn lenses_are_told_apart_whatever_the_size_and_orientation_of_their_photographs() {
        let data = dataset(&[(400, 300, 1.0), (600, 800, 1.01), (400, 300, 1.3), (256, 256, 0.5)]);
        let vignette = Vignette::new(&data).expect("two lenses");
        assert_eq!(vignette.lenses.len(), 2, "faces of a cube have none: {vignette:?}");
        assert!(Vignette::new(&dataset(&[(256, 256, 0.5)])).is_none());
    }

    #[test]
    fn a_file_gives_it_back_and_damaged_ones_are_refused() {
        let (vignette, k, color, weights) = example();
        let file = vignette.export().expect("always written");
        let read = Vignette::from_file(&file).unwrap();
        assert_eq!(loss(&read, &k, &color, &weights), loss(&vignette, &k, &color, &weights));
        for end in [0, 8, file.len() / 2, file.len() - 1] {
            assert!(Vignette::from_file(&file[..end]).is_err());
        }
        let lenses = NamedTensor::f32s("lenses", vec![2, 2], &[1.0; 4]);
        let curves = NamedTensor::f32s("curves", vec![1, N], &[0.0; N]);
        let error = Vignette::from_file(&to_bytes(&[lenses, curves], ("irradia_vignette", "1".into()))).unwrap_err();
        assert_eq!(error, "2 lenses, 1 curves");
    }
}

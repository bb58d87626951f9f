//! After blending, before the exposure: a sky behind the splats, with separate colours for each photograph.
//!
//! Photographs taken on many days have skies that one scene cannot show: splats explain them by fog around everything in front. Here
//! whatever splats leave uncovered has a colour that is linear in the direction, as a clear or overcast sky nearly is within a photograph's
//! field of view: `c + G d`, one for all photographs plus one for each. (Per-image backgrounds: "Splatfacto-W", Xu et al. 2024, and
//! "WildGaussians", Kulhanek et al. 2024, learn them by a network or as splats.) The sky does not consist of splats: exported scenes have
//! no alpha there.

use super::per_view::PerViewAdam;
use super::{Occupant, pixel_chunks};
use crate::tensor_file::{NamedTensor, TensorSource, to_bytes};
use glam::{Vec2, Vec3};
use irradia_scene::{Camera, Dataset};
use rayon::prelude::*;
use safetensors::SafeTensors;

/// Terms of a colour channel: a constant, and one for each component of the direction.
const TERMS: usize = 4;
/// Parameters of a sky: the terms of red, of green, of blue.
const N: usize = 3 * TERMS;
/// Distance between pixels whose viewing directions are computed; directions between them are interpolated.
const DIRECTION_SPACING: u32 = 8;
/// Smallest cosine between two such directions for interpolation (26 degrees): they are further apart where a lens ends between them.
const MIN_COSINE: f32 = 0.9;
/// The initial parameters of the common sky.
const GREY: [f32; N] = [0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0];
/// Weight of the squared differences of a photograph's sky from the common one: a photograph that shows no sky has the common one.
const OWN_WEIGHT: f32 = 1e-4;

/// Colours of the sky: those common to all photographs, and the differences of each photograph from them.
#[derive(Clone, Debug, PartialEq)]
pub struct Sky {
    common: [f32; N],
    /// `[views][N]`.
    own: Vec<[f32; N]>,
    /// The training views.
    train: Vec<usize>,
    /// Mean optical axis of the training views, world.
    axis: Vec3,
    common_adam: PerViewAdam<N>,
    own_adam: PerViewAdam<N>,
}

/// The terms of a direction.
fn terms(direction: Vec3) -> [f32; TERMS] {
    [1.0, direction.x, direction.y, direction.z]
}

fn color(sky: &[f32; N], direction: Vec3) -> [f32; 3] {
    let terms = terms(direction);
    std::array::from_fn(|c| (0..TERMS).map(|k| sky[TERMS * c + k] * terms[k]).sum())
}

/// Unit viewing directions, world, of the pixels of `row`. They are interpolated between every [`DIRECTION_SPACING`]th pixel, since the
/// inverse of a lens is slow; for a pinhole they are exact.
fn directions(camera: &Camera, row: usize) -> impl Iterator<Item = Vec3> {
    let (k, rotation) = (camera.intrinsics, camera.pose.rotation);
    let ray = move |column: u32| k.ray(Vec2::new(column as f32 + 0.5, row as f32 + 0.5));
    (0..k.width.div_ceil(DIRECTION_SPACING)).flat_map(move |piece| {
        let first = piece * DIRECTION_SPACING;
        let (start, end) = (ray(first), ray(first + DIRECTION_SPACING));
        let is_smooth = start.normalize().dot(end.normalize()) > MIN_COSINE;
        let step = (end - start) / DIRECTION_SPACING as f32;
        (0..DIRECTION_SPACING.min(k.width - first)).map(move |i| {
            let along = if is_smooth {
                start + step * i as f32
            } else {
                ray(first + i)
            };
            rotation * along.normalize()
        })
    })
}

impl Sky {
    /// Name of the file beside the scene.
    pub const FILE: &str = "sky.safetensors";

    /// A grey sky for the views of `dataset`.
    pub fn new(dataset: &Dataset) -> Self {
        let axes = dataset
            .train
            .iter()
            .map(|i| dataset.views[*i].camera.pose.rotation * Vec3::Z);
        Self {
            common: GREY,
            own: vec![[0.0; N]; dataset.views.len()],
            axis: axes.sum::<Vec3>() / dataset.train.len().max(1) as f32,
            train: dataset.train.clone(),
            common_adam: PerViewAdam::new(1),
            own_adam: PerViewAdam::new(dataset.views.len()),
        }
    }

    /// The parameters of the sky of `view`.
    fn parameters(&self, view: usize) -> [f32; N] {
        std::array::from_fn(|i| self.common[i] + self.own[view][i])
    }

    /// The mean colour over the training views, sRGB in \[0, 1\]: the background of views that were not trained on.
    pub fn background(&self) -> [f32; 3] {
        let mut mean = self.common;
        for (i, mean) in mean.iter_mut().enumerate() {
            let sum: f32 = self.train.iter().map(|view| self.own[*view][i]).sum();
            *mean += sum / self.train.len().max(1) as f32;
        }
        color(&mean, self.axis).map(|channel| channel.clamp(0.0, 1.0))
    }

    /// Puts the sky of `view` behind `frame`: a colour `[3, H, W]` rendered over black, and its coverage `[H, W]`.
    pub fn composite_behind(&self, view: usize, camera: &Camera, frame: [&[f32]; 2], to: &mut Vec<f32>) {
        let ([from, alpha], sky) = (frame, self.parameters(view));
        let (width, pixels) = (camera.intrinsics.width as usize, alpha.len());
        to.resize(from.len(), 0.0);
        pixel_chunks(to, width)
            .enumerate()
            .for_each(|(row, [red, green, blue])| {
                for (x, direction) in directions(camera, row).enumerate() {
                    let at = row * width + x;
                    let (behind, uncovered) = (color(&sky, direction), 1.0 - alpha[at]);
                    red[x] = from[at] + uncovered * behind[0];
                    green[x] = from[pixels + at] + uncovered * behind[1];
                    blue[x] = from[2 * pixels + at] + uncovered * behind[2];
                }
            });
    }

    /// The vector-Jacobian product of [`Self::composite_behind`]: adds the gradient of `alpha` to `v_alpha`, and returns that of the view's
    /// colours; that of `color` is `v_color` itself.
    pub fn vjp(&self, view: usize, camera: &Camera, alpha: &[f32], v_color: &[f32], v_alpha: &mut [f32]) -> [f32; N] {
        let (sky, pixels) = (self.parameters(view), alpha.len());
        let width = camera.intrinsics.width as usize;
        let rows: Vec<[f64; N]> = v_alpha
            .par_chunks_mut(width)
            .enumerate()
            .map(|(row, v_alpha)| {
                let mut sum = [0.0f64; N];
                for (x, direction) in directions(camera, row).enumerate() {
                    let at = row * width + x;
                    let (behind, uncovered) = (color(&sky, direction), 1.0 - alpha[at]);
                    let terms = terms(direction);
                    for c in 0..3 {
                        let v_channel = v_color[c * pixels + at];
                        v_alpha[x] -= v_channel * behind[c];
                        for k in 0..TERMS {
                            sum[TERMS * c + k] += f64::from(v_channel * uncovered * terms[k]);
                        }
                    }
                }
                sum
            })
            .collect();
        // In the order of rows: threads do not change the sum.
        std::array::from_fn(|i| rows.iter().map(|row| row[i]).sum::<f64>() as f32)
    }

    /// [`Self::vjp`] and a step of Adam at `rate`.
    pub fn step(
        &mut self,
        view: usize,
        camera: &Camera,
        alpha: &[f32],
        v_color: &[f32],
        v_alpha: &mut [f32],
        rate: f32,
    ) {
        let gradient = self.vjp(view, camera, alpha, v_color, v_alpha);
        let common = self.common_adam.step(0, gradient, [rate; N]);
        let own_gradient = std::array::from_fn(|i| gradient[i] + 2.0 * OWN_WEIGHT * self.own[view][i]);
        let own = self.own_adam.step(view, own_gradient, [rate; N]);
        for i in 0..N {
            self.common[i] += common[i];
            self.own[view][i] += own[i];
        }
    }
}

/// The background in the file of [`Sky::export`].
///
/// # Errors
/// One line, if it is not such a file.
pub fn background_of_sky(file: &[u8]) -> Result<[f32; 3], String> {
    let file = SafeTensors::deserialize(file).map_err(|error| error.to_string())?;
    let found = TensorSource::new(&file, "").f32s("background");
    let color: Option<[f32; 3]> = found.and_then(|values| values.try_into().ok());
    let valid = color.filter(|color| color.iter().all(|v| (0.0..=1.0).contains(v)));
    valid.ok_or_else(|| "background is missing or not a colour".into())
}

impl Occupant for Sky {
    fn name(&self) -> &'static str {
        "sky"
    }

    fn tensors(&self) -> Vec<NamedTensor> {
        let colors = [
            NamedTensor::f32s("common", vec![1, N], &self.common),
            NamedTensor::f32s("own", vec![self.own.len(), N], self.own.as_flattened()),
        ];
        let common = self.common_adam.tensors().into_iter().map(|t| t.prefixed("common_"));
        let own = self.own_adam.tensors().into_iter().map(|t| t.prefixed("own_"));
        colors.into_iter().chain(common).chain(own).collect()
    }

    fn restore(&mut self, tensors: TensorSource) -> Result<(), String> {
        [self.common] = tensors.rows::<N>("common", 1)?[..]
            .try_into()
            .map_err(|_| "common has the wrong shape")?;
        self.own = tensors.rows::<N>("own", self.own.len())?;
        self.common_adam.restore(tensors, "common_")?;
        self.own_adam.restore(tensors, "own_")
    }

    fn export(&self) -> Option<Vec<u8>> {
        let tensors = [
            NamedTensor::f32s("background", vec![3], &self.background()),
            NamedTensor::f32s("common", vec![1, N], &self.common),
            NamedTensor::f32s("own", vec![self.own.len(), N], self.own.as_flattened()),
        ];
        Some(to_bytes(&tensors, ("irradia_sky", "1".into())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use irradia_scene::{Intrinsics, Lens, Pose, Rng};
    use irradia_testkit::finite_differences::FiniteDifferences;
    use std::f32::consts::TAU;

    const SIZE: [u32; 2] = [9, 7];
    const PIXELS: usize = 63;

    fn camera() -> Camera {
        let pose = Pose {
            rotation: Quat::from_rotation_x(0.7) * Quat::from_rotation_y(0.4),
            position: Vec3::ZERO,
        };
        Camera::new(pose, Intrinsics::from_fov_x(SIZE[0], SIZE[1], 1.0))
    }

    fn example() -> (Sky, Vec<f32>, Vec<f32>, Vec<f32>) {
        let mut rng = Rng::new(3, 3);
        let sky = Sky {
            common: GREY.map(|v| v + rng.range(-0.2, 0.2)),
            own: vec![[0.0; N], std::array::from_fn(|_| rng.range(-0.2, 0.2))],
            train: vec![0, 1],
            axis: Vec3::Z,
            common_adam: PerViewAdam::new(1),
            own_adam: PerViewAdam::new(2),
        };
        let mut random = |count, most| (0..count).map(|_| rng.range(0.0, most)).collect::<Vec<f32>>();
        (
            sky,
            random(3 * PIXELS, 0.6),
            random(PIXELS, 1.0),
            random(3 * PIXELS, 1.0),
        )
    }

    /// Also where the lens ends inside a block: at the right edge of a panorama and at the border of a fisheye's image.
    #[test]
    fn directions_are_those_of_the_lens() {
        let fisheye = Lens::fisheye([0.0; 4]);
        let round = Intrinsics::from_fov_x(360, 360, 1.0);
        let fisheye = Intrinsics {
            fx: 60.0,
            fy: 60.0,
            lens: fisheye,
            ..round
        };
        let panorama = Intrinsics {
            fx: 64.0 / TAU,
            fy: 64.0 / TAU,
            width: 64,
            height: 32,
            cx: 32.0,
            cy: 16.0,
            lens: Lens::Equirectangular,
        };
        for k in [fisheye, panorama] {
            let camera = Camera::new(camera().pose, k);
            let row = k.height as usize / 2;
            for (x, direction) in directions(&camera, row).enumerate() {
                let pixel = Vec2::new(x as f32 + 0.5, row as f32 + 0.5);
                if let Some(expected) = k.lens.direction(k.plane_of(pixel.as_dvec2())) {
                    let expected = camera.pose.rotation * expected.as_vec3().normalize();
                    assert!(
                        expected.dot(direction) > 0.9999,
                        "{x} of {}: {direction} for {expected}",
                        k.width
                    );
                }
            }
        }
    }

    fn loss(sky: &Sky, color: &[f32], alpha: &[f32], weights: &[f32]) -> f64 {
        let mut over = Vec::new();
        sky.composite_behind(1, &camera(), [color, alpha], &mut over);
        over.iter()
            .zip(weights)
            .map(|(y, w)| f64::from(*y) * f64::from(*w))
            .sum()
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let (sky, color, alpha, weights) = example();
        let mut v_alpha = vec![0.0; PIXELS];
        let of_sky = sky.vjp(1, &camera(), &alpha, &weights, &mut v_alpha);
        // Linear in all of them: a large step costs only rounding.
        let within = |absolute| FiniteDifferences {
            step: 1e-1,
            relative: 0.0,
            relative_to_max: 0.0,
            absolute,
        };
        let own = sky.own[1].map(f64::from);
        within(1e-3).check("sky", &own, &of_sky.map(f64::from), 0..N, |own| {
            let mut moved = sky.clone();
            moved.own[1] = std::array::from_fn(|i| own[i] as f32);
            loss(&moved, &color, &alpha, &weights)
        });
        let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
        let every_fifth = (0..PIXELS).step_by(5);
        within(1e-4).check("alpha", &wide(&alpha), &wide(&v_alpha), every_fifth, |alpha| {
            let alpha: Vec<f32> = alpha.iter().map(|v| *v as f32).collect();
            loss(&sky, &color, &alpha, &weights)
        });
    }

    #[test]
    fn steps_recover_the_sky_of_each_photograph_and_nothing_where_splats_cover_it() {
        let (mut sky, ..) = example();
        sky.own = vec![[0.0; N]; 3];
        sky.own_adam = PerViewAdam::new(3);
        let color = vec![0.0; 3 * PIXELS];
        let wanted = [[0.2f32, 0.4, 0.9], [0.8, 0.8, 0.7]];
        let alphas = [vec![0.0; PIXELS], vec![0.5; PIXELS], vec![1.0; PIXELS]];
        for step in 0..400 {
            let rate = if step < 300 { 0.03 } else { 0.002 };
            for view in 0..3 {
                let (mut over, mut v_alpha) = (Vec::new(), vec![0.0; PIXELS]);
                sky.composite_behind(view, &camera(), [&color, &alphas[view]], &mut over);
                let left = 1.0 - alphas[view][0];
                let v: Vec<f32> = over
                    .iter()
                    .enumerate()
                    .map(|(i, y)| {
                        if view < 2 {
                            y - left * wanted[view][i / PIXELS]
                        } else {
                            1.0
                        }
                    })
                    .collect();
                sky.step(view, &camera(), &alphas[view], &v, &mut v_alpha, rate);
            }
        }
        for (view, wanted) in wanted.iter().enumerate() {
            let got = super::color(&sky.parameters(view), directions(&camera(), 3).nth(4).unwrap());
            assert!(
                got.iter().zip(wanted).all(|(got, wanted)| (got - wanted).abs() < 0.02),
                "{view}: {got:?}"
            );
        }
        assert!(sky.own[2].iter().all(|v| *v == 0.0), "{:?}", sky.own[2]);
    }

    #[test]
    fn the_exported_background_is_the_mean_over_the_training_views() {
        let (sky, ..) = example();
        let background = background_of_sky(&sky.export().unwrap()).unwrap();
        let background_of = |view: usize| super::color(&sky.parameters(view), sky.axis);
        for c in 0..3 {
            assert!((background[c] - 0.5 * (background_of(0)[c] + background_of(1)[c])).abs() < 1e-6);
        }
        assert!(background_of_sky(b"{}").is_err());
        let without = to_bytes(
            &[NamedTensor::f32s("background", vec![2], &[0.0; 2])],
            ("x", "1".into()),
        );
        assert!(background_of_sky(&without).unwrap_err().contains("background"));
    }
}

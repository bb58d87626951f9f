//! The training objective: every loss of the plan, summed, with gradients.

use crate::edges::{edges, unit_range};
use crate::photos::Prepared;
use crate::recipe::Param;
use crate::schedule::StepPlan;
use irradia_measure::{
    CoarseLoss, Crop, DepthGradient, DepthKind, DepthLoss, DepthPlanes, DepthSample, LossWeights, Lpips, NormalLoss,
    NormalSample, PhotometricLoss, SmoothLoss, Smoothed, Target, Truth, perceptual,
};
use irradia_scene::{Intrinsics, Rng};
use irradia_splat::{FramePlanes, Gather, OutputGradient};
use rayon::prelude::*;
use std::sync::Arc;

/// Side of the random LPIPS crop of a step, pixels.
pub(crate) const CROP_SIDE: usize = 128;
/// Fraction of the pixels, those that fit best, by which photographs are compared: a person in front of the camera makes only the other
/// pixels worse, a wrong pose makes all of them worse.
const TRIMMED_FRACTION: f32 = 0.7;
/// Edge sensitivity of depth smoothness: a colour edge of 0.1 reduces it to 1 / e (Godard et al. 2017 use 1 for colours normalised
/// differently).
const EDGE_SHARPNESS: f32 = 10.0;

/// All losses with their buffers, and the gradients of the last frame.
pub struct Objective {
    /// Weights of the perceptual loss, which is skipped without them.
    pub lpips: Option<Arc<Lpips>>,
    photometric: PhotometricLoss,
    coarse: CoarseLoss,
    depth: DepthLosses,
    /// The photograph over the random background.
    recolored: Vec<u8>,
    v_color: Vec<f32>,
    v_alpha: Vec<f32>,
    v_depth: Vec<f32>,
    error: Vec<f32>,
    edges: Vec<f32>,
    present: PresentGradients,
}

/// The losses on the depth of a frame.
#[derive(Default)]
struct DepthLosses {
    samples: DepthLoss,
    normals: NormalLoss,
    smooth: SmoothLoss,
}

/// The losses on the coverage of a frame that apply to a photograph.
struct CoverageLosses<'a> {
    /// Weight of the coverage of what the photograph shows.
    cover: f32,
    /// Weight of the difference from the photograph's alpha, `[H, W]`.
    alpha: Option<(f32, &'a [u8])>,
    /// Weight of what covers pixels that the photograph's own mask, `[H, W]`, leaves out.
    left_out: Option<(f32, &'a [u8])>,
    /// The pixels that count, `[H, W]`.
    mask: Option<&'a [u8]>,
}

/// Which gradients the last frame has.
#[derive(Clone, Copy, Default)]
struct PresentGradients {
    alpha: bool,
    depth: bool,
}

/// The loss of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObjectiveValues {
    /// The weighted sum.
    pub total: f64,
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean squared difference.
    pub mse: f64,
}

/// The reference of a frame.
pub struct Reference<'a> {
    /// The photograph, with what is hidden from training masked.
    pub photo: &'a Prepared,
    /// The photograph's own mask: pixels that show nothing of the scene, `[H, W]`. What is hidden from training is not empty.
    pub left_out: Option<&'a [u8]>,
    /// Background of the photograph and of the frame, if it is random per step.
    pub background: Option<[f32; 3]>,
    /// Known depths.
    pub depths: &'a [DepthSample],
    /// Depths from a map given with the photograph.
    pub depth_map: Option<(&'a [DepthSample], DepthKind)>,
    /// Normals from a map given with the photograph, half of their spacing in pixels, and the camera.
    pub normal_map: Option<(&'a [NormalSample], u32, &'a Intrinsics)>,
}

impl Reference<'_> {
    /// Whether a loss of `plan` compares depth, which then has to be rendered.
    pub fn compares_depth(&self, plan: &StepPlan) -> bool {
        let weighs = |param| plan.value(param) > 0.0;
        weighs(Param::DepthWeight) && !self.depths.is_empty()
            || weighs(Param::DepthMapWeight) && self.depth_map.is_some()
            || weighs(Param::NormalMapWeight) && self.normal_map.is_some()
            || weighs(Param::SmoothWeight)
    }
}

impl Objective {
    /// An objective that has not evaluated a frame yet.
    pub fn new(lpips: Option<Arc<Lpips>>) -> Self {
        Self {
            lpips,
            photometric: PhotometricLoss::new(),
            coarse: CoarseLoss::default(),
            depth: DepthLosses::default(),
            recolored: Vec::new(),
            v_color: Vec::new(),
            v_alpha: Vec::new(),
            v_depth: Vec::new(),
            error: Vec::new(),
            edges: Vec::new(),
            present: PresentGradients::default(),
        }
    }

    /// Evaluates `frame`, which must have been rendered with depth if a loss on depth has a weight.
    pub fn evaluate(
        &mut self,
        frame: FramePlanes,
        reference: &Reference,
        plan: &StepPlan,
        rng: &mut Rng,
    ) -> ObjectiveValues {
        let photo = reference.photo;
        let (width, height) = (photo.width as usize, photo.height as usize);
        let pixels = width * height;
        let rgb = match (reference.background, &photo.alpha) {
            (Some(background), Some(alpha)) => {
                photo.recolor(alpha, background, &mut self.recolored);
                &self.recolored
            }
            _ => &photo.rgb,
        };
        let target = Target {
            width,
            height,
            truth: Truth::Rgb8(rgb),
            mask: photo.mask.as_deref(),
        };
        self.v_color.resize(3 * pixels, 0.0);
        let weights = photometric_weights(plan);
        let values = self
            .photometric
            .evaluate(frame.color, &target, &weights, &mut self.v_color);
        let mut total = values.total;
        let coarse_weight = plan.value(Param::CoarseWeight);
        if coarse_weight > 0.0 {
            let factor = plan.values[Param::CoarseFactor] as usize;
            let loss = self
                .coarse
                .evaluate(frame.color, &target, factor, coarse_weight, &mut self.v_color);
            total += f64::from(coarse_weight) * loss;
        }
        let perceptual_weight = plan.value(Param::PerceptualWeight);
        if let Some(lpips) = self.lpips.as_ref().filter(|_| perceptual_weight > 0.0) {
            let crop = Crop::random(width, height, CROP_SIDE, rng);
            // Images too small for the network are skipped.
            if let Ok(loss) = perceptual(lpips, frame.color, &target, crop, perceptual_weight, &mut self.v_color) {
                total += f64::from(perceptual_weight) * loss;
            }
        }
        let coverage = CoverageLosses::new(reference, plan);
        let compares_depth = reference.compares_depth(plan);
        self.present = PresentGradients {
            depth: compares_depth,
            alpha: compares_depth || coverage.any(),
        };
        if self.present.alpha {
            clear(&mut self.v_alpha, pixels);
            coverage.evaluate(frame.alpha, &mut self.v_alpha, &mut total);
        }
        if compares_depth {
            clear(&mut self.v_depth, pixels);
            let rendered = DepthPlanes {
                depth: frame.depth,
                alpha: frame.alpha,
            };
            let mut gradient = DepthGradient {
                depth: &mut self.v_depth,
                alpha: &mut self.v_alpha,
            };
            self.depth
                .evaluate(rendered, &target, reference, plan, &mut gradient, &mut total);
        }
        ObjectiveValues {
            total,
            l1: values.l1,
            mse: values.mse,
        }
    }

    /// Computes the mean absolute difference of each pixel of the frame last evaluated, for [`Gather::Error`].
    pub fn error(&mut self, color: &[f32], photo: &Prepared, recolored: bool) {
        let (width, pixels) = (photo.width as usize, photo.rgb.len() / 3);
        let rgb = if recolored { &self.recolored } else { &photo.rgb };
        self.error.resize(pixels, 0.0);
        self.error.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, error) in row.iter_mut().enumerate() {
                let at = y * width + x;
                let counts = photo.mask.as_ref().is_none_or(|mask| mask[at] != 0);
                let difference = |c: usize| (color[c * pixels + at] - f32::from(rgb[3 * at + c]) * (1.0 / 255.0)).abs();
                *error = if counts {
                    (difference(0) + difference(1) + difference(2)) * (1.0 / 3.0)
                } else {
                    0.0
                };
            }
        });
    }

    /// Mixes the photograph's edges into the result of [`Objective::error`], as the saliency of Taming 3DGS does: each is normalised to
    /// its range, then weighted by `fraction` for edges and 1 - `fraction` for the error.
    pub fn add_edges(&mut self, photo: &Prepared, fraction: f32) {
        edges(photo, &mut self.edges);
        let [min_error, error_scale] = unit_range(&self.error);
        let [min_edge, edge_scale] = unit_range(&self.edges);
        for (i, (error, edge)) in self.error.iter_mut().zip(&self.edges).enumerate() {
            let counts = photo.mask.as_ref().is_none_or(|mask| mask[i] != 0);
            let mixed =
                (1.0 - fraction) * (*error - min_error) * error_scale + fraction * (edge - min_edge) * edge_scale;
            *error = if counts { mixed } else { 0.0 };
        }
    }

    /// The mean of the result of [`Objective::error`] over the pixels of `photo` that are neither masked nor transparent, and over the
    /// fraction [`TRIMMED_FRACTION`] of them that fits best; 0 if there are none.
    pub fn mean_errors(&self, photo: &Prepared) -> [f64; 2] {
        let is_set = |plane: &Option<Vec<u8>>, at: usize| plane.as_ref().is_none_or(|values| values[at] != 0);
        let counts = |at: &usize| is_set(&photo.mask, *at) && is_set(&photo.alpha, *at);
        let mut errors: Vec<f32> = (0..self.error.len()).filter(counts).map(|at| self.error[at]).collect();
        let mean = |errors: &[f32]| errors.iter().map(|e| f64::from(*e)).sum::<f64>() / errors.len().max(1) as f64;
        let all = mean(&errors);
        let best = (errors.len() as f32 * TRIMMED_FRACTION) as usize;
        if best < errors.len() {
            errors.select_nth_unstable_by(best, f32::total_cmp);
        }
        [all, mean(&errors[..best])]
    }

    /// The gradient of the colour last evaluated, `[3, H, W]`, for components between it and the scene's colour.
    pub fn v_color_mut(&mut self) -> &mut [f32] {
        &mut self.v_color
    }

    /// The gradient of the colour last evaluated, `[3, H, W]`, and that of the coverage, `[H, W]`, for the caller to add to.
    pub fn v_color_and_alpha(&mut self) -> (&[f32], &mut [f32]) {
        if !self.present.alpha {
            self.present.alpha = true;
            clear(&mut self.v_alpha, self.v_color.len() / 3);
        }
        (&self.v_color, &mut self.v_alpha)
    }

    /// The gradients of the frame last evaluated; `gather` and `camera` are left for the caller to set.
    pub fn gradient(&self) -> OutputGradient<'_> {
        OutputGradient {
            alpha: self.present.alpha.then_some(&self.v_alpha[..]),
            depth: self.present.depth.then_some(&self.v_depth[..]),
            ..OutputGradient::of_color(&self.v_color)
        }
    }

    /// The result of [`Objective::error`].
    pub fn gather_error(&self) -> Gather<'_> {
        Gather::Error(&self.error)
    }
}

impl DepthLosses {
    /// Adds the weighted losses of `rendered` to `total`, one by one since the order of the sum determines its rounding, and their gradients
    /// to `gradient`.
    fn evaluate(
        &mut self,
        rendered: DepthPlanes,
        target: &Target,
        reference: &Reference,
        plan: &StepPlan,
        gradient: &mut DepthGradient,
        total: &mut f64,
    ) {
        let point_weight = plan.value(Param::DepthWeight);
        if point_weight > 0.0 {
            let values = self
                .samples
                .evaluate(rendered, reference.depths, DepthKind::Metric, point_weight, gradient);
            *total += f64::from(point_weight) * values.loss;
        }
        let map_weight = plan.value(Param::DepthMapWeight);
        if let Some((depths, kind)) = reference.depth_map.filter(|_| map_weight > 0.0) {
            let values = self.samples.evaluate(rendered, depths, kind, map_weight, gradient);
            *total += f64::from(map_weight) * values.loss;
        }
        let normal_weight = plan.value(Param::NormalMapWeight);
        if let Some((normals, reach, camera)) = reference.normal_map.filter(|_| normal_weight > 0.0) {
            let loss = self
                .normals
                .evaluate(rendered, camera, normals, reach, normal_weight, gradient);
            *total += f64::from(normal_weight) * loss;
        }
        let smooth_weight = plan.value(Param::SmoothWeight);
        if smooth_weight > 0.0 {
            let (of, k) = (Smoothed::Disparity, EDGE_SHARPNESS);
            let loss = self.smooth.evaluate(rendered, target, of, k, smooth_weight, gradient);
            *total += f64::from(smooth_weight) * loss;
        }
    }
}

impl<'a> CoverageLosses<'a> {
    fn new(reference: &Reference<'a>, plan: &StepPlan) -> Self {
        let photo = reference.photo;
        let weighted = |param: Param, map: Option<&'a [u8]>| {
            let weight = plan.value(param);
            map.filter(|_| weight > 0.0).map(|map| (weight, map))
        };
        Self {
            cover: cover_weight(photo, plan),
            alpha: weighted(Param::AlphaWeight, photo.alpha.as_deref()),
            left_out: weighted(Param::MaskWeight, reference.left_out),
            mask: photo.mask.as_deref(),
        }
    }

    /// Whether any has a weight.
    fn any(&self) -> bool {
        self.cover > 0.0 || self.alpha.is_some() || self.left_out.is_some()
    }

    /// Adds the weighted losses of the opacities `alpha` `[H, W]` to `total`, and their gradients to `v_alpha`, which is zero.
    fn evaluate(&self, alpha: &[f32], v_alpha: &mut [f32], total: &mut f64) {
        if self.cover > 0.0 {
            let v = self.cover / v_alpha.len() as f32;
            match self.mask {
                Some(mask) => {
                    for (v_alpha, mask) in v_alpha.iter_mut().zip(mask) {
                        *v_alpha -= v * f32::from(*mask) / 255.0;
                    }
                }
                None => v_alpha.fill(-v),
            }
        }
        if let Some((weight, wanted)) = self.alpha {
            *total += alpha_loss(alpha, wanted, weight, v_alpha);
        }
        if let Some((weight, mask)) = self.left_out {
            *total += masked_alpha_loss(alpha, mask, weight, v_alpha);
        }
    }
}

/// The weights of the photometric loss.
pub(crate) fn photometric_weights(plan: &StepPlan) -> LossWeights {
    LossWeights {
        l1: plan.value(Param::PhotoWeight),
        ssim: plan.value(Param::SsimWeight),
        mse: plan.value(Param::MseWeight),
    }
}

/// Resets `plane` to `pixels` zeros.
fn clear(plane: &mut Vec<f32>, pixels: usize) {
    plane.clear();
    plane.resize(pixels, 0.0);
}

/// The weight of the coverage of `photo`: 0 for a photograph with alpha, which shows what is empty.
pub(crate) fn cover_weight(photo: &Prepared, plan: &StepPlan) -> f32 {
    match photo.alpha {
        Some(_) => 0.0,
        None => plan.value(Param::CoverWeight),
    }
}

/// Mean |got - want|, weighted; adds its gradient to `v_alpha`.
fn alpha_loss(got: &[f32], want: &[u8], weight: f32, v_alpha: &mut [f32]) -> f64 {
    let weight = weight / got.len() as f32;
    let mut sum = 0.0f64;
    for ((v, got), want) in v_alpha.iter_mut().zip(got).zip(want) {
        let difference = got - f32::from(*want) / 255.0;
        sum += f64::from(difference.abs());
        if difference != 0.0 {
            *v += weight * difference.signum();
        }
    }
    f64::from(weight) * sum
}

/// Sum of alpha over the pixels that `mask` leaves out, divided by the number of all pixels, weighted; adds its gradient to `v_alpha`.
/// Pixels that the mask keeps have no target: outlines of masks are rarely exact, and what they keep next to an object may be empty as
/// well.
fn masked_alpha_loss(alpha: &[f32], mask: &[u8], weight: f32, v_alpha: &mut [f32]) -> f64 {
    let weight = weight / alpha.len() as f32;
    let mut sum = 0.0f64;
    for ((v, alpha), _) in v_alpha.iter_mut().zip(alpha).zip(mask).filter(|(_, mask)| **mask == 0) {
        sum += f64::from(*alpha);
        *v += weight * f32::from(*alpha > 0.0);
    }
    f64::from(weight) * sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Recipe;
    use crate::schedule::{Clock, plan};

    /// A photograph of 4 x 2 pixels of one grey.
    fn masked(grey: u8, mask: [u8; 8]) -> Prepared {
        Prepared {
            width: 4,
            height: 2,
            rgb: vec![grey; 24],
            alpha: None,
            mask: Some(mask.to_vec()),
            background: [0.0; 3],
        }
    }

    #[test]
    fn surfaces_are_wanted_where_photographs_show_something_and_none_where_masks_leave_out() {
        let photo = masked(128, [255, 255, 255, 255, 0, 0, 255, 255]);
        let (color, alpha) = ([0.5; 24], [0.9, 0.2, 1.0, 0.0, 0.9, 0.0, 0.5, 0.5]);
        let gradient = |set: &str, photo: &Prepared, left_out: Option<&[u8]>| {
            let set = ["params.cover_weight=0", set].map(str::to_owned);
            let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &set).unwrap();
            let plan = plan(&recipe, &Clock::new(&recipe));
            let frame = FramePlanes {
                color: &color,
                alpha: &alpha,
                depth: &[],
            };
            let reference = Reference {
                photo,
                left_out,
                background: None,
                depths: &[],
                depth_map: None,
                normal_map: None,
            };
            let mut objective = Objective::new(None);
            objective.evaluate(frame, &reference, &plan, &mut Rng::new(1, 1));
            assert!(objective.gradient().depth.is_none(), "there are no depths to compare");
            objective.gradient().alpha.map(<[f32]>::to_vec)
        };
        let v_alpha = |set, photo: &Prepared| gradient(set, photo, photo.mask.as_deref());
        let covered = v_alpha("params.cover_weight=0.8", &photo).unwrap();
        let near = |got: &[f32], wanted: [f32; 8]| got.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-7);
        assert!(
            near(&covered, [-0.1, -0.1, -0.1, -0.1, 0.0, 0.0, -0.1, -0.1]),
            "{covered:?}"
        );
        let masked = v_alpha("params.mask_weight=0.8", &photo).unwrap();
        assert!(near(&masked, [0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0]), "{masked:?}");
        assert_eq!(v_alpha("params.mask_weight=0", &photo), None);
        assert_eq!(
            gradient("params.mask_weight=0.8", &photo, None),
            None,
            "what is hidden from training is not empty"
        );
        let transparent = Prepared {
            alpha: Some(vec![255; 8]),
            ..photo.clone()
        };
        assert_eq!(
            v_alpha("params.cover_weight=0.8", &transparent),
            None,
            "alpha shows what is empty"
        );
    }

    #[test]
    fn errors_are_those_of_what_a_photograph_shows() {
        let photo = Prepared {
            alpha: Some(vec![255, 255, 255, 255, 255, 255, 255, 0]),
            ..masked(0, [255, 255, 255, 255, 0, 0, 0, 255])
        };
        let mut objective = Objective::new(None);
        let errors = [0.1, 0.1, 0.1, 0.9, 0.7, 0.7, 0.7, 0.7];
        objective.error(&[errors; 3].concat(), &photo, false);
        let near = |got: [f64; 2], wanted: [f64; 2]| got.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(
            near(objective.mean_errors(&photo), [0.3, 0.1]),
            "{:?}",
            objective.mean_errors(&photo)
        );
        let hidden = Prepared {
            mask: Some(vec![0; 8]),
            ..photo
        };
        assert_eq!(objective.mean_errors(&hidden), [0.0; 2]);
    }

    #[test]
    fn a_map_of_depths_draws_the_depth_at_its_pixels() {
        let photo = Prepared {
            width: 4,
            height: 2,
            rgb: vec![128; 24],
            alpha: None,
            mask: None,
            background: [0.0; 3],
        };
        let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
        let plan = plan(&recipe, &Clock::new(&recipe));
        let (color, alpha, depth) = ([0.5; 24], [1.0; 8], [2.0; 8]);
        let v_depth = |kind, depths: [f32; 2]| {
            let samples = [(3, depths[0]), (5, depths[1])].map(|(pixel, depth)| DepthSample {
                pixel,
                depth,
                weight: 1.0 / depth,
            });
            let frame = FramePlanes {
                color: &color,
                alpha: &alpha,
                depth: &depth,
            };
            let reference = Reference {
                photo: &photo,
                left_out: None,
                background: None,
                depths: &[],
                depth_map: Some((&samples, kind)),
                normal_map: None,
            };
            let mut objective = Objective::new(None);
            objective.evaluate(frame, &reference, &plan, &mut Rng::new(1, 1));
            let v = objective.gradient().depth.unwrap().to_vec();
            assert!(v.iter().enumerate().all(|(i, v)| *v == 0.0 || i == 3 || i == 5));
            [v[3], v[5]]
        };
        let [near, far] = v_depth(DepthKind::Metric, [1.0, 4.0]);
        assert!(near > 0.0 && far < 0.0, "{near} {far}");
        // Each error counts relative to its depth: 1 of 1, and 2 of 4.
        assert_eq!(near, -4.0 * far);
        assert_eq!(v_depth(DepthKind::Metric, [2.0, 2.0]), [0.0; 2]);
    }
}

//! Judges suspected floaters by photographs: how much of each suspect's opacity the photographs support.
//!
//! The opacities of all suspects are fitted to the photographs together, while the rest of the scene stays fixed. They cannot be judged
//! one by one: a bright veil and a dark one hide each other, and each seems to help. An invisible splat has no gradient, so that a splat
//! that vanished in the fog of a hundred veils would never come back: hidden suspects are therefore shown faintly in turns, and tried
//! again at the end, when the fog is gone.

use crate::draft::gather;
use crate::{Draft, LoadedPhotographs, Selection};
use irradia_scene::Camera;
use irradia_splat::{
    Gather, OutputGradient, RenderOptions, Renderer, SplatGradients, Splats, ViewParams, logit, sigmoid,
};

/// Steps of Adam over all photographs if suspects start hidden, and if they start as trained.
const FIT_STEPS: [usize; 2] = [40, 20];
/// Learning rates of the first and of the last step.
const LEARNING_RATES: [f32; 2] = [0.2, 0.02];
/// Decay of the means of gradients and of their squares. Their memory is short, because the gradients in the fog of the first steps are a
/// thousand times larger than those by which a wall regains the opacity that it lost there.
const MOMENT_DECAY: f32 = 0.8;
/// Hidden suspects have no gradients. Each is shown faintly in one of this many steps: a hundred veils at once would be a fog in which no
/// wall comes back.
const REVEAL_INTERVAL: usize = 8;
/// Minimum opacity at which a splat has gradients: more than the cut-off of 1/255, so that it is drawn around its centre as well.
const MIN_VISIBLE_OPACITY: f32 = 0.012;
/// Minimum share of its opacity that the fit leaves to a splat that photographs need.
const MIN_NEEDED_SHARE: f32 = 0.5;
/// Share of the error that a splat may add without being rejected: splats that photographs do not contradict stay.
const MAX_HARMLESS_ERROR_SHARE: f64 = 2e-5;
/// Number of rejected splats shown faintly at a time to test whether they would help.
const TEST_GROUP_SIZE: usize = 8;
/// Maximum number of times that all rejected splats are tried again; it ends earlier when none comes back.
const MAX_TEST_ROUNDS: usize = 3;

/// The opacities at which the suspects start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum InitialOpacity {
    /// Suspects start hidden and come back if photographs need them.
    Hidden,
    /// Suspects start as trained and vanish if photographs contradict them.
    Trained,
}

/// Whether the photographs need each of `suspects`; `of` are the splats that are rendered, suspects included.
pub(crate) fn are_needed(
    draft: &Draft,
    photographs: &LoadedPhotographs,
    of: &Selection,
    suspects: &Selection,
    initial: InitialOpacity,
) -> Vec<(u32, bool)> {
    let indices = of.indices();
    let suspects: Vec<usize> = (0..indices.len())
        .filter(|at| suspects.contains(indices[*at] as usize))
        .collect();
    if suspects.is_empty() {
        return Vec::new();
    }
    let mut fit = OpacityFit::new(draft, photographs, &indices, suspects);
    let mut is_needed = fit.run(initial);
    if initial == InitialOpacity::Hidden {
        fit.restore_useful(&mut is_needed);
    }
    let suspects = fit.suspects.iter().map(|at| indices[*at]);
    suspects.zip(is_needed).collect()
}

/// The suspects, the photographs, and what is needed to compare them.
struct OpacityFit<'a> {
    draft: &'a Draft,
    photographs: &'a LoadedPhotographs,
    splats: Splats,
    /// Index of each suspect in `splats`, and its opacity as trained.
    suspects: Vec<usize>,
    trained_opacities: Vec<f32>,
    renderer: Renderer,
    gradients: SplatGradients,
    v_color: Vec<f32>,
}

impl<'a> OpacityFit<'a> {
    fn new(draft: &'a Draft, photographs: &'a LoadedPhotographs, indices: &[u32], suspects: Vec<usize>) -> Self {
        let splats = Splats::from_cloud(&gather(&draft.cloud, indices));
        Self {
            trained_opacities: suspects.iter().map(|at| splats.opacity(*at)).collect(),
            draft,
            photographs,
            splats,
            suspects,
            renderer: Renderer::new(),
            gradients: SplatGradients::default(),
            v_color: Vec::new(),
        }
    }

    /// Sets the opacity of a suspect to a share of its trained opacity.
    fn set_share(&mut self, suspect: usize, share: f32) {
        let opacity = (share * self.trained_opacities[suspect]).max(1e-6);
        self.splats
            .opacity_logits
            .set(0, self.suspects[suspect], logit(opacity));
    }

    /// The share of its opacity at which a suspect is just drawn.
    fn min_visible_share(&self, suspect: usize) -> f32 {
        (MIN_VISIBLE_OPACITY / self.trained_opacities[suspect]).min(1.0)
    }

    /// Renders the view of every photograph. Returns half the sum of squared errors; `after` is called after each view, with its errors in
    /// `v_color`.
    fn render_errors(&mut self, mut after: impl FnMut(&mut Self)) -> f64 {
        let options = RenderOptions {
            antialias: self.draft.cloud.antialiased,
            background: self.photographs.background,
            ..RenderOptions::default()
        };
        let mut error = 0.0;
        for (number, photo) in &self.photographs.photos {
            let camera = self.draft.cameras[*number];
            let intrinsics = camera.intrinsics.resized(photo.width, photo.height);
            let view = ViewParams::new(&Camera { intrinsics, ..camera });
            self.renderer.render(&self.splats, &view, &options);
            let pixels = self.renderer.alpha().len();
            let errors = self.renderer.color().iter().enumerate().map(|(at, shown)| {
                let (channel, pixel) = (at / pixels, at % pixels);
                let is_valid = photo.mask.as_ref().is_none_or(|mask| mask[pixel] > 0);
                let expected = f32::from(photo.data[3 * pixel + channel]) / 255.0;
                if is_valid { shown - expected } else { 0.0 }
            });
            self.v_color.clear();
            self.v_color.extend(errors);
            error += self.v_color.iter().map(|e| 0.5 * f64::from(e * e)).sum::<f64>();
            after(self);
        }
        error
    }

    /// The error, and its derivative with respect to each suspect's share.
    fn slopes(&mut self) -> (f64, Vec<f32>) {
        let mut slopes = vec![0.0f32; self.suspects.len()];
        let error = self.render_errors(|fit| {
            let v_out = OutputGradient {
                gather: Gather::Nothing,
                ..OutputGradient::of_color(&fit.v_color)
            };
            fit.renderer.backward(&fit.splats, &v_out, &mut fit.gradients);
            let v_logits = fit.gradients.splats.opacity_logits.plane(0);
            for (slope, at) in slopes.iter_mut().zip(&fit.suspects) {
                if fit.gradients.active[*at] > 0.0 {
                    *slope += v_logits[*at];
                }
            }
        });
        for ((slope, at), trained_opacity) in slopes.iter_mut().zip(&self.suspects).zip(&self.trained_opacities) {
            // From the derivative with respect to the logit to that with respect to the share: divides by the sigmoid's slope.
            let opacity = sigmoid(self.splats.opacity_logits.get(0, *at));
            *slope *= trained_opacity / ((1.0 - opacity).max(0.01) * opacity);
        }
        (error, slopes)
    }

    /// Fits the shares of all suspects together. Returns whether each is needed.
    fn run(&mut self, initial: InitialOpacity) -> Vec<bool> {
        let is_hidden = initial == InitialOpacity::Hidden;
        let (first, steps) = if is_hidden {
            (0.0, FIT_STEPS[0])
        } else {
            (1.0, FIT_STEPS[1])
        };
        let mut shares = vec![first; self.suspects.len()];
        let mut moments = vec![[0.0f32; 2]; shares.len()];
        // Number of steps that the moments of each suspect cover.
        let mut ages = vec![0; shares.len()];
        let mut harmless = vec![false; shares.len()];
        for (step, revealed) in (0..steps).zip((0..REVEAL_INTERVAL).cycle()) {
            for i in 0..shares.len() {
                if is_hidden && i % REVEAL_INTERVAL == revealed && shares[i] < self.min_visible_share(i) {
                    shares[i] = self.min_visible_share(i);
                    (moments[i], ages[i]) = ([0.0; 2], 0);
                }
                self.set_share(i, shares[i]);
            }
            let (error, slopes) = self.slopes();
            if !is_hidden && step == 0 {
                // Hiding a suspect whose best share is at or above 0 lowers the error by at most half the slope.
                harmless = slopes
                    .iter()
                    .map(|slope| f64::from(*slope) < 2.0 * MAX_HARMLESS_ERROR_SHARE * error)
                    .collect();
            }
            let rate = LEARNING_RATES[0] + (LEARNING_RATES[1] - LEARNING_RATES[0]) * step as f32 / (steps - 1) as f32;
            for (i, slope) in slopes.into_iter().enumerate() {
                ages[i] += 1;
                let corrected = 1.0 - MOMENT_DECAY.powi(ages[i]);
                let [mean, square] = &mut moments[i];
                *mean += (1.0 - MOMENT_DECAY) * (slope - *mean);
                *square += (1.0 - MOMENT_DECAY) * (slope * slope - *square);
                let update = (*mean / corrected) / ((*square / corrected).sqrt() + 1e-12);
                let least = if is_hidden {
                    0.0
                } else {
                    self.min_visible_share(i).min(0.1)
                };
                shares[i] = (shares[i] - rate * update).clamp(least, 1.0);
            }
        }
        let is_needed = |(share, harmless): (f32, bool)| share >= MIN_NEEDED_SHARE || harmless;
        shares.into_iter().zip(harmless).map(is_needed).collect()
    }

    /// Restores rejected splats that lower the error, the most useful first: suspects whose turn came late had too few steps in the fit.
    fn restore_useful(&mut self, is_needed: &mut [bool]) {
        for (i, needed) in is_needed.iter().enumerate() {
            self.set_share(i, f32::from(u8::from(*needed)));
        }
        let mut error = self.render_errors(|_| ());
        for _ in 0..MAX_TEST_ROUNDS {
            let mut candidates: Vec<(f32, usize)> = Vec::new();
            let rejected: Vec<usize> = (0..is_needed.len()).filter(|i| !is_needed[*i]).collect();
            for group in rejected.chunks(TEST_GROUP_SIZE) {
                for i in group {
                    self.set_share(*i, self.min_visible_share(*i));
                }
                let (_, slopes) = self.slopes();
                for i in group {
                    self.set_share(*i, 0.0);
                }
                candidates.extend(group.iter().map(|i| (slopes[*i], *i)).filter(|(slope, _)| *slope < 0.0));
            }
            candidates.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut is_changed = false;
            for (_, i) in candidates {
                self.set_share(i, 1.0);
                let with = self.render_errors(|_| ());
                if with < error {
                    (error, is_needed[i], is_changed) = (with, true, true);
                } else {
                    self.set_share(i, 0.0);
                }
            }
            if !is_changed {
                break;
            }
        }
    }
}

//! Judges suspected floaters by photographs: how much of each suspect's opacity the photographs support.
//!
//! The opacities of all suspects are fitted to the photographs together, while the rest of the scene stays fixed. They cannot be judged
//! one by one: a bright veil and a dark one hide each other, and each seems to help. An invisible splat has no gradient, so that a splat
//! that vanished in the fog of a hundred veils would never come back: hidden suspects are therefore shown faintly in turns, and tried
//! again at the end, when the fog is gone.

use crate::draft::gather;
use crate::{Draft, Selection, Taken};
use irradia_scene::Camera;
use irradia_splat::{
    Gather, OutputGradient, RenderOptions, Renderer, SplatGradients, Splats, ViewParams, logit, sigmoid,
};

/// Steps of Adam over all photographs if suspects start hidden, and if they start as trained.
const STEPS: [usize; 2] = [40, 20];
/// Learning rates of the first and of the last step.
const RATES: [f32; 2] = [0.2, 0.02];
/// Decay of the means of gradients and of their squares. Their memory is short, because the gradients in the fog of the first steps are a
/// thousand times larger than those by which a wall regains the opacity that it lost there.
const DECAY: f32 = 0.8;
/// Hidden suspects have no gradients. Each is shown faintly in one of this many steps: a hundred veils at once would be a fog in which no
/// wall comes back.
const TURNS: usize = 8;
/// Minimum opacity at which a splat has gradients: more than the cut-off of 1/255, so that it is drawn around its centre as well.
const FAINTEST: f32 = 0.012;
/// Minimum share of its opacity that the fit leaves to a splat that photographs need.
const NEEDED: f32 = 0.5;
/// Share of the error that a splat may add without being condemned: splats that photographs do not contradict stay.
const HARMLESS: f64 = 2e-5;
/// Number of condemned splats shown faintly at a time to test whether they would help.
const GROUP: usize = 8;
/// Maximum number of times that all condemned splats are tried again; it ends earlier when none comes back.
const TRIALS: usize = 3;

/// How suspects are judged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Presumption {
    /// Suspects start hidden and come back if photographs need them.
    Guilty,
    /// Suspects start as trained and vanish if photographs contradict them.
    Innocent,
}

/// Whether the photographs need each of `suspects`; `of` are the splats that are rendered, suspects included.
pub(crate) fn needed(
    draft: &Draft,
    taken: &Taken,
    of: &Selection,
    suspects: &Selection,
    presumption: Presumption,
) -> Vec<(u32, bool)> {
    let numbers = of.indices();
    let places: Vec<usize> = (0..numbers.len())
        .filter(|at| suspects.contains(numbers[*at] as usize))
        .collect();
    if places.is_empty() {
        return Vec::new();
    }
    let mut trial = Trial::new(draft, taken, &numbers, places);
    let mut verdicts = trial.fit(presumption);
    if presumption == Presumption::Guilty {
        trial.acquit(&mut verdicts);
    }
    let suspects = trial.places.iter().map(|at| numbers[*at]);
    suspects.zip(verdicts).collect()
}

/// The splats on trial, the photographs, and what is needed to compare them.
struct Trial<'a> {
    draft: &'a Draft,
    taken: &'a Taken,
    splats: Splats,
    /// Index of each suspect in `splats`, and its opacity as trained.
    places: Vec<usize>,
    whole: Vec<f32>,
    renderer: Renderer,
    gradients: SplatGradients,
    v_color: Vec<f32>,
}

impl<'a> Trial<'a> {
    fn new(draft: &'a Draft, taken: &'a Taken, numbers: &[u32], places: Vec<usize>) -> Self {
        let splats = Splats::from_cloud(&gather(&draft.cloud, numbers));
        Self {
            whole: places.iter().map(|at| splats.opacity(*at)).collect(),
            draft,
            taken,
            splats,
            places,
            renderer: Renderer::new(),
            gradients: SplatGradients::default(),
            v_color: Vec::new(),
        }
    }

    /// Sets the opacity of a suspect to a share of its trained opacity.
    fn show(&mut self, suspect: usize, share: f32) {
        let opacity = (share * self.whole[suspect]).max(1e-6);
        self.splats.opacity_logits.set(0, self.places[suspect], logit(opacity));
    }

    /// The share of its opacity at which a suspect is just drawn.
    fn faintest(&self, suspect: usize) -> f32 {
        (FAINTEST / self.whole[suspect]).min(1.0)
    }

    /// Renders the view of every photograph. Returns half the sum of squared errors; `after` is called after each view, with its errors in
    /// `v_color`.
    fn look(&mut self, mut after: impl FnMut(&mut Self)) -> f64 {
        let options = RenderOptions {
            antialias: self.draft.cloud.antialiased,
            background: self.taken.background,
            ..RenderOptions::default()
        };
        let mut error = 0.0;
        for (number, photo) in &self.taken.photos {
            let camera = self.draft.cameras[*number];
            let intrinsics = camera.intrinsics.resized(photo.width, photo.height);
            let view = ViewParams::new(&Camera { intrinsics, ..camera });
            self.renderer.render(&self.splats, &view, &options);
            let pixels = self.renderer.alpha().len();
            let errors = self.renderer.color().iter().enumerate().map(|(at, shown)| {
                let (channel, pixel) = (at / pixels, at % pixels);
                let says = photo.mask.as_ref().is_none_or(|mask| mask[pixel] > 0);
                let taken = f32::from(photo.data[3 * pixel + channel]) / 255.0;
                if says { shown - taken } else { 0.0 }
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
        let mut slopes = vec![0.0f32; self.places.len()];
        let error = self.look(|trial| {
            let v_out = OutputGradient {
                gather: Gather::Nothing,
                ..OutputGradient::of_color(&trial.v_color)
            };
            trial.renderer.backward(&trial.splats, &v_out, &mut trial.gradients);
            let v_logits = trial.gradients.splats.opacity_logits.plane(0);
            for (slope, at) in slopes.iter_mut().zip(&trial.places) {
                if trial.gradients.active[*at] > 0.0 {
                    *slope += v_logits[*at];
                }
            }
        });
        for ((slope, at), whole) in slopes.iter_mut().zip(&self.places).zip(&self.whole) {
            // From the derivative with respect to the logit to that with respect to the share: divides by the sigmoid's slope.
            let opacity = sigmoid(self.splats.opacity_logits.get(0, *at));
            *slope *= whole / ((1.0 - opacity).max(0.01) * opacity);
        }
        (error, slopes)
    }

    /// Fits the shares of all suspects together. Returns whether each is needed.
    fn fit(&mut self, presumption: Presumption) -> Vec<bool> {
        let is_hidden = presumption == Presumption::Guilty;
        let (first, steps) = if is_hidden { (0.0, STEPS[0]) } else { (1.0, STEPS[1]) };
        let mut shares = vec![first; self.places.len()];
        let mut moments = vec![[0.0f32; 2]; shares.len()];
        // Number of steps that the moments of each suspect cover.
        let mut ages = vec![0; shares.len()];
        let mut harmless = vec![false; shares.len()];
        for (step, turn) in (0..steps).zip((0..TURNS).cycle()) {
            for i in 0..shares.len() {
                if is_hidden && i % TURNS == turn && shares[i] < self.faintest(i) {
                    shares[i] = self.faintest(i);
                    (moments[i], ages[i]) = ([0.0; 2], 0);
                }
                self.show(i, shares[i]);
            }
            let (error, slopes) = self.slopes();
            if !is_hidden && step == 0 {
                // Hiding a suspect whose best share is at or above 0 lowers the error by at most half the slope.
                harmless = slopes
                    .iter()
                    .map(|slope| f64::from(*slope) < 2.0 * HARMLESS * error)
                    .collect();
            }
            let rate = RATES[0] + (RATES[1] - RATES[0]) * step as f32 / (steps - 1) as f32;
            for (i, slope) in slopes.into_iter().enumerate() {
                ages[i] += 1;
                let corrected = 1.0 - DECAY.powi(ages[i]);
                let [mean, square] = &mut moments[i];
                *mean += (1.0 - DECAY) * (slope - *mean);
                *square += (1.0 - DECAY) * (slope * slope - *square);
                let pace = (*mean / corrected) / ((*square / corrected).sqrt() + 1e-12);
                let least = if is_hidden { 0.0 } else { self.faintest(i).min(0.1) };
                shares[i] = (shares[i] - rate * pace).clamp(least, 1.0);
            }
        }
        let is_needed = |(share, harmless): (f32, bool)| share >= NEEDED || harmless;
        shares.into_iter().zip(harmless).map(is_needed).collect()
    }

    /// Acquits condemned splats that lower the error, the most useful first: suspects whose turn came late had too few steps in the fit.
    fn acquit(&mut self, verdicts: &mut [bool]) {
        for (i, needed) in verdicts.iter().enumerate() {
            self.show(i, f32::from(u8::from(*needed)));
        }
        let mut error = self.look(|_| ());
        for _ in 0..TRIALS {
            let mut hopeful: Vec<(f32, usize)> = Vec::new();
            let condemned: Vec<usize> = (0..verdicts.len()).filter(|i| !verdicts[*i]).collect();
            for group in condemned.chunks(GROUP) {
                for i in group {
                    self.show(*i, self.faintest(*i));
                }
                let (_, slopes) = self.slopes();
                for i in group {
                    self.show(*i, 0.0);
                }
                hopeful.extend(group.iter().map(|i| (slopes[*i], *i)).filter(|(slope, _)| *slope < 0.0));
            }
            hopeful.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut is_changed = false;
            for (_, i) in hopeful {
                self.show(i, 1.0);
                let with = self.look(|_| ());
                if with < error {
                    (error, verdicts[i], is_changed) = (with, true, true);
                } else {
                    self.show(i, 0.0);
                }
            }
            if !is_changed {
                break;
            }
        }
    }
}

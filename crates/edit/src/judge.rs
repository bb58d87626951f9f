//! What photographs say about suspects: how much of each the scene needs.
//!
//! The opacities of all suspects together are fitted to the photographs while the rest of the scene stays. One by one they cannot be judged:
//! a bright veil and a dark one hide each other, and each seems to help. What is invisible has no gradient, so that nothing that vanished in
//! the fog of a hundred veils would come back: hidden suspects are shown faintly in turns, and tried again in clear air at the end.

use crate::draft::gather;
use crate::{Draft, Selection, Taken};
use irradia_scene::Camera;
use irradia_splat::{
    Gather, OutputGradient, RenderOptions, Renderer, SplatGradients, Splats, ViewParams, logit, sigmoid,
};

/// Steps of Adam over all photographs where suspects begin hidden, and where they begin as trained; rates at the first step and at the last.
const STEPS: [usize; 2] = [40, 20];
const RATES: [f32; 2] = [0.2, 0.02];
/// Decay of the means of gradients and of their squares. It is short: the fog of the first steps has gradients a thousand times larger than
/// those by which a wall gets back what it lost in it.
const DECAY: f32 = 0.8;
/// Hidden suspects have no gradients. Each is shown faintly in one of so many steps: a hundred veils at once are a fog in which no wall comes back.
const TURNS: usize = 8;
/// Opacity from which on a splat has gradients: 1/255 in the middle and a little more around.
const FAINTEST: f32 = 0.012;
/// Share of its opacity that photographs leave to a splat that they need.
const NEEDED: f32 = 0.5;
/// Share of the error that a splat may add without being condemned: what photographs do not object to stays.
const HARMLESS: f64 = 2e-5;
/// Condemned splats that are shown faintly at a time to see whether they would help.
const GROUP: usize = 8;
/// Times that all condemned are tried again, as long as any comes back.
const TRIALS: usize = 3;

/// How suspects are judged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Presumption {
    /// Hidden, unless photographs ask for them.
    Guilty,
    /// Shown, unless photographs object to them.
    Innocent,
}

/// Whether the photographs need each of `suspects`; `of` is what is rendered.
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

/// The scene before its photographs.
struct Trial<'a> {
    draft: &'a Draft,
    taken: &'a Taken,
    splats: Splats,
    /// Where each suspect is in `splats`, and its opacity as trained.
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

    /// Shows a suspect with a share of its opacity.
    fn show(&mut self, suspect: usize, share: f32) {
        let opacity = (share * self.whole[suspect]).max(1e-6);
        self.splats.opacity_logits.set(0, self.places[suspect], logit(opacity));
    }

    /// The share with which a suspect is just drawn.
    fn faintest(&self, suspect: usize) -> f32 {
        (FAINTEST / self.whole[suspect]).min(1.0)
    }

    /// Renders every photograph's view. Returns half the sum of squared errors; `after` is called after each view, its errors in `v_color`.
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

    /// The error, and its slope along the share of each suspect.
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
            // The slope along the logit, without what the sigmoid makes of it.
            let opacity = sigmoid(self.splats.opacity_logits.get(0, *at));
            *slope *= whole / ((1.0 - opacity).max(0.01) * opacity);
        }
        (error, slopes)
    }

    /// Fits the shares of all suspects together.
    fn fit(&mut self, presumption: Presumption) -> Vec<bool> {
        let is_hidden = presumption == Presumption::Guilty;
        let (first, steps) = if is_hidden { (0.0, STEPS[0]) } else { (1.0, STEPS[1]) };
        let mut shares = vec![first; self.places.len()];
        let mut moments = vec![[0.0f32; 2]; shares.len()];
        // The steps that a suspect's moments know of.
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
                // The error falls by no more than half the slope when one vanishes that has its best share at or above 0.
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

    /// Acquits the condemned by which the photographs are met better, the most useful first: late turns leave the fit no time.
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

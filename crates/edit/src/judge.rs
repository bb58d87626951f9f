//! What photographs say about suspects: how much of each the scene needs.
//!
//! The opacities of all suspects together are fitted to the photographs while the rest of the scene stays. One by one they cannot be judged:
//! a bright veil and a dark one hide each other, and each seems to help.

use crate::draft::gather;
use crate::{Draft, Selection, Taken};
use irradia_scene::Camera;
use irradia_splat::{
    Gather, OutputGradient, RenderOptions, Renderer, SplatGradients, Splats, ViewParams, logit, sigmoid,
};

/// Steps of Adam over all photographs, and its rates at the first and at the last.
const STEPS: usize = 20;
const RATES: [f32; 2] = [0.2, 0.02];
/// Decay of the means of gradients and of their squares. It is short: the fog of the first steps has gradients a thousand times larger than
/// those by which a wall gets back what it lost in it.
const DECAY: f32 = 0.8;
/// Steps after which suspects that began faint may vanish: a hundred veils of the faintest opacity are a fog in which no wall comes back.
const FADING: usize = 6;
/// Opacity from which on a splat has gradients: 1/255 in the middle and a little more around.
const FAINTEST: f32 = 0.012;

/// The share of its opacity that the photographs leave to each of `suspects`, beginning with the share `first`. `of` is what is rendered.
pub(crate) fn needed(
    draft: &Draft,
    taken: &Taken,
    of: &Selection,
    suspects: &Selection,
    first: f32,
) -> Vec<(u32, f32)> {
    let numbers = of.indices();
    let mut splats = Splats::from_cloud(&gather(&draft.cloud, &numbers));
    // Where each suspect is in `splats`, and its opacity as trained.
    let places: Vec<usize> = (0..numbers.len())
        .filter(|at| suspects.contains(numbers[*at] as usize))
        .collect();
    let whole: Vec<f32> = places.iter().map(|at| splats.opacity(*at)).collect();
    let mut shares: Vec<f32> = whole
        .iter()
        .map(|opacity| (FAINTEST / opacity).clamp(first, 1.0))
        .collect();
    let mut moments = vec![[0.0f32; 2]; places.len()];
    let (mut renderer, mut gradients) = (Renderer::new(), SplatGradients::default());
    let options = RenderOptions {
        antialias: draft.cloud.antialiased,
        background: taken.background,
        ..RenderOptions::default()
    };
    let mut v_color = Vec::new();
    for step in 1..=STEPS {
        for ((at, opacity), share) in places.iter().zip(&whole).zip(&shares) {
            splats.opacity_logits.set(0, *at, logit((share * opacity).max(1e-6)));
        }
        let mut slopes = vec![0.0f32; places.len()];
        for (number, photo) in &taken.photos {
            let camera = draft.cameras[*number];
            let intrinsics = camera.intrinsics.resized(photo.width, photo.height);
            renderer.render(&splats, &ViewParams::new(&Camera { intrinsics, ..camera }), &options);
            let pixels = renderer.alpha().len();
            v_color.clear();
            v_color.extend(renderer.color().iter().enumerate().map(|(at, shown)| {
                let (channel, pixel) = (at / pixels, at % pixels);
                let says = photo.mask.as_ref().is_none_or(|mask| mask[pixel] > 0);
                let taken = f32::from(photo.data[3 * pixel + channel]) / 255.0;
                if says { shown - taken } else { 0.0 }
            }));
            let v_out = OutputGradient {
                gather: Gather::Nothing,
                ..OutputGradient::of_color(&v_color)
            };
            renderer.backward(&splats, &v_out, &mut gradients);
            let v_logits = gradients.splats.opacity_logits.plane(0);
            for (slope, at) in slopes.iter_mut().zip(&places) {
                if gradients.active[*at] > 0.0 {
                    *slope += v_logits[*at];
                }
            }
        }
        let rate = RATES[0] + (RATES[1] - RATES[0]) * (step - 1) as f32 / (STEPS - 1) as f32;
        for (i, at) in places.iter().enumerate() {
            // The slope along the share: that along the logit, without what the sigmoid makes of it.
            let opacity = sigmoid(splats.opacity_logits.get(0, *at));
            let slope = slopes[i] / ((1.0 - opacity).max(0.01) * shares[i].max(1e-3));
            let [mean, square] = &mut moments[i];
            *mean += (1.0 - DECAY) * (slope - *mean);
            *square += (1.0 - DECAY) * (slope * slope - *square);
            let corrected = 1.0 - DECAY.powi(step as i32);
            let pace = (*mean / corrected) / ((*square / corrected).sqrt() + 1e-12);
            let least = match first < 1.0 && step > FADING {
                true => 0.0,
                false => (FAINTEST / whole[i]).min(0.1),
            };
            shares[i] = (shares[i] - rate * pace).clamp(least, 1.0);
        }
    }
    places
        .iter()
        .zip(shares)
        .map(|(at, share)| (numbers[*at], share))
        .collect()
}

use super::picture::Picture;
use super::*;
use crate::metric;
use irradia_compute::simd::Double;
use irradia_testkit::finite_differences::{FiniteDifferences, sample_indices};

const MIXED: LossWeights = LossWeights {
    l1: 0.7,
    ssim: 0.3,
    mse: 0.5,
};

impl Picture {
    fn in_double(&self, render: &[f64], weights: &LossWeights) -> (LossValues, Vec<f64>) {
        let mut v_render = vec![0.0; render.len()];
        let target = Target {
            width: self.width,
            height: self.height,
            truth: Truth::Planar(&self.truth),
            mask: self.mask.as_deref(),
        };
        let mut loss = PhotometricLoss::<f64>::with_level(Level::detect());
        let values = loss.run_bands(render, &target, weights, &mut v_render, |job, scratch, v| {
            band(Double, job, scratch, v)
        });
        (values, v_render)
    }

    fn in_single(&self, loss: &mut PhotometricLoss, weights: &LossWeights) -> (LossValues, Vec<f32>) {
        let single = |values: &[f64]| -> Vec<f32> { values.iter().map(|v| *v as f32).collect() };
        let (render, truth) = (single(&self.render), single(&self.truth));
        let mut v_render = vec![7.0; render.len()];
        let target = Target {
            width: self.width,
            height: self.height,
            truth: Truth::Planar(&truth),
            mask: self.mask.as_deref(),
        };
        let values = loss.evaluate(&render, &target, weights, &mut v_render);
        (values, v_render)
    }
}

const SIZES: [(usize, usize); 7] = [(1, 1), (5, 3), (23, 17), (1, 40), (40, 1), (16, 16), (33, 150)];

#[test]
fn every_part_matches_plain_code() {
    for (seed, (width, height)) in SIZES.into_iter().enumerate() {
        let case = Picture::random(width, height, false, seed as u64);
        let (values, _) = case.in_double(&case.render, &MIXED);
        let n = case.render.len() as f64;
        let differences = || case.render.iter().zip(&case.truth).map(|(x, y)| x - y);
        let l1 = differences().map(f64::abs).sum::<f64>() / n;
        let mse = differences().map(|d| d * d).sum::<f64>() / n;
        let ssim = metric::ssim(&case.image(&case.render), &case.image(&case.truth));
        // Both in double precision: only the order of sums differs.
        assert!((values.l1 - l1).abs() < 1e-12, "{width}x{height}");
        assert!((values.mse - mse).abs() < 1e-12, "{width}x{height}");
        assert!(
            (values.ssim.unwrap() - ssim).abs() < 1e-11,
            "{width}x{height} {values:?} {ssim}"
        );
        let total = 0.7 * l1 + 0.3 * (1.0 - ssim) + 0.5 * mse;
        // The weights are in single precision.
        assert!((values.total - total).abs() < 1e-7, "{width}x{height}");
    }
}

#[test]
fn gradients_match_finite_differences() {
    const STEP: f64 = 1e-5;
    for (seed, (width, height)) in SIZES.into_iter().enumerate() {
        for masked in [false, true] {
            for weights in [MIXED, LossWeights { ssim: 0.0, ..MIXED }, LossWeights::photometric(1.0)] {
                let case = Picture::random(width, height, masked, seed as u64 + 100);
                let (_, v_render) = case.in_double(&case.render, &weights);
                // Values within a step of the truth are at the kink of L1.
                let smooth = |i: &usize| (case.render[*i] - case.truth[*i]).abs() >= 2.0 * STEP;
                // Truncation error is STEP^2 times the third derivative over the gradient; SSIM's constants are 1e-3,
                // so 1e-5 of the largest gradient; 1e-10 is the rounding of a loss near 1 over 2 STEP.
                let differences = FiniteDifferences {
                    absolute: 1e-10,
                    ..FiniteDifferences::relative_to_max(STEP, 1e-5)
                };
                let what = format!("{width}x{height} masked {masked} {weights:?}");
                let value = |render: &[f64]| case.in_double(render, &weights).0.total;
                let which = sample_indices(v_render.len()).filter(smooth);
                differences.check(&what, &case.render, &v_render, which, value);
            }
        }
    }
}

#[test]
fn every_level_matches_double_precision() {
    for level in Level::all() {
        let mut loss = PhotometricLoss::with_level(level);
        for (seed, (width, height)) in SIZES.into_iter().chain([(70, 300)]).enumerate() {
            for weights in [MIXED, LossWeights { ssim: 0.0, ..MIXED }] {
                let case = Picture::random(width, height, seed % 2 == 1, seed as u64 + 200);
                let (want, v_want) = case.in_double(&case.render, &weights);
                let (got, v_got) = case.in_single(&mut loss, &weights);
                let name = format!("{} {width}x{height}", level.name());
                assert!((got.total - want.total).abs() < 1e-6, "{name}: {got:?} {want:?}");
                assert!(
                    (got.ssim.unwrap_or(0.0) - want.ssim.unwrap_or(0.0)).abs() < 3e-6,
                    "{name}: {got:?} {want:?}"
                );
                let largest = v_want.iter().fold(0.0f64, |m, v| m.max(v.abs()));
                for (i, (got, want)) in v_got.iter().zip(&v_want).enumerate() {
                    // E[x^2] - mu^2 cancels to 1e-7 beside C2 = 9e-4: 1e-4 of a derivative at worst.
                    assert!(
                        (f64::from(*got) - want).abs() < 1e-4 * largest,
                        "{name} value {i}: {got} {want}"
                    );
                }
            }
        }
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let case = Picture::random(70, 300, true, 5);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| case.in_single(&mut PhotometricLoss::new(), &MIXED))
    };
    let one = run(1);
    for threads in [2, 3, 8] {
        assert_eq!(run(threads), one);
    }
}

#[test]
fn changing_the_size_leaves_no_stale_memory() {
    let mut reused = PhotometricLoss::new();
    // 70, 68 and 80 columns round up to the same number of vectors.
    for (seed, (width, height)) in [(70, 40), (68, 40), (80, 9), (3, 3), (70, 40)].into_iter().enumerate() {
        let case = Picture::random(width, height, seed == 1, seed as u64);
        let fresh = case.in_single(&mut PhotometricLoss::new(), &MIXED);
        assert_eq!(case.in_single(&mut reused, &MIXED), fresh, "{width}x{height}");
    }
}

#[test]
fn equal_images_have_zero_loss_and_gradient() {
    let mut case = Picture::random(30, 20, false, 1);
    case.render = case.truth.clone();
    let (values, v_render) = case.in_single(&mut PhotometricLoss::new(), &LossWeights::photometric(0.2));
    assert_eq!((values.l1, values.mse), (0.0, 0.0));
    assert!(values.total.abs() < 1e-6);
    // Only rounding remains, beside gradients of 1 / 1800 where images differ.
    assert!(v_render.iter().all(|v| v.abs() < 1e-7));
    let (_, v_render) = case.in_single(&mut PhotometricLoss::new(), &LossWeights::photometric(0.0));
    assert!(v_render.iter().all(|v| *v == 0.0));
}

#[test]
fn masked_pixels_have_no_effect_even_if_not_finite() {
    let case = Picture::random(40, 30, true, 9);
    let mask = case.mask.clone().unwrap();
    let (clean, v_clean) = case.in_single(&mut PhotometricLoss::new(), &MIXED);
    let mut poisoned = case;
    for (i, value) in poisoned.render.iter_mut().enumerate() {
        if mask[i % mask.len()] == 0 {
            *value = [f64::NAN, f64::INFINITY, -1e30][i % 3];
        }
    }
    let (values, v_render) = poisoned.in_single(&mut PhotometricLoss::new(), &MIXED);
    assert_eq!((values, &v_render), (clean, &v_clean));
    assert!((0..v_render.len()).all(|i| mask[i % mask.len()] != 0 || v_render[i] == 0.0));

    poisoned.mask = Some(vec![0; mask.len()]);
    let (nothing, v_render) = poisoned.in_single(&mut PhotometricLoss::new(), &MIXED);
    assert_eq!((nothing.total, nothing.ssim), (0.0, Some(1.0)));
    assert!(v_render.iter().all(|v| *v == 0.0));
}

#[test]
fn values_far_from_colours_stay_finite() {
    let mut case = Picture::random(40, 30, false, 9);
    case.render.iter_mut().for_each(|v| *v *= 1e4);
    let (values, v_render) = case.in_single(&mut PhotometricLoss::new(), &MIXED);
    assert!(values.total.is_finite() && v_render.iter().all(|v| v.is_finite()));
}

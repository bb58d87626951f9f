//! Robust estimation: MSAC (Torr and Zisserman 2000) with local optimisation (Chum, Matas and Kittler 2003).

use irradia_scene::Rng;

/// An estimation problem with candidate models from minimal samples.
pub trait Estimator {
    /// The type of model that is estimated.
    type Model: Clone;
    /// Size of a minimal sample.
    const SAMPLE: usize;
    /// Number of observations.
    fn observations(&self) -> usize;
    /// Adds the models through the observations `sample` to `models`.
    fn fit(&self, sample: &[usize], models: &mut Vec<Self::Model>);
    /// The MSAC cost, a sum of squared residuals in units of the squared threshold, each at most 1, and the number of inliers.
    fn cost(&self, model: &Self::Model) -> (f64, usize);
    /// A least-squares model over the inliers of `model`; `None` where that fails.
    fn refine(&self, model: &Self::Model) -> Option<Self::Model>;
}

/// When to stop sampling.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Maximum number of samples.
    pub samples: usize,
    /// Probability, given the number of inliers found, that at least one sample of inliers only has been drawn.
    pub confidence: f64,
    /// Random seed; the same seed gives the same result.
    pub seed: u64,
}

/// The best model found.
#[derive(Clone, Debug)]
pub struct Estimate<M> {
    /// The model.
    pub model: M,
    /// Its MSAC cost.
    pub cost: f64,
    /// Its number of inliers.
    pub inliers: usize,
}

/// The best of the candidates `first` and of the models through random minimal samples; `None` if there is none.
pub fn estimate<E: Estimator>(problem: &E, first: Vec<E::Model>, limits: Limits) -> Option<Estimate<E::Model>> {
    let n = problem.observations();
    let mut best: Option<Estimate<E::Model>> = None;
    for model in first {
        consider(problem, model, &mut best);
    }
    if n < E::SAMPLE {
        return best;
    }
    let mut rng = Rng::new(limits.seed, n as u64);
    let mut models = Vec::new();
    let mut sample = vec![0; E::SAMPLE];
    let mut drawn = 0;
    while drawn < needed_samples(&best, n, E::SAMPLE, limits) {
        drawn += 1;
        for i in 0..E::SAMPLE {
            sample[i] = loop {
                let pick = rng.below(n as u32) as usize;
                if !sample[..i].contains(&pick) {
                    break pick;
                }
            };
        }
        models.clear();
        problem.fit(&sample, &mut models);
        for model in models.drain(..) {
            consider(problem, model, &mut best);
        }
    }
    best
}

/// Number of samples needed for the confidence, given the inliers of the best model so far.
fn needed_samples<M>(best: &Option<Estimate<M>>, n: usize, sample: usize, limits: Limits) -> usize {
    let Some(best) = best else { return limits.samples };
    let clean_fraction = (best.inliers as f64 / n as f64).powi(sample as i32);
    if clean_fraction >= 1.0 {
        return limits.samples.min(1);
    }
    let samples = (1.0 - limits.confidence).ln() / (1.0 - clean_fraction).ln();
    limits.samples.min(if samples.is_finite() {
        samples.ceil() as usize
    } else {
        usize::MAX
    })
}

/// Replaces `best` by `model` if that is better, refined as long as that improves it.
fn consider<E: Estimator>(problem: &E, model: E::Model, best: &mut Option<Estimate<E::Model>>) {
    let (cost, inliers) = problem.cost(&model);
    if best.as_ref().is_some_and(|best| cost >= best.cost) || cost.is_nan() {
        return;
    }
    let mut winner = Estimate { model, cost, inliers };
    for _ in 0..3 {
        if winner.inliers <= E::SAMPLE {
            break;
        }
        let Some(model) = problem.refine(&winner.model) else {
            break;
        };
        let (cost, inliers) = problem.cost(&model);
        if cost.is_nan() || cost >= winner.cost * (1.0 - 1e-4) {
            break;
        }
        winner = Estimate { model, cost, inliers };
    }
    *best = Some(winner);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The mean of normal variates with a standard deviation of 1 among uniform outliers; a sample is one value.
    struct Mean(Vec<f64>);

    impl Estimator for Mean {
        type Model = f64;
        const SAMPLE: usize = 1;
        fn observations(&self) -> usize {
            self.0.len()
        }
        fn fit(&self, sample: &[usize], models: &mut Vec<f64>) {
            models.push(self.0[sample[0]]);
        }
        fn cost(&self, model: &f64) -> (f64, usize) {
            let residuals = self.0.iter().map(|x| ((x - model) / 3.0).powi(2));
            (
                residuals.clone().map(|r| r.min(1.0)).sum(),
                residuals.filter(|r| *r < 1.0).count(),
            )
        }
        fn refine(&self, model: &f64) -> Option<f64> {
            let inliers: Vec<f64> = self.0.iter().copied().filter(|x| (x - model).abs() < 3.0).collect();
            (!inliers.is_empty()).then(|| inliers.iter().sum::<f64>() / inliers.len() as f64)
        }
    }

    fn values(seed: u64) -> Mean {
        let mut rng = Rng::new(seed, 0);
        let mut values: Vec<f64> = (0..200).map(|_| 5.0 + f64::from(rng.normal())).collect();
        values.extend((0..100).map(|_| f64::from(rng.range(-45.0, 55.0))));
        Mean(values)
    }

    #[test]
    fn the_outcome_has_no_bias() {
        let limits = |seed| Limits {
            samples: 100,
            confidence: 0.999,
            seed,
        };
        let runs = 300;
        let errors: Vec<f64> = (0..runs)
            .map(|seed| {
                estimate(&values(seed), Vec::new(), limits(seed))
                    .expect("a model")
                    .model
                    - 5.0
            })
            .collect();
        let mean = errors.iter().sum::<f64>() / runs as f64;
        let deviation = (errors.iter().map(|e| e * e).sum::<f64>() / runs as f64).sqrt();
        // The mean of 200 variates has a standard deviation of 0.071, its mean over 300 runs one of 0.0041; the bounds are four of these
        // and a margin for outliers.
        assert!(deviation < 0.10, "{deviation}");
        assert!(mean.abs() < 0.017, "{mean}");
    }

    #[test]
    fn the_same_seed_gives_the_same_model() {
        let limits = Limits {
            samples: 10,
            confidence: 0.99,
            seed: 3,
        };
        let run = || estimate(&values(1), Vec::new(), limits).expect("a model").model;
        assert_eq!(run().to_bits(), run().to_bits());
    }

    #[test]
    fn too_few_observations_give_none() {
        let limits = Limits {
            samples: 10,
            confidence: 0.99,
            seed: 3,
        };
        assert!(estimate(&Mean(Vec::new()), Vec::new(), limits).is_none());
    }
}

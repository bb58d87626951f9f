//! Adam (Kingma and Ba 2015) on planar arrays: dense, as published, or sparse.

use crate::Planes;
use crate::simd::{Kernel, Lanes, Level, Mask, Simd};
use rayon::prelude::*;

/// Hyperparameters of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamStep {
    /// Decay of the first moment; 0.9 in the paper and in 3DGS.
    pub beta1: f32,
    /// Decay of the second moment; 0.999 in the paper and in 3DGS.
    pub beta2: f32,
    /// Added to the square root; 1e-15 in 3DGS, whose gradients are tiny.
    pub epsilon: f32,
    /// Number of this step, counted from 1, for the bias correction.
    pub step: u64,
}

impl AdamStep {
    /// The bias corrections of the first and second moment (section 3 of the paper): the moments are divided by them.
    pub fn corrections(&self) -> [f64; 2] {
        [self.beta1, self.beta2].map(|beta| 1.0 - f64::from(beta).powf(self.step as f64))
    }

    /// The `rule` of `adam.wgsl`: decay of the moments, epsilon, inverse root of the second correction.
    #[cfg(feature = "gpu")]
    pub fn device_rule(&self) -> [f32; 4] {
        let [_, second] = self.corrections();
        [self.beta1, self.beta2, self.epsilon, (1.0 / second.sqrt()) as f32]
    }

    /// The learning rate `rate` as `adam.wgsl` takes it, divided by the first correction.
    #[cfg(feature = "gpu")]
    pub fn device_rate(&self, rate: f32) -> f32 {
        (f64::from(rate) / self.corrections()[0]) as f32
    }
}

/// Items whose activity is counted together.
pub const RUN_LEN: usize = 512;
/// Items of a parallel task.
const ITEMS_PER_TASK: usize = 32 * RUN_LEN;

/// Which items have a gradient in this step, and what the step does to the others. The flags (length: the stride) are nonzero
/// where an item has one; elsewhere the gradient is not read.
#[derive(Clone, Copy, Debug)]
pub enum Active<'a> {
    /// Items without a gradient keep parameters and moments. The second slice counts the items with a gradient in each [`RUN_LEN`];
    /// runs without any are skipped.
    Sparse(&'a [f32], &'a [u32]),
    /// Items without a gradient step with a gradient of zero: their moments decay and still move them, as in the paper and in 3DGS.
    Dense(&'a [f32]),
    /// All items have a gradient.
    All,
}

/// Learning rates: the product of the plane's and the item's.
#[derive(Clone, Copy, Debug)]
pub struct AdamRates<'a> {
    /// One per plane; a plane with rate 0 and its moments stay unchanged.
    pub planes: &'a [f32],
    /// One per item (length: the stride); 1 when absent.
    pub items: Option<&'a [f32]>,
}

impl<'a> AdamRates<'a> {
    /// The same for all items of a plane.
    pub fn of_planes(planes: &'a [f32]) -> Self {
        Self { planes, items: None }
    }
}

/// One step on every plane.
///
/// `parameters`, `gradients` and both `moments` have the same shape. Planes are processed in parallel, piece by piece; the result does not
/// depend on the number of threads.
///
/// # Panics
/// When shapes differ.
pub fn adam(
    level: Level,
    parameters: &mut Planes,
    gradients: &Planes,
    moments: [&mut Planes; 2],
    rates: AdamRates,
    active: Active,
    step: AdamStep,
) {
    let [first, second] = moments;
    let (count, len, stride) = (parameters.count(), parameters.len(), parameters.stride());
    let shape = |p: &Planes| (p.count(), p.stride());
    assert!(
        [shape(gradients), shape(first), shape(second)] == [(count, stride); 3],
        "same shapes"
    );
    let complete = match active {
        Active::Sparse(flags, counts) => flags.len() == stride && counts.len() == stride.div_ceil(RUN_LEN),
        Active::Dense(flags) => flags.len() == stride,
        Active::All => true,
    };
    let rated = rates.planes.len() == count && rates.items.is_none_or(|items| items.len() == stride);
    assert!(
        rated && complete,
        "a rate per plane and per item, a flag per item, a count per run"
    );
    if stride == 0 {
        return;
    }
    parameters
        .as_mut_slice()
        .par_chunks_mut(stride)
        .zip(gradients.as_slice().par_chunks(stride))
        .zip(first.as_mut_slice().par_chunks_mut(stride))
        .zip(second.as_mut_slice().par_chunks_mut(stride))
        .zip(rates.planes)
        .filter(|(_, rate)| **rate != 0.0)
        .for_each(|((((parameters, gradients), first), second), rate)| {
            parameters
                .par_chunks_mut(ITEMS_PER_TASK)
                .zip(gradients.par_chunks(ITEMS_PER_TASK))
                .zip(first.par_chunks_mut(ITEMS_PER_TASK))
                .zip(second.par_chunks_mut(ITEMS_PER_TASK))
                .enumerate()
                .for_each(|(task, (((parameter, gradient), first), second))| {
                    level.run(AdamPiece {
                        parameter,
                        gradient,
                        first,
                        second,
                        from: task * ITEMS_PER_TASK,
                        len,
                        active,
                        rate: *rate,
                        of_items: rates.items,
                        step,
                    });
                });
        });
}

/// The constants of a step, broadcast to all lanes.
#[derive(Clone, Copy, Debug)]
pub struct AdamRule<L> {
    rate: L,
    root_scale: L,
    epsilon: L,
    beta: [L; 2],
    rest: [L; 2],
}

impl<L: Lanes<Scalar = f32>> AdamRule<L> {
    /// The rule for `step` at the learning rate `rate`. The bias corrections are folded into the rate and the scale of the
    /// root once, instead of being applied to every moment.
    #[inline(always)]
    pub fn new<S: Simd<F = L>>(simd: S, step: &AdamStep, rate: f32) -> Self {
        let [correction1, correction2] = step.corrections();
        Self {
            rate: simd.splat(f64::from(rate) / correction1),
            root_scale: simd.splat(1.0 / correction2.sqrt()),
            epsilon: simd.set(step.epsilon),
            beta: [simd.set(step.beta1), simd.set(step.beta2)],
            rest: [simd.set(1.0 - step.beta1), simd.set(1.0 - step.beta2)],
        }
    }

    /// The rule at `factor` times its learning rate.
    #[inline(always)]
    fn at(&self, factor: L) -> Self {
        Self {
            rate: self.rate * factor,
            ..*self
        }
    }

    /// Parameter and both moments after the gradient `g`.
    #[inline(always)]
    pub fn step(&self, g: L, parameter: L, first: L, second: L) -> [L; 3] {
        let m = first.mul_add(self.beta[0], self.rest[0] * g);
        let v = second.mul_add(self.beta[1], self.rest[1] * g * g);
        let p = parameter - self.rate * m / v.sqrt().mul_add(self.root_scale, self.epsilon);
        [p, m, v]
    }
}

/// First moments below this are set to zero: hundreds of steps without a gradient would make them subnormal, and processors are
/// slow with subnormal numbers. The largest movement lost is 1e-15 times the rate.
const FAINTEST_MOMENT: f64 = 1e-30;

struct AdamPiece<'a> {
    parameter: &'a mut [f32],
    gradient: &'a [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    /// The piece's first item, a multiple of [`RUN_LEN`].
    from: usize,
    /// Number of items of the plane.
    len: usize,
    active: Active<'a>,
    rate: f32,
    of_items: Option<&'a [f32]>,
    step: AdamStep,
}

impl Kernel for AdamPiece<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        if let Active::Sparse(_, counts) = self.active {
            let runs = &counts[self.from / RUN_LEN..][..self.parameter.len().div_ceil(RUN_LEN)];
            if runs.iter().all(|count| *count == 0) {
                return;
            }
        }
        let rule = AdamRule::new(simd, &self.step, self.rate);
        let (zero, faintest) = (simd.splat(0.0), simd.splat(FAINTEST_MOMENT));
        let dense = matches!(self.active, Active::Dense(_));
        for run in (0..self.parameter.len()).step_by(RUN_LEN) {
            if let Active::Sparse(_, counts) = self.active
                && counts[(self.from + run) / RUN_LEN] == 0
            {
                continue;
            }
            for at in (run..self.parameter.len().min(run + RUN_LEN)).step_by(S::LANES) {
                let item = self.from + at;
                let on = match self.active {
                    Active::Sparse(flags, _) | Active::Dense(flags) => zero.lt(simd.load(&flags[item..])),
                    Active::All => {
                        let left = self.len.saturating_sub(item).min(S::LANES);
                        simd.lanes(|i| i as f32).lt(simd.set(left as f32))
                    }
                };
                if on.none() && !dense {
                    continue;
                }
                let g = simd.load(&self.gradient[at..]).masked(on);
                let m_old = simd.load(&self.first[at..]);
                let v_old = simd.load(&self.second[at..]);
                let p_old = simd.load(&self.parameter[at..]);
                let rule = self.of_items.map_or(rule, |rates| rule.at(simd.load(&rates[item..])));
                let [mut p, mut m, mut v] = rule.step(g, p_old, m_old, v_old);
                if dense {
                    m = m.masked(faintest.lt(m.abs()));
                } else {
                    m = m.select(on, m_old);
                    v = v.select(on, v_old);
                    p = p.select(on, p_old);
                }
                m.store(&mut self.first[at..]);
                v.store(&mut self.second[at..]);
                p.store(&mut self.parameter[at..]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The paper's algorithm 1 on one item, in double precision.
    #[derive(Clone, Copy, Default)]
    struct Reference {
        x: f64,
        m: f64,
        v: f64,
    }

    impl Reference {
        fn step(&mut self, gradient: f64, rate: f64, t: u64) {
            self.m = 0.9 * self.m + 0.1 * gradient;
            self.v = 0.999 * self.v + 0.001 * gradient * gradient;
            let corrected = |moment: f64, beta: f64| moment / (1.0 - beta.powf(t as f64));
            self.x -= rate * corrected(self.m, 0.9) / (corrected(self.v, 0.999).sqrt() + 1e-15);
        }
    }

    /// Items have gradients in some steps only, each at its own pace, and NaN in the others; some items never have one.
    fn agrees_with_the_paper(dense: bool) {
        let (n, rate, steps) = (3 * RUN_LEN + 37, 0.01, 12);
        // The rate of each item.
        let of_item = |i: usize| [1.0, 0.25, 0.5][i % 3];
        // The items of the second run never have a gradient.
        let present =
            |i: usize, t: u64| i / RUN_LEN != 1 && i % 5 != 4 && (t + i as u64).is_multiple_of(1 + i as u64 % 4);
        for level in Level::all() {
            let mut p = Planes::zeros(2, n);
            let (mut m, mut v) = (Planes::zeros(2, n), Planes::zeros(2, n));
            let mut expected = vec![Reference::default(); n];
            for t in 1..=steps {
                let mut g = Planes::zeros(2, n);
                g.as_mut_slice().fill(f32::NAN);
                let active: Vec<f32> = (0..p.stride())
                    .map(|i| f32::from(u8::from(i < n && present(i, t))))
                    .collect();
                let counts: Vec<u32> = active
                    .chunks(RUN_LEN)
                    .map(|run| run.iter().filter(|flag| **flag != 0.0).count() as u32)
                    .collect();
                for i in 0..n {
                    let gradient = ((i % 37) as f32 - 10.5) * 0.1 + t as f32 * 0.03;
                    if present(i, t) {
                        g.set(1, i, gradient);
                        expected[i].step(f64::from(gradient), rate * f64::from(of_item(i)), t);
                    } else if dense {
                        expected[i].step(0.0, rate * f64::from(of_item(i)), t);
                    }
                }
                let step = AdamStep {
                    beta1: 0.9,
                    beta2: 0.999,
                    epsilon: 1e-15,
                    step: t,
                };
                let rates = [0.0, rate as f32];
                let items: Vec<f32> = (0..p.stride()).map(of_item).collect();
                let active = if dense {
                    Active::Dense(&active)
                } else {
                    Active::Sparse(&active, &counts)
                };
                let rates = AdamRates {
                    planes: &rates,
                    items: Some(&items),
                };
                adam(level, &mut p, &g, [&mut m, &mut v], rates, active, step);
            }
            for (i, expected) in expected.iter().enumerate() {
                assert_eq!(p.get(0, i), 0.0, "a plane with rate 0 rests");
                // 1 - 0.999f32 is off by 5e-5 of itself; its root moves twelve steps of 0.02 by less than 6e-6.
                let difference = (f64::from(p.get(1, i)) - expected.x).abs();
                assert!(difference < 6e-6, "{} item {i}: {difference:e}", level.name());
                let first = f64::from(m.get(1, i));
                assert!((first - expected.m).abs() < 1e-6, "{} item {i}: {first}", level.name());
            }
            assert_eq!(p.get(1, 4), 0.0, "what never had a gradient never moves");
        }
    }

    #[test]
    fn sparse_steps_agree_with_the_paper_in_double_precision_and_absent_items_rest() {
        agrees_with_the_paper(false);
    }

    #[test]
    fn dense_steps_agree_with_the_paper_in_double_precision_and_absent_items_go_on() {
        agrees_with_the_paper(true);
    }

    #[test]
    fn a_moment_without_gradients_ends_at_zero_and_never_becomes_subnormal() {
        let (mut p, mut m, mut v) = (Planes::zeros(1, 1), Planes::zeros(1, 1), Planes::zeros(1, 1));
        let g = Planes::zeros(1, 1);
        m.set(0, 0, 1e-6);
        v.set(0, 0, 1e-12);
        let absent = vec![0.0; p.stride()];
        for t in 1..=1000 {
            let step = AdamStep {
                beta1: 0.9,
                beta2: 0.999,
                epsilon: 1e-15,
                step: t,
            };
            let active = Active::Dense(&absent);
            let (moments, rates) = ([&mut m, &mut v], AdamRates::of_planes(&[0.01]));
            adam(Level::detect(), &mut p, &g, moments, rates, active, step);
            assert!(m.get(0, 0) == 0.0 || m.get(0, 0).is_normal(), "step {t}");
        }
        assert_eq!(m.get(0, 0), 0.0);
    }
}

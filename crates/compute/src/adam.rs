//! Sparse Adam (Kingma and Ba 2015) on planar arrays: inactive items keep their parameters and moments.

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

/// Takes one step on every plane.
///
/// `parameters`, `gradients` and both `moments` have the same shape; `rates[c]` is the learning rate of plane `c`; an item is
/// updated where `active` (length: the stride) is not 0. Planes run in parallel, which does not affect the result.
///
/// # Panics
/// When shapes differ.
pub fn adam(
    level: Level,
    parameters: &mut Planes,
    gradients: &Planes,
    moments: [&mut Planes; 2],
    rates: &[f32],
    active: &[f32],
    step: AdamStep,
) {
    let [first, second] = moments;
    let (count, stride) = (parameters.count(), parameters.stride());
    let shape = |p: &Planes| (p.count(), p.stride());
    assert!(
        [shape(gradients), shape(first), shape(second)] == [(count, stride); 3],
        "same shapes"
    );
    assert!(
        rates.len() == count && active.len() == stride,
        "one rate per plane, one flag per item"
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
        .zip(rates)
        .filter(|(_, rate)| **rate != 0.0)
        .for_each(|((((parameter, gradient), first), second), rate)| {
            level.run(AdamPlane {
                parameter,
                gradient,
                first,
                second,
                active,
                rate: *rate,
                step,
            });
        });
}

/// The constants of a step in lanes.
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
        let t = step.step as f64;
        let correction1 = 1.0 - f64::from(step.beta1).powf(t);
        let correction2 = 1.0 - f64::from(step.beta2).powf(t);
        Self {
            rate: simd.splat(f64::from(rate) / correction1),
            root_scale: simd.splat(1.0 / correction2.sqrt()),
            epsilon: simd.set(step.epsilon),
            beta: [simd.set(step.beta1), simd.set(step.beta2)],
            rest: [simd.set(1.0 - step.beta1), simd.set(1.0 - step.beta2)],
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

struct AdamPlane<'a> {
    parameter: &'a mut [f32],
    gradient: &'a [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    active: &'a [f32],
    rate: f32,
    step: AdamStep,
}

impl Kernel for AdamPlane<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let rule = AdamRule::new(simd, &self.step, self.rate);
        let zero = simd.splat(0.0);
        for at in (0..self.parameter.len()).step_by(S::LANES) {
            let on = zero.lt(simd.load(&self.active[at..]));
            if on.none() {
                continue;
            }
            let g = simd.load(&self.gradient[at..]);
            let m_old = simd.load(&self.first[at..]);
            let v_old = simd.load(&self.second[at..]);
            let p_old = simd.load(&self.parameter[at..]);
            let [p, m, v] = rule.step(g, p_old, m_old, v_old);
            m.select(on, m_old).store(&mut self.first[at..]);
            v.select(on, v_old).store(&mut self.second[at..]);
            p.select(on, p_old).store(&mut self.parameter[at..]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_steps_match_the_paper_in_double_precision_and_skip_inactive_items() {
        let n = 21;
        for level in Level::all() {
            let mut p = Planes::zeros(2, n);
            let (mut m, mut v) = (Planes::zeros(2, n), Planes::zeros(2, n));
            let mut expected = vec![(0.0f64, 0.0f64, 0.0f64); n];
            let active: Vec<f32> = (0..p.stride()).map(|i| f32::from(u8::from(i % 3 != 0))).collect();
            for t in 1..=3u64 {
                let mut g = Planes::zeros(2, n);
                for i in 0..n {
                    let value = (i as f32 - 10.0) * 0.1 + t as f32 * 0.01;
                    g.set(1, i, value);
                    if i % 3 != 0 {
                        let (x, m, v) = &mut expected[i];
                        let value = f64::from(value);
                        *m = 0.9 * *m + 0.1 * value;
                        *v = 0.999 * *v + 0.001 * value * value;
                        let (mh, vh) = (*m / (1.0 - 0.9f64.powf(t as f64)), *v / (1.0 - 0.999f64.powf(t as f64)));
                        *x -= 0.01 * mh / (vh.sqrt() + 1e-15);
                    }
                }
                let step = AdamStep {
                    beta1: 0.9,
                    beta2: 0.999,
                    epsilon: 1e-15,
                    step: t,
                };
                adam(level, &mut p, &g, [&mut m, &mut v], &[0.0, 0.01], &active, step);
            }
            for i in 0..n {
                assert_eq!(p.get(0, i), 0.0, "a plane with rate 0 is unchanged");
                // 1 - 0.999f32 has a relative error of 5e-5; its root changes a step of 0.03 by less than 2e-6.
                assert!((f64::from(p.get(1, i)) - expected[i].0).abs() < 2e-6, "item {i}");
            }
        }
    }
}

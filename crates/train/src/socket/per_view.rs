//! Adam for per-view parameters: a view's parameters are updated only in the steps that show it.

use crate::tensor_file::{NamedTensor, TensorSource};
use irradia_compute::adam::{Active, AdamRates, AdamStep, adam};
use irradia_compute::{Level, Planes};

/// Decays of the two moments, as published (Kingma and Ba 2015).
const BETAS: [f32; 2] = [0.9, 0.999];
/// Added to the root of the second moment: 1e-15 as in the code of 3DGS (Kerbl et al. 2023), not the 1e-8 of Kingma and Ba. The size of
/// a step then does not depend on the scale of the gradients, however small they are.
const EPSILON: f32 = 1e-15;

/// Adam's constants for the parameters of a photograph in their step `step`, from 1.
pub(super) fn adam_step(step: u64) -> AdamStep {
    AdamStep {
        beta1: BETAS[0],
        beta2: BETAS[1],
        epsilon: EPSILON,
        step,
    }
}

/// Moments and step counts of `N` parameters per view.
#[derive(Clone, Debug, PartialEq)]
pub struct PerViewAdam<const N: usize> {
    /// First and second moments, `[N, views]`.
    moments: [Planes; 2],
    /// Number of steps of each view.
    steps: Vec<u64>,
}

impl<const N: usize> PerViewAdam<N> {
    /// For `views` views without steps.
    pub fn new(views: usize) -> Self {
        Self {
            moments: [Planes::zeros(N, views), Planes::zeros(N, views)],
            steps: vec![0; views],
        }
    }

    /// Number of views.
    pub fn views(&self) -> usize {
        self.steps.len()
    }

    /// The change of the parameters of `view` in one step with `gradient`.
    pub fn step(&mut self, view: usize, gradient: [f32; N], rates: [f32; N]) -> [f32; N] {
        if gradient.iter().any(|g| !g.is_finite()) {
            return [0.0; N];
        }
        self.steps[view] += 1;
        let mut one = Planes::from_interleaved(N, &[0.0; N]);
        let gradient = Planes::from_interleaved(N, &gradient);
        let [mut first, mut second] = [0, 1].map(|m: usize| self.moments[m].gather(&[view as u32]));
        let mut active = vec![0.0; one.stride()];
        active[0] = 1.0;
        adam(
            Level::detect(),
            &mut one,
            &gradient,
            [&mut first, &mut second],
            AdamRates::of_planes(&rates),
            Active::Sparse(&active, &[1]),
            adam_step(self.steps[view]),
        );
        for (moments, new) in self.moments.iter_mut().zip([&first, &second]) {
            for c in 0..N {
                moments.set(c, view, new.get(c, 0));
            }
        }
        std::array::from_fn(|c| one.get(c, 0))
    }

    /// Moments and counts.
    pub fn tensors(&self) -> Vec<NamedTensor> {
        let [first, second] = &self.moments;
        vec![
            NamedTensor::f32s("first_moments", vec![self.views(), N], &first.to_interleaved()),
            NamedTensor::f32s("second_moments", vec![self.views(), N], &second.to_interleaved()),
            NamedTensor::u64s("steps", &self.steps),
        ]
    }

    /// Restores the result of [`Self::tensors`], whose names begin with `prefix`.
    ///
    /// # Errors
    /// One line, when a tensor is missing or has another shape.
    pub fn restore(&mut self, tensors: TensorSource, prefix: &str) -> Result<(), String> {
        let views = self.views();
        for (moment, name) in self.moments.iter_mut().zip(["first_moments", "second_moments"]) {
            let rows = tensors.rows::<N>(&format!("{prefix}{name}"), views)?;
            *moment = Planes::from_interleaved(N, rows.as_flattened());
        }
        let name = format!("{prefix}steps");
        let steps = tensors.u64s(&name).filter(|steps| steps.len() == views);
        self.steps = steps.ok_or(format!("{name} is missing or has the wrong length"))?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_of_each_view_is_a_full_one_however_late() {
        let mut adam = PerViewAdam::<2>::new(3);
        for _ in 0..5 {
            adam.step(0, [1.0, -2.0], [0.1, 0.1]);
        }
        let [a, b] = adam.step(2, [7.0, -0.001], [0.1, 0.2]);
        assert!((a + 0.1).abs() < 1e-5 && (b - 0.2).abs() < 1e-5, "{a} {b}");
        assert_eq!(adam.steps, [5, 0, 1]);
        assert_eq!(adam.step(1, [f32::NAN, 0.0], [0.1; 2]), [0.0; 2]);
        assert_eq!(adam.steps, [5, 0, 1], "a gradient that is not finite is skipped");
    }
}

//! Adam on flat lists, where a gradient of exactly zero can mean that a number took no part.

use irradia_compute::adam::AdamStep;
use irradia_compute::simd::{Kernel, Lanes, Mask, Simd};

/// One step on one list.
pub(crate) struct Adam<'a> {
    pub parameters: &'a mut [f32],
    pub gradients: &'a [f32],
    pub first: &'a mut [f32],
    pub second: &'a mut [f32],
    pub rate: f32,
    pub step: AdamStep,
    /// Numbers whose gradient is zero keep everything, as entries of a table that no sample touched do.
    pub sparse: bool,
}

impl Kernel for Adam<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let t = self.step.step as f64;
        let correction1 = 1.0 - f64::from(self.step.beta1).powf(t);
        let correction2 = 1.0 - f64::from(self.step.beta2).powf(t);
        let rate = simd.splat(f64::from(self.rate) / correction1);
        let root_scale = simd.splat(1.0 / correction2.sqrt());
        let epsilon = simd.set(self.step.epsilon);
        let (beta1, beta2) = (simd.set(self.step.beta1), simd.set(self.step.beta2));
        let (rest1, rest2) = (simd.set(1.0 - self.step.beta1), simd.set(1.0 - self.step.beta2));
        let zero = simd.splat(0.0);
        let n = self.parameters.len();
        let mut at = 0;
        while at < n {
            // The last vector of a list that is no multiple goes by way of a copy.
            let mut copies = [[0.0f32; 16]; 4];
            let whole = at + S::LANES <= n;
            let count = if whole { S::LANES } else { n - at };
            if !whole {
                copies[0][..count].copy_from_slice(&self.gradients[at..]);
                copies[1][..count].copy_from_slice(&self.first[at..]);
                copies[2][..count].copy_from_slice(&self.second[at..]);
                copies[3][..count].copy_from_slice(&self.parameters[at..]);
            }
            let g = simd.load(if whole { &self.gradients[at..] } else { &copies[0] });
            let on = zero.lt(g.abs());
            if self.sparse && on.none() {
                at += count;
                continue;
            }
            let m_old = simd.load(if whole { &self.first[at..] } else { &copies[1] });
            let v_old = simd.load(if whole { &self.second[at..] } else { &copies[2] });
            let p_old = simd.load(if whole { &self.parameters[at..] } else { &copies[3] });
            let mut m = m_old.mul_add(beta1, rest1 * g);
            let mut v = v_old.mul_add(beta2, rest2 * g * g);
            let mut p = p_old - rate * m / v.sqrt().mul_add(root_scale, epsilon);
            if self.sparse {
                m = m.or_where_not(on, m_old);
                v = v.or_where_not(on, v_old);
                p = p.or_where_not(on, p_old);
            }
            if whole {
                m.store(&mut self.first[at..]);
                v.store(&mut self.second[at..]);
                p.store(&mut self.parameters[at..]);
            } else {
                m.store(&mut copies[1]);
                v.store(&mut copies[2]);
                p.store(&mut copies[3]);
                self.first[at..].copy_from_slice(&copies[1][..count]);
                self.second[at..].copy_from_slice(&copies[2][..count]);
                self.parameters[at..].copy_from_slice(&copies[3][..count]);
            }
            at += count;
        }
    }
}

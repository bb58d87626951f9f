//! Adam on flat lists, where a gradient of exactly zero can mean that a parameter is inactive.

use irradia_compute::adam::{AdamRule, AdamStep};
use irradia_compute::simd::{Kernel, Lanes, Mask, Simd};

/// One step on one list.
pub(crate) struct Adam<'a> {
    pub parameters: &'a mut [f32],
    pub gradients: &'a [f32],
    pub first: &'a mut [f32],
    pub second: &'a mut [f32],
    pub rate: f32,
    pub step: AdamStep,
    /// Parameters whose gradient is zero, such as table entries that no sample touched, keep their value and moments.
    pub sparse: bool,
}

impl Kernel for Adam<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let rule = AdamRule::new(simd, &self.step, self.rate);
        let zero = simd.splat(0.0);
        let n = self.parameters.len();
        let mut at = 0;
        while at < n {
            // A partial last vector goes through a copy.
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
            let [mut p, mut m, mut v] = rule.step(g, p_old, m_old, v_old);
            if self.sparse {
                m = m.select(on, m_old);
                v = v.select(on, v_old);
                p = p.select(on, p_old);
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

//! Spherical harmonics over a chunk of splats, plane by plane.
//!
//! The coefficients are 48 planes. Splat by splat, forward and backward would access about a hundred places in memory in turn,
//! more than caches and prefetchers follow: at 50,000 splats that was a quarter of a training step. Plane by plane, each is
//! read or written sequentially.

use super::sh::{MAX_COEFFICIENTS, basis, basis_vjp, direction, direction_vjp};
use crate::Splats;
use irradia_compute::simd::{Lanes, Simd};
use irradia_scene::sh::coefficients;

/// Splats per task of projection: a multiple of every vector length, and small enough for the buffers to stay in cache.
pub const CHUNK: usize = irradia_compute::adam::RUN_LEN;

/// The plane after `plane` from splat `first` on, to be prefetched while `plane` is read: a chunk reads more planes in turn than the
/// processor's prefetchers follow.
#[inline(always)]
fn next_plane(splats: &Splats, plane: usize, first: usize) -> &[f32] {
    &splats.sh.plane((plane + 1).min(splats.sh.count() - 1))[first..]
}

/// A chunk's harmonics.
pub(super) struct Harmonics {
    degree: u32,
    /// The basis at each splat's direction; after [`Harmonics::vjp`], its gradient.
    basis: [[f32; CHUNK]; MAX_COEFFICIENTS],
    /// Start indices of the vectors of splats evaluated.
    starts: [u16; CHUNK],
    count: usize,
}

impl Harmonics {
    /// With no vectors evaluated.
    #[inline(always)]
    pub fn new(degree: u32) -> Self {
        Self {
            degree,
            basis: [[0.0; CHUNK]; MAX_COEFFICIENTS],
            starts: [0; CHUNK],
            count: 0,
        }
    }

    /// Evaluates the basis for the vector of splats that starts at `at`, whose means are `mean`, seen from `center`.
    #[inline(always)]
    pub fn evaluate_basis<F: Lanes<Scalar = f32>>(&mut self, at: usize, mean: [F; 3], center: [F; 3]) {
        let (d, _) = direction(mean, center);
        let basis = basis(self.degree, d);
        for k in 0..coefficients(self.degree) {
            basis[k].store(&mut self.basis[k][at..]);
        }
        self.starts[self.count] = at as u16;
        self.count += 1;
    }

    /// Start indices of the vectors evaluated.
    #[inline(always)]
    pub fn starts(&self) -> impl Iterator<Item = usize> + use<> {
        let (starts, count) = (self.starts, self.count);
        (0..count).map(move |i| usize::from(starts[i]))
    }

    /// Colours of the vectors evaluated, clamped at 0 if `clamp`; `first` is the chunk's first splat.
    #[inline(always)]
    pub fn colors<S: Simd>(&self, simd: S, splats: &Splats, first: usize, clamp: bool) -> [[f32; CHUNK]; 3]
    where
        S::F: Lanes<Scalar = f32>,
    {
        let mut colors = [[0.5; CHUNK]; 3];
        for k in 0..coefficients(self.degree) {
            for c in 0..3 {
                let plane = &splats.sh.plane(3 * k + c)[first..];
                let next = next_plane(splats, 3 * k + c, first);
                for start in &self.starts[..self.count] {
                    let at = usize::from(*start);
                    simd.prefetch(&next[at]);
                    let color = simd
                        .load(&self.basis[k][at..])
                        .mul_add(simd.load(&plane[at..]), simd.load(&colors[c][at..]));
                    color.store(&mut colors[c][at..]);
                }
            }
        }
        for color in colors.iter_mut().filter(|_| clamp) {
            for start in &self.starts[..self.count] {
                let at = usize::from(*start);
                simd.load(&color[at..]).max(simd.splat(0.0)).store(&mut color[at..]);
            }
        }
        colors
    }

    /// Writes the gradients of the coefficients, given the colours' `v_colors`, into the planes `v_sh`, and keeps those of the basis.
    #[inline(always)]
    pub fn vjp<S: Simd>(
        &mut self,
        simd: S,
        splats: &Splats,
        first: usize,
        v_colors: &[[f32; CHUNK]; 3],
        v_sh: &mut [&mut [f32]],
    ) where
        S::F: Lanes<Scalar = f32>,
    {
        for k in 0..coefficients(self.degree) {
            for c in 0..3 {
                let v_plane = &mut v_sh[3 * k + c];
                for start in &self.starts[..self.count] {
                    let at = usize::from(*start);
                    let v = simd.load(&self.basis[k][at..]) * simd.load(&v_colors[c][at..]);
                    v.store(&mut v_plane[at..]);
                }
            }
            let v_basis = &mut self.basis[k];
            v_basis.fill(0.0);
            if k == 0 {
                continue; // The DC term does not depend on the direction.
            }
            for c in 0..3 {
                let plane = &splats.sh.plane(3 * k + c)[first..];
                let next = next_plane(splats, 3 * k + c, first);
                for start in &self.starts[..self.count] {
                    let at = usize::from(*start);
                    simd.prefetch(&next[at]);
                    let v = simd
                        .load(&plane[at..])
                        .mul_add(simd.load(&v_colors[c][at..]), simd.load(&v_basis[at..]));
                    v.store(&mut v_basis[at..]);
                }
            }
        }
    }

    /// The gradient of the means through the direction, after [`Harmonics::vjp`].
    #[inline(always)]
    pub fn v_mean<F: Lanes<Scalar = f32>>(&self, at: usize, mean: [F; 3], center: [F; 3]) -> [F; 3] {
        let (d, inverse) = direction(mean, center);
        let simd = d[0].simd();
        let mut v_basis = [simd.splat(0.0); MAX_COEFFICIENTS];
        for k in 1..coefficients(self.degree) {
            v_basis[k] = simd.load(&self.basis[k][at..]);
        }
        direction_vjp(d, inverse, basis_vjp(self.degree, d, &v_basis))
    }
}

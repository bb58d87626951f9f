//! Dense symmetric positive definite systems of a few thousand unknowns.

use irradia_compute::simd::{Kernel, Lanes, Level, Simd};
use rayon::prelude::*;

/// Rows factorised before the rest of the matrix is updated: a panel stays in the second-level cache.
const PANEL_ROWS: usize = 32;

/// A symmetric matrix whose upper triangle is stored, row by row.
#[derive(Clone, Debug, Default)]
pub struct Symmetric {
    /// Number of rows and columns.
    pub n: usize,
    /// `[n, n]`; below the diagonal the values are unspecified.
    pub values: Vec<f64>,
}

impl Symmetric {
    /// Zeros.
    pub fn zeros(n: usize) -> Self {
        Self {
            n,
            values: vec![0.0; n * n],
        }
    }

    /// Factorises in place as `u^T u` and solves for `b` in place; `false` if the matrix is not positive definite.
    ///
    /// Zeros left of the first nonzero of a column stay zero and cost nothing, as in the banded systems of films.
    pub fn solve(&mut self, b: &mut [f64]) -> bool {
        let n = self.n;
        for first in (0..n).step_by(PANEL_ROWS) {
            let last = (first + PANEL_ROWS).min(n);
            let (panel, below) = self.values[first * n..].split_at_mut((last - first) * n);
            for k in 0..last - first {
                let (before, row) = panel.split_at_mut(k * n);
                let row = &mut row[..n];
                for (j, upper) in before.chunks_exact(n).enumerate() {
                    debug_assert!(j < k);
                    subtract(upper[first + k], &upper[first + k..], &mut row[first + k..]);
                }
                let pivot = row[first + k];
                if pivot.is_nan() || pivot <= 0.0 {
                    return false;
                }
                let inverse = 1.0 / pivot.sqrt();
                row[first + k..].iter_mut().for_each(|x| *x *= inverse);
            }
            let panel = &*panel;
            below.par_chunks_mut(n).enumerate().for_each(|(i, row)| {
                Level::detect().run(Update {
                    panel,
                    n,
                    column: last + i,
                    row,
                });
            });
        }
        for i in 0..n {
            b[i] /= self.values[i * n + i];
            let (head, tail) = b.split_at_mut(i + 1);
            subtract(head[i], &self.values[i * n + i + 1..(i + 1) * n], tail);
        }
        for i in (0..n).rev() {
            let row = &self.values[i * n..(i + 1) * n];
            let sum: f64 = row[i + 1..].iter().zip(&b[i + 1..]).map(|(u, x)| u * x).sum();
            b[i] = (b[i] - sum) / row[i];
        }
        true
    }

    /// `y = self x`, each row's sum in a fixed order.
    pub fn multiply(&self, x: &[f64], y: &mut [f64]) {
        let n = self.n;
        y.iter_mut().for_each(|y| *y = 0.0);
        for i in 0..n {
            let row = &self.values[i * n + i..(i + 1) * n];
            let mut sums = [0.0; 4];
            let x_i = x[i];
            let (xs, ys) = (&x[i..], &mut y[i..]);
            let mut chunks = row.chunks_exact(4).zip(xs.chunks_exact(4));
            for (row, x) in &mut chunks {
                for k in 0..4 {
                    sums[k] += row[k] * x[k];
                }
            }
            let whole = row.len() / 4 * 4;
            for k in whole..row.len() {
                sums[0] += row[k] * xs[k];
            }
            for (y, value) in ys.iter_mut().zip(row).skip(1) {
                *y += value * x_i;
            }
            ys[0] += (sums[0] + sums[1]) + (sums[2] + sums[3]);
        }
    }
}

#[inline(always)]
fn subtract(factor: f64, from: &[f64], to: &mut [f64]) {
    if factor != 0.0 {
        for (to, from) in to.iter_mut().zip(from) {
            *to -= factor * from;
        }
    }
}

/// Subtracts a panel's rows, weighted by their values at `column`, from one row right of `column`.
struct Update<'a> {
    panel: &'a [f64],
    n: usize,
    column: usize,
    row: &'a mut [f64],
}

impl Kernel for Update<'_> {
    type Output = ();

    // Plain f64 code: inside a kernel it is compiled for the widest instruction set, which is twice as fast.
    #[inline(always)]
    fn run<S: Simd>(self, _: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let Self { panel, n, column, row } = self;
        let to = &mut row[column..n];
        let rows = panel.len() / n;
        let mut k = 0;
        while k + 4 <= rows {
            let at = |i: usize| &panel[(k + i) * n + column..(k + i + 1) * n];
            let (a, b, c, d) = (at(0), at(1), at(2), at(3));
            let (fa, fb, fc, fd) = (a[0], b[0], c[0], d[0]);
            k += 4;
            if fa == 0.0 && fb == 0.0 && fc == 0.0 && fd == 0.0 {
                continue;
            }
            for ((((to, a), b), c), d) in to.iter_mut().zip(a).zip(b).zip(c).zip(d) {
                *to -= (fa * a + fb * b) + (fc * c + fd * d);
            }
        }
        for k in k..rows {
            let from = &panel[k * n + column..(k + 1) * n];
            subtract(from[0], from, to);
        }
    }
}

/// Solves `a x = b` by conjugate gradients, preconditioned by the diagonal blocks `blocks` (first row, size); `x` starts at zero.
///
/// Stops at a residual norm of `tolerance` times the norm of `b`, or after `iterations`. `None` if a matrix is not positive definite.
pub fn conjugate_gradients(
    a: &Symmetric,
    b: &[f64],
    blocks: &[(usize, usize)],
    tolerance: f64,
    iterations: usize,
) -> Option<Vec<f64>> {
    let factors: Vec<Symmetric> = blocks
        .iter()
        .map(|&(first, size)| {
            let mut block = Symmetric::zeros(size);
            for i in 0..size {
                for j in i..size {
                    block.values[i * size + j] = a.values[(first + i) * a.n + first + j];
                }
            }
            block
        })
        .collect();
    let precondition = |r: &[f64]| {
        let mut z = r.to_vec();
        for (&(first, size), block) in blocks.iter().zip(&factors) {
            if !block.clone().solve(&mut z[first..first + size]) {
                return None;
            }
        }
        Some(z)
    };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut x = vec![0.0; a.n];
    let mut r = b.to_vec();
    let mut z = precondition(&r)?;
    let mut p = z.clone();
    let mut ap = vec![0.0; a.n];
    let mut rz = dot(&r, &z);
    let goal = tolerance * tolerance * dot(b, b);
    for _ in 0..iterations {
        if dot(&r, &r) <= goal {
            break;
        }
        a.multiply(&p, &mut ap);
        let curvature = dot(&p, &ap);
        if curvature.is_nan() || curvature <= 0.0 {
            return None;
        }
        let alpha = rz / curvature;
        for i in 0..a.n {
            x[i] += alpha * p[i];
            r[i] -= alpha * ap[i];
        }
        z = precondition(&r)?;
        let next = dot(&r, &z);
        let beta = next / rz;
        rz = next;
        for i in 0..a.n {
            p[i] = z[i] + beta * p[i];
        }
    }
    Some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    /// A random positive definite matrix, and its product with 1, 2, 3, ..
    fn system(n: usize) -> (Symmetric, Vec<f64>) {
        let mut rng = Rng::new(n as u64, 0);
        let b: Vec<f64> = (0..n * n).map(|_| f64::from(rng.normal())).collect();
        let mut a = Symmetric::zeros(n);
        for i in 0..n {
            for j in i..n {
                a.values[i * n + j] = (0..n).map(|k| b[i * n + k] * b[j * n + k]).sum::<f64>() / n as f64;
            }
            a.values[i * n + i] += 0.5;
            // The lower triangle is never read.
            for j in 0..i {
                a.values[i * n + j] = f64::NAN;
            }
        }
        let x: Vec<f64> = (1..=n).map(|i| i as f64).collect();
        let mut y = vec![0.0; n];
        a.multiply(&x, &mut y);
        (a, y)
    }

    #[test]
    fn both_solvers_invert_the_product() {
        for n in [1, 5, 32, 33, 150] {
            let (a, b) = system(n);
            let blocks: Vec<(usize, usize)> = (0..n).step_by(6).map(|i| (i, 6.min(n - i))).collect();
            let iterated = conjugate_gradients(&a, &b, &blocks, 1e-12, 10 * n).expect("positive definite");
            let mut direct = b.clone();
            assert!(a.clone().solve(&mut direct));
            for i in 0..n {
                let want = (i + 1) as f64;
                assert!((direct[i] - want).abs() < 1e-9 * n as f64, "{n} {i} {}", direct[i]);
                assert!((iterated[i] - want).abs() < 1e-7 * n as f64, "{n} {i} {}", iterated[i]);
            }
        }
    }

    #[test]
    fn an_indefinite_matrix_is_refused() {
        let mut a = Symmetric {
            n: 2,
            values: vec![1.0, 2.0, 0.0, 1.0],
        };
        assert!(conjugate_gradients(&a, &[1.0, -1.0], &[(0, 1), (1, 1)], 1e-9, 9).is_none());
        assert!(!a.solve(&mut [1.0, 1.0]));
    }
}

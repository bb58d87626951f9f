//! The gradient of a layer's weights and bias: outer products summed over all samples.
//!
//! The sums run over samples, which lie in the lanes. The outputs' gradients are therefore transposed first, a strip of outputs
//! at a time, with the output in the lane: one shuffle for four values, each of which is then used with all inputs. Tiles with
//! the sample in the lane need no transpose, but sums across lanes at the end and twice the loads: with them the whole backward
//! pass reached half of peak FMA throughput on AVX-512; this way it reaches 60 to 75 %, depending on width.

use super::{PANEL, TILE_ROWS};
use crate::{Num, Rows};
use irradia_compute::simd::{Lanes, Simd};

/// Panels at a time: a strip of 32 outputs is then 16 KiB and stays in the L1 cache while all inputs use it (a tenth faster at
/// width 32 than all panels at a time, equal from 128 on).
const PANELS_PER_BLOCK: usize = 4;

/// Adds to a layer's gradient `to`, weights `[inputs, outputs]` and bias: `to[i][o] += sum over samples of x[i][s] v[o][s]`.
///
/// Arrays come with their rows per panel, the inputs in up to two parts. `strip` is scratch.
#[inline(always)]
pub(super) fn outer<S: Simd>(
    simd: S,
    x: [(&[Num<S>], usize); 2],
    (v, outputs): (&[Num<S>], usize),
    strip: &mut Rows<Num<S>>,
    to: &mut [Num<S>],
) {
    let panels = v.len() / (outputs * PANEL);
    for begin in (0..panels).step_by(PANELS_PER_BLOCK) {
        let end = panels.min(begin + PANELS_PER_BLOCK);
        let part = |rows: usize| begin * rows * PANEL..end * rows * PANEL;
        let x = [(&x[0].0[part(x[0].1)], x[0].1), (&x[1].0[part(x[1].1)], x[1].1)];
        let v = &v[part(outputs)];
        let mut first = 0;
        while first < outputs {
            if outputs - first > S::LANES {
                columns::<S, 2>(simd, x, v, first, outputs, strip, to);
                first += 2 * S::LANES;
            } else {
                columns::<S, 1>(simd, x, v, first, outputs, strip, to);
                first += S::LANES;
            }
        }
    }
}

/// The columns of `to` for `V` vectors of outputs from `first` on.
#[inline(always)]
fn columns<S: Simd, const V: usize>(
    simd: S,
    x: [(&[Num<S>], usize); 2],
    v: &[Num<S>],
    first: usize,
    outputs: usize,
    strip: &mut Rows<Num<S>>,
    to: &mut [Num<S>],
) {
    let wide = V * S::LANES;
    strip.resize(v.len() / outputs * wide, Default::default());
    for (p, strip) in strip.chunks_exact_mut(PANEL * wide).enumerate() {
        let v = &v[(p * outputs + first) * PANEL..];
        for s in (0..PANEL).step_by(S::LANES) {
            for k in (0..wide).step_by(S::LANES) {
                let (from, to) = (&v[k * PANEL + s..], &mut strip[s * wide + k..]);
                // Rows beyond the outputs land in lanes that are never added. Behind the last panel there are none: a zero-padded copy
                // is transposed instead.
                if from.len() >= (S::LANES - 1) * PANEL + S::LANES {
                    simd.transpose(from, PANEL, to, wide);
                } else {
                    let mut square = [Default::default(); 16 * 16];
                    for (row, from) in square.chunks_exact_mut(16).zip(from.chunks(PANEL)) {
                        row[..S::LANES].copy_from_slice(&from[..S::LANES]);
                    }
                    simd.transpose(&square, 16, to, wide);
                }
            }
        }
    }
    let strip = &strip[..];
    let mut rows = to.chunks_exact_mut(outputs);
    for (x, inputs) in x {
        let x = x.as_chunks::<PANEL>().0;
        for i in (0..inputs).step_by(TILE_ROWS) {
            // Eight rows per tile keep 16 accumulators of 16 lanes in registers; with fewer registers, four.
            if S::LANES == 16 {
                let sums = tile::<S, 8, V>(simd, x, i, inputs, strip);
                for sums in &sums {
                    add(simd, sums, &mut rows.next().expect("one row per input")[first..]);
                }
            } else {
                for i in [i, i + 4] {
                    let sums = tile::<S, 4, V>(simd, x, i, inputs, strip);
                    for sums in &sums {
                        add(simd, sums, &mut rows.next().expect("one row per input")[first..]);
                    }
                }
            }
        }
    }
    // Four sums at a time hide the latency of an addition.
    let mut sums = [[simd.splat(0.0); V]; 4];
    for four in strip.chunks_exact(4 * wide) {
        for k in 0..4 {
            for v in 0..V {
                sums[k][v] += simd.load(&four[k * wide + v * S::LANES..]);
            }
        }
    }
    let mut sum = sums[0];
    for v in 0..V {
        sum[v] = (sums[0][v] + sums[1][v]) + (sums[2][v] + sums[3][v]);
    }
    add(simd, &sum, &mut rows.next().expect("the bias comes last")[first..]);
}

/// Products of `I` inputs from `i` on with a strip of outputs, summed over all samples.
#[inline(always)]
fn tile<S: Simd, const I: usize, const V: usize>(
    simd: S,
    x: &[[Num<S>; PANEL]],
    i: usize,
    inputs: usize,
    strip: &[Num<S>],
) -> [[S::F; V]; I] {
    let mut sums = [[simd.splat(0.0); V]; I];
    let mut row = i;
    for strip in strip.chunks_exact(PANEL * V * S::LANES) {
        let x: &[[Num<S>; PANEL]; I] = x[row..].first_chunk().expect("a tile");
        row += inputs;
        for (four, strip) in strip.chunks_exact(4 * V * S::LANES).enumerate().take(PANEL / 4) {
            for s in 0..4 {
                let mut vs = [simd.splat(0.0); V];
                for v in 0..V {
                    vs[v] = simd.load(&strip[(s * V + v) * S::LANES..]);
                }
                for j in 0..I {
                    let x = simd.set(x[j][4 * four + s]);
                    for v in 0..V {
                        sums[j][v] = x.mul_add(vs[v], sums[j][v]);
                    }
                }
            }
        }
    }
    sums
}

/// Adds sums to the front of a row that may be shorter.
#[inline(always)]
fn add<S: Simd, const V: usize>(simd: S, sums: &[S::F; V], row: &mut [Num<S>]) {
    for (v, to) in row.chunks_mut(S::LANES).enumerate().take(V) {
        if to.len() == S::LANES {
            (simd.load(to) + sums[v]).store(to);
        } else {
            let mut values = [Num::<S>::default(); 16];
            sums[v].store(&mut values);
            for (to, value) in to.iter_mut().zip(values) {
                *to = *to + value;
            }
        }
    }
}

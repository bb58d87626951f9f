//! A layer's product over one panel of samples, as register tiles.
//!
//! Weights come in tiles of 8 outputs, `[outputs / 8, inputs, 8]`: a register tile then reads them contiguously. In
//! the layout of the parameters, with rows a layer's width apart, a width of 256 maps all rows of a tile to four sets of the L1
//! cache.

use super::{PANEL, TILE_ROWS};
use crate::{Num, Rows};
use irradia_compute::simd::{Lanes, Scalar, Simd};

/// Initial value of the sums.
#[derive(Clone, Copy)]
pub(super) enum Begin<'a, T> {
    Zero,
    Bias(&'a [T]),
    /// The current value of the output.
    Add,
}

/// Final operation on the sums.
#[derive(Clone, Copy)]
pub(super) enum Finish<'a, T> {
    Keep,
    Relu,
    /// Zero where this is not positive: the VJP of the ReLU.
    Mask(&'a [T]),
}

/// Packs weights `[inputs, outputs]` into tiles `[outputs / 8, inputs, 8]`.
#[inline(always)]
pub(super) fn pack<T: Scalar>(weights: &[T], outputs: usize, to: &mut Rows<T>) {
    to.resize(weights.len(), T::default());
    let inputs = weights.len() / outputs;
    let tiles = to.as_chunks_mut::<TILE_ROWS>().0;
    for (i, row) in weights.chunks_exact(outputs).enumerate() {
        for (o, w) in row.as_chunks::<TILE_ROWS>().0.iter().enumerate() {
            tiles[o * inputs + i] = *w;
        }
    }
}

/// `to[o][s] = begin + sum over i of w[i][o] x[i][s]` for one panel; `w` in tiles, the inputs in up to two parts.
#[inline(always)]
pub(super) fn product<S: Simd>(
    simd: S,
    w: &[Num<S>],
    x: [&[Num<S>]; 2],
    begin: Begin<Num<S>>,
    finish: Finish<Num<S>>,
    to: &mut [Num<S>],
) {
    // Enough accumulators to hide the latency of two FMA units while leaving registers for the operands.
    match S::LANES {
        16 => tiles::<S, 8, 2>(simd, w, x, begin, finish, to),
        4 | 8 => tiles::<S, 4, 2>(simd, w, x, begin, finish, to),
        _ => tiles::<S, 4, 1>(simd, w, x, begin, finish, to),
    }
}

/// Tiles of `O` outputs, a divisor of 8, by `V` vectors of samples.
#[inline(always)]
fn tiles<S: Simd, const O: usize, const V: usize>(
    simd: S,
    w: &[Num<S>],
    x: [&[Num<S>]; 2],
    begin: Begin<Num<S>>,
    finish: Finish<Num<S>>,
    to: &mut [Num<S>],
) {
    let (first, again) = (x[0].as_chunks::<PANEL>().0, x[1].as_chunks::<PANEL>().0);
    let (w, to) = (w.as_chunks::<TILE_ROWS>().0, to.as_chunks_mut::<PANEL>().0);
    let zero = simd.splat(0.0);
    let tiles = w.chunks_exact(first.len() + again.len());
    for (tile, (w, to)) in tiles.zip(to.as_chunks_mut::<TILE_ROWS>().0).enumerate() {
        let (w_first, w_again) = w.split_at(first.len());
        for o in (0..TILE_ROWS).step_by(O) {
            let row = tile * TILE_ROWS + o;
            for s in (0..PANEL).step_by(V * S::LANES) {
                let mut sums = [[zero; V]; O];
                match begin {
                    Begin::Zero => {}
                    Begin::Bias(bias) => {
                        for k in 0..O {
                            sums[k] = [simd.set(bias[row + k]); V];
                        }
                    }
                    Begin::Add => {
                        for k in 0..O {
                            for v in 0..V {
                                sums[k][v] = simd.load(&to[o + k][s + v * S::LANES..]);
                            }
                        }
                    }
                }
                for (w, x) in [(w_first, first), (w_again, again)] {
                    // Four inputs per iteration (there are always eight or more) amortise the loop.
                    for (w, x) in w.as_chunks::<4>().0.iter().zip(x.as_chunks::<4>().0) {
                        for i in 0..4 {
                            let mut xs = [zero; V];
                            for v in 0..V {
                                xs[v] = simd.load(&x[i][s + v * S::LANES..]);
                            }
                            for k in 0..O {
                                let w = simd.set(w[i][o + k]);
                                for v in 0..V {
                                    sums[k][v] = w.mul_add(xs[v], sums[k][v]);
                                }
                            }
                        }
                    }
                }
                for k in 0..O {
                    for v in 0..V {
                        let at = s + v * S::LANES;
                        let sum = match finish {
                            Finish::Keep => sums[k][v],
                            Finish::Relu => sums[k][v].max(zero),
                            Finish::Mask(mask) => {
                                let mask = simd.load(&mask[(row + k) * PANEL + at..]);
                                sums[k][v].masked(zero.lt(mask))
                            }
                        };
                        sum.store(&mut to[o + k][at..]);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_hold_eight_adjacent_outputs_of_every_input() {
        let (inputs, outputs) = (16, 24);
        let weights: Vec<f32> = (0..inputs * outputs).map(|n| n as f32).collect();
        let mut tiles = Rows::default();
        pack(&weights, outputs, &mut tiles);
        for (i, o) in (0..inputs).flat_map(|i| (0..outputs).map(move |o| (i, o))) {
            let at = (o / TILE_ROWS * inputs + i) * TILE_ROWS + o % TILE_ROWS;
            assert_eq!(tiles[at], weights[i * outputs + o], "input {i}, output {o}");
        }
    }
}

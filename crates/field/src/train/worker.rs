//! Forward pass, losses and backward pass of one group of a batch's rays.

use super::{GROUPS, StepLoss, StepOptions, max_samples};
use crate::background::background_vjp;
use crate::batch::RayBatch;
use crate::config::Sampler;
use crate::encoding::PositionEncoding;
use crate::field::Field;
use crate::net::{Block, Net, NetParameters, get3, set3};
use crate::pass::{Pass, trace};
use crate::render::quadrature::weights_vjp;
use crate::sample::proposal::{distortion, interlevel};
use irradia_compute::Level;
use irradia_compute::simd::{Kernel, Lanes, Simd};
use irradia_scene::Rng;

/// One group's sums and buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct Worker {
    passes: Vec<Pass>,
    /// Points that do not lie on rays.
    pub(super) block: Block<f32>,
    pub grads: Vec<NetParameters<f32>>,
    pub codes: Vec<f32>,
    pub background: Vec<f32>,
    /// For each network, the points and the gradients of their encodings, panel by panel.
    pub stored: Vec<[Vec<f32>; 2]>,
    v_weights: Vec<f32>,
    v_optical_depth: Vec<f32>,
    pub loss: StepLoss,
}

/// Shared inputs of [`Worker::rays`].
pub(super) struct Task<'a> {
    pub level: Level,
    pub field: &'a Field,
    pub transposed: &'a [NetParameters<f32>],
    pub batch: &'a RayBatch,
    pub options: &'a StepOptions,
    /// Weight of one ray's squared error of distance in the sum over all.
    pub depth: f32,
}

/// The colour error of a ray.
struct Score {
    /// Mean squared error.
    squares: f32,
    /// Background of the ray.
    background: [f32; 3],
    /// The gradient of the batch's mean with respect to the colour.
    v_color: [f32; 3],
}

impl Task<'_> {
    /// Compares ray `ray`, composited to `color` with `transmittance`, to its target; adds to the gradient of the learnt background.
    fn score(&self, ray: usize, color: [f32; 3], transmittance: f32, v_background: &mut [f32]) -> Score {
        let batch = self.batch;
        let ray_weight = 1.0 / batch.rays.len() as f32;
        let view = batch.rays[ray].view;
        let learnt = if batch.opaque[ray] {
            self.field.background_toward(view)
        } else {
            None
        };
        let background = learnt.unwrap_or(batch.backgrounds[ray]);
        let error: [f32; 3] = std::array::from_fn(|c| color[c] + transmittance * background[c] - batch.targets[ray][c]);
        let v_color = error.map(|e| 2.0 / 3.0 * e * ray_weight);
        if learnt.is_some() {
            background_vjp(background, view, v_color.map(|v| v * transmittance), v_background);
        }
        Score {
            squares: error.iter().map(|e| e * e / 3.0).sum(),
            background,
            v_color,
        }
    }
}

impl Worker {
    /// Resets all sums to zero.
    pub fn clear(&mut self, field: &Field) {
        self.loss = StepLoss::default();
        self.stored.resize_with(field.nets.len(), Default::default);
        self.stored.iter_mut().flatten().for_each(Vec::clear);
        self.codes.clear();
        self.codes.resize(field.codes.len(), 0.0);
        self.background.clear();
        self.background.resize(field.background.len(), 0.0);
        if self.grads.len() == field.nets.len() {
            for grads in &mut self.grads {
                grads.density.fill(0.0);
                grads.color.fill(0.0);
            }
        } else {
            self.grads = field.parameters.iter().map(NetParameters::without_table).collect();
        }
    }

    /// Forward and backward over the rays `range` of the batch, until the group has its share of the samples that a batch may have.
    pub fn rays(&mut self, task: &Task, mut range: std::ops::Range<usize>, rng: &mut Rng) {
        let field = task.field;
        self.clear(field);
        while !range.is_empty() && self.loss.samples <= max_samples(task.options) / GROUPS {
            let rays = &task.batch.rays[range.clone()];
            let images = &task.batch.images[range.clone()];
            let taken = trace(task.level, field, rays, images, Some(rng), &mut self.passes);
            for net in 0..field.nets.len() {
                self.backward(task, net, range.start..range.start + taken);
            }
            range.start += taken;
            self.loss.rays += taken;
        }
    }

    /// Losses of one network's pass over the rays `range`, and its backward pass.
    fn backward(&mut self, task: &Task, net: usize, range: std::ops::Range<usize>) {
        let (field, batch) = (task.field, task.batch);
        let last = net + 1 == field.nets.len();
        let with_color = field.nets[net].shape.color.is_some();
        let (earlier, later) = self.passes.split_at_mut(net + 1);
        let pass = &mut earlier[net];
        let n = pass.block.len;
        if n == 0 {
            if with_color {
                self.score_empty(task, range, last);
            }
            return;
        }
        let ray_weight = 1.0 / batch.rays.len() as f32;
        self.v_weights.clear();
        self.v_weights.resize(n, 0.0);
        let v_weights = &mut self.v_weights;
        let padded = pass.block.panels() * crate::mlp::PANEL;
        self.v_optical_depth.clear();
        self.v_optical_depth.resize(padded, 0.0);
        pass.block.v_rgb.clear();
        pass.block.v_rgb.resize(3 * padded, 0.0);
        for (r, ray) in range.clone().enumerate() {
            let samples = pass.samples_of(r);
            if with_color {
                let Score {
                    squares,
                    background,
                    v_color,
                } = task.score(ray, pass.composite(r).0, pass.transmittance[r], &mut self.background);
                for i in samples.clone() {
                    let rgb = get3(&pass.block.rgb, i);
                    v_weights[i] = (0..3).map(|c| v_color[c] * (rgb[c] - background[c])).sum();
                    set3(&mut pass.block.v_rgb, i, v_color.map(|v| v * pass.weights[i]));
                }
                let known = batch.depths.get(ray).copied().unwrap_or(0.0);
                if known > 0.0 && task.depth > 0.0 {
                    // The mean over the weights, without the transmitted part of the ray.
                    let beyond = |i: usize| field.space.spread(pass.middles[i]) - field.space.spread(known);
                    let error: f32 = samples.clone().map(|i| pass.weights[i] * beyond(i)).sum();
                    for i in samples.clone() {
                        v_weights[i] += 2.0 * task.depth * error * beyond(i);
                    }
                    self.loss.total += f64::from(task.depth * error * error / ray_weight);
                }
                self.loss.color += if last { f64::from(squares) } else { 0.0 };
                self.loss.total += f64::from(squares);
            }
            let Sampler::Proposal { rounds, last: count } = &field.config.sampler else {
                continue;
            };
            let count_of = |net: usize| rounds.get(net).map_or(*count, |(_, n)| *n);
            let edges = &pass.edges[r * (count_of(net) + 1)..][..samples.len() + 1];
            if last && task.options.distortion > 0.0 {
                let scale = task.options.distortion * ray_weight;
                let v = &mut v_weights[samples.clone()];
                let loss = distortion(edges, &pass.weights[samples.clone()], scale, v);
                self.loss.total += f64::from(loss / ray_weight);
            }
            if let (false, Some(fine)) = (last, later.last()) {
                let of = fine.samples_of(r);
                let stride = count_of(field.nets.len() - 1) + 1;
                let fine_edges = &fine.edges[r * stride..][..of.len() + 1];
                let scale = task.options.interlevel * ray_weight;
                let v = &mut v_weights[samples.clone()];
                let bound = &pass.weights[samples.clone()];
                let loss = interlevel(fine_edges, &fine.weights[of], edges, bound, scale, v);
                self.loss.total += f64::from(loss / ray_weight);
            }
        }
        if with_color {
            self.loss.samples += n;
        }
        for r in 0..range.len() {
            let samples = pass.samples_of(r);
            let (interval_transmittances, weights) = (
                &pass.interval_transmittances[samples.clone()],
                &pass.weights[samples.clone()],
            );
            let counted = samples.len();
            let v = &mut self.v_optical_depth[samples.clone()];
            weights_vjp(interval_transmittances, weights, &v_weights[samples], counted, v);
        }
        pass.block.v_density.resize(padded, 0.0);
        let lengths = pass.lengths.iter().chain(std::iter::repeat(&0.0));
        let optical_depths = self.v_optical_depth.iter().zip(lengths);
        for (to, (v, length)) in pass.block.v_density.iter_mut().zip(optical_depths) {
            *to = v * length;
        }
        task.level.run(Backward {
            net: &field.nets[net],
            transposed: &task.transposed[net],
            block: &mut pass.block,
            grads: &mut self.grads[net],
            with_color,
        });
        let size = if with_color { field.config.appearance() } else { 0 };
        for (r, ray) in range.enumerate() {
            for i in pass.samples_of(r) {
                for k in 0..size {
                    let at = batch.images[ray] as usize * size + k;
                    if let Some(to) = self.codes.get_mut(at) {
                        *to += field.nets[net].code_gradient(&pass.block, i, k);
                    }
                }
            }
        }
        if let PositionEncoding::HashGrid(_) = field.nets[net].shape.encoding {
            self.stored[net][0].extend_from_slice(&pass.block.points);
            self.stored[net][1].extend_from_slice(&pass.block.v_encoded);
        }
    }

    /// The loss of rays without samples.
    fn score_empty(&mut self, task: &Task, range: std::ops::Range<usize>, last: bool) {
        for ray in range {
            let squares = task.score(ray, [0.0; 3], 1.0, &mut self.background).squares;
            self.loss.color += if last { f64::from(squares) } else { 0.0 };
            self.loss.total += f64::from(squares);
        }
    }
}

pub(super) struct Backward<'a> {
    pub net: &'a Net,
    pub transposed: &'a NetParameters<f32>,
    pub block: &'a mut Block<f32>,
    pub grads: &'a mut NetParameters<f32>,
    pub with_color: bool,
}

impl Kernel for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        self.net
            .backward(simd, self.transposed, self.block, self.grads, self.with_color);
    }
}

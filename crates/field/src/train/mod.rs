//! One training step.
//!
//! The rays of a batch are split into a fixed number of groups, independent of the number of threads. A group processes its
//! chunks in order and keeps its own sums of the networks' gradients, which are then added in group order. The tables'
//! gradients are scattered afterwards, each level by one task that visits all samples in order: no locks, no atomics, and the
//! same bits for any number of threads.

use crate::batch::{Background, Draw, RayBatch, TrainView};
use crate::field::Field;
use crate::query::update_occupancy;
use crate::state::FieldState;
use irradia_compute::Level;
use irradia_compute::adam::AdamStep;
use irradia_scene::Rng;
use rayon::prelude::*;
use worker::{Task, Worker};

mod residual;
mod update;
mod worker;

pub use residual::{ResidualQuery, residual_at, train_residual};

/// Number of groups per batch, which limits how many threads can work at once.
const GROUPS: usize = 32;
/// Random streams of a step, in addition to those of the groups.
const STREAM_RAYS: u64 = 0xfe;
pub(crate) const STREAM_OCCUPANCY: u64 = 0xff;

/// Options of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepOptions {
    /// Learning rate of tables; 0.01 in Instant-NGP.
    pub table_rate: f32,
    /// Learning rate of networks and of the background; 0.01 in Instant-NGP, 0.0005 in NeRF.
    pub net_rate: f32,
    /// Learning rate of appearance codes.
    pub code_rate: f32,
    /// Decay of Adam's second moment; 0.99 in Instant-NGP, 0.999 in NeRF.
    pub beta2: f32,
    /// Weight of the interlevel loss; 1 in mip-NeRF 360.
    pub interlevel: f32,
    /// Weight of the distortion loss; 0.01 in mip-NeRF 360.
    pub distortion: f32,
    /// Weight of the mean squared error of distance, over the rays of known distance, in the measure in which samples
    /// are spread ([`crate::Space::spread`]): field units, and disparity in the far part of a contracted world.
    pub depth: f32,
    /// Background behind photographs; for those without alpha, a background learnt by the field takes precedence.
    pub background: Background,
    /// Target number of samples per batch, by which [`train_views`] sets the number of rays; 2^18 in Instant-NGP.
    pub samples: usize,
    /// Whether [`train_views`] updates the occupancy grid after the step; every 16th step in Instant-NGP.
    pub update_occupancy: bool,
    /// Random seed; random numbers depend on it and the number of the step.
    pub seed: u64,
}

impl Default for StepOptions {
    fn default() -> Self {
        Self {
            table_rate: 1e-2,
            net_rate: 1e-2,
            code_rate: 1e-3,
            beta2: 0.99,
            interlevel: 1.0,
            distortion: 0.0,
            depth: 0.0,
            background: Background::Random,
            samples: 1 << 16,
            update_occupancy: true,
            seed: 0,
        }
    }
}

/// Losses of a step, means over its rays.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepLoss {
    /// Mean squared error of the last network's colour.
    pub color: f64,
    /// Weighted sum of all losses.
    pub total: f64,
    /// Rays in the batch, without those left out since they had too many samples together.
    pub rays: usize,
    /// Samples whose colour was computed, over all networks; determines the size of the next batch.
    pub samples: usize,
}

/// Buffers of a step.
#[derive(Clone, Debug, Default)]
pub(crate) struct Scratch {
    workers: Vec<Worker>,
    /// Gradients of the tables, zero between steps.
    tables: Vec<Vec<f32>>,
    /// The batch of [`train_views`].
    pub(crate) batch: RayBatch,
}

/// One in this many empty cells is updated.
pub(crate) const EMPTY_CELL_DIVISOR: u32 = 16;
/// Samples of a batch, in units of those wanted, above which its last rays are left out, so that memory is bounded. The number of rays
/// follows the number of samples only gradually, and a new part of the scene may yield many more.
const MAX_EXCESS: usize = 4;
/// Bounds of the number of rays in a batch.
const MIN_RAYS: usize = 64;
pub(crate) const MAX_RAYS: usize = 16_384;
/// One in this many rays passes through a pixel of known depth if the depth loss is on.
const KNOWN_DEPTH_DIVISOR: usize = 4;

/// One step on photographs: samples [`FieldState::rays`] rays, trains on them, updates the occupancy grid, and sets the number of
/// rays of the next batch to yield about `options.samples` samples.
pub fn train_views(state: &mut FieldState, views: &[TrainView], options: &StepOptions) -> StepLoss {
    let batch = draw(state, views, options);
    let loss = train_step(state, &batch, options);
    state.scratch.batch = batch;
    if updates_occupancy(&loss, options) {
        update_occupancy(state, false, EMPTY_CELL_DIVISOR, options.seed);
    }
    set_rays(state, &loss, options);
    loss
}

/// The batch of the next step.
pub(crate) fn draw(state: &mut FieldState, views: &[TrainView], options: &StepOptions) -> RayBatch {
    let mut batch = std::mem::take(&mut state.scratch.batch);
    let mut rng = Rng::new(options.seed, (state.step << 8) + STREAM_RAYS);
    let what = Draw {
        rays: state.rays,
        known: if options.depth > 0.0 {
            state.rays / KNOWN_DEPTH_DIVISOR
        } else {
            0
        },
        background: options.background,
    };
    batch.draw(views, &what, &state.field.space, &mut rng);
    batch
}

pub(crate) fn updates_occupancy(loss: &StepLoss, options: &StepOptions) -> bool {
    options.update_occupancy && loss.rays > 0
}

/// Number of samples that a batch may have.
pub(crate) fn max_samples(options: &StepOptions) -> usize {
    options.samples.saturating_mul(MAX_EXCESS)
}

/// Sets the number of rays of the next batch.
pub(crate) fn set_rays(state: &mut FieldState, loss: &StepLoss, options: &StepOptions) {
    let wanted = options.samples as f64 * loss.rays as f64 / loss.samples.max(1) as f64;
    state.rays = ((0.8 * state.rays as f64 + 0.2 * wanted) as usize).clamp(MIN_RAYS, MAX_RAYS);
}

/// Takes one step on `batch`.
pub fn train_step(state: &mut FieldState, batch: &RayBatch, options: &StepOptions) -> StepLoss {
    descend(state, options, |level, field, step, workers| {
        gradients(level, field, batch, options, step, workers)
    })
}

/// Takes one step of Adam with the gradients that `fill` leaves in the workers, given the number of the step. Returns its loss.
fn descend(
    state: &mut FieldState,
    options: &StepOptions,
    fill: impl FnOnce(Level, &Field, u64, &mut [Worker]) -> StepLoss,
) -> StepLoss {
    let level = Level::detect();
    state.step += 1;
    let mut scratch = std::mem::take(&mut state.scratch);
    scratch.workers.resize_with(GROUPS, Worker::default);
    let loss = fill(level, &state.field, state.step, &mut scratch.workers);
    let step = adam_step(options, state.step);
    update::update(level, state, &mut scratch, options, step);
    state.scratch = scratch;
    loss
}

/// Weight of one ray's squared error of distance.
pub(crate) fn depth_weight(batch: &RayBatch, options: &StepOptions) -> f32 {
    let known = batch.depths.iter().filter(|depth| **depth > 0.0).count();
    options.depth / known.max(1) as f32
}

/// Hyperparameters of Adam in step `step`.
pub(crate) fn adam_step(options: &StepOptions, step: u64) -> AdamStep {
    AdamStep {
        beta1: 0.9,
        beta2: options.beta2,
        epsilon: 1e-15,
        step,
    }
}

/// The rays of `group` in a batch of `rays`, and their random numbers in step `step`.
fn group_of(group: usize, rays: usize, seed: u64, step: u64) -> (std::ops::Range<usize>, Rng) {
    let range = rays * group / GROUPS..rays * (group + 1) / GROUPS;
    (range, Rng::new(seed, (step << 8) + group as u64))
}

/// The fraction of a step by which the samples of each ray are shifted when marching through an occupancy grid.
#[cfg(feature = "gpu")]
pub(crate) fn offsets(rays: usize, seed: u64, step: u64) -> Vec<f32> {
    let of_group = |group| {
        let (range, mut rng) = group_of(group, rays, seed, step);
        range.map(move |_| rng.uniform())
    };
    (0..GROUPS).flat_map(of_group).collect()
}

/// Computes all gradients: those of networks, codes and background end up in the first worker; for the tables, each worker keeps its
/// points with the gradients of their encodings.
fn gradients(
    level: Level,
    field: &Field,
    batch: &RayBatch,
    options: &StepOptions,
    step: u64,
    workers: &mut [Worker],
) -> StepLoss {
    let transposed = field.transposed();
    let task = Task {
        level,
        field,
        transposed: &transposed,
        batch,
        options,
        depth: depth_weight(batch, options),
    };
    let n = batch.rays.len();
    workers.par_iter_mut().enumerate().for_each(|(group, worker)| {
        let (range, mut rng) = group_of(group, n, options.seed, step);
        worker.rays(&task, range, &mut rng);
    });
    let loss = add_up(workers);
    let mean = 1.0 / loss.rays.max(1) as f64;
    StepLoss {
        color: loss.color * mean,
        total: loss.total * mean,
        ..loss
    }
}

/// Adds the workers' sums to the first one's, in order; returns the sum of their losses.
fn add_up(workers: &mut [Worker]) -> StepLoss {
    let (first, others) = workers.split_at_mut(1);
    let (sum, mut loss) = (&mut first[0], StepLoss::default());
    loss.add(&sum.loss);
    for worker in others {
        loss.add(&worker.loss);
        for (to, from) in sum.grads.iter_mut().zip(&worker.grads) {
            add(&mut to.density, &from.density);
            add(&mut to.color, &from.color);
        }
        add(&mut sum.codes, &worker.codes);
        add(&mut sum.background, &worker.background);
    }
    loss
}

fn add(to: &mut [f32], from: &[f32]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
}

impl StepLoss {
    fn add(&mut self, other: &Self) {
        self.color += other.color;
        self.total += other.total;
        self.rays += other.rays;
        self.samples += other.samples;
    }
}

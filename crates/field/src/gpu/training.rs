//! Training of a field on a GPU: the twin of [`crate::train_step`].

use super::layout::{MAX_CHUNKS, chunk};
use super::{Batch, GpuField, RAY_GROUP, SAMPLE_GROUP};
use crate::batch::RayBatch;
use crate::field::Field;
use crate::state::FieldState;
use crate::train::{StepLoss, StepOptions, adam_step, depth_weight, max_samples, offsets};
use irradia_compute::DeviceError;
use irradia_compute::adam::AdamStep;
use irradia_compute::gpu::{Array, Gpu, Work};
use std::sync::Arc;

/// Parameters and moments of a field on a GPU, and the training step.
pub struct GpuFieldTraining {
    field: GpuField,
    /// Gradients of `field.rows`.
    v_rows: Array,
    losses: Array,
    totals: Array,
    /// Gradients of the networks, `[MAX_CHUNKS, parameters]`.
    chunks: Array,
    /// Gradients of the table, two words each, zero between steps.
    table_sums: Array,
    table: Trained,
    nets: Trained,
    background: Trained,
}

/// Moments of a list of parameters, and how they are updated.
struct Trained {
    /// `[2, parameters]`.
    moments: Array,
    /// `Update` of `rates.wgsl`.
    update: Array,
    len: usize,
}

impl Trained {
    fn new(gpu: &Gpu, moments: [&[f32]; 2]) -> Self {
        let len = moments[0].len();
        let trained = Self {
            moments: Array::zeros(gpu, "moments of a field", 2 * len),
            update: Array::zeros(gpu, "update of a field", 12),
            len,
        };
        for (k, moment) in moments.into_iter().enumerate() {
            trained.moments.write(gpu, k * len, moment);
        }
        trained
    }

    fn write(&self, gpu: &Gpu, rate: f32, step: &AdamStep, count: usize) {
        let rate = [step.device_rate(rate), 0.0, 0.0, 0.0];
        let sizes = [self.len as u32, count as u32, 0, 0];
        let floats = [step.device_rule(), rate].map(|quad| quad.map(f32::to_bits));
        self.update.write(gpu, 0, &[floats[0], floats[1], sizes]);
    }

    /// Both moments.
    fn read(&self, gpu: &Gpu) -> [Vec<f32>; 2] {
        let mut first: Vec<f32> = self.moments.to_vec(gpu, 2 * self.len);
        let second = first.split_off(self.len);
        [first, second]
    }
}

impl GpuFieldTraining {
    /// Uploads `state`.
    ///
    /// # Errors
    /// When the device refuses a kernel, or has too little memory.
    ///
    /// # Panics
    /// When GPUs do not support the field: see [`super::supports`].
    pub fn new(gpu: Arc<Gpu>, state: &FieldState) -> Result<Self, DeviceError> {
        let field = GpuField::new(gpu.clone(), &state.field)?;
        let of_nets = state.moments.each_ref().map(|moment| {
            let net = &moment[0];
            [&net.density[..], &net.color].concat()
        });
        let array = |label| Array::zeros(&gpu, label, 0);
        let made = Self {
            v_rows: array("gradients of activations"),
            losses: array("losses of rays"),
            totals: Array::zeros(&gpu, "totals", 2),
            chunks: Array::zeros(&gpu, "gradients of networks", MAX_CHUNKS * field.layout.parameters),
            table_sums: Array::zeros(&gpu, "gradients of the hash table", 2 * state.moments[0][0].table.len()),
            table: Trained::new(&gpu, state.moments.each_ref().map(|moment| &moment[0].table[..])),
            nets: Trained::new(&gpu, of_nets.each_ref().map(|moment| &moment[..])),
            background: Trained::new(&gpu, state.background_moments.each_ref().map(|moment| &moment[..])),
            field,
        };
        made.field.gpu.check()?;
        Ok(made)
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.field.gpu
    }

    /// Takes one step on `batch`. Changes only the number of steps in `state`.
    pub fn step(&mut self, state: &mut FieldState, batch: &RayBatch, options: &StepOptions) -> StepLoss {
        state.step += 1;
        let (gpu, field) = (self.field.gpu.clone(), &mut self.field);
        let mut batch = packed(batch, options, state.step);
        let samples = field.march_within(&mut batch, max_samples(options));
        let rays = batch.rays.len();
        field.prepare(&batch, samples);
        self.v_rows.reserve(&gpu, field.layout.rows * field.stride);
        self.losses.reserve(&gpu, 5 * rays);
        let mut work = Work::new(&gpu);
        field.evaluate(&mut work, rays, samples);
        let arrays = field.composited(&[&self.v_rows, &self.losses]);
        work.run(&field.kernels.composite, &arrays, rays.div_ceil(RAY_GROUP));
        work.run(&field.kernels.totals, &[&field.task, &self.losses, &self.totals], 1);
        self.propagate(&mut work, samples);
        self.update(&mut work, options, &adam_step(options, state.step), [rays, samples]);
        work.submit();
        let mut totals = [0.0f32; 2];
        self.totals.read(&gpu, 0, &mut totals);
        let mean = |sum: f32| f64::from(sum) / rays.max(1) as f64;
        StepLoss {
            color: mean(totals[0]),
            total: mean(totals[1]),
            rays,
            samples,
        }
    }

    /// Propagates the gradients of the networks' outputs to all parameters.
    fn propagate(&self, work: &mut Work, samples: usize) {
        let field = &self.field;
        for (of, layer) in field.layout.layers.iter().zip(&field.layers).rev() {
            let tiles = of.inputs.div_ceil(32) * of.outputs.div_ceil(32);
            let arrays = [layer, &field.rows, &self.v_rows, &self.chunks];
            work.run(&field.kernels.weights_vjp, &arrays, chunks(samples) * tiles);
            let groups = samples.div_ceil(SAMPLE_GROUP) * of.wanted.div_ceil(8);
            let arrays = [layer, &field.nets, &field.rows, &self.v_rows];
            work.run(&field.kernels.dense_vjp, &arrays, groups);
        }
        let groups = samples.div_ceil(SAMPLE_GROUP) * field.levels();
        let arrays = [&field.task, &field.points, &self.v_rows, &self.table_sums];
        work.run(&field.kernels.scatter, &arrays, groups);
    }

    fn update(&self, work: &mut Work, options: &StepOptions, step: &AdamStep, [rays, samples]: [usize; 2]) {
        let (field, gpu) = (&self.field, work.gpu());
        self.table.write(gpu, options.table_rate, step, 0);
        self.nets.write(gpu, options.net_rate, step, chunks(samples));
        self.background.write(gpu, options.net_rate, step, rays);
        let arrays = [&self.table.update, &self.table_sums, &field.table, &self.table.moments];
        work.run(&field.kernels.update_table, &arrays, self.table.len.div_ceil(256));
        let arrays = [&self.nets.update, &self.chunks, &field.nets, &self.nets.moments];
        work.run(&field.kernels.update_nets, &arrays, self.nets.len.div_ceil(64));
        let arrays = [
            &self.background.update,
            &field.rays,
            &self.losses,
            &field.background,
            &self.background.moments,
        ];
        work.run(&field.kernels.update_background, &arrays, self.background.len);
    }

    /// Densities at points in the unit cube.
    pub(crate) fn densities(&mut self, field: &Field, points: &[[f32; 3]]) -> Vec<f32> {
        self.field.densities(field, points)
    }

    /// Uploads the occupied cells of `field`.
    pub(crate) fn upload_occupancy(&self, field: &Field) {
        self.field.upload_occupancy(field);
    }

    /// `state` with the parameters and moments read back from the device.
    pub fn download(&self, state: &FieldState) -> FieldState {
        let (gpu, mut state) = (self.gpu(), state.clone());
        let parameters = &mut state.field.parameters[0];
        self.field.table.read(gpu, 0, &mut parameters.table);
        self.field.nets.read(gpu, 0, &mut parameters.density);
        self.field
            .nets
            .read(gpu, parameters.density.len(), &mut parameters.color);
        self.field.background.read(gpu, 0, &mut state.field.background);
        let lists = [&self.table, &self.nets, &self.background].map(|list| list.read(gpu));
        let [tables, nets, backgrounds] = lists;
        for (k, (moment, (table, net))) in state.moments.iter_mut().zip(tables.into_iter().zip(nets)).enumerate() {
            let (density, color) = net.split_at(moment[0].density.len());
            moment[0].table = table;
            moment[0].density.copy_from_slice(density);
            moment[0].color.copy_from_slice(color);
            state.background_moments[k].copy_from_slice(&backgrounds[k]);
        }
        state
    }
}

fn chunks(samples: usize) -> usize {
    samples.div_ceil(chunk(samples))
}

fn packed(batch: &RayBatch, options: &StepOptions, step: u64) -> Batch {
    let offsets = offsets(batch.rays.len(), options.seed, step);
    let words = |r: usize| {
        let [red, green, blue] = batch.targets[r];
        let known = batch.depths.get(r).copied().unwrap_or(0.0);
        let [br, bg, bb] = batch.backgrounds[r];
        let learnt = f32::from(u8::from(batch.opaque[r]));
        GpuField::ray(
            &batch.rays[r],
            offsets[r],
            [red, green, blue, known],
            [br, bg, bb, learnt],
        )
    };
    Batch {
        rays: (0..batch.rays.len()).map(words).collect(),
        weights: [1.0 / batch.rays.len().max(1) as f32, depth_weight(batch, options)],
    }
}

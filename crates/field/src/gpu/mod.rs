//! Fields on any GPU: hash grids marched through an occupancy grid, as in Instant-NGP (Mueller et al. 2022).
//!
//! A thread marches a ray, with densities evaluated in registers, until the ray is opaque. The samples of all rays are then stored
//! contiguously, plane by plane, and go through encoding, networks and compositing, forwards and backwards. Only the number of samples
//! is read back in between: it determines the sizes of arrays here and the number of rays of the next batch on the host. The last rays of
//! a batch that has too many samples are left out. The occupancy grid is kept on the host, which requests densities and uploads bits.

mod layout;
mod training;
mod view;

pub(crate) use layout::Layout;
pub use training::GpuFieldTraining;
pub use view::GpuFieldRenderer;

use crate::config::{FieldConfig, Sampler};
use crate::encoding::{DirectionEncoding, PositionEncoding};
use crate::field::Field;
use crate::net::Activation;
use crate::sample::march::Steps;
use crate::shaders::Kernels;
use crate::space::{Outside, Ray};
use irradia_compute::DeviceError;
use irradia_compute::gpu::{Array, Gpu, Scan, Work};
use irradia_compute::simd::{Lanes, Portable, Simd};
use std::sync::Arc;

/// Whether GPUs support fields of `config`.
pub fn supports(config: &FieldConfig) -> bool {
    let net = &config.net;
    let color = net
        .color
        .is_some_and(|color| color.direction == DirectionEncoding::Harmonics);
    matches!(config.sampler, Sampler::Occupancy(_))
        && matches!(net.encoding, PositionEncoding::HashGrid(_))
        && color
        && config.appearance() == 0
        && net.skip.is_none()
        // A thread evaluates these layers in registers.
        && (1..=4).contains(&net.depth)
        && net.width <= 128
}

/// Workgroup sizes of kernels with one thread per ray, and of those with one thread per sample.
const RAY_GROUP: usize = 64;
const SAMPLE_GROUP: usize = 256;
/// Number of words of a ray, and the positions of its distances: see `ray.wgsl`.
const RAY_WORDS: usize = 20;
const NEAR_WORD: usize = 3;
const FAR_WORD: usize = 7;
/// Maximum number of samples per ray: steps may be much shorter than the recipes'.
const MAX_SAMPLES: usize = 1 << 14;

/// The forward pass of a field.
pub(crate) struct GpuField {
    pub gpu: Arc<Gpu>,
    pub kernels: Kernels,
    pub layout: Layout,
    steps: Steps,
    /// Number of rays in the last march, by which `middles` is laid out: rays may be left out afterwards.
    marched: usize,
    /// Maximum number of samples per ray in the last march.
    samples_per_ray: usize,
    /// The field's part of `Task` in `task.wgsl`.
    task_of_field: TaskOfField,
    pub table: Array,
    /// Parameters of the networks, layer by layer.
    pub nets: Array,
    pub background: Array,
    bricks: Array,
    pub task: Array,
    /// One `Layer` of `layer.wgsl` each.
    pub layers: Vec<Array>,
    pub rays: Array,
    middles: Array,
    counts: Array,
    pub starts: Array,
    /// `[4, stride]`: points in the unit cube, and middles of intervals.
    pub points: Array,
    /// Inputs and outputs of all layers, `[rows, stride]`.
    pub rows: Array,
    scan: Scan,
    scan_params: Array,
    /// Capacity of a plane in samples.
    pub stride: usize,
}

struct TaskOfField {
    space: [u32; 4],
    rows: [u32; 3],
    march: [u32; 4],
    levels: Vec<[u32; 4]>,
}

/// Rays of a batch, and weights of the losses.
pub(crate) struct Batch {
    /// One ray each, [`RAY_WORDS`] words.
    pub rays: Vec<[f32; RAY_WORDS]>,
    /// Weights of a ray and of a known distance in the loss.
    pub weights: [f32; 2],
}

impl GpuField {
    /// Compiles the kernels for `field` and uploads it.
    ///
    /// # Errors
    /// When the device refuses a kernel, or has too little memory.
    ///
    /// # Panics
    /// When GPUs do not support the field: see [`supports`].
    pub fn new(gpu: Arc<Gpu>, field: &Field) -> Result<Self, DeviceError> {
        assert!(supports(&field.config), "a field that GPUs support");
        let Sampler::Occupancy(options) = field.config.sampler else {
            unreachable!("just checked");
        };
        let (net, layout) = (&field.nets[0], Layout::new(&field.nets[0]));
        let side = field.occupancy.as_ref().map_or(0, |grid| grid.side);
        let activation = match net.shape.activation {
            Activation::Exp => 0,
            Activation::Softplus => 1,
            Activation::Relu => 2,
        };
        let is_contracted = field.space.outside == Outside::Contracted;
        let coefficients = field.background.len() / 3;
        let floats = [
            options.steps.shortest,
            options.steps.growth(),
            net.shape.density_bias,
            0.0,
        ];
        let task_of_field = TaskOfField {
            space: [side as u32, u32::from(is_contracted), activation, coefficients as u32],
            rows: [layout.density_row, layout.direction_row, layout.rgb_row].map(|row| row as u32),
            march: floats.map(f32::to_bits),
            levels: net
                .levels
                .iter()
                .map(|level| {
                    let [first, entries] = [level.first, level.entries].map(|n| n as u32);
                    [level.cells, first, entries, u32::from(level.dense)]
                })
                .collect(),
        };
        let array = |label| Array::zeros(&gpu, label, 0);
        let parameters = &field.parameters[0];
        let made = Self {
            kernels: Kernels::new(&gpu, &layout.constants(net)),
            steps: options.steps,
            marched: 0,
            samples_per_ray: 0,
            task_of_field,
            table: Array::zeros(&gpu, "the hash table's entries", parameters.table.len()),
            nets: Array::zeros(&gpu, "networks", layout.parameters),
            background: Array::zeros(&gpu, "background", field.background.len()),
            bricks: Array::zeros(&gpu, "occupied cells", 2 * (side / 4).pow(3)),
            task: Array::zeros(&gpu, "task", TASK_WORDS),
            layers: layout.layers.iter().map(|_| Array::zeros(&gpu, "layer", 16)).collect(),
            rays: array("rays"),
            middles: array("samples of rays"),
            counts: array("numbers of samples"),
            starts: array("first samples"),
            points: array("points"),
            rows: array("activations"),
            scan: Scan::new(&gpu),
            scan_params: Scan::params(&gpu),
            stride: 0,
            layout,
            gpu,
        };
        made.upload(field);
        made.gpu.check()?;
        Ok(made)
    }

    /// Uploads the parameters and the occupancy grid of `field`, which has the same shape.
    fn upload(&self, field: &Field) {
        let (gpu, parameters) = (&*self.gpu, &field.parameters[0]);
        self.table.write(gpu, 0, &parameters.table);
        self.nets.write(gpu, 0, &parameters.density);
        self.nets.write(gpu, parameters.density.len(), &parameters.color);
        self.background.write(gpu, 0, &field.background);
        self.upload_occupancy(field);
    }

    /// Uploads the occupied cells.
    pub fn upload_occupancy(&self, field: &Field) {
        if let Some(grid) = &field.occupancy {
            self.bricks.write(&self.gpu, 0, grid.bricks());
        }
    }

    /// Marches along the rays of `batch`; returns the number of samples.
    pub fn march(&mut self, batch: &Batch) -> usize {
        let gpu = self.gpu.clone();
        let rays = batch.rays.len();
        self.rays.reserve(&gpu, RAY_WORDS * rays);
        self.rays.write(&gpu, 0, batch.rays.as_flattened());
        (self.marched, self.samples_per_ray) = (rays, self.max_samples(batch));
        self.middles.reserve(&gpu, self.samples_per_ray * rays);
        self.counts.reserve(&gpu, rays + 1);
        self.starts.reserve(&gpu, rays + 1);
        self.write_task(rays, 0, batch.weights);
        let mut work = Work::new(&gpu);
        // The count behind the last ray's is 0, so that its start is the total.
        work.clear(&self.counts, rays + 1);
        let arrays = [
            &self.task,
            &self.rays,
            &self.bricks,
            &self.table,
            &self.nets,
            &self.middles,
            &self.counts,
        ];
        work.run(&self.kernels.march, &arrays, rays.div_ceil(RAY_GROUP));
        self.scan
            .run(&mut work, &self.scan_params, &self.counts, &self.starts, rays + 1);
        work.submit();
        let mut total = [0u32];
        self.starts.read(&gpu, rays, &mut total);
        total[0] as usize
    }

    /// Like [`Self::march`], but removes the last rays of `batch` if all together have more than `max_samples`, or more than the device's
    /// arrays hold.
    pub fn march_within(&mut self, batch: &mut Batch, max_samples: usize) -> usize {
        batch.rays.truncate(self.max_rays(batch).max(1));
        let samples = self.march(batch);
        let limit = max_samples.min(self.max_batch_samples());
        if samples <= limit {
            return samples;
        }
        let mut starts = vec![0u32; batch.rays.len() + 1];
        self.starts.read(&self.gpu, 0, &mut starts);
        let kept = starts.partition_point(|start| *start as usize <= limit).max(2) - 1;
        batch.rays.truncate(kept);
        starts[kept] as usize
    }

    /// Maximum number of steps along any ray of `batch`.
    pub fn max_samples(&self, batch: &Batch) -> usize {
        let (shortest, growth) = (self.steps.shortest, self.steps.growth());
        let spans = batch.rays.iter().map(|words| (words[NEAR_WORD], words[FAR_WORD]));
        let most = spans.fold(0.0f32, |most, (near, far)| {
            // Even steps up to here, then steps that grow with distance.
            let even = (shortest / growth).max(near);
            let growing = if even < far {
                (far / even).ln() / growth.ln_1p()
            } else {
                0.0
            };
            most.max((even.min(far) - near) / shortest + growing)
        });
        (most.ceil() as usize + 2).min(MAX_SAMPLES)
    }

    /// Makes room for the `samples` of the last march, that of `batch`.
    pub fn prepare(&mut self, batch: &Batch, samples: usize) {
        self.make_room(samples);
        self.write_task(batch.rays.len(), samples, batch.weights);
        self.write_layers(samples);
    }

    /// Makes room for `samples`.
    fn make_room(&mut self, samples: usize) {
        if samples > self.stride {
            self.stride = (samples + samples / 4).next_multiple_of(64);
            self.points.reserve(&self.gpu, 4 * self.stride);
            self.rows.reserve(&self.gpu, self.layout.rows * self.stride);
        }
    }

    /// Evaluates the samples of the last march.
    pub fn evaluate(&self, work: &mut Work, rays: usize, samples: usize) {
        let arrays = [
            &self.task,
            &self.rays,
            &self.middles,
            &self.starts,
            &self.points,
            &self.rows,
        ];
        work.run(&self.kernels.gather, &arrays, rays.div_ceil(RAY_GROUP));
        self.encode(work, samples);
        for layer in 0..self.layers.len() {
            self.forward(work, layer, samples);
        }
    }

    fn encode(&self, work: &mut Work, samples: usize) {
        let groups = samples.div_ceil(SAMPLE_GROUP) * self.levels();
        let arrays = [&self.task, &self.points, &self.table, &self.rows];
        work.run(&self.kernels.encode, &arrays, groups);
    }

    fn forward(&self, work: &mut Work, layer: usize, samples: usize) {
        let groups = samples.div_ceil(SAMPLE_GROUP) * (self.layout.layers[layer].padded / 8);
        let arrays = [&self.layers[layer], &self.nets, &self.rows];
        work.run(&self.kernels.dense, &arrays, groups);
    }

    /// The arrays that compositing reads, in the order of its bindings, followed by those it writes.
    pub fn composited<'a>(&'a self, written: &[&'a Array]) -> Vec<&'a Array> {
        let read = [
            &self.task,
            &self.rays,
            &self.starts,
            &self.points,
            &self.rows,
            &self.background,
        ];
        [&read[..], written].concat()
    }

    /// Densities at points in the unit cube.
    pub fn densities(&mut self, field: &Field, points: &[[f32; 3]]) -> Vec<f32> {
        let gpu = self.gpu.clone();
        let shape = &field.nets[0].shape;
        let mut densities = Vec::with_capacity(points.len());
        self.make_room(points.len().min(POINTS_PER_QUERY));
        for points in points.chunks(POINTS_PER_QUERY) {
            let samples = points.len();
            for c in 0..3 {
                let plane: Vec<f32> = points.iter().map(|point| point[c]).collect();
                self.points.write(&gpu, c * self.stride, &plane);
            }
            self.write_task(0, samples, [0.0; 2]);
            self.write_layers(samples);
            let mut work = Work::new(&gpu);
            self.encode(&mut work, samples);
            for layer in 0..self.layout.densities {
                self.forward(&mut work, layer, samples);
            }
            work.submit();
            let begin = densities.len();
            densities.resize(begin + samples, 0.0);
            let row = self.layout.density_row * self.stride;
            self.rows.read(&gpu, row, &mut densities[begin..]);
        }
        let mut lanes = [0.0; Portable::LANES];
        for x in &mut densities {
            let [density, _] = shape
                .activation
                .with_slope(Portable, Portable.set(*x + shape.density_bias));
            density.store(&mut lanes);
            *x = lanes[0];
        }
        densities
    }

    fn write_task(&self, rays: usize, samples: usize, weights: [f32; 2]) {
        let of = &self.task_of_field;
        let sizes = [rays, samples, self.stride, self.samples_per_ray].map(|n| n as u32);
        let [density, direction, rgb] = of.rows;
        let rows = [density, direction, rgb, self.marched as u32];
        let loss = [weights[0], weights[1], 0.0, 0.0].map(f32::to_bits);
        let mut words = vec![sizes, of.space, rows, of.march, loss];
        words.extend_from_slice(&of.levels);
        self.task.write(&self.gpu, 0, &words);
    }

    fn write_layers(&self, samples: usize) {
        for (array, layer) in self.layers.iter().zip(&self.layout.layers) {
            array.write(&self.gpu, 0, &layer.words(samples, self.stride, self.layout.parameters));
        }
    }

    /// The words of a ray. `goal` is its target colour and known distance (in training), or the conversion of its distances to the world
    /// (in rendering); `behind` is the background, and whether a learnt one takes precedence.
    pub fn ray(ray: &Ray, offset: f32, goal: [f32; 4], behind: [f32; 4]) -> [f32; RAY_WORDS] {
        let mut words = [0.0; RAY_WORDS];
        let parts = [(&ray.origin, ray.near), (&ray.direction, ray.far), (&ray.view, offset)];
        for (to, (vector, number)) in words.chunks_exact_mut(4).zip(parts) {
            to[..3].copy_from_slice(vector);
            to[3] = number;
        }
        words[12..16].copy_from_slice(&goal);
        words[16..].copy_from_slice(&behind);
        words
    }

    pub fn levels(&self) -> usize {
        self.task_of_field.levels.len()
    }

    /// Number of rays of `batch` that fit into one array with room for the maximum number of samples each.
    pub fn max_rays(&self, batch: &Batch) -> usize {
        (self.gpu.info().largest_array / 4) as usize / self.max_samples(batch)
    }

    /// Number of samples whose activations fit into one array.
    pub fn max_batch_samples(&self) -> usize {
        (self.gpu.info().largest_array / 4) as usize / self.layout.rows * 4 / 5
    }
}

/// Number of words of `Task` in `task.wgsl`.
const TASK_WORDS: usize = 4 * (5 + 32);
/// Number of points per evaluation of densities.
const POINTS_PER_QUERY: usize = 1 << 16;

#[cfg(test)]
mod tests;

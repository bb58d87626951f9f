//! Evaluation of a field along a few rays: samples, densities, weights, colours. Shared by training and rendering.
//!
//! A chunk holds as many rays as yield a block of samples that stays in the cache: everything from encoding to compositing
//! (and back) runs on it before the next chunk begins.

use crate::Rows;
use crate::config::Sampler;
use crate::field::Field;
use crate::mlp::PANEL;
use crate::net::{Block, Net, NetParameters, get3, sample_offset, set3};
use crate::render::quadrature::weights;
use crate::sample::importance::importance;
use crate::sample::march::March;
use crate::sample::stratified::stratified;
use crate::space::Ray;
use crate::walk::Walks;
use irradia_compute::Level;
use irradia_compute::simd::{Kernel, Lanes, Simd};
use irradia_scene::Rng;

/// Number of samples that fills a chunk: 16 panels, whose activations fit the L2 cache.
const CHUNK_SAMPLES: usize = 512;
/// Number of rays marched together through an occupancy grid: at the start of a chunk, and at most.
const MARCHED_RAYS: [usize; 2] = [4, 16];

/// One network's samples along a chunk of rays.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pass {
    /// First sample of each ray, and the total as the last element.
    pub starts: Vec<usize>,
    /// Distances of the samples, field units.
    pub middles: Vec<f32>,
    /// Lengths of their intervals, field units; padded with zeros to whole panels.
    pub lengths: Vec<f32>,
    /// Interval edges in \[0, 1\], ray by ray, for samplers that use them.
    pub edges: Vec<f32>,
    pub block: Block<f32>,
    /// Transmittance of each interval, `exp(-sigma_i delta_i)`.
    pub interval_transmittances: Vec<f32>,
    pub weights: Vec<f32>,
    /// Transmittance of each whole ray.
    pub transmittance: Vec<f32>,
    /// `[panels, 3, 32]`, after [`Self::slope`].
    pub slopes: Rows<f32>,
    kept: Vec<u32>,
    walks: Walks,
}

impl Pass {
    fn clear(&mut self) {
        self.starts.clear();
        self.starts.push(0);
        self.middles.clear();
        self.lengths.clear();
        self.edges.clear();
        self.transmittance.clear();
    }

    /// The samples of a ray.
    pub fn samples_of(&self, ray: usize) -> std::ops::Range<usize> {
        self.starts[ray]..self.starts[ray + 1]
    }

    /// Colour and alpha of ray `r`, before any background.
    pub fn composite(&self, r: usize) -> ([f32; 3], f32) {
        let mut color = [0.0; 3];
        for i in self.samples_of(r) {
            let w = self.weights[i];
            let rgb = get3(&self.block.rgb, i);
            for c in 0..3 {
                color[c] += w * rgb[c];
            }
        }
        (color, 1.0 - self.transmittance[r])
    }

    /// The sample at which the accumulated weight of ray `r` reaches a half.
    pub fn median(&self, r: usize) -> Option<usize> {
        let mut covered = 0.0;
        self.samples_of(r).find(|i| {
            covered += self.weights[*i];
            covered >= 0.5
        })
    }

    /// Writes the derivative of each sample's density with respect to its point in the unit cube to [`Self::slopes`].
    pub fn slope(&mut self, level: Level, field: &Field, net: usize, transposed: &NetParameters<f32>) {
        level.run(Slopes {
            net: &field.nets[net],
            parameters: &field.parameters[net],
            transposed,
            block: &mut self.block,
            slopes: &mut self.slopes,
        });
    }

    /// Computes densities and weights from positions; if `last`, drops samples past the end of their rays.
    fn evaluate_density(&mut self, level: Level, field: &Field, net: usize, rays: &[Ray], last: bool) {
        let n = self.middles.len();
        self.block.reset(n);
        for (r, ray) in rays.iter().enumerate() {
            for i in self.samples_of(r) {
                set3(&mut self.block.points, i, field.space.unit(ray.at(self.middles[i])));
            }
        }
        self.lengths.resize(self.block.panels() * PANEL, 0.0);
        level.run(DensitiesAlongRays {
            net: &field.nets[net],
            parameters: &field.parameters[net],
            lengths: &self.lengths,
            interval_transmittances: &mut self.interval_transmittances,
            block: &mut self.block,
        });
        self.weights.resize(n, 0.0);
        self.kept.clear();
        for r in 0..rays.len() {
            let range = self.samples_of(r);
            let (counted, transmittance) = weights(
                &self.interval_transmittances[range.clone()],
                &mut self.weights[range.clone()],
            );
            self.transmittance.push(transmittance);
            self.kept.extend((range.start..range.start + counted).map(|i| i as u32));
        }
        if last && self.kept.len() < n {
            self.block.keep(&self.kept);
            let mut at = 0;
            for r in 0..rays.len() {
                let end = self.starts[r + 1];
                self.starts[r + 1] = at;
                while at < self.kept.len() && (self.kept[at] as usize) < end {
                    at += 1;
                }
                self.starts[r + 1] = at;
            }
            for (to, from) in self.kept.iter().map(|k| *k as usize).enumerate() {
                self.middles[to] = self.middles[from];
                self.lengths[to] = self.lengths[from];
                self.interval_transmittances[to] = self.interval_transmittances[from];
                self.weights[to] = self.weights[from];
            }
            for list in [&mut self.middles, &mut self.lengths, &mut self.weights] {
                list.truncate(at);
            }
        }
    }

    /// Computes the colours of all samples.
    fn evaluate_color(&mut self, level: Level, field: &Field, net: usize, rays: &[Ray], images: &[u32]) {
        let panels = self.block.panels();
        self.block.directions.clear();
        self.block.directions.resize(panels * 3 * PANEL, 0.0);
        let size = field.config.appearance();
        self.block.codes.clear();
        self.block.codes.resize(panels * size * PANEL, 0.0);
        for (r, ray) in rays.iter().enumerate() {
            let code = if size > 0 {
                field.code(images.get(r).copied())
            } else {
                Vec::new()
            };
            for i in self.starts[r]..self.starts[r + 1] {
                set3(&mut self.block.directions, i, ray.view);
                for (k, value) in code.iter().enumerate() {
                    self.block.codes[sample_offset(size, i) + k * PANEL] = *value;
                }
            }
        }
        level.run(Colors {
            net: &field.nets[net],
            parameters: &field.parameters[net],
            block: &mut self.block,
        });
    }

    /// Fills middles and lengths from edges, `n` intervals per ray.
    fn place_intervals(&mut self, field: &Field, rays: &[Ray], n: usize) {
        for (r, ray) in rays.iter().enumerate() {
            let (near, far) = (field.space.spread(ray.near), field.space.spread(ray.far.max(ray.near)));
            let distance = |s: f32| field.space.unspread(near + s * (far - near));
            for pair in self.edges[r * (n + 1)..][..n + 1].windows(2) {
                let (a, b) = (distance(pair[0]), distance(pair[1]));
                self.middles.push(0.5 * (a + b));
                self.lengths.push(b - a);
            }
            self.starts.push(self.middles.len());
        }
    }
}

/// Evaluates the field along the first `rays` that fill a chunk, with one [`Pass`] per network; returns how many. `rng` jitters
/// the samples; without it they lie in the middle of their intervals.
pub(crate) fn trace(
    level: Level,
    field: &Field,
    rays: &[Ray],
    images: &[u32],
    mut rng: Option<&mut Rng>,
    passes: &mut Vec<Pass>,
) -> usize {
    passes.resize_with(field.nets.len(), Pass::default);
    passes.iter_mut().for_each(Pass::clear);
    let rounds = match &field.config.sampler {
        Sampler::Occupancy(options) => {
            let pass = &mut passes[0];
            let grid = field.occupancy.as_ref().expect("made with the field");
            let mut taken = 0;
            let march = March {
                space: &field.space,
                grid,
                steps: options.steps,
            };
            while taken < rays.len() && pass.middles.len() < CHUNK_SAMPLES {
                // As many rays as should fill the chunk, judging by those already in it.
                let missing = (CHUNK_SAMPLES - pass.middles.len()) * taken / pass.middles.len().max(1);
                let count = if taken == 0 {
                    MARCHED_RAYS[0]
                } else {
                    missing.clamp(1, MARCHED_RAYS[1])
                };
                let group = &rays[taken..rays.len().min(taken + count)];
                let offset = || rng.as_mut().map_or(0.5, |rng| rng.uniform());
                for walk in pass.walks.march(level, field, &march, group, offset) {
                    pass.middles.extend_from_slice(&walk.middles);
                    pass.lengths.extend_from_slice(&walk.lengths);
                    pass.starts.push(pass.middles.len());
                }
                taken += group.len();
            }
            pass.evaluate_density(level, field, 0, &rays[..taken], true);
            pass.evaluate_color(level, field, 0, &rays[..taken], images);
            return taken;
        }
        // The points do not lie on rays.
        Sampler::Given { .. } => {
            let pass = &mut passes[0];
            pass.starts.resize(rays.len() + 1, 0);
            pass.evaluate_density(level, field, 0, rays, true);
            pass.evaluate_color(level, field, 0, rays, images);
            return rays.len();
        }
        Sampler::Hierarchy { coarse, fine } => vec![(*coarse, false), (*fine, true)],
        Sampler::Proposal { rounds, last } => {
            let rounds = rounds.iter().map(|(_, n)| (*n, false));
            rounds.chain([(*last, false)]).collect()
        }
    };
    let max_samples = rounds.iter().map(|(n, _)| *n).max().unwrap_or(1);
    let taken = rays.len().min((CHUNK_SAMPLES / max_samples).max(1));
    let rays = &rays[..taken];
    let mut edges = Vec::new();
    let mut before = 0;
    for (net, (drawn, union)) in rounds.iter().copied().enumerate() {
        let (earlier, later) = passes.split_at_mut(net);
        let pass = &mut later[0];
        let n = if union { before + drawn } else { drawn };
        for r in 0..taken {
            match earlier.last() {
                None => stratified(n, rng.as_deref_mut(), &mut edges),
                Some(old) => {
                    let old_edges = &old.edges[r * (before + 1)..][..before + 1];
                    let histogram = blurred(&old.weights[r * before..][..before]);
                    if union {
                        importance(old_edges, &histogram, drawn, rng.as_deref_mut(), &mut edges);
                        edges.extend_from_slice(old_edges);
                        edges.sort_by(f32::total_cmp);
                    } else {
                        importance(old_edges, &histogram, drawn - 1, rng.as_deref_mut(), &mut edges);
                        edges.insert(0, 0.0);
                        edges.push(1.0);
                    }
                }
            }
            pass.edges.extend_from_slice(&edges);
        }
        pass.place_intervals(field, rays, n);
        pass.evaluate_density(level, field, net, rays, net + 1 == rounds.len());
        if field.nets[net].shape.color.is_some() {
            pass.evaluate_color(level, field, net, rays, images);
        }
        before = n;
    }
    taken
}

/// The weights max-filtered over neighbours, then averaged, plus a small constant: samples then surround the surfaces found so far,
/// and every interval keeps a nonzero probability (mip-NeRF, section 3.3).
fn blurred(weights: &[f32]) -> Vec<f32> {
    let n = weights.len();
    let at = |i: usize| weights[i.min(n - 1)];
    (0..n)
        .map(|i| 0.5 * (at(i.saturating_sub(1)).max(at(i)) + at(i).max(at(i + 1))) + 0.01 / n as f32)
        .collect()
}

/// Computes densities from positions, and the transmittance of intervals of `lengths`, `[panels * 32]`.
pub(crate) struct DensitiesAlongRays<'a> {
    pub net: &'a Net,
    pub parameters: &'a NetParameters<f32>,
    pub lengths: &'a [f32],
    pub interval_transmittances: &'a mut Vec<f32>,
    pub block: &'a mut Block<f32>,
}

impl Kernel for DensitiesAlongRays<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        self.net.density(simd, self.parameters, self.block);
        self.interval_transmittances.resize(self.lengths.len(), 0.0);
        for s in (0..self.lengths.len()).step_by(S::LANES) {
            let optical_depth = simd.load(&self.block.density[s..]) * simd.load(&self.lengths[s..]);
            (-optical_depth).exp().store(&mut self.interval_transmittances[s..]);
        }
    }
}

/// Computes the densities of a block of arbitrary points.
pub(crate) struct DensitiesAtPoints<'a> {
    pub net: &'a Net,
    pub parameters: &'a NetParameters<f32>,
    pub block: &'a mut Block<f32>,
}

impl Kernel for DensitiesAtPoints<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        self.net.density(simd, self.parameters, self.block);
    }
}

pub(crate) struct Colors<'a> {
    pub net: &'a Net,
    pub parameters: &'a NetParameters<f32>,
    pub block: &'a mut Block<f32>,
}

impl Kernel for Colors<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        self.net.color(simd, self.parameters, self.block);
    }
}

struct Slopes<'a> {
    net: &'a Net,
    parameters: &'a NetParameters<f32>,
    transposed: &'a NetParameters<f32>,
    block: &'a mut Block<f32>,
    slopes: &'a mut Rows<f32>,
}

impl Kernel for Slopes<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        self.net
            .density_slope(simd, self.parameters, self.transposed, self.block, self.slopes);
    }
}

use crate::regularize::Regularized;
use crate::render::CHUNK;
use crate::{COLUMN_NAMES, SplatGradients, Splats};
use irradia_compute::Planes;
use irradia_compute::adam::{Active, AdamRates, AdamStep, adam};
use irradia_compute::simd::Level;
use irradia_compute::sort::{Pair, pair, payload, sort_by_key};
use rayon::prelude::*;

/// Splats in training, with all per-splat arrays that must stay consistent with them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplatState {
    /// The parameters.
    pub splats: Splats,
    /// Adam's first and second moments.
    pub moments: [Splats; 2],
    /// Statistics accumulated since the last round of density control, or several rounds for splats rarely in view of
    /// [`crate::densify::fast`]: planes [`SplatState::GRADIENT`], [`SplatState::SEEN`],
    /// [`SplatState::EXTENT`], [`SplatState::ERROR`], [`SplatState::WEIGHT`].
    pub statistics: Planes,
    /// Variance of each splat's 3D smoothing filter, world units squared, 1 plane; zeros where the recipe has no filter.
    pub filter: Planes,
}

/// What [`SplatState::gather_statistics`] accumulates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Statistics {
    /// The norm of the screen gradient (3DGS).
    Gradient,
    /// The norm of the screen gradient with absolute values summed over fragments (AbsGS).
    AbsoluteGradient,
    /// The norm of the screen gradient, the error and the blending weight.
    Error,
}

/// Adam's options in one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Optimizer {
    /// Constants of Adam.
    pub step: AdamStep,
    /// Whether splats without a gradient, such as those out of view, step with a gradient of zero (3DGS); otherwise they keep
    /// parameters and moments.
    pub dense: bool,
}

/// Learning rates of one step.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Rates {
    /// Of the means, world units per step.
    pub means: f32,
    /// Position of the last frame's camera, world. If given, `means` is relative to each splat's distance from it, so that a step has the
    /// same size on screen at any distance.
    pub means_from: Option<[f32; 3]>,
    /// Of the raw quaternions.
    pub quats: f32,
    /// Of the ln scales.
    pub log_scales: f32,
    /// Of the opacity logits.
    pub opacities: f32,
    /// Of the SH DC coefficients.
    pub sh_dc: f32,
    /// Of the other SH coefficients.
    pub sh_rest: f32,
}

impl Rates {
    /// All rates times `factor`.
    pub fn scaled(self, factor: f32) -> Self {
        Self {
            means: self.means * factor,
            means_from: self.means_from,
            quats: self.quats * factor,
            log_scales: self.log_scales * factor,
            opacities: self.opacities * factor,
            sh_dc: self.sh_dc * factor,
            sh_rest: self.sh_rest * factor,
        }
    }
}

impl SplatState {
    /// Statistics plane: sum of the screen-space gradient's norm, in normalised device coordinates as in 3DGS.
    pub const GRADIENT: usize = 0;
    /// Statistics plane: frames in which the splat was visible.
    pub const SEEN: usize = 1;
    /// Statistics plane: largest half size on screen, pixels.
    pub const EXTENT: usize = 2;
    /// Statistics plane: sum over frames of the error in the pixels that the splat covers, pixels times the error's unit.
    pub const ERROR: usize = 3;
    /// Statistics plane: sum over frames of its blending weights, pixels.
    pub const WEIGHT: usize = 4;
    /// Number of statistics planes.
    pub const STATISTICS: usize = 5;

    /// Zero moments and statistics for `splats`, which are put into Morton order.
    pub fn new(splats: Splats) -> Self {
        let (n, degree) = (splats.len(), splats.sh_degree());
        let mut state = Self {
            splats,
            moments: std::array::from_fn(|_| Splats::zeros(n, degree)),
            statistics: Planes::zeros(Self::STATISTICS, n),
            filter: Planes::zeros(1, n),
        };
        state.sort_morton();
        state
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.splats.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.splats.is_empty()
    }

    /// Keeps the splats `indices`, in that order, with their moments and statistics.
    pub fn gather(&mut self, indices: &[u32]) {
        let mut scratch = Vec::new();
        for column in self.all_columns_mut() {
            column.rearrange(indices, &[], &mut scratch);
        }
    }

    /// Appends `splats` with moments and statistics of zero.
    pub fn append(&mut self, splats: &Splats) {
        let order: Vec<u32> = (0..(self.len() + splats.len()) as u32).collect();
        let mut scratch = Vec::new();
        for (to, from) in self.splats.columns_mut().into_iter().zip(splats.columns()) {
            to.rearrange(&order, &[from], &mut scratch);
        }
        for column in self.auxiliary_columns_mut() {
            column.rearrange(&order, &[], &mut scratch);
        }
    }

    /// Keeps the splats `kept`, adds `added` with moments of zero, resets the moments of the splats `reset` (ascending), clears the
    /// statistics of all but those that `keeps_statistics` accepts, and puts all into Morton order: a round of density control in one pass
    /// over the state, column by column, so that it needs hardly more memory than the state itself.
    pub fn rebuild(
        &mut self,
        kept: Vec<u32>,
        added: &[&Splats],
        reset: &[u32],
        keeps_statistics: impl Fn(&Planes, u32) -> bool + Sync,
    ) {
        let n = self.len() as u32;
        let new = added.iter().map(|splats| splats.len() as u32).sum::<u32>();
        let mut order = kept;
        order.extend(n..n + new);
        let mut scratch = Vec::new();
        let mut means = self.splats.means.gather(&[]);
        // Positions in the new order: all that the Morton order needs.
        let parts: Vec<&Planes> = [&self.splats].iter().chain(added).map(|splats| &splats.means).collect();
        means.rearrange(&order, &parts, &mut scratch);
        let order: Vec<u32> = morton_order(&means).par_iter().map(|i| order[*i as usize]).collect();
        drop(means);
        for (c, column) in self.splats.columns_mut().into_iter().enumerate() {
            let added: Vec<&Planes> = added.iter().map(|splats| splats.columns()[c]).collect();
            column.rearrange(&order, &added, &mut scratch);
        }
        self.filter.rearrange(&order, &[], &mut scratch);
        let kept_statistics = |i: &u32| {
            if *i < n && keeps_statistics(&self.statistics, *i) {
                *i
            } else {
                u32::MAX
            }
        };
        let statistics: Vec<u32> = order.par_iter().map(kept_statistics).collect();
        self.statistics.rearrange(&statistics, &[], &mut scratch);
        drop(statistics);
        let kept_moment = |i: &u32| if reset.binary_search(i).is_ok() { u32::MAX } else { *i };
        let order: Vec<u32> = order.par_iter().map(kept_moment).collect();
        for column in self.moments.iter_mut().flat_map(Splats::columns_mut) {
            column.rearrange(&order, &[], &mut scratch);
        }
    }

    /// Every column with an item for each splat.
    fn all_columns(&self) -> Vec<&Planes> {
        let [first, second] = &self.moments;
        let splats = [&self.splats, first, second].into_iter().flat_map(Splats::columns);
        splats.chain([&self.statistics, &self.filter]).collect()
    }

    /// The same, mutable.
    fn all_columns_mut(&mut self) -> Vec<&mut Planes> {
        let [first, second] = &mut self.moments;
        let splats = [&mut self.splats, first, second]
            .into_iter()
            .flat_map(Splats::columns_mut);
        splats.chain([&mut self.statistics, &mut self.filter]).collect()
    }

    /// Every column but the parameters.
    fn auxiliary_columns_mut(&mut self) -> Vec<&mut Planes> {
        self.all_columns_mut().split_off(COLUMN_NAMES.len())
    }

    /// Becomes a copy of `from`, made by all threads; reuses memory where possible.
    pub fn copy_from(&mut self, from: &Self) {
        for (to, from) in self.all_columns_mut().into_iter().zip(from.all_columns()) {
            to.copy_from(from);
        }
    }

    /// `len` splats of degree `sh_degree`, unspecified, whose memory the system has already supplied.
    pub fn resident(len: usize, sh_degree: u32) -> Self {
        let mut state = Self::new(Splats::zeros(0, sh_degree));
        for column in state.all_columns_mut() {
            *column = Planes::resident(column.count(), len);
        }
        state
    }

    /// Whether [`Self::copy_from`] `other` needs no further memory.
    pub fn has_room_for(&self, other: &Self) -> bool {
        let mut columns = self.all_columns().into_iter().zip(other.all_columns());
        columns.all(|(own, other)| own.has_room_for(other))
    }

    /// Allocated bytes.
    pub fn bytes(&self) -> usize {
        self.all_columns().into_iter().map(Planes::bytes).sum()
    }

    /// Statistics plane `plane` of splat `i`, averaged over the frames in which it was visible.
    pub fn mean_statistic(&self, plane: usize, i: usize) -> f32 {
        self.statistics.get(plane, i) / self.statistics.get(Self::SEEN, i).max(1.0)
    }

    /// Sorts the splats in Morton order of the means, so that neighbours in space are neighbours in memory: vectors of splats are
    /// visible or invisible together, and tiles read few cache lines.
    pub fn sort_morton(&mut self) {
        let order = morton_order(&self.splats.means);
        self.gather(&order);
    }

    /// One Adam step with `gradients`. SH bands above `sh_degree` are not updated. `regularized` tells which splats have gradients of
    /// ln scales and opacity logits: the active ones, or all.
    pub fn step(
        &mut self,
        level: Level,
        gradients: &SplatGradients,
        regularized: Regularized,
        rates: &Rates,
        sh_degree: u32,
        optimizer: Optimizer,
    ) {
        let mut sh = vec![0.0; self.splats.sh.count()];
        for (plane, rate) in sh
            .iter_mut()
            .enumerate()
            .take(3 * irradia_scene::sh::coefficients(sh_degree))
        {
            *rate = if plane < 3 { rates.sh_dc } else { rates.sh_rest };
        }
        let active = if optimizer.dense {
            Active::Dense(&gradients.active)
        } else {
            Active::Sparse(&gradients.active, &gradients.counts)
        };
        let shape_active = match regularized {
            Regularized::Visible => active,
            Regularized::All => Active::All,
        };
        let distances = rates.means_from.map(|from| distances(&self.splats.means, from));
        let rules = [
            (vec![rates.means; 3], distances.as_deref(), active),
            (vec![rates.quats; 4], None, active),
            (vec![rates.log_scales; 3], None, shape_active),
            (vec![rates.opacities], None, shape_active),
            (sh, None, active),
        ];
        let [first, second] = &mut self.moments;
        let columns = self
            .splats
            .columns_mut()
            .into_iter()
            .zip(first.columns_mut())
            .zip(second.columns_mut());
        for (((parameters, first), second), (g, (planes, items, active))) in
            columns.zip(gradients.splats.columns().into_iter().zip(rules))
        {
            let rates = AdamRates { planes: &planes, items };
            adam(level, parameters, g, [first, second], rates, active, optimizer.step);
        }
    }

    /// Adds one frame's gradients to the statistics. `width` and `height` are the frame's, pixels; `extent(i)` is splat
    /// i's half size on screen, pixels. All but [`Statistics::Gradient`] require the matching [`crate::Gather`] in the backward pass.
    pub fn gather_statistics(
        &mut self,
        what: Statistics,
        gradients: &SplatGradients,
        width: u32,
        height: u32,
        extent: impl Fn(usize) -> f32 + Sync,
    ) {
        let n = self.len();
        let screen = match what {
            Statistics::AbsoluteGradient => &gradients.gathered,
            Statistics::Gradient | Statistics::Error => &gradients.screen,
        };
        let (x, y) = (screen.plane(0), screen.plane(1));
        let (error, weight) = (gradients.gathered.plane(0), gradients.gathered.plane(1));
        // Pixels to normalised device coordinates, whose range has length 2.
        let scale = [0.5 * width as f32, 0.5 * height as f32];
        let planes = self.statistics.planes_mut::<{ Self::STATISTICS }>();
        let [gradient, seen, extents, errors, weights] = planes.map(|plane| &mut plane[..n]);
        let chunks = gradient
            .par_chunks_mut(CHUNK)
            .zip(seen.par_chunks_mut(CHUNK))
            .zip(extents.par_chunks_mut(CHUNK))
            .zip(errors.par_chunks_mut(CHUNK).zip(weights.par_chunks_mut(CHUNK)))
            .zip(&gradients.counts)
            .enumerate();
        chunks.filter(|(_, (_, active))| **active > 0).for_each(
            |(chunk, ((((gradient, seen), extents), (errors, weights)), _))| {
                for at in 0..gradient.len() {
                    let i = chunk * CHUNK + at;
                    if gradients.active[i] == 0.0 {
                        continue;
                    }
                    let (gx, gy) = (x[i] * scale[0], y[i] * scale[1]);
                    gradient[at] += (gx * gx + gy * gy).sqrt();
                    seen[at] += 1.0;
                    extents[at] = extents[at].max(extent(i));
                    if what == Statistics::Error {
                        errors[at] += error[i];
                        weights[at] += weight[i];
                    }
                }
            },
        );
    }
}

/// Distance of every item of `means` from `center`, world units, with padding up to the stride.
fn distances(means: &Planes, center: [f32; 3]) -> Vec<f32> {
    let mut distances = vec![0.0; means.stride()];
    let [x, y, z] = [0, 1, 2].map(|c| means.plane(c).par_chunks(CHUNK));
    let chunks = distances.par_chunks_mut(CHUNK).zip(x).zip(y.zip(z));
    chunks.for_each(|((distances, x), (y, z))| {
        for (distance, ((x, y), z)) in distances.iter_mut().zip(x.iter().zip(y).zip(z)) {
            let [x, y, z] = [x - center[0], y - center[1], z - center[2]];
            *distance = (x * x + y * y + z * z).sqrt();
        }
    });
    distances
}

/// Indices in Morton (Z-curve) order of the positions, 10 bits per axis, over the box of the central 98 % of each axis (otherwise
/// a few outliers would compress the scene into one cell).
fn morton_order(means: &Planes) -> Vec<u32> {
    let n = means.len();
    let axes: Vec<(&[f32], f32, f32)> = (0..3)
        .filter_map(|axis| {
            let values = &means.plane(axis)[..n];
            let mut sample: Vec<f32> = values
                .iter()
                .copied()
                .step_by((n / 4096).max(1))
                .filter(|v| v.is_finite())
                .collect();
            sample.sort_unstable_by(f32::total_cmp);
            let last = sample.len().checked_sub(1)?;
            let (low, high) = (sample[last / 100], sample[last - last / 100]);
            Some((values, low, 1023.0 / (high - low).max(1e-20)))
        })
        .collect();
    let code = |i: usize| {
        axes.iter().enumerate().fold(0, |code, (axis, (values, low, scale))| {
            code | spread(((values[i] - low) * scale).clamp(0.0, 1023.0) as u32) << axis
        })
    };
    let mut items: Vec<Pair> = (0..n).into_par_iter().map(|i| pair(code(i), i as u32)).collect();
    sort_by_key(&mut items, &mut Vec::new());
    items.par_iter().map(payload).collect()
}

/// Spreads ten bits to every third bit of thirty.
fn spread(v: u32) -> u32 {
    let v = (v | v << 16) & 0x0300_00ff;
    let v = (v | v << 8) & 0x0300_f00f;
    let v = (v | v << 4) & 0x030c_30c3;
    (v | v << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gather_and_append_keep_moments_with_their_splats() {
        let mut state = SplatState::new(Splats::zeros(0, 1));
        let mut three = Splats::zeros(3, 1);
        for i in 0..3 {
            three.means.set(0, i, i as f32);
        }
        state.append(&three);
        for i in 0..3 {
            state.moments[1].means.set(0, i, 10.0 * i as f32);
            state.statistics.set(SplatState::SEEN, i, 100.0 * i as f32);
        }
        state.gather(&[2, 0]);
        state.append(&three);
        assert_eq!(state.len(), 5);
        let column = |p: &Planes, c: usize| p.plane(c)[..5].to_vec();
        assert_eq!(column(&state.splats.means, 0), [2.0, 0.0, 0.0, 1.0, 2.0]);
        assert_eq!(column(&state.moments[1].means, 0), [20.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(column(&state.statistics, SplatState::SEEN), [200.0, 0.0, 0.0, 0.0, 0.0]);
    }

    /// The first step of Adam is the rate, whatever the gradient.
    #[test]
    fn steps_of_means_are_relative_to_the_distance_from_the_camera_if_it_is_given() {
        let mut splats = Splats::zeros(3, 0);
        for (i, z) in [1.0, 4.0, 30.0].into_iter().enumerate() {
            splats.means.set(2, i, z);
        }
        let mut gradients = SplatGradients {
            splats: Splats::zeros(3, 0),
            active: vec![1.0; splats.means.stride()],
            counts: vec![3],
            ..SplatGradients::default()
        };
        (0..3).for_each(|i| gradients.splats.means.set(0, i, 0.1 + i as f32));
        let optimizer = Optimizer {
            step: AdamStep {
                beta1: 0.9,
                beta2: 0.999,
                epsilon: 1e-15,
                step: 1,
            },
            dense: true,
        };
        for (means_from, expected) in [(None, [0.01; 3]), (Some([0.0, 0.0, 2.0]), [0.01, 0.02, 0.28])] {
            let mut state = SplatState::new(splats.clone());
            let rates = Rates {
                means: 0.01,
                means_from,
                ..Rates::default()
            };
            state.step(Level::detect(), &gradients, Regularized::Visible, &rates, 0, optimizer);
            for (i, expected) in expected.into_iter().enumerate() {
                let moved = -state.splats.means.get(0, i);
                assert!((moved - expected).abs() < 1e-5 * expected, "{i}: {moved} {expected}");
            }
        }
    }

    #[test]
    fn a_copy_into_resident_memory_needs_no_more_of_it() {
        let mut state = SplatState::new(Splats::zeros(5, 2));
        state.splats.means.set(2, 4, 3.0);
        let mut copy = SplatState::resident(20, 2);
        assert!(copy.has_room_for(&state) && !SplatState::resident(20, 1).has_room_for(&state));
        let bytes = copy.bytes();
        copy.copy_from(&state);
        assert!(copy == state && copy.bytes() == bytes);
        assert!(!copy.has_room_for(&SplatState::new(Splats::zeros(33, 2))));
    }

    /// Compares a round with its definition, one splat at a time, with 1 and with 2 threads.
    #[test]
    fn a_round_in_place_gives_what_splat_by_splat_gives_with_any_number_of_threads() {
        let (n, degree) = (40_000, 1);
        let mut rng = irradia_scene::Rng::new(4, 4);
        let mut random = |n: usize| {
            let mut splats = Splats::zeros(n, degree);
            for column in splats.columns_mut() {
                for c in 0..column.count() {
                    (0..n).for_each(|i| column.set(c, i, rng.normal()));
                }
            }
            splats
        };
        let mut before = SplatState::new(random(n));
        before.moments = [random(n), random(n)];
        before.filter.plane_mut(0)[..n].fill(0.5);
        for i in 0..n {
            before.statistics.set(1, i, 1.0 + i as f32);
        }
        let added = [random(700), random(90)];
        let kept: Vec<u32> = (0..n as u32).filter(|i| i % 7 != 3).collect();
        let reset: Vec<u32> = (0..n as u32).step_by(70).collect();

        // Source of each new splat: part and index. The Morton order is that of `morton_order`.
        let mut sources: Vec<(usize, usize)> = kept.iter().map(|i| (0, *i as usize)).collect();
        sources.extend((0..700).map(|i| (1, i)).chain((0..90).map(|i| (2, i))));
        let parts = [&before.splats, &added[0], &added[1]];
        let means: Vec<f32> = sources.iter().flat_map(|(part, i)| parts[*part].mean(*i)).collect();
        let order = morton_order(&Planes::from_interleaved(3, &means));
        for threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut state = before.clone();
            pool.install(|| state.rebuild(kept.clone(), &[&added[0], &added[1]], &reset, |_, i| i % 5 == 0));
            assert_eq!(state.len(), sources.len());
            for (to, from) in order.iter().enumerate() {
                let (part, i) = sources[*from as usize];
                let stays = part == 0 && reset.binary_search(&(i as u32)).is_err();
                for (column, old) in state.splats.columns().into_iter().zip(parts[part].columns()) {
                    assert!((0..column.count()).all(|c| column.get(c, to) == old.get(c, i)));
                }
                for (now, then) in state.moments.iter().zip(&before.moments) {
                    for (column, old) in now.columns().into_iter().zip(then.columns()) {
                        let old = |c: usize| if stays { old.get(c, i) } else { 0.0 };
                        assert!((0..column.count()).all(|c| column.get(c, to) == old(c)));
                    }
                }
                assert_eq!(state.filter.get(0, to), if part == 0 { 0.5 } else { 0.0 });
                let keeps = part == 0 && i % 5 == 0;
                assert_eq!(state.statistics.get(1, to), if keeps { 1.0 + i as f32 } else { 0.0 });
            }
        }
    }

    #[test]
    fn morton_order_groups_octants() {
        let bit = |i: usize, axis: usize| (((i * 37) % 64) >> axis & 1) as f32;
        let corners: Vec<f32> = (0..64).flat_map(|i| [bit(i, 0), bit(i, 1), bit(i, 2)]).collect();
        let means = Planes::from_interleaved(3, &corners);
        let order = morton_order(&means);
        let runs = order
            .windows(2)
            .filter(|w| (0..3).any(|c| means.get(c, w[0] as usize) != means.get(c, w[1] as usize)))
            .count();
        assert_eq!(runs, 7, "eight corners, seven changes");
    }
}

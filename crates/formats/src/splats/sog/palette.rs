//! Codebooks of 256 numbers that stand for all numbers, and palettes of vectors that stand for all vectors. Both minimise the squared
//! error by Lloyd's method, start from the data's own order and sum in a fixed order, so that equal scenes give equal files.

use crate::splats::rows::SPLATS_PER_TASK;
use rayon::prelude::*;
use std::collections::HashMap;
use std::collections::hash_map::Entry;

/// Bins of the histogram by which numbers are clustered.
const BINS: usize = 1 << 16;
/// Bins by which their density is estimated: few, so that each holds many numbers.
const DENSITY_BINS: usize = 512;
/// Numbers farther than this many inner ranges from the inner range are outliers.
const OUTLIER_RANGES: f32 = 4.0;
/// Rounds of Lloyd's method; later ones change little.
const CODEBOOK_ROUNDS: usize = 30;
const COARSE_ROUNDS: usize = 10;
const FINE_ROUNDS: usize = 8;
/// Maximum number of vectors from which the coarse clusters are found.
const MAX_SAMPLES: usize = 1 << 16;
/// Centroids compared at a time: the compiler vectorises over them.
const LANES: usize = 16;

/// 256 numbers in increasing order.
pub(super) struct Codebook(pub [f32; 256]);

impl Codebook {
    /// The best `count` numbers, 2 to 256, for `values`; values that are not finite are ignored.
    pub fn of(values: &[f32], count: usize) -> Self {
        let finite = || values.iter().copied().filter(|v| v.is_finite());
        let (low, high) = finite().fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(v), high.max(v)));
        if low >= high {
            return Self([if low == high { low } else { 0.0 }; 256]);
        }
        if let Some(exact) = Self::exact(finite(), count) {
            return exact;
        }
        let [low, high] = inner_range(values, [low, high]).map(f64::from);
        let scale = (BINS - 1) as f64 / (high - low);
        let mut bins = vec![(0u64, 0f64); BINS];
        // Outliers, of which there are few, have bins of their own.
        let mut outliers = Vec::new();
        for v in finite().map(f64::from) {
            if v < low || v > high {
                outliers.push((1, v));
                continue;
            }
            let bin = &mut bins[((v - low) * scale) as usize];
            bin.0 += 1;
            bin.1 += v;
        }
        bins.retain(|(count, _)| *count > 0);
        let mut numbers = Self::initial_numbers(&bins, low, high, count);
        if !outliers.is_empty() {
            bins.append(&mut outliers);
            bins.sort_unstable_by(|a, b| (a.1 / a.0 as f64).total_cmp(&(b.1 / b.0 as f64)));
        }
        for _ in 0..CODEBOOK_ROUNDS {
            let mut sums = [(0u64, 0f64); 256];
            let mut nearest = 0;
            for (members, sum) in &bins {
                let mean = sum / *members as f64;
                // Bins increase, and so does the nearest number.
                while nearest < count - 1 && mean - numbers[nearest] > numbers[nearest + 1] - mean {
                    nearest += 1;
                }
                sums[nearest].0 += members;
                sums[nearest].1 += sum;
            }
            for (number, (count, sum)) in numbers.iter_mut().zip(sums) {
                if count > 0 {
                    *number = sum / count as f64;
                }
            }
            numbers.sort_unstable_by(f64::total_cmp);
        }
        Self(std::array::from_fn(|i| numbers[i.min(count - 1)] as f32))
    }

    /// The numbers of `values` if there are at most `count`.
    fn exact(values: impl Iterator<Item = f32>, count: usize) -> Option<Self> {
        let mut distinct: Vec<f32> = Vec::with_capacity(count + 1);
        for value in values {
            if let Err(at) = distinct.binary_search_by(|known| known.total_cmp(&value)) {
                distinct.insert(at, value);
            }
            if distinct.len() > count {
                return None;
            }
        }
        let last = *distinct.last()?;
        distinct.resize(256, last);
        Some(Self(std::array::from_fn(|i| distinct[i])))
    }

    /// Initial numbers: the quantiles of the cube root of the density, which are optimal for many numbers (Panter and Dite 1951).
    fn initial_numbers(bins: &[(u64, f64)], low: f64, high: f64, count: usize) -> Vec<f64> {
        let mut density = [0u64; DENSITY_BINS];
        let width = (high - low) / DENSITY_BINS as f64;
        for (count, sum) in bins {
            let bin = (sum / *count as f64 - low) / width;
            density[(bin as usize).min(DENSITY_BINS - 1)] += count;
        }
        let weights = density.map(|count| (count as f64).cbrt());
        let total: f64 = weights.iter().sum();
        let mut numbers = Vec::with_capacity(count);
        let mut cumulative = 0.0;
        for (i, weight) in weights.into_iter().enumerate() {
            let quantile = |found: usize| (found as f64 + 0.5) / count as f64 * total;
            while numbers.len() < count && quantile(numbers.len()) <= cumulative + weight {
                let fraction = (quantile(numbers.len()) - cumulative) / weight;
                numbers.push(low + (i as f64 + fraction) * width);
            }
            cumulative += weight;
        }
        numbers.resize(count, high);
        numbers
    }

    /// Replaces the number nearest to zero by zero.
    pub fn with_zero(mut self) -> Self {
        let nearest = self.index(0.0);
        self.0[usize::from(nearest)] = 0.0;
        self
    }

    /// The index of the number nearest to `value`.
    pub fn index(&self, value: f32) -> u8 {
        let above = self.0.partition_point(|number| *number < value).clamp(1, 255);
        let nearer_below = value - self.0[above - 1] <= self.0[above] - value;
        (above - usize::from(nearer_below)) as u8
    }
}

/// The range of the finite `values`, within [`OUTLIER_RANGES`] ranges of all but a thousandth of them at each end: a single outlier would
/// make the bins of all others coarse. At least one value counts as the end's thousandth. `all` is the whole range.
fn inner_range(values: &[f32], all: [f32; 2]) -> [f32; 2] {
    let step = values.len().div_ceil(MAX_SAMPLES);
    let mut sample: Vec<f32> = values.iter().step_by(step).copied().filter(|v| v.is_finite()).collect();
    sample.sort_unstable_by(f32::total_cmp);
    let cut = (sample.len() / 1000).max(1);
    if sample.len() <= 2 * cut {
        return all;
    }
    let [low, high] = [sample[cut], sample[sample.len() - 1 - cut]];
    let margin = OUTLIER_RANGES * (high - low);
    if margin > 0.0 {
        [(low - margin).max(all[0]), (high + margin).min(all[1])]
    } else {
        all
    }
}

/// Vectors, and for each vector of the scene the index of the one that stands for it.
pub(super) struct Palette {
    /// `[entries, width]`
    pub entries: Vec<f32>,
    pub labels: Vec<u16>,
}

impl Palette {
    /// At most `max_entries` entries (2 to 65,536) for `vectors` of `width` numbers: all distinct ones if they are few enough.
    pub fn of(vectors: &[f32], width: usize, max_entries: usize) -> Self {
        if let Some(exact) = Self::exact(vectors, width, max_entries) {
            return exact;
        }
        // Vectors of zeros, of splats whose harmonics do not show, share one entry; otherwise many centroids would start there.
        let is_zero = |vector: &[f32]| vector.iter().all(|v| *v == 0.0);
        let (zero, other): (Vec<usize>, Vec<usize>) =
            (0..vectors.len() / width).partition(|i| is_zero(&vectors[i * width..(i + 1) * width]));
        if zero.is_empty() {
            return Self::clustered(vectors, width, max_entries);
        }
        let others: Vec<f32> = other
            .iter()
            .flat_map(|i| &vectors[i * width..(i + 1) * width])
            .copied()
            .collect();
        let clustered = Self::clustered(&others, width, max_entries - 1);
        let mut palette = Self {
            entries: vec![0.0; width],
            labels: vec![0; vectors.len() / width],
        };
        palette.entries.extend(clustered.entries);
        for (i, label) in other.iter().zip(clustered.labels) {
            palette.labels[*i] = label + 1;
        }
        palette
    }

    /// The distinct vectors, in the order of their first use, if there are at most `max_entries`.
    fn exact(vectors: &[f32], width: usize, max_entries: usize) -> Option<Self> {
        let mut known: HashMap<Vec<u32>, u16> = HashMap::new();
        let (mut entries, mut labels) = (Vec::new(), Vec::with_capacity(vectors.len() / width));
        for vector in vectors.chunks_exact(width) {
            let next = known.len();
            let label = match known.entry(vector.iter().map(|v| v.to_bits()).collect()) {
                Entry::Occupied(known) => *known.get(),
                Entry::Vacant(_) if next == max_entries => return None,
                Entry::Vacant(new) => {
                    entries.extend_from_slice(vector);
                    *new.insert(next as u16)
                }
            };
            labels.push(label);
        }
        Some(Self { entries, labels })
    }

    /// Entries by clustering.
    ///
    /// In two steps: first as many coarse clusters as the square root of `max_entries`, then the entries within each, in a number that
    /// follows its share of the error. This compares a vector with hundreds of centroids, where one step would compare it with tens of thousands.
    fn clustered(vectors: &[f32], width: usize, max_entries: usize) -> Self {
        let count = vectors.len() / width;
        if count <= max_entries {
            return Self {
                entries: vectors.to_vec(),
                labels: (0..count).map(|i| i as u16).collect(),
            };
        }
        let vector = |i: usize| &vectors[i * width..(i + 1) * width];
        let step = count.div_ceil(MAX_SAMPLES);
        let sample: Vec<u32> = (0..count as u32).step_by(step).collect();
        let coarse = lloyd(
            vectors,
            width,
            &sample,
            (max_entries as f64).sqrt() as usize,
            COARSE_ROUNDS,
        );
        let nearest: Vec<(u32, f32)> = (0..count)
            .into_par_iter()
            .with_min_len(SPLATS_PER_TASK / 16)
            .map(|i| coarse.nearest(vector(i)))
            .collect();
        let mut members = vec![Vec::new(); coarse.count];
        let mut errors = vec![0f64; coarse.count];
        for (i, (cluster, error)) in nearest.into_iter().enumerate() {
            members[cluster as usize].push(i as u32);
            errors[cluster as usize] += f64::from(error.max(0.0));
        }
        let shares = entries_per_cluster(&members, &errors, max_entries);
        let fine: Vec<(Centroids, Vec<u32>)> = members
            .par_iter()
            .zip(shares)
            .with_max_len(1)
            .map(|(members, share)| {
                let centroids = lloyd(vectors, width, members, share, FINE_ROUNDS);
                let labels = members
                    .iter()
                    .map(|i| centroids.nearest(vector(*i as usize)).0)
                    .collect();
                (centroids, labels)
            })
            .collect();
        let mut palette = Self {
            entries: Vec::with_capacity(max_entries * width),
            labels: vec![0; count],
        };
        for ((centroids, labels), members) in fine.iter().zip(&members) {
            let first = palette.entries.len() / width;
            for (i, label) in members.iter().zip(labels) {
                palette.labels[*i as usize] = (first + *label as usize) as u16;
            }
            (0..centroids.count).for_each(|c| palette.entries.extend(centroids.get(c)));
        }
        palette
    }
}

/// Number of entries of each cluster, at most `max_entries` in total: one each, and the rest by its error and number of members, but never
/// more than it has members.
fn entries_per_cluster(members: &[Vec<u32>], errors: &[f64], max_entries: usize) -> Vec<usize> {
    let total: f64 = errors.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    let count: usize = members.iter().map(Vec::len).sum();
    let spare = (max_entries - members.len().min(max_entries)) as f64;
    let share = |(members, error): (&Vec<u32>, &f64)| {
        let part = 0.5 * error / total + 0.5 * members.len() as f64 / count as f64;
        (1 + (part * spare) as usize).min(members.len())
    };
    members.iter().zip(errors).map(share).collect()
}

/// Centroids in blocks of [`LANES`]: component by component, with a block's centroids side by side.
struct Centroids {
    count: usize,
    width: usize,
    blocks: Vec<[f32; LANES]>,
    /// Half the squared length of each; infinite in unused lanes.
    half_norms: Vec<[f32; LANES]>,
}

impl Centroids {
    fn new(width: usize, centroids: &[Vec<f32>]) -> Self {
        let mut blocks = vec![[0.0; LANES]; centroids.len().div_ceil(LANES) * width];
        let mut half_norms = vec![[f32::INFINITY; LANES]; centroids.len().div_ceil(LANES)];
        for (i, centroid) in centroids.iter().enumerate() {
            for (k, value) in centroid.iter().enumerate() {
                blocks[i / LANES * width + k][i % LANES] = *value;
            }
            half_norms[i / LANES][i % LANES] = 0.5 * centroid.iter().map(|v| v * v).sum::<f32>();
        }
        Self {
            count: centroids.len(),
            width,
            blocks,
            half_norms,
        }
    }

    fn get(&self, i: usize) -> impl Iterator<Item = f32> {
        let block = &self.blocks[i / LANES * self.width..][..self.width];
        block.iter().map(move |lanes| lanes[i % LANES])
    }

    /// The nearest centroid, and the squared distance to it.
    fn nearest(&self, vector: &[f32]) -> (u32, f32) {
        let (mut best, mut best_index) = (f32::INFINITY, 0);
        for (block, (numbers, half_norms)) in self.blocks.chunks_exact(self.width).zip(&self.half_norms).enumerate() {
            // Half the squared distance, less half the squared length of the vector.
            let mut distances = *half_norms;
            for (value, lanes) in vector.iter().zip(numbers) {
                for (distance, number) in distances.iter_mut().zip(lanes) {
                    *distance -= value * number;
                }
            }
            for (lane, distance) in distances.into_iter().enumerate() {
                if distance < best {
                    (best, best_index) = (distance, block * LANES + lane);
                }
            }
        }
        (
            best_index as u32,
            2.0 * best + vector.iter().map(|v| v * v).sum::<f32>(),
        )
    }
}

/// Lloyd's method on the vectors `members`, starting from every n-th of them.
fn lloyd(vectors: &[f32], width: usize, members: &[u32], count: usize, rounds: usize) -> Centroids {
    let vector = |i: u32| &vectors[i as usize * width..][..width];
    let count = count.min(members.len());
    let mut centroids: Vec<Vec<f32>> = (0..count)
        .map(|k| vector(members[k * members.len() / count.max(1)]).to_vec())
        .collect();
    for _ in 0..rounds {
        let packed = Centroids::new(width, &centroids);
        let labels: Vec<u32> = members
            .par_iter()
            .with_min_len(1024)
            .map(|i| packed.nearest(vector(*i)).0)
            .collect();
        let mut sums = vec![0f32; count * width];
        let mut counts = vec![0u32; count];
        for (i, label) in members.iter().zip(labels) {
            counts[label as usize] += 1;
            let sum = &mut sums[label as usize * width..][..width];
            sum.iter_mut().zip(vector(*i)).for_each(|(sum, v)| *sum += v);
        }
        for ((centroid, sum), count) in centroids.iter_mut().zip(sums.chunks_exact(width)).zip(counts) {
            if count > 0 {
                let mean = sum.iter().map(|v| v / count as f32);
                centroid.iter_mut().zip(mean).for_each(|(to, v)| *to = v);
            }
        }
    }
    Centroids::new(width, &centroids)
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    #[test]
    fn few_numbers_are_kept_and_many_are_near() {
        let few: Vec<f32> = (0..1000).map(|i| [-7.0, 0.25, 3.5][i % 3]).collect();
        let codebook = Codebook::of(&few, 256);
        assert!(few.iter().all(|v| codebook.0[usize::from(codebook.index(*v))] == *v));
        let mut rng = Rng::new(4, 1);
        let many: Vec<f32> = (0..50_000)
            .map(|_| (0..6).map(|_| rng.uniform()).sum::<f32>() - 3.0)
            .collect();
        let codebook = Codebook::of(&many, 256);
        assert!(codebook.0.is_sorted());
        let squares: f64 = many
            .iter()
            .map(|v| f64::from(v - codebook.0[usize::from(codebook.index(*v))]).powi(2))
            .sum();
        // Panter and Dite's bound for a normal density of this variance is sqrt(3) pi / 2 / 256^2 of it.
        let bound = 0.5 * 2.72 / 65536.0;
        assert!(
            squares / many.len() as f64 <= 1.1 * bound,
            "{}",
            squares / many.len() as f64
        );
        assert_eq!(Codebook::of(&[f32::NAN], 256).0, [0.0; 256]);
        assert_eq!(Codebook::of(&[2.0, f32::INFINITY], 256).0, [2.0; 256]);
    }

    #[test]
    fn what_fits_is_kept_and_vectors_of_zeros_share_an_entry() {
        let mut rng = Rng::new(6, 1);
        let few: Vec<f32> = (0..300).map(|_| rng.range(-1.0, 1.0)).collect();
        // Each of 100 vectors of three numbers, many times.
        let many: Vec<f32> = (0..5000)
            .flat_map(|i| few[i * 7 % 100 * 3..][..3].iter().copied())
            .collect();
        let palette = Palette::of(&many, 3, 128);
        assert_eq!(palette.entries.len(), 300);
        for (vector, label) in many.chunks_exact(3).zip(&palette.labels) {
            assert_eq!(vector, &palette.entries[usize::from(*label) * 3..][..3]);
        }
        let half: Vec<f32> = (0..5000)
            .flat_map(|i| [0.0; 3].map(|_: f32| if i % 2 == 0 { 0.0 } else { rng.range(1.0, 2.0) }))
            .collect();
        let palette = Palette::of(&half, 3, 64);
        assert!(palette.entries.len() <= 64 * 3);
        let zeros = |i: usize| palette.entries[i * 3..][..3].iter().all(|v| *v == 0.0);
        assert_eq!((0..palette.entries.len() / 3).filter(|i| zeros(*i)).count(), 1);
        assert!((0..5000).all(|i| zeros(palette.labels[i].into()) == (i % 2 == 0)));
        // Numbers closer together than the bins of the histogram.
        let near: Vec<f32> = (0..200).map(|i| 1.0 + i as f32 * 1e-6).chain([1000.0]).collect();
        let codebook = Codebook::of(&near, 256);
        assert!(near.iter().all(|v| codebook.0[usize::from(codebook.index(*v))] == *v));
        // An outlier does not cost the others their precision.
        let error = |values: &[f32]| {
            let codebook = Codebook::of(values, 256);
            let errors = values[..10_000]
                .iter()
                .map(|v| (codebook.0[usize::from(codebook.index(*v))] - v).abs());
            errors.sum::<f32>() / 10_000.0
        };
        let mut values: Vec<f32> = (0..10_000).map(|_| rng.range(-1.0, 1.0)).collect();
        let alone = error(&values);
        values.extend([1e5, -3e7]);
        assert!(
            alone < 0.003 && error(&values) < 1.1 * alone,
            "{alone}, {}",
            error(&values)
        );
        assert_eq!(
            Codebook::of(&[-1.0, 0.01, 2.0], 256).with_zero().0[..3],
            [-1.0, 0.0, 2.0]
        );
    }

    #[test]
    fn clusters_are_found_and_do_not_depend_on_threads() {
        let mut rng = Rng::new(5, 1);
        // 64 clusters of width 3, far apart.
        let vectors: Vec<f32> = (0..20_000usize)
            .flat_map(|i| [i % 4, i / 4 % 4, i / 16 % 4].map(|v| v as f32 * 10.0))
            .map(|v| v + rng.range(-0.5, 0.5))
            .collect();
        let palette = Palette::of(&vectors, 3, 1024);
        assert!(palette.entries.len() <= 1024 * 3);
        let worst = vectors.chunks_exact(3).zip(&palette.labels).map(|(vector, label)| {
            let entry = &palette.entries[usize::from(*label) * 3..][..3];
            vector.iter().zip(entry).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        });
        assert!(worst.fold(0.0, f32::max) < 1.0);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let alone = pool.install(|| Palette::of(&vectors, 3, 1024));
        assert!(alone.entries == palette.entries && alone.labels == palette.labels);
        let exact = Palette::of(&vectors[..30], 3, 1024);
        assert_eq!((exact.entries.len(), exact.labels[9]), (30, 9));
    }
}

//! Splats from rows of bytes and back, in parallel, and the order in which compressed formats store them.

use crate::Malformed;
use irradia_scene::{GaussianCloud, sh};
use rayon::prelude::*;

/// Splats converted per task.
pub(crate) const SPLATS_PER_TASK: usize = 16_384;
/// Maximum number of splats per byte of a compressed file; a file that declares more is damaged or designed to exhaust memory: a splat
/// takes up to 344 bytes of it. The best known compression needs several bytes per splat.
const MAX_SPLATS_PER_BYTE: u64 = 1;
/// This many splats are allowed in any file.
const MIN_SPLAT_LIMIT: u64 = 4096;

/// The parameters of one splat, to be filled in.
pub(crate) struct SplatMut<'a> {
    pub mean: &'a mut [f32; 3],
    pub quat: &'a mut [f32; 4],
    pub log_scale: &'a mut [f32; 3],
    pub opacity_logit: &'a mut f32,
    /// `[(degree + 1)^2, 3]`, DC first.
    pub sh: &'a mut [f32],
}

/// A cloud of `count` splats, each decoded by `decode(index, splat)`. All values are zero before.
pub(crate) fn decode_splats(count: usize, sh_degree: u32, decode: impl Fn(usize, SplatMut) + Sync) -> GaussianCloud {
    let sh_values = 3 * sh::coefficients(sh_degree);
    let mut cloud = GaussianCloud {
        means: vec![[0.0; 3]; count],
        quats: vec![[0.0; 4]; count],
        log_scales: vec![[0.0; 3]; count],
        opacity_logits: vec![0.0; count],
        sh: vec![0.0; count * sh_values],
        sh_degree,
        ..GaussianCloud::default()
    };
    let geometry = cloud
        .means
        .par_chunks_mut(SPLATS_PER_TASK)
        .zip(cloud.quats.par_chunks_mut(SPLATS_PER_TASK));
    let shape = cloud
        .log_scales
        .par_chunks_mut(SPLATS_PER_TASK)
        .zip(cloud.opacity_logits.par_chunks_mut(SPLATS_PER_TASK));
    let colour = cloud.sh.par_chunks_mut(SPLATS_PER_TASK * sh_values);
    geometry
        .zip(shape)
        .zip(colour)
        .enumerate()
        .for_each(|(chunk, (((means, quats), (scales, opacities)), sh))| {
            let rows = means.iter_mut().zip(quats).zip(scales.iter_mut().zip(opacities));
            for (i, (((mean, quat), (log_scale, opacity_logit)), sh)) in
                rows.zip(sh.chunks_exact_mut(sh_values)).enumerate()
            {
                let splat = SplatMut {
                    mean,
                    quat,
                    log_scale,
                    opacity_logit,
                    sh,
                };
                decode(chunk * SPLATS_PER_TASK + i, splat);
            }
        });
    cloud
}

/// `count` rows of `width` bytes, each encoded by `encode(index, row)`. All bytes are zero before.
pub(crate) fn encode_rows(count: usize, width: usize, encode: impl Fn(usize, &mut [u8]) + Sync) -> Vec<u8> {
    let mut bytes = vec![0; count * width];
    if width > 0 {
        bytes
            .par_chunks_mut(SPLATS_PER_TASK * width)
            .enumerate()
            .for_each(|(chunk, rows)| {
                for (i, row) in rows.chunks_exact_mut(width).enumerate() {
                    encode(chunk * SPLATS_PER_TASK + i, row);
                }
            });
    }
    bytes
}

/// The number of splats that a compressed file of `bytes` bytes declares, checked before memory is allocated for them.
pub(crate) fn plausible_count(declared: u64, bytes: usize) -> Result<usize, Malformed> {
    let limit = (bytes as u64).saturating_mul(MAX_SPLATS_PER_BYTE).max(MIN_SPLAT_LIMIT);
    usize::try_from(declared)
        .ok()
        .filter(|_| declared <= limit)
        .ok_or_else(|| {
            Malformed(format!(
                "declares {declared} splats, which {bytes} bytes cannot hold; the file is damaged"
            ))
        })
}

/// Whether splat `i` can be drawn: position, rotation and colour are finite, size and opacity are not NaN, and the size is not infinite.
fn is_valid(cloud: &GaussianCloud, i: usize) -> bool {
    let width = 3 * cloud.sh_coefficients();
    let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
    finite(&cloud.means[i])
        && finite(&cloud.quats[i])
        && finite(&cloud.sh[i * width..(i + 1) * width])
        && cloud.log_scales[i].iter().all(|v| *v < f32::INFINITY)
        && !cloud.opacity_logits[i].is_nan()
}

/// Makes rotations by quaternions of length zero the identity, as which other viewers draw them.
pub(crate) fn define_rotations(cloud: &mut GaussianCloud) {
    cloud.quats.par_iter_mut().for_each(|quat| {
        if quat.iter().map(|v| v * v).sum::<f32>() == 0.0 {
            *quat = [1.0, 0.0, 0.0, 0.0];
        }
    });
}

/// Whether there is a splat that cannot be drawn.
pub(crate) fn has_invalid(cloud: &GaussianCloud) -> bool {
    (0..cloud.len()).into_par_iter().any(|i| !is_valid(cloud, i))
}

/// Leaves out splats that cannot be drawn. Returns how many.
pub(crate) fn remove_invalid(cloud: &mut GaussianCloud) -> usize {
    let width = 3 * cloud.sh_coefficients();
    let valid: Vec<bool> = (0..cloud.len()).into_par_iter().map(|i| is_valid(cloud, i)).collect();
    let removed = valid.iter().filter(|valid| !**valid).count();
    if removed > 0 {
        let mut to = 0;
        for from in (0..valid.len()).filter(|i| valid[*i]) {
            cloud.means[to] = cloud.means[from];
            cloud.quats[to] = cloud.quats[from];
            cloud.log_scales[to] = cloud.log_scales[from];
            cloud.opacity_logits[to] = cloud.opacity_logits[from];
            cloud.sh.copy_within(from * width..(from + 1) * width, to * width);
            to += 1;
        }
        cloud.means.truncate(to);
        cloud.quats.truncate(to);
        cloud.log_scales.truncate(to);
        cloud.opacity_logits.truncate(to);
        cloud.sh.truncate(to * width);
        let kept: Vec<u32> = (0..valid.len() as u32).filter(|i| valid[*i as usize]).collect();
        for column in &mut cloud.extra {
            *column = column.gather(&kept);
        }
    }
    removed
}

/// Indices of the splats along a Morton curve through their bounding box: neighbours in space become neighbours in the file, so
/// that chunks are small and images smooth.
pub(crate) fn morton_order(means: &[[f32; 3]]) -> Vec<u32> {
    let (low, high) = bounds(means);
    let scale: [f32; 3] = std::array::from_fn(|c| 2_097_151.0 / (high[c] - low[c]).max(f32::MIN_POSITIVE));
    // 21 bits of a coordinate, each followed by two zeros.
    let interleave = |value: f32, c: usize| {
        let mut bits = ((value - low[c]) * scale[c]) as u64 & 0x1f_ffff;
        for (shift, mask) in [
            (32, 0x1f_0000_0000_ffff),
            (16, 0x1f_0000_ff00_00ff),
            (8, 0x100f_00f0_0f00_f00f),
            (4, 0x10c3_0c30_c30c_30c3),
            (2, 0x1249_2492_4924_9249),
        ] {
            bits = (bits | bits << shift) & mask;
        }
        bits << c
    };
    let mut order: Vec<(u64, u32)> = means
        .par_iter()
        .enumerate()
        .map(|(i, mean)| ((0..3).fold(0, |code, c| code | interleave(mean[c], c)), i as u32))
        .collect();
    order.par_sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// The lowest and the highest coordinates; zeros if there are no points.
pub(crate) fn bounds(means: &[[f32; 3]]) -> ([f32; 3], [f32; 3]) {
    let Some(first) = means.first() else {
        return ([0.0; 3], [0.0; 3]);
    };
    means.iter().fold((*first, *first), |(low, high), mean| {
        (
            std::array::from_fn(|c| low[c].min(mean[c])),
            std::array::from_fn(|c| high[c].max(mean[c])),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_splats_that_can_be_drawn_stay() {
        let mut cloud = decode_splats(7, 1, |i, splat| {
            *splat.mean = [i as f32; 3];
            splat.quat[0] = 1.0;
            splat.sh.fill(i as f32);
        });
        cloud.means[0][1] = f32::NAN;
        cloud.quats[2][3] = f32::INFINITY;
        cloud.log_scales[3] = [f32::NEG_INFINITY; 3];
        cloud.opacity_logits[4] = f32::NAN;
        cloud.sh[5 * 12 + 7] = f32::NEG_INFINITY;
        cloud.opacity_logits[6] = f32::INFINITY;
        assert_eq!(remove_invalid(&mut cloud), 4);
        assert!(cloud.is_consistent());
        assert_eq!(cloud.means, [[1.0; 3], [3.0; 3], [6.0; 3]]);
        assert_eq!((cloud.sh[0], cloud.sh[12], cloud.sh[35]), (1.0, 3.0, 6.0));
        assert_eq!(remove_invalid(&mut cloud), 0);
    }

    #[test]
    fn morton_order_visits_octants_one_after_another() {
        let means: Vec<[f32; 3]> = (0..64)
            .map(|i| [(i * 7 % 4) as f32, (i * 11 / 4 % 4) as f32, (i * 13 / 16 % 4) as f32])
            .collect();
        let order = morton_order(&means);
        let octant = |i: &u32| means[*i as usize].map(|v| v >= 2.0);
        let changes = order.windows(2).filter(|w| octant(&w[0]) != octant(&w[1])).count();
        assert!(changes < 8, "{changes}");
        assert!(morton_order(&[]).is_empty());
    }

    #[test]
    fn declared_counts_are_bounded_by_the_file() {
        assert_eq!(plausible_count(1000, 10).unwrap(), 1000);
        assert!(
            plausible_count(1 << 40, 1 << 20)
                .unwrap_err()
                .to_string()
                .contains("cannot hold")
        );
        assert_eq!(plausible_count(1 << 20, 1 << 20).unwrap(), 1 << 20);
    }
}

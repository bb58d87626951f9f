use super::{Descriptor, MatchOptions, comparable_descriptors, merge_matches, mutual_matches};
use crate::Features;
use glam::{DMat3, DVec3};
use irradia_compute::nearest::Nearest;
use irradia_compute::simd::{Kernel, Lanes, Mask, Simd};

/// Like [`super::match_features`], but only among features that agree with the fundamental matrix `F` of the pair, `x2^T F x1 = 0` in
/// pixels at full size: their Sampson distance (Hartley and Zisserman, eq. 11.9) is at most `threshold` pixels. Both the nearest and the
/// second nearest neighbour are among these, so repeated structures elsewhere do not make a match ambiguous.
pub fn match_guided(
    a: &Features,
    b: &Features,
    fundamental: &DMat3,
    threshold: f64,
    options: &MatchOptions,
) -> Vec<[u32; 2]> {
    let columns = KeypointColumns::new(b, fundamental, threshold);
    let none = |photo: &Features| vec![Nearest::NONE; photo.keypoints.len()];
    let mut kinds: Vec<_> = comparable_descriptors(a, b)
        .map(|both| (both, [none(a), none(b)]))
        .collect();
    let mut candidates: Vec<u32> = Vec::new();
    for (i, keypoint) in a.keypoints.iter().enumerate() {
        candidates.clear();
        options.level.run(FindCandidates {
            columns: &columns,
            x1: keypoint.at().extend(1.0),
            candidates: &mut candidates,
        });
        for ([a, b], [of_a, of_b]) in &mut kinds {
            for &j in &candidates {
                let product = dot_product(&a[i], &b[j as usize]);
                of_a[i].merge(j, product, 0);
                of_b[j as usize].merge(i as u32, product, 0);
            }
        }
    }
    let matches = kinds
        .iter()
        .map(|(_, [of_a, of_b])| mutual_matches(of_a, of_b, options));
    matches.reduce(merge_matches).unwrap_or_default()
}

fn dot_product(a: &Descriptor, b: &Descriptor) -> u32 {
    a.iter().zip(b).map(|(a, b)| u32::from(*a) * u32::from(*b)).sum()
}

/// The second photograph's keypoints, in columns padded to whole vectors.
struct KeypointColumns {
    fundamental: DMat3,
    /// Squared pixels.
    threshold2: f32,
    x: Vec<f32>,
    y: Vec<f32>,
    /// The squared length of the gradient of `x2^T F x1` with respect to `x1`.
    gradient2: Vec<f32>,
    count: usize,
}

impl KeypointColumns {
    fn new(b: &Features, fundamental: &DMat3, threshold: f64) -> Self {
        let count = b.keypoints.len();
        let padded = |value: &dyn Fn(usize) -> f32| -> Vec<f32> {
            let mut column: Vec<f32> = (0..count).map(value).collect();
            column.resize(count.next_multiple_of(16), 0.0);
            column
        };
        // F is defined up to scale.
        let largest = fundamental.to_cols_array().iter().fold(0.0f64, |a, b| a.max(b.abs()));
        let fundamental = *fundamental * (1.0 / largest.max(f64::MIN_POSITIVE));
        let gradient2 = |j: usize| {
            let line = fundamental.transpose() * b.keypoints[j].at().extend(1.0);
            line.truncate().length_squared() as f32
        };
        Self {
            fundamental,
            threshold2: (threshold * threshold) as f32,
            x: padded(&|j| b.keypoints[j].x),
            y: padded(&|j| b.keypoints[j].y),
            gradient2: padded(&gradient2),
            count,
        }
    }
}

/// Finds the keypoints that agree with `x1`, ascending.
struct FindCandidates<'a> {
    columns: &'a KeypointColumns,
    /// Homogeneous, pixels.
    x1: DVec3,
    candidates: &'a mut Vec<u32>,
}

impl Kernel for FindCandidates<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let Self {
            columns,
            x1,
            candidates,
        } = self;
        let set = |value: f64| simd.set(value as f32);
        let limit = simd.set(columns.threshold2);
        // The epipolar line with a unit normal keeps distances small.
        let line = columns.fundamental * x1;
        let length2 = line.truncate().length_squared().max(f64::MIN_POSITIVE);
        let unit = line / length2.sqrt();
        for at in (0..columns.count).step_by(S::LANES) {
            let (x, y) = (simd.load(&columns.x[at..]), simd.load(&columns.y[at..]));
            let distance = x * set(unit.x) + y * set(unit.y) + set(unit.z);
            let weight = simd.load(&columns.gradient2[at..]) * set(1.0 / length2) + simd.splat(1.0);
            let agree = (distance * distance).le(weight * limit);
            let valid = (columns.count - at).min(S::LANES);
            let mut bits = agree.bits() & ((1u32 << valid) - 1);
            while bits != 0 {
                candidates.push(at as u32 + bits.trailing_zeros());
                bits &= bits - 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Keypoint;

    /// Features at `places` that alternate between two descriptors: only geometry can tell them apart.
    fn repeated(places: &[[f32; 2]]) -> Features {
        let looks =
            [0usize, 64].map(|from| std::array::from_fn(|i| if (from..from + 64).contains(&i) { 64 } else { 1 }));
        let keypoint = |&[x, y]: &[f32; 2]| Keypoint {
            x,
            y,
            scale: 2.0,
            angle: 0.0,
        };
        Features {
            keypoints: places.iter().map(keypoint).collect(),
            descriptors: (0..places.len()).map(|i| looks[i % 2]).collect(),
            frontal: Vec::new(),
        }
    }

    #[test]
    fn repeated_structures_match_along_their_epipolar_lines_only() {
        let places: Vec<[f32; 2]> = (0..40)
            .map(|i| [100.0 + 13.0 * i as f32, 50.0 + 20.0 * i as f32])
            .collect();
        let a = repeated(&places);
        // A sideways motion: epipolar lines are rows.
        let moved: Vec<[f32; 2]> = places.iter().map(|[x, y]| [x - 30.0, y + 1.0]).collect();
        let b = repeated(&moved);
        let sideways = DMat3::from_cols(DVec3::ZERO, DVec3::new(0.0, 0.0, -1.0), DVec3::new(0.0, 1.0, 0.0));
        let options = MatchOptions::default();
        let expected: Vec<[u32; 2]> = (0..40).map(|i| [i, i]).collect();
        assert!(super::super::match_features(&a, &b, &options).is_empty());
        let fundamental = sideways * 1e-4;
        for level in irradia_compute::Level::all() {
            let options = MatchOptions { level, ..options };
            assert_eq!(match_guided(&a, &b, &fundamental, 2.0, &options), expected);
        }
        assert!(match_guided(&a, &b, &fundamental, 0.6, &options).is_empty());
    }

    #[test]
    fn degenerate_geometry_matches_nothing_and_does_not_panic() {
        let a = repeated(&[[1.0, 2.0], [30.0, 4.0]]);
        let nan = DMat3::from_diagonal(DVec3::splat(f64::NAN));
        assert!(match_guided(&a, &a, &nan, 4.0, &MatchOptions::default()).is_empty());
    }
}

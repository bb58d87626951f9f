//! Metric scale from the locations in the photographs' metadata.

use super::types::Model;
use crate::geometry::align::{Alignment, align};
use crate::geometry::linear::{scatter, symmetric_eigen};
use crate::median;
use glam::{DQuat, DVec2, DVec3};

/// Minimum number of photographs with a location for a scale.
const MIN_PHOTOS: usize = 5;
/// Maximum relative standard deviation of a scale that is used.
const MAX_SCALE_ERROR: f64 = 0.1;
/// Maximum distance of a photograph that agrees with a fit, relative to the median distance of all photographs.
const MAX_DISTANCE_RATIO: f64 = 3.0;
/// Maximum number of photographs whose pairs are all tried.
const MAX_PAIR_PHOTOS: usize = 150;
/// Minimum assumed error of a location, m: metadata are rounded.
const MIN_ERROR_METRES: f64 = 0.1;
/// Maximum number of photographs whose triples are all tried.
const MAX_TRIPLE_PHOTOS: usize = 20;
/// Cosine of the minimum angle between a model's up and that of its locations for the locations to correct it: the up of photographs is
/// more accurate than that.
const MAX_TILT_COSINE: f64 = 0.866;
/// Minimum extent of the locations in their second principal direction, in standard deviations, for them to determine up: for locations
/// on a line, every rotation about it fits equally well.
const MIN_EXTENT_DEVIATIONS: f64 = 5.0;
/// Maximum residual of a model rotated by its locations, relative to that of the upright one.
const MAX_RESIDUAL_RATIO: f64 = 0.5;

/// How well the scale of a model is determined.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleFit {
    /// Number of photographs whose locations agree.
    pub photos: usize,
    /// Number of photographs with a location.
    pub total: usize,
    /// Root mean square of the horizontal distances between the locations and the model, m.
    pub residual_m: f64,
    /// Relative standard deviation of the scale.
    pub scale_error: f64,
}

/// Scales an upright `model` to metres and rotates it so that +X is east and +Y is north, by the `locations` of its photographs,
/// `[photos]`: east, north and up relative to any origin, m. Its origin stays. Up stays too, and heights are ignored, since satellite
/// positioning is poor at them, unless the locations clearly show that up is wrong: photographs that look straight down, as those of
/// drones do, do not determine up, and the ground may stand like a wall.
///
/// # Errors
/// `None` when too few photographs have a location; when the scale is too uncertain, its relative standard deviation.
pub fn scale_to_locations(model: &mut Model, locations: &[Option<DVec3>]) -> Result<ScaleFit, Option<f64>> {
    let known = model.poses.iter().zip(locations);
    let pairs: Vec<(DVec3, DVec3)> = known
        .filter_map(|(pose, location)| Some((pose.as_ref()?.position, (*location)?)))
        .collect();
    if pairs.len() < MIN_PHOTOS {
        return Err(None);
    }
    let fit_tilted = |tilt: DQuat| {
        let pairs = pairs
            .iter()
            .map(|(from, to)| ((tilt * *from).truncate(), to.truncate()));
        fit_horizontally(&pairs.collect::<Vec<_>>())
    };
    let mut rotation = DQuat::IDENTITY;
    let mut found = fit_tilted(rotation);
    if let Some((tilt, tilted)) = tilt_correction(&pairs).and_then(|tilt| Some((tilt, fit_tilted(tilt)?)))
        && found.is_none_or(|(_, upright)| tilted.1.residual_m < MAX_RESIDUAL_RATIO * upright.residual_m)
    {
        (rotation, found) = (tilt, Some(tilted));
    }
    let (heading, scale_fit) = found.ok_or(Some(f64::INFINITY))?;
    if scale_fit.scale_error.is_nan() || scale_fit.scale_error > MAX_SCALE_ERROR {
        return Err(Some(scale_fit.scale_error));
    }
    model.align(&Alignment {
        scale: heading.length(),
        rotation: DQuat::from_rotation_z(heading.y.atan2(heading.x)) * rotation,
        translation: DVec3::ZERO,
    });
    Ok(scale_fit)
}

/// The pairs that agree with the best of `fits`, the one with the smallest median distance over all pairs; `None` without any fit.
fn inliers<P: Copy, F>(pairs: &[P], fits: impl Iterator<Item = F>, residual: impl Fn(&F, &P) -> f64) -> Option<Vec<P>> {
    let mut best: Option<(f64, F)> = None;
    for fit in fits {
        let median = median(pairs.iter().map(|pair| residual(&fit, pair)).collect())?;
        if best.as_ref().is_none_or(|(least, _)| median < *least) {
            best = Some((median, fit));
        }
    }
    let (median, best) = best?;
    let limit = MAX_DISTANCE_RATIO * median.max(MIN_ERROR_METRES);
    Some(
        pairs
            .iter()
            .copied()
            .filter(|pair| residual(&best, pair) <= limit)
            .collect(),
    )
}

/// Scale and rotation, as a complex number, from pairs (model, metres): the fit of two photographs with the smallest median distance over
/// all, then least squares over those that agree with it.
fn fit_horizontally(pairs: &[(DVec2, DVec2)]) -> Option<(DVec2, ScaleFit)> {
    let tried: Vec<_> = pairs.iter().step_by(pairs.len().div_ceil(MAX_PAIR_PHOTOS)).collect();
    let pair_fits = tried.iter().enumerate().flat_map(|(i, a)| {
        let rest = tried[i + 1..].iter();
        rest.filter_map(|b| least_squares(&[**a, **b]))
    });
    let inliers = inliers(pairs, pair_fits, residual)?;
    let fit = least_squares(&inliers)?;
    let n = inliers.len() as f64;
    let squares: f64 = inliers.iter().map(|pair| residual(&fit, pair).powi(2)).sum();
    let mean = inliers.iter().map(|pair| pair.1).sum::<DVec2>() / n;
    let spread: f64 = inliers.iter().map(|pair| (pair.1 - mean).length_squared()).sum();
    // Two coordinates per photograph, four fitted parameters.
    let variance = squares / (2.0 * n - 4.0).max(1.0) + MIN_ERROR_METRES * MIN_ERROR_METRES;
    let scale_fit = ScaleFit {
        photos: inliers.len(),
        total: pairs.len(),
        residual_m: (squares / n).sqrt(),
        scale_error: (variance / spread).sqrt(),
    };
    (2 * inliers.len() > pairs.len()).then_some((fit[0], scale_fit))
}

/// The rotation that brings up to +Z if the locations, heights included, contradict the model's up: from the similarity of three
/// photographs with the smallest median distance over all, then least squares over those that agree with it. `None` if up is correct
/// or undetermined.
fn tilt_correction(pairs: &[(DVec3, DVec3)]) -> Option<DQuat> {
    let residual = |fit: &Alignment, (from, to): &(DVec3, DVec3)| fit.point(*from).distance(*to);
    let tried: Vec<_> = pairs.iter().step_by(pairs.len().div_ceil(MAX_TRIPLE_PHOTOS)).collect();
    let count = tried.len();
    let triples = (0..count).flat_map(|i| (i + 1..count).flat_map(move |j| (j + 1..count).map(move |k| [i, j, k])));
    let triple_fits = triples.filter_map(|photos| align(&photos.map(|i| *tried[i])));
    let inliers = inliers(pairs, triple_fits, residual)?;
    let fit = align(&inliers)?;
    let n = inliers.len() as f64;
    let variance = inliers.iter().map(|pair| residual(&fit, pair).powi(2)).sum::<f64>() / n;
    let mean = inliers.iter().map(|pair| pair.1).sum::<DVec3>() / n;
    let ([_, second, _], _) = symmetric_eigen(scatter(inliers.iter().map(|(_, to)| *to - mean)));
    let up = fit.rotation.inverse() * DVec3::Z;
    (up.z < MAX_TILT_COSINE
        && second / n
            > MIN_EXTENT_DEVIATIONS * MIN_EXTENT_DEVIATIONS * variance.max(MIN_ERROR_METRES * MIN_ERROR_METRES))
    .then(|| DQuat::from_rotation_arc(up, DVec3::Z))
}

fn complex_product(a: DVec2, b: DVec2) -> DVec2 {
    DVec2::new(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x)
}

fn residual(fit: &[DVec2; 2], (from, to): &(DVec2, DVec2)) -> f64 {
    (complex_product(fit[0], *from) + fit[1] - *to).length()
}

/// `[rotation, shift]` of `to = rotation from + shift` in complex numbers; `None` for equal points.
fn least_squares(pairs: &[(DVec2, DVec2)]) -> Option<[DVec2; 2]> {
    let n = pairs.len() as f64;
    let from_mean = pairs.iter().map(|p| p.0).sum::<DVec2>() / n;
    let to_mean = pairs.iter().map(|p| p.1).sum::<DVec2>() / n;
    let (mut cross, mut square) = (DVec2::ZERO, 0.0);
    for (from, to) in pairs {
        let from = *from - from_mean;
        cross += complex_product(DVec2::new(from.x, -from.y), *to - to_mean);
        square += from.length_squared();
    }
    let rotation = cross / square;
    (rotation.is_finite() && rotation.length() > 0.0)
        .then(|| [rotation, to_mean - complex_product(rotation, from_mean)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::DPose;
    use crate::map::ModelPoint;
    use irradia_scene::Rng;

    /// `count` cameras on a circle of radius 1, and their locations, with 20 m per unit and +X 30 degrees north of east.
    fn capture(count: usize, noise_m: f64) -> (Model, Vec<Option<DVec3>>) {
        let mut rng = Rng::new(4, 4);
        let turn = DQuat::from_rotation_z(30f64.to_radians());
        let mut model = Model::default();
        let mut locations = Vec::new();
        for i in 0..count {
            let angle = 6.0 * i as f64 / count as f64;
            let position = DVec3::new(angle.cos(), angle.sin(), 0.3);
            let mut noise = || noise_m * f64::from(rng.normal());
            locations.push(Some(
                20.0 * (turn * position) + DVec3::new(500.0 + noise(), -90.0 + noise(), 7.0 * noise()),
            ));
            model.poses.push(Some(DPose {
                rotation: DQuat::from_rotation_x(0.2),
                position,
            }));
        }
        model.points.push(ModelPoint {
            position: DVec3::new(1.0, 0.0, 0.5),
            track: Vec::new(),
            error: 0.0,
        });
        (model, locations)
    }

    #[test]
    fn places_give_scale_and_heading_in_spite_of_noise_and_wrong_ones() {
        let (mut model, mut locations) = capture(40, 1.0);
        for location in locations.iter_mut().step_by(5) {
            *location = location.map(|location| location + DVec3::new(150.0, -300.0, 0.0));
        }
        locations[1] = None;
        let scale_fit = scale_to_locations(&mut model, &locations).expect("a scale");
        assert!(
            (28..=31).contains(&scale_fit.photos) && scale_fit.total == 39,
            "{scale_fit:?}"
        );
        assert!((0.5..2.0).contains(&scale_fit.residual_m), "{scale_fit:?}");
        let point = model.points[0].position;
        let expected = 20.0 * DVec3::new(30f64.to_radians().cos(), 30f64.to_radians().sin(), 0.5);
        let off = (point - expected).length() / expected.length();
        assert!(
            off < 3.0 * scale_fit.scale_error && scale_fit.scale_error < 0.02,
            "{off} {scale_fit:?}"
        );
        let position = model.poses[3].expect("posed").position;
        assert!(
            (position.length() / 20.0 / 1.09f64.sqrt() - 1.0).abs() < 0.03,
            "{position}"
        );
    }

    /// A survey of `rows` x 6 photographs from 40 m above the ground, in a model whose ground is the vertical x-z plane.
    fn survey(rows: usize) -> (Model, Vec<Option<DVec3>>) {
        let mut rng = Rng::new(5, 5);
        let mut model = Model::default();
        let mut locations = Vec::new();
        for i in 0..6 * rows {
            let location = DVec3::new(20.0 * (i % 6) as f64, 25.0 * (i / 6) as f64, 40.0);
            let mut noise = || 0.5 * f64::from(rng.normal());
            locations.push(Some(location + DVec3::new(noise(), noise(), noise())));
            model.poses.push(Some(DPose {
                rotation: DQuat::IDENTITY,
                position: DQuat::from_rotation_x(-1.5) * location / 40.0,
            }));
        }
        (model, locations)
    }

    #[test]
    fn a_survey_that_stands_like_a_wall_is_laid_down() {
        let (mut model, locations) = survey(3);
        let scale_fit = scale_to_locations(&mut model, &locations).expect("a scale");
        assert!(scale_fit.photos >= 14 && scale_fit.scale_error < 0.01, "{scale_fit:?}");
        let heights: Vec<f64> = model.poses.iter().flatten().map(|pose| pose.position.z).collect();
        assert!(heights.iter().all(|height| (height - 40.0).abs() < 2.0), "{heights:?}");
        let across = model.poses[12].expect("posed").position - model.poses[0].expect("posed").position;
        assert!((across - DVec3::new(0.0, 50.0, 0.0)).length() < 2.0, "{across}");
    }

    #[test]
    fn places_on_a_line_do_not_turn_a_model() {
        let (mut model, locations) = survey(1);
        let height =
            |model: &Model| model.poses[5].expect("posed").position.z / model.poses[5].expect("posed").position.x;
        let before = height(&model);
        scale_to_locations(&mut model, &locations).expect("a scale");
        assert!((height(&model) - before).abs() < 0.02, "{} {before}", height(&model));
    }

    #[test]
    fn coarse_few_and_equal_places_change_nothing() {
        let (mut model, locations) = capture(30, 30.0);
        let before = model.clone();
        let error = scale_to_locations(&mut model, &locations)
            .expect_err("too coarse")
            .expect("an error");
        assert!(error > 0.1, "{error}");
        assert_eq!(scale_to_locations(&mut model, &locations[..3]), Err(None));
        let nowhere = vec![Some(DVec3::ZERO); 30];
        assert!(matches!(scale_to_locations(&mut model, &nowhere), Err(Some(error)) if error > 0.1));
        assert_eq!(model, before);
    }
}

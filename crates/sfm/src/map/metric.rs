//! Metres from the places that the photographs' metadata tell.

use super::types::Model;
use crate::geometry::align::{Alignment, align};
use crate::geometry::linear::{scatter, symmetric_eigen};
use crate::median;
use glam::{DQuat, DVec2, DVec3};

/// Photographs with a place below which there is no scale.
const LEAST_PHOTOS: usize = 5;
/// Relative standard deviation of the scale above which it is not used.
const COARSEST: f64 = 0.1;
/// Distances, in medians of the distances of all photographs, up to which a photograph agrees with a fit.
const AGREES: f64 = 3.0;
/// Photographs of which all pairs are tried.
const MOST_TRIED: usize = 150;
/// Smallest error of a place that is assumed, m: metadata are rounded.
const LEAST_ERROR_M: f64 = 0.1;
/// Photographs of which all triples are tried.
const MOST_IN_TRIPLES: usize = 20;
/// Cosine of the angle by which a model is thought not to be upright at least, before its places turn it: photographs tell their up within less.
const TILTED: f64 = 0.866;
/// How far places reach in their second direction, in standard deviations, at least, to say where up is: of those on a line every turn about it is as good.
const WIDE: f64 = 5.0;
/// Residual of a model turned by its places by that of the upright one, at most.
const BETTER: f64 = 0.5;

/// The scale of a model, and how well it is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Metric {
    /// Photographs whose places agree.
    pub photos: usize,
    /// Photographs with a place.
    pub of: usize,
    /// Root mean square of the horizontal distances between places and the model, m.
    pub residual_m: f64,
    /// Relative standard deviation of the scale.
    pub scale_error: f64,
}

/// Brings an upright `model` to metres, with +X east and +Y north, by the `places` of its photographs `[photos]`: east, north and up of
/// any origin, m. Its origin stays. So does up, and heights are not used, since satellites tell them poorly; unless the places show clearly that it is
/// wrong: what looks straight down, as drones do, has no up of its own, and the ground stands like a wall.
///
/// # Errors
/// When too few photographs have a place (`None`), or the scale is known too poorly: its relative standard deviation.
pub fn to_metres(model: &mut Model, places: &[Option<DVec3>]) -> Result<Metric, Option<f64>> {
    let known = model.poses.iter().zip(places);
    let pairs: Vec<(DVec3, DVec3)> = known
        .filter_map(|(pose, place)| Some((pose.as_ref()?.position, (*place)?)))
        .collect();
    if pairs.len() < LEAST_PHOTOS {
        return Err(None);
    }
    let level = |turn: DQuat| {
        let pairs = pairs
            .iter()
            .map(|(from, to)| ((turn * *from).truncate(), to.truncate()));
        fit(&pairs.collect::<Vec<_>>())
    };
    let mut rotation = DQuat::IDENTITY;
    let mut found = level(rotation);
    if let Some((turn, turned)) = tilt(&pairs).and_then(|turn| Some((turn, level(turn)?)))
        && found.is_none_or(|(_, upright)| turned.1.residual_m < BETTER * upright.residual_m)
    {
        (rotation, found) = (turn, Some(turned));
    }
    let (heading, metric) = found.ok_or(Some(f64::INFINITY))?;
    if metric.scale_error.is_nan() || metric.scale_error > COARSEST {
        return Err(Some(metric.scale_error));
    }
    let alignment = Alignment {
        scale: heading.length(),
        rotation: DQuat::from_rotation_z(heading.y.atan2(heading.x)) * rotation,
        translation: DVec3::ZERO,
    };
    for pose in model.poses.iter_mut().flatten() {
        *pose = alignment.pose(pose);
    }
    for point in &mut model.points {
        point.position = alignment.point(point.position);
    }
    Ok(metric)
}

/// The pairs that agree with the one of `fits` that has the least median distance of all; `None` without any.
fn agreeing<P: Copy, F>(pairs: &[P], fits: impl Iterator<Item = F>, off: impl Fn(&F, &P) -> f64) -> Option<Vec<P>> {
    let mut best: Option<(f64, F)> = None;
    for fit in fits {
        let median = median(pairs.iter().map(|pair| off(&fit, pair)).collect())?;
        if best.as_ref().is_none_or(|(least, _)| median < *least) {
            best = Some((median, fit));
        }
    }
    let (median, best) = best?;
    let limit = AGREES * median.max(LEAST_ERROR_M);
    Some(pairs.iter().copied().filter(|pair| off(&best, pair) <= limit).collect())
}

/// Scale and turn, as a complex number, from pairs (model, metres): the fit of two photographs with the least median distance of all,
/// then least squares over those that agree with it.
fn fit(pairs: &[(DVec2, DVec2)]) -> Option<(DVec2, Metric)> {
    let tried: Vec<_> = pairs.iter().step_by(pairs.len().div_ceil(MOST_TRIED)).collect();
    let twos = tried.iter().enumerate().flat_map(|(i, a)| {
        let rest = tried[i + 1..].iter();
        rest.filter_map(|b| least_squares(&[**a, **b]))
    });
    let agreeing = agreeing(pairs, twos, distance)?;
    let fit = least_squares(&agreeing)?;
    let n = agreeing.len() as f64;
    let squares: f64 = agreeing.iter().map(|pair| distance(&fit, pair).powi(2)).sum();
    let mean = agreeing.iter().map(|pair| pair.1).sum::<DVec2>() / n;
    let spread: f64 = agreeing.iter().map(|pair| (pair.1 - mean).length_squared()).sum();
    // Two coordinates a photograph, four numbers fitted.
    let variance = squares / (2.0 * n - 4.0).max(1.0) + LEAST_ERROR_M * LEAST_ERROR_M;
    let metric = Metric {
        photos: agreeing.len(),
        of: pairs.len(),
        residual_m: (squares / n).sqrt(),
        scale_error: (variance / spread).sqrt(),
    };
    (2 * agreeing.len() > pairs.len()).then_some((fit[0], metric))
}

/// The turn that brings up to +Z where the places, heights included, have it elsewhere: from the similarity of three photographs with the least
/// median distance of all, and least squares over those that agree with it. `None` where up is as it should be, or open.
fn tilt(pairs: &[(DVec3, DVec3)]) -> Option<DQuat> {
    let off = |fit: &Alignment, (from, to): &(DVec3, DVec3)| fit.point(*from).distance(*to);
    let tried: Vec<_> = pairs.iter().step_by(pairs.len().div_ceil(MOST_IN_TRIPLES)).collect();
    let count = tried.len();
    let triples = (0..count).flat_map(|i| (i + 1..count).flat_map(move |j| (j + 1..count).map(move |k| [i, j, k])));
    let threes = triples.filter_map(|photos| align(&photos.map(|i| *tried[i])));
    let agreeing = agreeing(pairs, threes, off)?;
    let fit = align(&agreeing)?;
    let n = agreeing.len() as f64;
    let variance = agreeing.iter().map(|pair| off(&fit, pair).powi(2)).sum::<f64>() / n;
    let mean = agreeing.iter().map(|pair| pair.1).sum::<DVec3>() / n;
    let ([_, second, _], _) = symmetric_eigen(scatter(agreeing.iter().map(|(_, to)| *to - mean)));
    let up = fit.rotation.inverse() * DVec3::Z;
    (up.z < TILTED && second / n > WIDE * WIDE * variance.max(LEAST_ERROR_M * LEAST_ERROR_M))
        .then(|| DQuat::from_rotation_arc(up, DVec3::Z))
}

fn product(a: DVec2, b: DVec2) -> DVec2 {
    DVec2::new(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x)
}

fn distance(fit: &[DVec2; 2], (from, to): &(DVec2, DVec2)) -> f64 {
    (product(fit[0], *from) + fit[1] - *to).length()
}

/// `[turn, shift]` of `to = turn from + shift` in complex numbers; `None` for equal points.
fn least_squares(pairs: &[(DVec2, DVec2)]) -> Option<[DVec2; 2]> {
    let n = pairs.len() as f64;
    let from_mean = pairs.iter().map(|p| p.0).sum::<DVec2>() / n;
    let to_mean = pairs.iter().map(|p| p.1).sum::<DVec2>() / n;
    let (mut cross, mut square) = (DVec2::ZERO, 0.0);
    for (from, to) in pairs {
        let from = *from - from_mean;
        cross += product(DVec2::new(from.x, -from.y), *to - to_mean);
        square += from.length_squared();
    }
    let turn = cross / square;
    (turn.is_finite() && turn.length() > 0.0).then(|| [turn, to_mean - product(turn, from_mean)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::pose::DPose;
    use crate::map::ModelPoint;
    use irradia_scene::Rng;

    /// `count` cameras on a circle of radius 1, and their places where a unit is 20 m and +X is 30 degrees north of east.
    fn capture(count: usize, noise_m: f64) -> (Model, Vec<Option<DVec3>>) {
        let mut rng = Rng::new(4, 4);
        let turn = DQuat::from_rotation_z(30f64.to_radians());
        let mut model = Model::default();
        let mut places = Vec::new();
        for i in 0..count {
            let angle = 6.0 * i as f64 / count as f64;
            let position = DVec3::new(angle.cos(), angle.sin(), 0.3);
            let mut noise = || noise_m * f64::from(rng.normal());
            places.push(Some(
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
        (model, places)
    }

    #[test]
    fn places_give_scale_and_heading_in_spite_of_noise_and_wrong_ones() {
        let (mut model, mut places) = capture(40, 1.0);
        for place in places.iter_mut().step_by(5) {
            *place = place.map(|place| place + DVec3::new(150.0, -300.0, 0.0));
        }
        places[1] = None;
        let metric = to_metres(&mut model, &places).expect("a scale");
        assert!((28..=31).contains(&metric.photos) && metric.of == 39, "{metric:?}");
        assert!((0.5..2.0).contains(&metric.residual_m), "{metric:?}");
        let point = model.points[0].position;
        let expected = 20.0 * DVec3::new(30f64.to_radians().cos(), 30f64.to_radians().sin(), 0.5);
        let off = (point - expected).length() / expected.length();
        assert!(
            off < 3.0 * metric.scale_error && metric.scale_error < 0.02,
            "{off} {metric:?}"
        );
        let position = model.poses[3].expect("posed").position;
        assert!(
            (position.length() / 20.0 / 1.09f64.sqrt() - 1.0).abs() < 0.03,
            "{position}"
        );
    }

    /// A survey of `rows` x 6 photographs from 40 m above the ground, in a model whose ground is its wall x-z.
    fn survey(rows: usize) -> (Model, Vec<Option<DVec3>>) {
        let mut rng = Rng::new(5, 5);
        let mut model = Model::default();
        let mut places = Vec::new();
        for i in 0..6 * rows {
            let place = DVec3::new(20.0 * (i % 6) as f64, 25.0 * (i / 6) as f64, 40.0);
            let mut noise = || 0.5 * f64::from(rng.normal());
            places.push(Some(place + DVec3::new(noise(), noise(), noise())));
            model.poses.push(Some(DPose {
                rotation: DQuat::IDENTITY,
                position: DQuat::from_rotation_x(-1.5) * place / 40.0,
            }));
        }
        (model, places)
    }

    #[test]
    fn a_survey_that_stands_like_a_wall_is_laid_down() {
        let (mut model, places) = survey(3);
        let metric = to_metres(&mut model, &places).expect("a scale");
        assert!(metric.photos >= 14 && metric.scale_error < 0.01, "{metric:?}");
        let heights: Vec<f64> = model.poses.iter().flatten().map(|pose| pose.position.z).collect();
        assert!(heights.iter().all(|height| (height - 40.0).abs() < 2.0), "{heights:?}");
        let across = model.poses[12].expect("posed").position - model.poses[0].expect("posed").position;
        assert!((across - DVec3::new(0.0, 50.0, 0.0)).length() < 2.0, "{across}");
    }

    #[test]
    fn places_on_a_line_do_not_turn_a_model() {
        let (mut model, places) = survey(1);
        let height =
            |model: &Model| model.poses[5].expect("posed").position.z / model.poses[5].expect("posed").position.x;
        let before = height(&model);
        to_metres(&mut model, &places).expect("a scale");
        assert!((height(&model) - before).abs() < 0.02, "{} {before}", height(&model));
    }

    #[test]
    fn coarse_few_and_equal_places_change_nothing() {
        let (mut model, places) = capture(30, 30.0);
        let before = model.clone();
        let error = to_metres(&mut model, &places)
            .expect_err("too coarse")
            .expect("an error");
        assert!(error > 0.1, "{error}");
        assert_eq!(to_metres(&mut model, &places[..3]), Err(None));
        let nowhere = vec![Some(DVec3::ZERO); 30];
        assert!(matches!(to_metres(&mut model, &nowhere), Err(Some(error)) if error > 0.1));
        assert_eq!(model, before);
    }
}

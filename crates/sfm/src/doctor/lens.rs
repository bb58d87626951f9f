//! Focal lengths: several settings, zooms that no metadata tell, and such as cannot be known.

use super::{Diagnosis, Evidence};
use crate::geometry::ransac::Limits;
use crate::geometry::resection::Resection;
use crate::map::{Model, PairKind, Source};
use crate::median;
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap};

/// Ratio of focal lengths in the metadata from which on they are two settings: less is breathing while the lens focuses.
const SETTING: f64 = 1.08;
/// Candidates for the ratio of a photograph's focal length to that of its camera.
const RATIOS: [f64; 11] = [0.45, 0.54, 0.65, 0.77, 0.88, 1.0, 1.14, 1.3, 1.55, 1.85, 2.2];
/// The cost at another focal length, by that at the camera's own, at which the other is believed: a step nearer makes up for much of
/// a zoom, so that nearly as many points agree, but less well.
const BETTER: f64 = 0.6;
/// Points that agree, at least.
const ENOUGH: usize = 30;
/// Largest reprojection error of such a point, px.
const AGREES: f64 = 2.0;
/// Points that are tried, at most.
const POINTS: usize = 400;

/// Pairs that show depth, of all, from which on a focal length can be adjusted.
const GENERAL: f64 = 0.25;

/// Focal lengths by the metadata.
pub(super) fn settings(evidence: &Evidence) -> Vec<Diagnosis> {
    let mut known: Vec<(f64, usize)> = evidence
        .photos
        .iter()
        .enumerate()
        .filter_map(|(i, photo)| Some((photo.focal_prior_px? / f64::from(photo.width.max(photo.height)), i)))
        .filter(|(focal, _)| focal.is_finite() && *focal > 0.0)
        .collect();
    known.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut settings: Vec<(f64, Vec<usize>)> = Vec::new();
    let mut last = 0.0;
    for (focal, photo) in known {
        if last * SETTING < focal {
            settings.push((focal, Vec::new()));
        }
        settings.last_mut().expect("just added").1.push(photo);
        last = focal;
    }
    settings.sort_by_key(|(_, photos)| (std::cmp::Reverse(photos.len()), photos[0]));
    if settings.len() < 2 {
        Vec::new()
    } else {
        vec![Diagnosis::ZoomSettings { settings }]
    }
}

/// Photographs whose matches with the model fit another focal length much better than that of their camera.
pub(super) fn zoom(evidence: &Evidence) -> Vec<Diagnosis> {
    let Some(model) = evidence.model else { return Vec::new() };
    let point_of: HashMap<(u32, u32), usize> = model
        .points
        .iter()
        .enumerate()
        .flat_map(|(i, point)| point.track.iter().map(move |seen| (*seen, i)))
        .collect();
    let ratios: Vec<Option<f64>> = (0..evidence.photos.len())
        .into_par_iter()
        .map(|photo| own_ratio(evidence, model, &point_of, photo))
        .collect();
    let side = |longer: bool| {
        let of = |ratio: &f64| (*ratio > 1.0) == longer;
        let photos: Vec<usize> = (0..ratios.len())
            .filter(|p| ratios[*p].as_ref().is_some_and(of))
            .collect();
        let ratio = median(ratios.iter().flatten().copied().filter(of).collect())?;
        Some(Diagnosis::Zoom { photos, ratio })
    };
    [side(true), side(false)].into_iter().flatten().collect()
}

/// The focal length at which most of the points agree that a photograph shows by its verified pairs, by that of its camera;
/// `None` if its camera's own is nearly as good.
fn own_ratio(evidence: &Evidence, model: &Model, point_of: &HashMap<(u32, u32), usize>, photo: usize) -> Option<f64> {
    // A camera of which nothing is posed has the long side's focal length of the first that is.
    let camera = model.cameras[evidence.photos[photo].group].as_ref()?;
    let mut shown: BTreeSet<(u32, usize)> = BTreeSet::new();
    for pair in evidence
        .pairs
        .iter()
        .filter(|pair| pair.photos.contains(&(photo as u32)))
    {
        let own = usize::from(pair.photos[1] as usize == photo);
        let partner = pair.photos[1 - own];
        for seen in &pair.matches {
            if let Some(point) = point_of.get(&(partner, seen[1 - own])) {
                shown.insert((seen[own], *point));
            }
        }
    }
    let thin = shown.len().div_ceil(POINTS).max(1);
    let points: Vec<(DVec2, DVec3)> = shown
        .into_iter()
        .step_by(thin)
        .filter_map(|(keypoint, point)| {
            let k = evidence.features[photo].keypoints[keypoint as usize];
            Some((
                camera.unproject(DVec2::new(k.x.into(), k.y.into()))?,
                model.points[point].position,
            ))
        })
        .collect();
    if points.len() < ENOUGH {
        return None;
    }
    let fits = RATIOS.map(|ratio| {
        let scaled = points.iter().map(|(at, point)| (*at / ratio, *point)).collect();
        let limits = Limits {
            samples: 400,
            confidence: 0.999,
            seed: photo as u64,
        };
        let found = Resection::new(scaled, AGREES / (camera.focal() * ratio)).solve(Vec::new(), limits);
        found.map_or((f64::INFINITY, 0), |found| (found.cost, found.inliers))
    });
    let own = RATIOS.iter().position(|ratio| *ratio == 1.0).expect("listed");
    let best = (0..RATIOS.len()).min_by(|a, b| fits[*a].0.total_cmp(&fits[*b].0))?;
    (fits[best].1 >= ENOUGH && fits[best].0 < BETTER * fits[own].0).then_some(RATIOS[best])
}

/// Cameras of which any focal length fits.
pub(super) fn focal_unknown(evidence: &Evidence) -> Vec<Diagnosis> {
    let mut found = Vec::new();
    for (group, (_, source)) in evidence.cameras.iter().enumerate() {
        let held = evidence
            .model
            .is_some_and(|model| model.focal_held.get(group) == Some(&true));
        let of_group = |photo: usize| evidence.photos[photo].group == group;
        let photos: Vec<usize> = (0..evidence.photos.len()).filter(|p| of_group(*p)).collect();
        let pairs = || {
            evidence
                .pairs
                .iter()
                .filter(|pair| pair.photos.iter().all(|p| of_group(*p as usize)))
        };
        let general = pairs().filter(|pair| pair.kind == PairKind::General).count();
        // What the pairs leave open, many photographs of a scene with depth may still determine together.
        let open = *source == Source::Guess && (general as f64) < GENERAL * pairs().count() as f64;
        if (open || held) && photos.len() > 2 {
            found.push(Diagnosis::FocalUnknown { photos });
        }
    }
    found
}

//! Lenses: several focal lengths, zooms that are not in the metadata, focal lengths that cannot be determined, and principal points
//! away from the centre.

use super::{Diagnosis, Evidence};
use crate::map::{FocalSource, PairKind, Zoom, determines_focal};

/// Minimum ratio of focal lengths in the metadata for two settings: smaller ones come from focus breathing.
const MIN_SETTING_RATIO: f64 = 1.08;
/// Minimum fraction of pairs that show depth for a focal length to be adjustable.
const MIN_GENERAL_FRACTION: f64 = 0.25;
/// Minimum distance of a principal point from the centre, relative to the long side, for a photograph to count as cropped: those of
/// phones are up to 1 % away, and those estimated from ten photographs up to 3 %.
const MIN_PRINCIPAL_OFFSET: f64 = 0.04;

/// Several focal lengths in the metadata.
pub(super) fn settings(evidence: &Evidence) -> Vec<Diagnosis> {
    let mut known: Vec<(f64, usize)> = evidence
        .photos
        .iter()
        .enumerate()
        .filter_map(|(i, photo)| Some((photo.focal_prior_px? / photo.long_side(), i)))
        .filter(|(focal, _)| focal.is_finite() && *focal > 0.0)
        .collect();
    known.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut settings: Vec<(f64, Vec<usize>)> = Vec::new();
    let mut last = 0.0;
    for (focal, photo) in known {
        if last * MIN_SETTING_RATIO < focal {
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

/// Photographs whose focal lengths in the model differ from those of their camera.
pub(super) fn zoom(evidence: &Evidence) -> Vec<Diagnosis> {
    let diagnosis = |zoom: &Zoom| Diagnosis::Zoom {
        photos: zoom.photos.clone(),
        ratio: zoom.focals[1] / zoom.focals[0],
    };
    evidence.zooms.iter().map(diagnosis).collect()
}

/// Photographs that became cameras of their own.
pub(super) fn own_focals(evidence: &Evidence) -> Vec<Diagnosis> {
    let model = evidence.model().filter(|_| evidence.own_focals);
    let cameras = model.map_or(&[][..], |model| &model.cameras);
    let focals = cameras.iter().enumerate();
    let mut focals: Vec<(f64, usize)> = focals
        .filter_map(|(photo, camera)| Some((camera.as_ref()?.focal(), photo)))
        .collect();
    focals.sort_by(|a, b| a.0.total_cmp(&b.0));
    match focals[..] {
        [(shortest, short), .., (longest, long)] => vec![Diagnosis::OwnFocals {
            ends: [short, long],
            ratio: longest / shortest,
        }],
        _ => Vec::new(),
    }
}

/// Photographs whose principal point the mapper found away from the centre.
pub(super) fn cropped(evidence: &Evidence) -> Vec<Diagnosis> {
    let Some(model) = evidence.model() else {
        return Vec::new();
    };
    let principal_offset = |photo: usize| {
        let camera = model.cameras[evidence.photos[photo].group].as_ref()?;
        let is_known = evidence.photos[photo].camera.is_some();
        (!is_known && model.poses[photo].is_some()).then(|| (camera.principal_offset(), camera.long_side()))
    };
    let all = (0..evidence.photos.len()).filter_map(|photo| Some((photo, principal_offset(photo)?)));
    let mut cropped: Vec<(f64, usize)> = all
        .filter(|(_, (distance, long_side))| distance > &(MIN_PRINCIPAL_OFFSET * long_side))
        .map(|(photo, (distance, _))| (distance, photo))
        .collect();
    cropped.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    match cropped.first() {
        Some((distance, _)) => vec![Diagnosis::Cropped {
            distance: *distance,
            photos: cropped.iter().map(|c| c.1).collect(),
        }],
        None => Vec::new(),
    }
}

/// Cameras for which any focal length fits.
pub(super) fn focal_unknown(evidence: &Evidence) -> Vec<Diagnosis> {
    let mut found = Vec::new();
    for (group, camera) in evidence.cameras.iter().enumerate() {
        // A focal length from the metadata may be held as well, but it is no guess.
        let held = camera.source != FocalSource::Prior
            && evidence
                .model()
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
        let is_undetermined =
            camera.source == FocalSource::Guess && (general as f64) < MIN_GENERAL_FRACTION * pairs().count() as f64;
        // Many photographs of a scene with depth together may determine what single pairs leave open.
        let determined = || {
            let model = evidence.model().filter(|model| model.cameras[group].is_some());
            model.is_some_and(|model| determines_focal(evidence.photos, evidence.features, model, group))
        };
        if photos.len() > 2 && (held || is_undetermined && !determined()) {
            found.push(Diagnosis::FocalUnknown { photos });
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::camera::DCamera;
    use crate::map::{GroupCamera, Model, PhotoInfo};

    #[test]
    fn a_focal_length_from_metadata_is_no_guess() {
        let camera = DCamera::centered(100, 100, 90.0);
        let photos = [0; 3].map(|_| PhotoInfo::new(String::new(), 100, 100));
        let models = [Model {
            cameras: vec![Some(camera)],
            poses: vec![None; 3],
            points: Vec::new(),
            focal_held: vec![true],
        }];
        let found = |source: FocalSource| {
            focal_unknown(&Evidence {
                photos: &photos,
                appearances: &[],
                features: &[],
                colors: &[],
                matches: &[],
                masked: None,
                pairs: &[],
                cameras: &[GroupCamera { camera, source }],
                models: &models,
                zooms: &[],
                own_focals: false,
                missing: &[],
                split_models: None,
                left_out: &[],
            })
        };
        assert_eq!(found(FocalSource::Prior), []);
        let guess = Diagnosis::FocalUnknown { photos: vec![0, 1, 2] };
        assert_eq!(found(FocalSource::Guess), [guess]);
    }
}

//! Points for a dataset that has poses but no points: triangulated matches of its training photographs.
//!
//! Datasets of LLFF, of instant-ngp or from a phone's tracking have no points. Splats then begin at random positions, and nothing shows
//! which space is empty: the same photographs of fox at 540x960, by the same recipe in the same time, are 2 dB worse (RESULTS.md).

use super::output::mean_color;
use super::stages::max_features;
use super::view_features::{ViewFeatures, pose};
use crate::background::is_rendered;
use irradia_scene::{Dataset, Lens, PointCloud};
use irradia_sfm::features::Sift;
use irradia_sfm::map::{KnownGeometry, MapOptions, PhotoInfo, add_guided_points, extend};
use irradia_sfm::matching::{MatchOptions, PairOptions, candidate_pairs, match_pairs};
use rayon::prelude::*;

/// Maximum number of training photographs that are matched; if there are more, evenly spaced ones.
const MAX_PHOTOS: usize = 400;
/// Minimum number of points: fewer say little about where surfaces are.
const MIN_POINTS: usize = 200;
/// Maximum number of photographs whose features are also matched along epipolar lines. Held-out PSNR of the default run on 12 photographs
/// with known poses, three seeds, without and with: fox 28.30, 28.70 dB; cup 24.36, 24.80; can 29.12, 28.96; plush bear 26.50, 26.78; plush
/// toy 24.85, 25.16. With 24 photographs it gains no more than 0.1 dB.
const MAX_GUIDED_PHOTOS: usize = 25;

/// Whether points should be found for `dataset`: it has none and was not rendered. In rendered datasets, empty space is known, and poses
/// may be arbitrary.
pub(crate) fn lacks_points(dataset: &Dataset) -> bool {
    dataset.points.as_ref().is_none_or(PointCloud::is_empty) && !is_rendered(dataset)
}

/// Adds points from matches of the training photographs to `dataset`, in its world, and records in each view which of them it shows.
/// Returns their number, or `None` if there are too few, in which case the dataset is unchanged. `larger` has the same views with more
/// pixels. Held-out photographs are not used.
pub(crate) fn find_points(dataset: &mut Dataset, larger: Option<&Dataset>) -> Option<usize> {
    let step = dataset.train.len().div_ceil(MAX_PHOTOS).max(1);
    let chosen: Vec<usize> = dataset.train.iter().copied().step_by(step).collect();
    let photos_of = &larger.unwrap_or(dataset).views;
    let is_pinhole = |view: &usize| photos_of[*view].camera.intrinsics.lens == Lens::Pinhole;
    if !chosen.iter().all(is_pinhole) {
        return None;
    }
    let (side, most) = (Sift::default().max_side, max_features(None, chosen.len()));
    let look = |view: &usize| Some((*view, ViewFeatures::extract(&photos_of[*view], side, most)?));
    let extracted: Vec<(usize, ViewFeatures)> = chosen.par_iter().filter_map(look).collect();
    let (mut views, mut photos, mut features, mut colors) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (group, (view, look)) in extracted.into_iter().enumerate() {
        colors.push(look.colors);
        photos.push(PhotoInfo { group, ..look.info });
        features.push(look.features);
        views.push(view);
    }
    let known = KnownGeometry {
        poses: views
            .iter()
            .map(|view| Some(pose(&dataset.views[*view].camera)))
            .collect(),
        cameras: photos.iter().map(|photo| photo.camera).collect(),
    };
    let matching = MatchOptions::default();
    let candidates = candidate_pairs(&features, &PairOptions::default(), &matching);
    let matches = match_pairs(&features, &candidates, &matching, || ());
    let options = MapOptions::default();
    let mut found = extend(&photos, &features, &matches, &known, &options, &mut |_| ());
    let mut model = found.models.pop()?;
    if photos.len() <= MAX_GUIDED_PHOTOS {
        add_guided_points(&photos, &features, &found.pairs, &mut model, &options);
    }
    let points = model.points;
    if points.len() < MIN_POINTS {
        return None;
    }
    for (i, point) in (0u32..).zip(&points) {
        for (photo, _) in &point.track {
            dataset.views[views[*photo as usize]].points_seen.push(i);
        }
    }
    dataset.points = Some(PointCloud {
        positions: points.iter().map(|point| point.position.as_vec3()).collect(),
        colors: points.iter().map(|point| mean_color(point, &colors)).collect(),
    });
    Some(points.len())
}

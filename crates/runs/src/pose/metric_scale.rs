//! Scale in metres from the GPS positions in the photographs' metadata, or from known distances.

use super::stages::Work;
use super::{KnownDistance, ScaleReport};
use crate::RunError;
use glam::DVec3;
use irradia_formats::PhotoFolder;
use irradia_sfm::map::{Distance, Model, PhotoInfo, scale_to_distances, scale_to_locations};

/// Equatorial radius of the earth and the square of its eccentricity (WGS 84), m.
const RADIUS_M: f64 = 6_378_137.0;
const ECCENTRICITY_SQUARED: f64 = 6.694_379_990_14e-3;

/// Known distances contradict each other if their scales differ by more than this ratio: a tape measure is more precise, and poses account
/// for smaller differences.
const MAX_SCALE_RATIO: f64 = 1.1;

/// Scales `model` to metres if enough photographs have a GPS position, and reports the scale; warns if the positions do not determine it
/// well enough.
pub(super) fn scale_by_gps(folder: &PhotoFolder, work: &mut Work, model: &mut Model) -> Option<ScaleReport> {
    let gps: Vec<Option<[f64; 3]>> = work.photos().iter().map(|i| folder.photos[*i].tags.gps).collect();
    match scale_to_locations(model, &to_local(&gps)) {
        Ok(metric) => Some(ScaleReport {
            distances: 0,
            photos: metric.photos,
            with_place: metric.total,
            residual_m: metric.residual_m,
            scale_error: metric.scale_error,
        }),
        Err(Some(error)) => {
            work.warn(Some(format!(
                "the GPS positions leave the scale uncertain by {:.0} %: the unit of the poses is arbitrary",
                100.0 * error.min(10.0)
            )));
            None
        }
        Err(None) => None,
    }
}

/// Rejects distances that cannot be used, before any work is done.
pub(super) fn check_distances(distances: &[KnownDistance], folder: &PhotoFolder) -> Result<(), RunError> {
    for distance in distances {
        let [a, b] = &distance.photos;
        let unknown = [a, b]
            .into_iter()
            .find(|name| !folder.photos.iter().any(|photo| photo.name == **name));
        let message = match unknown {
            Some(name) => format!("{name} is not among the photographs"),
            None if a == b => "must be between two photographs".to_owned(),
            None if !(distance.metres.is_finite() && distance.metres > 0.0) => "must be more than 0 metres".to_owned(),
            None => continue,
        };
        return Err(refused(distance, message));
    }
    Ok(())
}

fn refused(distance: &KnownDistance, message: String) -> RunError {
    let [a, b] = &distance.photos;
    RunError::setting("distance", format!("{a},{b},{}", distance.metres), message)
}

/// Scales `model` to metres by known distances, and warns of one that contradicts the others; `None` if no distances are given.
pub(super) fn scale_by_distances(
    distances: &[KnownDistance],
    infos: &[PhotoInfo],
    work: &mut Work,
    model: &mut Model,
) -> Result<Option<ScaleReport>, RunError> {
    if distances.is_empty() {
        return Ok(None);
    }
    let posed = |name: &String| (0..infos.len()).find(|i| infos[*i].name == *name && model.poses[*i].is_some());
    let mut known = Vec::new();
    for distance in distances {
        let photos = distance.photos.each_ref().map(posed);
        let [Some(a), Some(b)] = photos else {
            let name = &distance.photos[usize::from(photos[0].is_some())];
            return Err(refused(
                distance,
                format!("{name} has no pose in the largest model: name another photograph"),
            ));
        };
        known.push(Distance {
            photos: [a, b],
            metres: distance.metres,
        });
    }
    match scale_to_distances(model, infos, &known) {
        Some(metric) => {
            let lengths = known.iter().map(|distance| length(model, distance));
            let ratios = distances
                .iter()
                .zip(lengths)
                .map(|(distance, length)| distance.metres / length);
            work.warn(contradicting(distances, &ratios.collect::<Vec<_>>()));
            Ok(Some(ScaleReport {
                distances: known.len(),
                residual_m: metric.residual_m,
                scale_error: metric.scale_error,
                ..ScaleReport::default()
            }))
        }
        None => Err(refused(
            &distances[0],
            "both photographs appear to have been taken from the same place: name photographs that are farther apart"
                .to_owned(),
        )),
    }
}

/// The distance of the model between the cameras of `distance`, which have poses.
fn length(model: &Model, distance: &Distance) -> f64 {
    let [a, b] = distance
        .photos
        .map(|photo| model.poses[photo].as_ref().expect("posed").position);
    a.distance(b)
}

/// A warning about the distance whose ratio to the model is farthest from the median, if it differs by more than [`MAX_SCALE_RATIO`].
fn contradicting(distances: &[KnownDistance], ratios: &[f64]) -> Option<String> {
    let mut sorted = ratios.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let median_ratio = *sorted.get(ratios.len().checked_sub(1)? / 2)?;
    let off = ratios.iter().map(|ratio| ratio / median_ratio).zip(distances);
    let (off, distance) = off.max_by(|a, b| a.0.ln().abs().total_cmp(&b.0.ln().abs()))?;
    let [a, b] = &distance.photos;
    (off.ln().abs() > MAX_SCALE_RATIO.ln()).then(|| {
        format!(
            "the distance {a},{b},{} is {off:.2} times what the other distances imply: one of them is wrong, and so is the scale",
            distance.metres
        )
    })
}

/// East, north and up, m, of latitudes, longitudes and altitudes, on the plane tangent to the earth at their median. The median, because a
/// distant position, as some cameras write before they have a fix, must not move that point: at another latitude, a degree along the
/// parallel has another length.
fn to_local(gps: &[Option<[f64; 3]>]) -> Vec<Option<DVec3>> {
    let known: Vec<&[f64; 3]> = gps.iter().flatten().collect();
    let [latitude, altitude] = [0, 2].map(|k| median(known.iter().map(|place| place[k])));
    // Relative to the first position, so that positions may straddle the date line.
    let first = known.first().map_or(0.0, |place| place[1]);
    let around = |from: f64, longitude: f64| (longitude - from + 540.0).rem_euclid(360.0) - 180.0;
    let longitude = first + median(known.iter().map(|place| around(first, place[1])));
    let (sin, cos) = latitude.to_radians().sin_cos();
    // Radii of curvature along the parallel and along the meridian.
    let flattened = 1.0 - ECCENTRICITY_SQUARED * sin * sin;
    let east = RADIUS_M / flattened.sqrt() * cos;
    let north = RADIUS_M * (1.0 - ECCENTRICITY_SQUARED) / flattened.powf(1.5);
    let place = |[lat, lon, up]: [f64; 3]| {
        DVec3::new(
            east * around(longitude, lon).to_radians(),
            north * (lat - latitude).to_radians(),
            up - altitude,
        )
    };
    gps.iter().map(|known| known.map(place)).collect()
}

/// The median of `values`; 0 if there are none.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    match values.len() {
        0 => 0.0,
        n => 0.5 * (values[(n - 1) / 2] + values[n / 2]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn degrees_become_metres() {
        // A degree along the meridian at 45 degrees north is 111.13 km, along the parallel 78.85 km.
        let places = to_local(&[Some([44.5, 7.5, 100.0]), None, Some([45.5, 8.5, 300.0])]);
        let [Some(a), None, Some(b)] = places[..] else {
            panic!("{places:?}");
        };
        let d = b - a;
        assert!(
            (d.x - 78_847.0).abs() < 10.0 && (d.y - 111_132.0).abs() < 10.0 && d.z == 200.0,
            "{d}"
        );
        // A position at the equator, as written before the camera has a fix, changes nothing.
        let place = |east: f64| Some([45.0, 7.0 + east, 100.0]);
        let places = to_local(&[place(0.0), Some([0.0, 1.0, 0.0]), place(0.5), place(1.0), place(0.5)]);
        let [Some(a), _, _, Some(b), _] = places[..] else {
            panic!("{places:?}");
        };
        assert!((b.x - a.x - 78_847.0).abs() < 10.0, "{a} {b}");
        let across = to_local(&[Some([0.0, 179.999, 0.0]), Some([0.0, -179.999, 0.0])]);
        let [Some(west), Some(east)] = across[..] else {
            panic!("{across:?}");
        };
        assert!((east.x - west.x - 222.6).abs() < 0.1, "{west} {east}");
    }

    #[test]
    fn a_distance_that_contradicts_the_others_is_named() {
        let of = |n: usize| KnownDistance {
            photos: [format!("{n}.jpg"), format!("{}.jpg", n + 1)],
            metres: 1.0,
        };
        let distances: Vec<KnownDistance> = (0..3).map(of).collect();
        let warning = contradicting(&distances, &[1.0, 2.0, 1.02]).unwrap();
        assert!(warning.contains("1.jpg,2.jpg,1 is 1.96 times"), "{warning}");
        assert_eq!(contradicting(&distances, &[1.0, 1.05, 0.97]), None);
        assert!(contradicting(&distances[..2], &[1.0, 2.0]).is_some());
        assert_eq!(contradicting(&distances[..1], &[1.0]), None);
    }
}

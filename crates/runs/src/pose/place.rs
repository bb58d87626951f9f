//! Metres from what the photographs' metadata say of their places, or from known distances.

use super::stages::Work;
use super::{KnownDistance, ScaleReport};
use crate::RunError;
use glam::DVec3;
use irradia_formats::PhotoFolder;
use irradia_sfm::map::{Distance, Model, PhotoInfo, to_distances, to_metres};

/// Equatorial radius of the earth and the square of its eccentricity (WGS 84), m.
const RADIUS_M: f64 = 6_378_137.0;
const ECCENTRICITY_SQUARED: f64 = 6.694_379_990_14e-3;

/// Brings `model` to metres if enough photographs tell their place, and tells what is known of its scale; warns where that is too little.
pub(super) fn scale(folder: &PhotoFolder, work: &mut Work, model: &mut Model) -> Option<ScaleReport> {
    let gps: Vec<Option<[f64; 3]>> = work.photos().iter().map(|i| folder.photos[*i].tags.gps).collect();
    match to_metres(model, &local(&gps)) {
        Ok(metric) => Some(ScaleReport {
            distances: 0,
            photos: metric.photos,
            with_place: metric.of,
            residual_m: metric.residual_m,
            scale_error: metric.scale_error,
        }),
        Err(Some(error)) => {
            work.warn(Some(format!(
                "the places of the photographs leave the scale open by {:.0} %: the unit of the poses is arbitrary",
                100.0 * error.min(10.0)
            )));
            None
        }
        Err(None) => None,
    }
}

/// Refuses distances that cannot be used, before anything else is done.
pub(super) fn check(distances: &[KnownDistance], folder: &PhotoFolder) -> Result<(), RunError> {
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

/// Brings `model` to metres by known distances; `None` if there are none.
pub(super) fn scale_by_distances(
    distances: &[KnownDistance],
    infos: &[PhotoInfo],
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
    match to_distances(model, infos, &known) {
        Some(metric) => Ok(Some(ScaleReport {
            distances: known.len(),
            residual_m: metric.residual_m,
            scale_error: metric.scale_error,
            ..ScaleReport::default()
        })),
        None => Err(refused(
            &distances[0],
            "the two were taken from one place, as far as can be told: name photographs that are farther apart"
                .to_owned(),
        )),
    }
}

/// East, north and up, m, of latitudes, longitudes and altitudes, about their mean: on the plane that touches the earth there.
fn local(gps: &[Option<[f64; 3]>]) -> Vec<Option<DVec3>> {
    let known: Vec<&[f64; 3]> = gps.iter().flatten().collect();
    let mean = |k: usize| known.iter().map(|place| place[k]).sum::<f64>() / known.len().max(1) as f64;
    let [latitude, longitude, altitude] = [0, 1, 2].map(mean);
    let (sin, cos) = latitude.to_radians().sin_cos();
    // Radii of curvature along the parallel and along the meridian.
    let flattened = 1.0 - ECCENTRICITY_SQUARED * sin * sin;
    let east = RADIUS_M / flattened.sqrt() * cos;
    let north = RADIUS_M * (1.0 - ECCENTRICITY_SQUARED) / flattened.powf(1.5);
    let place = |[lat, lon, up]: [f64; 3]| {
        // Across the date line.
        let around = (lon - longitude + 540.0).rem_euclid(360.0) - 180.0;
        DVec3::new(
            east * around.to_radians(),
            north * (lat - latitude).to_radians(),
            up - altitude,
        )
    };
    gps.iter().map(|known| known.map(place)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn degrees_become_metres() {
        // A degree along the meridian at 45 degrees north is 111.13 km, along the parallel 78.85 km.
        let places = local(&[Some([44.5, 7.5, 100.0]), None, Some([45.5, 8.5, 300.0])]);
        let [Some(a), None, Some(b)] = places[..] else {
            panic!("{places:?}");
        };
        let d = b - a;
        assert!(
            (d.x - 78_847.0).abs() < 10.0 && (d.y - 111_132.0).abs() < 10.0 && d.z == 200.0,
            "{d}"
        );
    }
}

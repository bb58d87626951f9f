//! Metric scale from known distances between cameras.

use super::types::{Model, PhotoInfo};
use crate::geometry::align::Alignment;
use crate::geometry::linear::solve_spd;
use glam::{DQuat, DVec3};

/// Mean length of a two-dimensional error relative to the standard deviation of each coordinate: the square root of pi / 2.
const RAYLEIGH_MEAN: f64 = 1.253_314_137_315_5;

/// A known distance between two cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Distance {
    /// Indices of both photographs.
    pub photos: [usize; 2],
    /// Metres.
    pub metres: f64,
}

/// How well a model agrees with known distances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DistanceFit {
    /// Root mean square of the differences between the known distances and the model's, m.
    pub residual_m: f64,
    /// Relative standard deviation of the scale, due to the poses and, if there are several distances, to their differences.
    pub scale_error: f64,
}

/// Scales `model` to metres about its origin: the sum of its distances becomes that of the known ones, so long distances count more.
///
/// `None`, and nothing changes, if a photograph has no pose or the cameras cannot be told to be at different places.
pub fn scale_to_distances(model: &mut Model, photos: &[PhotoInfo], distances: &[Distance]) -> Option<DistanceFit> {
    let (mut metres, mut units, mut variance) = (0.0, 0.0, 0.0);
    let mut lengths = Vec::new();
    for distance in distances {
        let [a, b] = distance
            .photos
            .map(|p| model.poses[p].as_ref().map(|pose| pose.position));
        let between = b? - a?;
        let along = between.try_normalize()?;
        for photo in distance.photos {
            variance += position_variance(model, photos, photo, along)?;
        }
        metres += distance.metres;
        units += between.length();
        lengths.push(between.length());
    }
    let scale = metres / units;
    // Otherwise more than half of the distance could be noise.
    if !(scale.is_finite() && scale > 0.0) || variance.sqrt() > 0.5 * units {
        return None;
    }
    let squares: f64 = distances
        .iter()
        .zip(&lengths)
        .map(|(distance, length)| (distance.metres - scale * length).powi(2))
        .sum();
    let n = distances.len() as f64;
    // The variance of the sum of n differences; one degree of freedom is spent on the scale.
    let scatter = if distances.len() > 1 {
        squares * n / (n - 1.0)
    } else {
        0.0
    };
    model.align(&Alignment {
        scale,
        rotation: DQuat::IDENTITY,
        translation: DVec3::ZERO,
    });
    Some(DistanceFit {
        residual_m: (squares / n).sqrt(),
        scale_error: (variance / (units * units) + scatter / (metres * metres)).sqrt(),
    })
}

/// Variance of a camera's position along a direction, in squared units of the model, from the reprojection errors of its points, whose
/// positions are assumed to be exact. `None` if its points do not determine its pose.
fn position_variance(model: &Model, photos: &[PhotoInfo], photo: usize, along: DVec3) -> Option<f64> {
    let pose = model.poses[photo].as_ref()?;
    let camera = model.cameras[photos[photo].group].as_ref()?;
    let from_world = pose.camera_rotation();
    let mut information = [[0.0; 6]; 6];
    for point in &model.points {
        let seen = point.track.binary_search_by_key(&(photo as u32), |seen| seen.0).is_ok();
        let p = pose.camera_from_world(point.position);
        if !seen || p.z <= 0.0 {
            continue;
        }
        for row in camera.project(p).point_jacobian {
            // A shift of the camera moves the point in the opposite direction, a turn rotates it about the camera.
            let [shift, turn] = [-(from_world.transpose() * row), p.cross(row)];
            let row = [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z];
            for i in 0..6 {
                for j in 0..6 {
                    information[i][j] += row[i] * row[j];
                }
            }
        }
    }
    let direction = [along.x, along.y, along.z, 0.0, 0.0, 0.0];
    let solved = solve_spd(information, direction)?;
    let deviation = model.mean_error() / RAYLEIGH_MEAN;
    let variance: f64 = direction.iter().zip(&solved).map(|(a, b)| a * b).sum();
    Some(deviation * deviation * variance)
}

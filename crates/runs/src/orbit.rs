//! Where a scene is viewed from: its centre and up axis, and cameras on a circle around it.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use glam::{DQuat, DVec3, Vec3};
use irradia_scene::{Camera, Intrinsics, Pose, median, survey};
use irradia_sfm::upright;
use irradia_splat::{Splats, init::focus_point};

/// Where a scene is viewed from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OrbitGeometry {
    /// The focus of the training cameras, the ground below the cameras of a survey, what is before cameras whose focus is behind them, or
    /// the middle of most splats; world.
    pub center: Vec3,
    /// Unit vector, derived from how the cameras were held.
    pub up: Vec3,
    /// Mean distance of the cameras from the axis through the centre along `up`, world units.
    pub radius: f32,
    /// Mean height of the cameras above the centre, world units.
    pub height: f32,
    /// Intrinsic parameters of the first camera, or 1280 x 720 pixels and a field of view of one radian.
    pub intrinsics: Intrinsics,
}

/// Maximum number of splats that are sampled to find the ground of a survey.
const MAX_GROUND_SAMPLES: usize = 10_000;

/// The geometry from the training cameras; for a scene without them, from the distribution of its splats.
pub(crate) fn orbit_geometry(splats: Option<&Splats>, cameras: Option<&[Camera]>) -> OrbitGeometry {
    match cameras.filter(|cameras| !cameras.is_empty()) {
        Some(cameras) => {
            let (center, up) = center_and_up(splats, cameras);
            let n = cameras.len() as f32;
            let height = cameras.iter().map(|c| (c.pose.position - center).dot(up)).sum::<f32>() / n;
            let across = |c: &Camera| {
                let offset = c.pose.position - center;
                (offset - up * offset.dot(up)).length()
            };
            let radius = cameras.iter().map(across).sum::<f32>() / n;
            OrbitGeometry {
                center,
                up,
                radius,
                height,
                intrinsics: cameras[0].intrinsics,
            }
        }
        None => {
            let quantiles = |plane: &dyn Fn(&Splats) -> &[f32]| {
                let plane = splats.map_or(&[][..], |splats| &plane(splats)[..splats.len()]);
                let mut values: Vec<f32> = plane.iter().copied().filter(|v| v.is_finite()).collect();
                values.sort_unstable_by(f32::total_cmp);
                move |share: f32| values.get((values.len() as f32 * share) as usize).copied()
            };
            let axes = [0, 1, 2].map(|c| {
                let at = quantiles(&|splats| splats.means.plane(c));
                let [first, low, high, last] = [0.02, 0.1, 0.9, 0.98].map(|share| at(share).unwrap_or(0.0));
                // Includes all of an object, but not the far surroundings of a scene.
                let (middle, reach) = (0.5 * (low + high), 0.75 * (high - low));
                let (low, high) = (first.max(middle - reach), last.min(middle + reach));
                (0.5 * (low + high), high - low)
            });
            // For a few splats in one place, the extent of the splats themselves counts.
            let sizes = [0, 1, 2].map(|c| quantiles(&|splats| splats.log_scales.plane(c))(0.5).map_or(0.0, f32::exp));
            let size = axes
                .iter()
                .map(|a| a.1)
                .chain(sizes.map(|size| 4.0 * size))
                .fold(1e-3, f32::max);
            OrbitGeometry {
                center: Vec3::from_array(axes.map(|a| a.0)),
                // Most files of this kind come from COLMAP, whose y axis points down.
                up: Vec3::NEG_Y,
                // A 16:9 view is 0.61 of its distance high.
                radius: 2.0 * size,
                height: 0.5 * size,
                intrinsics: Intrinsics::from_fov_x(1280, 720, 1.0),
            }
        }
    }
}

fn center_and_up(splats: Option<&Splats>, cameras: &[Camera]) -> (Vec3, Vec3) {
    let pose = |camera: &Camera| (camera.pose.rotation.as_dquat(), camera.pose.position.as_dvec3());
    let poses: Vec<(DQuat, DVec3)> = cameras.iter().map(pose).collect();
    let points = splats.into_iter().flat_map(|splats| {
        let every = splats.len().div_ceil(MAX_GROUND_SAMPLES).max(1);
        (0..splats.len())
            .step_by(every)
            .map(|i| Vec3::from(splats.mean(i)).as_dvec3())
    });
    let points: Vec<DVec3> = points.filter(|point| point.is_finite()).collect();
    match survey(&poses, points.iter().copied()) {
        Some(survey) => (survey.center.as_vec3(), survey.up.as_vec3()),
        None => {
            let up = upright::up(poses.iter().map(|(rotation, _)| (*rotation, None)));
            let focus = focus_point(cameras);
            let center = center_ahead(&poses, &points, focus.as_dvec3()).map_or(focus, |center| center.as_vec3());
            (center, up.as_vec3())
        }
    }
}

/// Minimum length of the mean viewing direction of cameras that look one way, not around them.
const MIN_COMMON_DIRECTION: f64 = 0.5;

/// If cameras of these world-from-camera rotations and positions look one way with the `focus` behind them, as in a film that turns as it
/// moves ahead: the place at the median distance of the `points` before them.
fn center_ahead(poses: &[(DQuat, DVec3)], points: &[DVec3], focus: DVec3) -> Option<DVec3> {
    let n = poses.len() as f64;
    let forward = poses.iter().map(|(rotation, _)| *rotation * DVec3::Z).sum::<DVec3>() / n;
    let mean = poses.iter().map(|(_, position)| *position).sum::<DVec3>() / n;
    if forward.length() < MIN_COMMON_DIRECTION || (focus - mean).dot(forward) > 0.0 {
        return None;
    }
    let forward = forward.normalize();
    let depths = points.iter().map(|point| (*point - mean).dot(forward));
    Some(mean + median(depths.filter(|depth| *depth > 0.0).collect())? * forward)
}

/// A gap between the azimuths of adjacent cameras beyond which that side counts as not photographed, radians.
const MIN_GAP_RADIANS: f32 = FRAC_PI_2;
/// Minimum half-width of an arc, for cameras that hardly move, radians.
const MIN_HALF_WIDTH_RADIANS: f32 = 0.1;

/// The middle and half the width of the arc that contains all `azimuths`, radians; `None` if there is no azimuth, or they are all around.
fn arc(mut azimuths: Vec<f32>) -> Option<(f32, f32)> {
    azimuths.sort_unstable_by(f32::total_cmp);
    let n = azimuths.len();
    let next = |i: usize| azimuths[(i + 1) % n] + if i + 1 == n { TAU } else { 0.0 };
    let (last, gap) = (0..n)
        .map(|i| (i, next(i) - azimuths[i]))
        .max_by(|a, b| a.1.total_cmp(&b.1))?;
    let half = 0.5 * (TAU - gap);
    // Between -pi and pi, like the azimuths.
    let middle = (next(last) + half + PI).rem_euclid(TAU) - PI;
    (gap > MIN_GAP_RADIANS).then_some((middle, half.max(MIN_HALF_WIDTH_RADIANS)))
}

/// A circle around the centre of the scene, at the training cameras' mean distance and height; back and forth on an arc if these are on
/// one side of it. The path starts at the azimuth of the first camera.
pub(crate) fn orbit(
    splats: Option<&Splats>,
    cameras: Option<&[Camera]>,
    frames: u32,
    size: Option<(u32, u32)>,
) -> Vec<Camera> {
    let OrbitGeometry {
        center,
        up,
        radius,
        height,
        mut intrinsics,
    } = orbit_geometry(splats, cameras);
    if let Some((width, height)) = size {
        let fov_x = 2.0 * (0.5 * intrinsics.width as f32 / intrinsics.fx).atan();
        intrinsics = Intrinsics::from_fov_x(width, height, fov_x);
    }
    let cameras = cameras.unwrap_or_default();
    let toward = cameras
        .first()
        .map_or(up.any_orthonormal_vector(), |c| c.pose.position - center);
    let x = (toward - up * toward.dot(up)).normalize_or(up.any_orthonormal_vector());
    let y = up.cross(x);
    let azimuth = |camera: &Camera| {
        let offset = camera.pose.position - center;
        offset.dot(y).atan2(offset.dot(x))
    };
    let arc = arc(cameras.iter().map(azimuth).collect());
    (0..frames)
        .map(|i| {
            let turn = TAU * i as f32 / frames as f32;
            let angle = match arc {
                // The first camera's azimuth is zero.
                Some((middle, half)) => {
                    let start = (-middle / half).clamp(-1.0, 1.0).asin();
                    middle + half * (turn + start).sin()
                }
                None => turn,
            };
            let eye = center + radius * (x * angle.cos() + y * angle.sin()) + up * height;
            Camera::new(Pose::look_at(eye, center, up), intrinsics)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use irradia_scene::GaussianCloud;

    /// Cameras at these azimuths, degrees, on a circle of radius 3 around the z axis.
    fn ring(azimuths: impl IntoIterator<Item = f32>) -> Vec<Camera> {
        let camera = |degrees: f32| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let pose = Pose::look_at(Vec3::new(3.0 * cos, 3.0 * sin, 1.0), Vec3::ZERO, Vec3::Z);
            Camera::new(pose, Intrinsics::from_fov_x(64, 48, 1.0))
        };
        azimuths.into_iter().map(camera).collect()
    }

    fn azimuths(cameras: &[Camera]) -> Vec<f32> {
        let azimuth = |c: &Camera| c.pose.position.y.atan2(c.pose.position.x).to_degrees();
        cameras.iter().map(azimuth).collect()
    }

    #[test]
    fn an_orbit_stays_on_the_side_that_was_photographed() {
        // Across the cut of the azimuths, from 120 to 240 degrees.
        let cameras = ring((0..=12).map(|i| 10.0 * i as f32 + 120.0));
        let seen = azimuths(&orbit(None, Some(&cameras), 64, None));
        let beside = seen.iter().map(|azimuth| (azimuth.abs() - 180.0).abs());
        let width = beside.clone().fold(0.0, f32::max);
        assert!((width - 60.0).abs() < 0.5, "{seen:?}");
        assert!((seen[0] - 120.0).abs() < 0.5, "{seen:?}");
        let step = |i: usize| (seen[(i + 1) % 64] - seen[i] + 540.0).rem_euclid(360.0) - 180.0;
        assert!((0..64).all(|i| step(i).abs() < 7.0), "{seen:?}");

        let alone = azimuths(&orbit(None, Some(&ring([30.0])), 16, None));
        assert!(alone.iter().all(|azimuth| azimuth.is_finite()), "{alone:?}");
    }

    #[test]
    fn an_orbit_of_cameras_all_around_is_a_circle() {
        let cameras = ring((0..9).map(|i| 35.0 * i as f32));
        let seen = azimuths(&orbit(None, Some(&cameras), 4, None));
        for (azimuth, expected) in seen.iter().zip([0.0, 90.0, 180.0, -90.0]) {
            let off = (azimuth - expected + 540.0).rem_euclid(360.0) - 180.0;
            assert!(off.abs() < 0.5, "{seen:?}");
        }
    }

    /// Small, mostly opaque splats.
    fn splats_at(means: Vec<[f32; 3]>) -> Splats {
        let n = means.len();
        Splats::from_cloud(&GaussianCloud {
            means,
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            log_scales: vec![[-3.0; 3]; n],
            opacity_logits: vec![2.0; n],
            sh: vec![0.0; 3 * n],
            sh_degree: 0,
            ..GaussianCloud::default()
        })
    }

    #[test]
    fn around_a_survey_means_above_its_ground() {
        let ground = (0..400).map(|i| [0.5 * (i % 20) as f32, 0.5 * (i / 20) as f32, 0.0]);
        let splats = splats_at(ground.collect());
        let camera = |i: usize| {
            let pose = Pose {
                rotation: Quat::from_rotation_x(std::f32::consts::PI),
                position: Vec3::new(2.5 * (i % 5) as f32, 2.5 * (i / 5) as f32, 4.0),
            };
            Camera::new(pose, Intrinsics::from_fov_x(64, 48, 1.0))
        };
        let cameras: Vec<Camera> = (0..20).map(camera).collect();
        for camera in orbit(Some(&splats), Some(&cameras), 8, None) {
            let forward = camera.pose.rotation * Vec3::Z;
            assert!(
                camera.pose.position.z > 3.0 && forward.z < -0.5,
                "{:?} {forward}",
                camera.pose
            );
        }
    }

    #[test]
    fn cameras_that_turn_away_from_each_other_are_before_the_scene() {
        let wall = (0..100).map(|i| [0.3 * (i % 10) as f32 - 1.5, 5.0, 0.1 * (i / 10) as f32]);
        let splats = splats_at(wall.collect());
        // The axes meet behind the cameras.
        let camera = |i: usize| {
            let x = 0.1 * (i as f32 - 4.0);
            let pose = Pose::look_at(Vec3::new(x, 0.0, 1.0), Vec3::new(6.0 * x, 5.0, 0.5), Vec3::Z);
            Camera::new(pose, Intrinsics::from_fov_x(64, 48, 1.0))
        };
        let cameras: Vec<Camera> = (0..9).map(camera).collect();
        assert!(focus_point(&cameras).y < 0.0);
        let center = orbit_geometry(Some(&splats), Some(&cameras)).center;
        assert!((center - Vec3::new(0.0, 5.0, 0.5)).length() < 0.2, "{center}");
        // Those that look around them orbit their middle.
        let around = ring((0..12).map(|i| 30.0 * i as f32)).into_iter().map(|mut camera| {
            camera.pose.rotation = Quat::from_rotation_z(std::f32::consts::PI) * camera.pose.rotation;
            camera
        });
        let around: Vec<Camera> = around.collect();
        let center = orbit_geometry(Some(&splats), Some(&around)).center;
        assert!((center - focus_point(&around)).length() < 1e-4, "{center}");
    }
}

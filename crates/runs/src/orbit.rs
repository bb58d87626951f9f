//! Cameras on a circle around a scene.

use glam::Vec3;
use irradia_scene::{Camera, Intrinsics, Pose};
use irradia_splat::{Splats, init::focus_point};

/// A circle around the focus of the training cameras, at their mean distance and height; for a scene without them, around
/// the centre of the splats.
pub(crate) fn orbit(
    splats: Option<&Splats>,
    cameras: Option<&[Camera]>,
    frames: u32,
    size: Option<(u32, u32)>,
) -> Vec<Camera> {
    let cameras = cameras.filter(|c| !c.is_empty());
    let (center, up, radius, height, mut intrinsics) = match cameras {
        Some(cameras) => {
            let center = focus_point(cameras);
            let n = cameras.len() as f32;
            let up = (cameras.iter().map(|c| c.pose.rotation * Vec3::NEG_Y).sum::<Vec3>() / n).normalize_or(Vec3::Z);
            let height = cameras.iter().map(|c| (c.pose.position - center).dot(up)).sum::<f32>() / n;
            let across = |c: &Camera| {
                let offset = c.pose.position - center;
                (offset - up * offset.dot(up)).length()
            };
            let radius = cameras.iter().map(across).sum::<f32>() / n;
            (center, up, radius, height, cameras[0].intrinsics)
        }
        None => {
            let middle = |c: usize| {
                let plane = splats.map_or(&[][..], |splats| &splats.means.plane(c)[..splats.len()]);
                let mut values: Vec<f32> = plane.iter().copied().filter(|v| v.is_finite()).collect();
                values.sort_unstable_by(f32::total_cmp);
                let at = |share: f32| {
                    values
                        .get((values.len() as f32 * share) as usize)
                        .copied()
                        .unwrap_or(0.0)
                };
                (at(0.5), at(0.9) - at(0.1))
            };
            let axes = [middle(0), middle(1), middle(2)];
            let size = axes.iter().map(|a| a.1).fold(1e-3, f32::max);
            // Most files of this kind come from COLMAP, whose y axis points down.
            (
                Vec3::from_array(axes.map(|a| a.0)),
                Vec3::NEG_Y,
                1.5 * size,
                0.4 * size,
                Intrinsics::from_fov_x(1280, 720, 1.0),
            )
        }
    };
    if let Some((width, height)) = size {
        let fov_x = 2.0 * (0.5 * intrinsics.width as f32 / intrinsics.fx).atan();
        intrinsics = Intrinsics::from_fov_x(width, height, fov_x);
    }
    // The circle starts at the azimuth of the first camera.
    let toward = cameras.map_or(up.any_orthonormal_vector(), |c| c[0].pose.position - center);
    let x = (toward - up * toward.dot(up)).normalize_or(up.any_orthonormal_vector());
    let y = up.cross(x);
    (0..frames)
        .map(|i| {
            let angle = std::f32::consts::TAU * i as f32 / frames as f32;
            let eye = center + radius * (x * angle.cos() + y * angle.sin()) + up * height;
            Camera::new(Pose::look_at(eye, center, up), intrinsics)
        })
        .collect()
}

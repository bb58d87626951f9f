//! Where a scene is seen from: its centre and up axis, and cameras on a circle around it.

use glam::Vec3;
use irradia_scene::{Camera, Intrinsics, Pose};
use irradia_splat::{Splats, init::focus_point};

/// From where a scene is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outlook {
    /// The focus of the training cameras, or the centre of the splats; world.
    pub center: Vec3,
    /// Unit vector, the cameras' mean up axis.
    pub up: Vec3,
    /// Mean distance of the cameras from the axis through the centre along `up`, world units.
    pub radius: f32,
    /// Mean height of the cameras above the centre, world units.
    pub height: f32,
    /// Intrinsic parameters of the first camera, or 1280 x 720 pixels and a field of view of one radian.
    pub intrinsics: Intrinsics,
}

/// From the training cameras; for a scene without them, from the distribution of its splats.
pub(crate) fn outlook(splats: Option<&Splats>, cameras: Option<&[Camera]>) -> Outlook {
    match cameras.filter(|cameras| !cameras.is_empty()) {
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
            Outlook {
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
                let at = |share| at(share).unwrap_or(0.0);
                (at(0.5), at(0.9) - at(0.1))
            });
            // A few splats in one place are as large as themselves.
            let sizes = [0, 1, 2].map(|c| quantiles(&|splats| splats.log_scales.plane(c))(0.5).map_or(0.0, f32::exp));
            let size = axes
                .iter()
                .map(|a| a.1)
                .chain(sizes.map(|size| 4.0 * size))
                .fold(1e-3, f32::max);
            Outlook {
                center: Vec3::from_array(axes.map(|a| a.0)),
                // Most files of this kind come from COLMAP, whose y axis points down.
                up: Vec3::NEG_Y,
                radius: 1.5 * size,
                height: 0.4 * size,
                intrinsics: Intrinsics::from_fov_x(1280, 720, 1.0),
            }
        }
    }
}

/// A circle around the centre of the scene, at the training cameras' mean distance and height.
pub(crate) fn orbit(
    splats: Option<&Splats>,
    cameras: Option<&[Camera]>,
    frames: u32,
    size: Option<(u32, u32)>,
) -> Vec<Camera> {
    let Outlook {
        center,
        up,
        radius,
        height,
        mut intrinsics,
    } = outlook(splats, cameras);
    if let Some((width, height)) = size {
        let fov_x = 2.0 * (0.5 * intrinsics.width as f32 / intrinsics.fx).atan();
        intrinsics = Intrinsics::from_fov_x(width, height, fov_x);
    }
    // The circle starts at the azimuth of the first camera.
    let first = cameras.and_then(|cameras| cameras.first());
    let toward = first.map_or(up.any_orthonormal_vector(), |c| c.pose.position - center);
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

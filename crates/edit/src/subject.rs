//! What the cameras look at.

use crate::Draft;
use crate::draft::median;
use glam::Vec3;
use irradia_scene::Camera;
use irradia_splat::init::focus_point;

/// The point that the cameras look at, and a radius around it that fills their images: the median over the cameras of the radius of the
/// ball there that spans the longer side of the image. In the coordinates of the dataset; `None` without cameras.
pub fn subject(draft: &Draft) -> Option<([f64; 3], f64)> {
    if draft.cameras.is_empty() {
        return None;
    }
    let focus = focus_point(&draft.cameras);
    let radii = draft.cameras.iter().map(|camera| framed_radius(camera, focus));
    let radius = median(radii.collect());
    let world = draft.cloud.world_from_dataset;
    Some((
        world.invert(focus.as_dvec3()).to_array(),
        f64::from(radius).max(1e-6) / world.scale,
    ))
}

/// Radius of the ball around `focus` that would span the longer side of the camera's image if the camera looked at it.
fn framed_radius(camera: &Camera, focus: Vec3) -> f32 {
    let k = &camera.intrinsics;
    let tangent = (0.5 * k.width as f32 / k.fx).max(0.5 * k.height as f32 / k.fy);
    camera.pose.position.distance(focus) * tangent.atan().sin()
}

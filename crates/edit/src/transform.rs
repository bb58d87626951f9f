//! Moving, rotating and scaling splats and cameras.

use crate::harmonics::BandRotation;
use crate::{Draft, Selection};
use glam::{DQuat, DVec3};
use irradia_scene::{GaussianCloud, Similarity};
use rayon::prelude::*;

/// A similarity of the dataset's coordinates: `to = scale rotation from + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform {
    /// Factor on lengths, positive.
    pub scale: f64,
    /// Rotation.
    pub rotation: DQuat,
    /// Where the origin goes.
    pub translation: DVec3,
}

impl Transform {
    /// The identity.
    pub const IDENTITY: Self = Self {
        scale: 1.0,
        rotation: DQuat::IDENTITY,
        translation: DVec3::ZERO,
    };

    /// The world of a scene in `world` after the whole scene was moved: only rotations then change coordinates of the world.
    pub fn moved_world(&self, world: &Similarity) -> Similarity {
        // world = s (d - c) and d' = k R d + t: with s' = s / k and c' = k R c + t, world' = s' (d' - c') = R world.
        Similarity {
            scale: world.scale / self.scale,
            center: self.apply(world.center),
        }
    }

    /// From the dataset's coordinates to `world`.
    pub fn to_world(world: &Similarity) -> Self {
        Self {
            scale: world.scale,
            rotation: DQuat::IDENTITY,
            translation: world.apply(DVec3::ZERO),
        }
    }

    /// Scale and rotation about `center`.
    pub fn about(center: DVec3, scale: f64, rotation: DQuat) -> Self {
        Self {
            scale,
            rotation,
            translation: center - scale * (rotation * center),
        }
    }

    /// A translation.
    pub fn translation(by: DVec3) -> Self {
        Self {
            translation: by,
            ..Self::IDENTITY
        }
    }

    /// Transforms a point.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }

    /// `self`, then `next`.
    pub fn then(&self, next: &Self) -> Self {
        Self {
            scale: next.scale * self.scale,
            rotation: (next.rotation * self.rotation).normalize(),
            translation: next.apply(self.translation),
        }
    }

    /// The inverse transform.
    pub fn inverse(&self) -> Self {
        let (scale, rotation) = (1.0 / self.scale, self.rotation.inverse());
        Self {
            scale,
            rotation,
            translation: -scale * (rotation * self.translation),
        }
    }

    /// Whether it changes nothing.
    pub fn is_identity(&self) -> bool {
        *self == Self::IDENTITY
    }
}

/// Transforms the selected splats.
pub(crate) fn transform_splats(cloud: &mut GaussianCloud, selection: &Selection, transform: &Transform) {
    let world = cloud.world_from_dataset;
    let moved = |mean: [f32; 3]| {
        let position = world.invert(DVec3::from(mean.map(f64::from)));
        world.apply(transform.apply(position)).as_vec3().to_array()
    };
    let selected = selection.as_slice();
    let means = cloud.means.par_iter_mut().zip(selected).with_min_len(1024);
    means.filter(|(_, s)| **s).for_each(|(mean, _)| *mean = moved(*mean));
    rotate_and_scale(cloud, Some(selected), transform);
}

/// Rotates the quaternions and harmonics of the selected splats and scales their sizes; those of all splats if `selected` is `None`.
fn rotate_and_scale(cloud: &mut GaussianCloud, selected: Option<&[bool]>, transform: &Transform) {
    let is_in = |i: usize| selected.is_none_or(|selected| selected[i]);
    if transform.scale != 1.0 {
        let by = transform.scale.ln();
        let scales = cloud.log_scales.par_iter_mut().enumerate().with_min_len(1024);
        scales
            .filter(|(i, _)| is_in(*i))
            .for_each(|(_, scales)| *scales = scales.map(|scale| (f64::from(scale) + by) as f32));
    }
    if transform.rotation == DQuat::IDENTITY {
        return;
    }
    let quats = cloud.quats.par_iter_mut().enumerate().with_min_len(1024);
    quats.filter(|(i, _)| is_in(*i)).for_each(|(_, quat)| {
        let [w, x, y, z] = quat.map(f64::from);
        // The length is kept: it matters to the optimiser.
        let turned = transform.rotation * DQuat::from_xyzw(x, y, z, w);
        *quat = [turned.w, turned.x, turned.y, turned.z].map(|v| v as f32);
    });
    let bands = BandRotation::new(transform.rotation);
    let width = 3 * cloud.sh_coefficients();
    let harmonics = cloud.sh.par_chunks_exact_mut(width).enumerate().with_min_len(1024);
    harmonics
        .filter(|(i, _)| is_in(*i))
        .for_each(|(_, coefficients)| bands.apply(coefficients));
}

/// Transforms everything: splats and cameras.
///
/// Translation and scale change `world_from_dataset` rather than the coordinates, which keeps every digit and a world of ordinary size,
/// unless the world's coordinates were those of the dataset and can stay so.
pub(crate) fn transform_scene(draft: &mut Draft, transform: &Transform) {
    let old = draft.cloud.world_from_dataset;
    let world = transform.moved_world(&old);
    let turn = transform.rotation;
    if turn != DQuat::IDENTITY {
        draft.cloud.means.par_iter_mut().for_each(|mean| {
            *mean = (turn * DVec3::from(mean.map(f64::from))).as_vec3().to_array();
        });
        let in_world = Transform {
            scale: 1.0,
            ..*transform
        };
        rotate_and_scale(&mut draft.cloud, None, &in_world);
        let turn = turn.as_quat();
        for camera in &mut draft.cameras {
            camera.pose.position = turn * camera.pose.position;
            camera.pose.rotation = (turn * camera.pose.rotation).normalize();
        }
    }
    draft.cloud.world_from_dataset = world;
    if old.is_identity() && fits_dataset_coordinates(&draft.cloud) {
        for camera in &mut draft.cameras {
            camera.pose.position = world.invert(camera.pose.position.as_dvec3()).as_vec3();
        }
        draft.cloud.bring_to_world(Similarity::IDENTITY);
    }
}

/// Whether the dataset's own coordinates can serve as the world: the scene has an ordinary size and is not far from the origin.
fn fits_dataset_coordinates(cloud: &GaussianCloud) -> bool {
    let world = cloud.world_from_dataset;
    let n = cloud.len().max(1);
    let mean = |i: usize| DVec3::from(cloud.means[i].map(f64::from));
    let center = (0..cloud.len()).map(mean).sum::<DVec3>() / n as f64;
    let reach = |i: usize| {
        let largest = cloud.log_scales[i].iter().copied().fold(f32::NEG_INFINITY, f32::max);
        mean(i).distance(center) + f64::from(largest).exp()
    };
    let mut reaches: Vec<f64> = (0..cloud.len()).map(reach).collect();
    let extent = if reaches.is_empty() {
        1.0
    } else {
        *reaches.select_nth_unstable_by(n / 2, f64::total_cmp).1
    };
    let units = extent / world.scale;
    let far = world.invert(center).length();
    // At 200 extents, f32 resolves a hundred-thousandth of the extent.
    (0.05..=100.0).contains(&units) && far < 200.0 * units
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transforms_compose_and_invert() {
        let a = Transform::about(DVec3::new(1.0, 2.0, 3.0), 2.0, DQuat::from_rotation_x(0.3));
        let b = Transform::translation(DVec3::new(-1.0, 0.0, 4.0));
        let p = DVec3::new(0.2, -7.0, 1.0);
        assert!((a.then(&b).apply(p) - b.apply(a.apply(p))).length() < 1e-12);
        assert!((a.inverse().apply(a.apply(p)) - p).length() < 1e-12);
        assert!((a.apply(DVec3::new(1.0, 2.0, 3.0)) - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-12);
        assert!(Transform::IDENTITY.is_identity() && !b.is_identity());
    }
}

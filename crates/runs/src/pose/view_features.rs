//! Views of a dataset in the form that the mapper needs: with their features, cameras and poses.

use super::stages::{color_at, combine_masks, to_grey};
use irradia_scene::{Camera, View};
use irradia_sfm::Features;
use irradia_sfm::features::{Extractor, GreyPhoto, Sift};
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::geometry::pose::DPose;
use irradia_sfm::map::PhotoInfo;

/// A view at the size at which its features were found.
pub(super) struct ViewFeatures {
    /// The photograph's camera is known; the group is 0.
    pub info: PhotoInfo,
    pub features: Features,
    /// The photograph's colour at each feature.
    pub colors: Vec<[u8; 3]>,
}

impl ViewFeatures {
    /// Finds the features of `view`, reduced to at most `side` pixels on its longer side; `None` if its photograph cannot be read.
    pub fn extract(view: &View, side: u32, max_features: usize) -> Option<Self> {
        let full = view.camera.intrinsics;
        let k = full.scaled((side as f32 / full.width.max(full.height) as f32).min(1.0));
        let photo = view.photo.load_at(k.width, k.height).ok()?;
        let sift = Sift {
            max_features,
            ..Sift::default()
        };
        let mask = combine_masks(photo.mask.clone(), photo.alpha());
        let features = sift.extract(&GreyPhoto {
            width: photo.width,
            height: photo.height,
            data: &to_grey(&photo.data, photo.channels),
            mask: mask.as_deref(),
        });
        let info = PhotoInfo {
            focal_prior_px: Some(f64::from(k.fx)),
            camera: Some(DCamera::pinhole(&k)),
            ..PhotoInfo::new(view.name.clone(), k.width, k.height)
        };
        let color = |x, y| color_at(&photo.data, [photo.width, photo.height], photo.channels, x, y);
        let colors = features.keypoints.iter().map(|k| color(k.x, k.y)).collect();
        Some(Self { info, features, colors })
    }
}

/// The pose of `camera` in double precision.
pub(super) fn pose(camera: &Camera) -> DPose {
    DPose {
        rotation: camera.pose.rotation.as_dquat(),
        position: camera.pose.position.as_dvec3(),
    }
}

//! Reconstructions whose photographs, poses, cameras and points refer to one another by keys, as OpenMVG and Meshroom write them.

use super::declared::{DeclaredCamera, DeclaredDataset, DeclaredPoints, DeclaredPose, DeclaredView};
use std::collections::HashMap;
use std::hash::Hash;
use std::path::{Path, PathBuf};

/// A photograph.
pub(super) struct LinkedView<K> {
    pub key: K,
    /// Key of its pose; `None` if it has none that can be used.
    pub pose: Option<K>,
    pub camera: Option<K>,
    /// With forward slashes.
    pub name: String,
}

/// A reconstruction; the maps are by key.
pub(super) struct Linked<K> {
    pub views: Vec<LinkedView<K>>,
    pub poses: HashMap<K, Option<DeclaredPose>>,
    pub cameras: HashMap<K, DeclaredCamera>,
    pub points: DeclaredPoints,
    /// Indices of the points that each photograph sees.
    pub points_seen: HashMap<K, Vec<u32>>,
}

impl<K: Eq + Hash> Linked<K> {
    /// The dataset of the photographs that have a pose and a camera. The others are skipped; they have `lack`, as the user is told.
    pub fn dataset(
        mut self,
        kind: &'static str,
        root: &Path,
        downscale: f32,
        lack: &str,
        locate: &dyn Fn(&str) -> Option<PathBuf>,
    ) -> DeclaredDataset {
        let mut views = Vec::new();
        for view in &self.views {
            let pose = view.pose.as_ref().and_then(|key| self.poses.get(key));
            let camera = view.camera.as_ref().and_then(|key| self.cameras.get(key));
            if let (Some(pose), Some(camera)) = (pose, camera) {
                views.push(DeclaredView {
                    points_seen: self.points_seen.remove(&view.key).unwrap_or_default(),
                    ..DeclaredView::posed(root, &view.name, locate(&view.name), *pose, *camera)
                });
            }
        }
        let skipped = self.views.len() - views.len();
        let warning = (skipped > 0).then(|| format!("{skipped} photographs have {lack} and are skipped"));
        DeclaredDataset {
            kind,
            root: root.to_owned(),
            views,
            points: Some(self.points),
            downscale,
            warnings: warning.into_iter().collect(),
        }
    }
}

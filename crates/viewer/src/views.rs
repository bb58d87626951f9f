//! The posed photographs of a scene, as far as they are known.

use irradia_scene::{Camera, Dataset, Intrinsics, Lens, PhotoSource, Pose};
use serde_json::{Value, json};
use std::collections::HashMap;
use std::f32::consts::FRAC_PI_2;
use std::sync::Arc;

/// One view.
pub(crate) struct SeenView {
    pub name: String,
    pub camera: Camera,
    /// Whether it was trained on; the others are held out.
    pub trained: bool,
    pub photo: Option<Arc<dyn PhotoSource>>,
}

/// All views, in the order of the dataset.
pub(crate) struct Views(pub Vec<SeenView>);

impl Views {
    /// The views of a dataset. `refined` are the poses of training views with their refinement, as far as they are known, by name: the
    /// dataset may have gained or lost photographs since.
    pub fn of_dataset(dataset: &Dataset, refined: &HashMap<String, Pose>) -> Self {
        let view = |(index, view): (usize, &irradia_scene::View)| {
            let mut camera = view.camera;
            camera.pose = refined.get(&view.name).copied().unwrap_or(camera.pose);
            // The page draws pinhole cameras at rest: photographs with distortion or a rolling shutter cannot be compared with them.
            let is_pinhole = camera.is_pinhole();
            camera.shutter = None;
            let k = &mut camera.intrinsics;
            if k.lens.is_wide() {
                *k = Intrinsics::from_fov_x(k.width, k.height, FRAC_PI_2);
            }
            k.lens = Lens::Pinhole;
            SeenView {
                name: view.name.clone(),
                camera,
                trained: dataset.train.contains(&index),
                photo: is_pinhole.then(|| view.photo.clone()),
            }
        };
        Self(dataset.views.iter().enumerate().map(view).collect())
    }

    /// Views without photographs.
    pub fn of_cameras(cameras: &[Camera]) -> Self {
        let view = |(index, camera): (usize, &Camera)| SeenView {
            name: format!("view {index}"),
            camera: *camera,
            trained: true,
            photo: None,
        };
        Self(cameras.iter().enumerate().map(view).collect())
    }

    /// The views in the form that the page reads.
    pub fn to_json(&self) -> Value {
        let view = |view: &SeenView| {
            let (k, pose) = (&view.camera.intrinsics, &view.camera.pose);
            let q = pose.rotation;
            json!({
                "name": view.name,
                "trained": view.trained,
                "photo": view.photo.is_some(),
                "width": k.width, "height": k.height,
                "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy,
                "position": pose.position.to_array(),
                "rotation": [q.w, q.x, q.y, q.z],
            })
        };
        self.0.iter().map(view).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_runs::synth::{SynthOptions, dataset};

    #[test]
    fn refined_poses_belong_to_views_by_their_names() {
        let options = SynthOptions {
            views: 4,
            width: 24,
            height: 16,
            ..SynthOptions::default()
        };
        let data = dataset(&options).expect("options");
        let (first, last) = (data.train[0], data.train[3]);
        // As many as training views, of which one is gone.
        let refined = data.train[1..].iter().map(|view| data.views[*view].name.clone());
        let pose = Pose {
            position: [7.0, 8.0, 9.0].into(),
            ..data.views[0].camera.pose
        };
        let refined = refined
            .chain(["gone.png".to_owned()])
            .map(|name| (name, pose))
            .collect();
        let views = Views::of_dataset(&data, &refined).0;
        assert_eq!(views[first].camera.pose, data.views[first].camera.pose);
        assert_eq!(views[last].camera.pose, pose);
    }
}

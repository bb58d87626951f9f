//! The posed photographs of a scene, as far as they are known.

use irradia_scene::{Camera, Dataset, Intrinsics, Lens, PhotoSource};
use serde_json::{Value, json};
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
    /// The views of a dataset. `trained` are the cameras of the training views with their refinement, if known.
    pub fn of_dataset(dataset: &Arc<Dataset>, trained: Option<&[Camera]>) -> Self {
        let refined = trained.filter(|cameras| cameras.len() == dataset.train.len());
        let view = |(index, view): (usize, &irradia_scene::View)| {
            let place = dataset.train.iter().position(|i| *i == index);
            let pose = place.and_then(|place| Some(refined?[place].pose));
            let mut camera = view.camera;
            camera.pose = pose.unwrap_or(camera.pose);
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
                trained: place.is_some(),
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

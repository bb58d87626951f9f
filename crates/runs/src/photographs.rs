//! Reduced photographs of a run, for the search for floaters.

use crate::RunFolder;
use crate::cameras::{camera_names, is_moved};
use crate::scene_file::render_settings_beside;
use irradia_edit::{LoadedPhotographs, Photographs};
use irradia_scene::Photo;
use rayon::prelude::*;
use std::path::Path;

/// Longer side, pixels. At much smaller sizes renders would differ from those in training, since splats are widened to a pixel.
const MAX_SIDE: f32 = 480.0;
/// Maximum number of photographs, spread evenly over the cameras.
const MAX_PHOTOS: usize = 24;

/// The photographs on which the scene `scene` was trained, if it is in its run's folder, was not moved away from them, and they are still
/// in place.
pub fn photographs_of(scene: &Path) -> Option<Photographs> {
    RunFolder::containing(scene).filter(|_| !is_moved(scene))?;
    let scene = scene.to_owned();
    Some(Photographs::new(move || read(&scene)))
}

fn read(scene: &Path) -> Option<LoadedPhotographs> {
    let input = RunFolder::record_containing(scene).ok()??.input;
    let dataset = input.reading.read(&input.data).ok()?;
    // The scene's cameras are pinholes: photographs with distortion or a rolling shutter do not match them.
    if dataset.views.iter().any(|view| !view.camera.is_pinhole()) {
        return None;
    }
    let background = render_settings_beside(scene).background;
    let names = camera_names(scene)?;
    let step = names.len().div_ceil(MAX_PHOTOS).max(1);
    let photos: Option<Vec<(usize, Photo)>> = (0..names.len())
        .into_par_iter()
        .step_by(step)
        .map(|camera| {
            let view = dataset.views.iter().find(|view| view.name == names[camera])?;
            let k = view.camera.intrinsics;
            let small = k.scaled((MAX_SIDE / k.width.max(k.height) as f32).min(1.0));
            let photo = view.photo.load_at(small.width, small.height).ok()?;
            let data = photo.over(background);
            Some((
                camera,
                Photo {
                    channels: 3,
                    data,
                    ..photo
                },
            ))
        })
        .collect();
    Some(LoadedPhotographs {
        photos: photos?,
        background,
    })
}

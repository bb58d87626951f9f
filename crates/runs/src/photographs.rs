//! The photographs of a run, small, for the search for floaters.

use crate::folder::camera_names_beside;
use crate::scene_file::render_knobs_beside;
use crate::{RunFolder, TrainInput};
use irradia_edit::{Photographs, Taken};
use irradia_scene::Photo;
use rayon::prelude::*;
use std::path::Path;

/// Longest side, pixels. Much smaller ones would be rendered unlike the scene was trained: splats are widened to a pixel.
const SIDE: f32 = 480.0;
/// At most so many, spread evenly over the cameras.
const MOST: usize = 24;

/// The photographs with which the scene `scene` was trained, if its run is beside it and they are where they were.
pub fn photographs_of(scene: &Path) -> Option<Photographs> {
    RunFolder::containing(scene)?;
    let scene = scene.to_owned();
    Some(Photographs::new(move || read(&scene)))
}

fn read(scene: &Path) -> Option<Taken> {
    let input = TrainInput::of_run(scene.parent()?).ok()?;
    let dataset = input.reading.read(&input.data).ok()?;
    // The cameras of the scene are pinholes: photographs with distortion or a rolling shutter show something else.
    if dataset.views.iter().any(|view| !view.camera.is_pinhole()) {
        return None;
    }
    let background = render_knobs_beside(scene).background;
    let names = camera_names_beside(scene)?;
    let step = names.len().div_ceil(MOST).max(1);
    let photos: Option<Vec<(usize, Photo)>> = (0..names.len())
        .into_par_iter()
        .step_by(step)
        .map(|camera| {
            let view = dataset.views.iter().find(|view| view.name == names[camera])?;
            let k = view.camera.intrinsics;
            let small = k.scaled((SIDE / k.width.max(k.height) as f32).min(1.0));
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
    Some(Taken {
        photos: photos?,
        background,
    })
}

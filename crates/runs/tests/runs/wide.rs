//! Photographs by wide lenses are cut into faces, which equal pinhole photographs in their directions.

use crate::folder;
use irradia_runs::formats::{DatasetOptions, read_dataset};
use irradia_runs::prelude::*;
use irradia_runs::synth::{Capture, SceneName, SynthLens};

/// PSNR in dB of 8-bit pixels, `photo` with four channels, of colours in \[0, 1\].
fn psnr(photo: &[u8], truth: &[f32]) -> f64 {
    let pairs = photo.chunks_exact(4).flat_map(|pixel| &pixel[..3]).zip(truth);
    let squares: f64 = pairs
        .map(|(a, b)| (f64::from(*a) / 255.0 - f64::from(*b)).powi(2))
        .sum();
    -10.0 * (squares / truth.len() as f64).log10()
}

fn faces_are_right(lens: SynthLens, (width, height): (u32, u32), expected: &[&str]) {
    let folder = folder();
    let options = SynthOptions {
        scene: SceneName::Room,
        views: 3,
        width,
        height,
        seed: 4,
        lens,
        turn: 0.0,
    };
    write_synth_dataset(folder.path(), &options).unwrap();
    let dataset = read_dataset(folder.path(), &DatasetOptions::default()).unwrap();
    let names: Vec<&str> = dataset.train.iter().map(|i| dataset.views[*i].name.as_str()).collect();
    let mut all = Vec::new();
    for photograph in 0..3 {
        all.extend(expected.iter().map(|face| format!("train/r_00{photograph}.png/{face}")));
    }
    assert_eq!(names, all);
    // Held-out photographs are by a pinhole and stay whole.
    assert!(dataset.test.iter().all(|i| dataset.views[*i].name.ends_with(".png")));
    assert!(
        dataset
            .warnings
            .iter()
            .any(|line| line.starts_with("3 of 5 photographs show more")),
        "{:?}",
        dataset.warnings
    );

    let capture = Capture::new(&options).unwrap();
    for i in &dataset.train {
        let view = &dataset.views[*i];
        let mut shot = capture.shots()[0];
        shot.camera = view.camera;
        let photo = view.photo.load().unwrap();
        assert_eq!(
            (photo.width, photo.height),
            (view.camera.intrinsics.width, view.camera.intrinsics.height)
        );
        let found = psnr(&photo.data, &capture.trace(&shot).color.data);
        // Only resampling loses quality: a face of the wrong direction has less than 15 dB.
        assert!(found > 27.0, "{}: {found} dB", view.name);
    }
}

#[test]
fn panoramas_become_six_faces() {
    faces_are_right(
        SynthLens::Equirectangular,
        (256, 128),
        &["back", "down", "front", "left", "right", "up"],
    );
}

#[test]
fn fisheyes_become_a_front_and_what_they_show_of_the_sides() {
    faces_are_right(
        SynthLens::Fisheye,
        (160, 160),
        &["down", "front", "left", "right", "up"],
    );
}

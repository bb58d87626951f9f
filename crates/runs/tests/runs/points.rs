//! Points for datasets that have poses but no points.

use crate::pose::{OPTIONS, views_of};
use crate::{folder, input};
use glam::Vec3;
use irradia_runs::prelude::*;
use irradia_runs::scene::{Photo, PointCloud, View};
use std::sync::{Arc, OnceLock};

/// Ray-traced photographs without points.
fn without_points() -> Dataset {
    static TRACED: OnceLock<Vec<View>> = OnceLock::new();
    let views = TRACED.get_or_init(|| views_of(OPTIONS.scene));
    let is_held_out = |view: &usize| view.is_multiple_of(8);
    Dataset {
        views: views.clone(),
        train: (0..views.len()).filter(|view| !is_held_out(view)).collect(),
        test: (0..views.len()).filter(is_held_out).collect(),
        ..Dataset::default()
    }
}

/// Maximum relative depth error of a sound point; the scene has a mirror, whose points are behind it.
const MAX_DEPTH_ERROR: f32 = 0.05;

/// `[points seen]` the relative depth error of each point in each view that is recorded as showing it.
fn errors_of_depth(dataset: &Dataset, points: &PointCloud) -> Vec<f32> {
    let scene = OPTIONS.scene.build(OPTIONS.seed).0;
    let mut errors = Vec::new();
    for view in &dataset.views {
        let depth = scene.trace(&view.camera, 1, 1).depth;
        for point in &view.points_seen {
            let seen = view.camera.sees(points.positions[*point as usize]);
            let (at, z) = seen.expect("within the image");
            // A feature at a corner may be on the other side of an edge by a pixel.
            let near = |v: f32, side: u32| (v as usize).saturating_sub(1)..(v as usize + 2).min(side as usize);
            let pixels = near(at.y, depth.height).flat_map(|y| near(at.x, depth.width).map(move |x| (x, y)));
            let error = |(x, y): (usize, usize)| (z / depth.data[y * depth.width as usize + x] - 1.0).abs();
            errors.push(pixels.map(error).fold(f32::INFINITY, f32::min));
        }
    }
    errors
}

/// A run after its first two steps, and its messages about points.
fn begin_and_step(input: TrainInput, dataset: Dataset) -> (Run, Vec<String>) {
    struct PointMessages(Vec<String>);
    impl Observer for PointMessages {
        fn on_event(&mut self, event: &Event, _trainer: &Trainer) -> Signal {
            if let Event::Decided { message } = event {
                self.0.extend(message.contains("no points").then(|| message.clone()));
            }
            match event {
                Event::Step(step) if step.step == 2 => Signal::Stop,
                _ => Signal::Continue,
            }
        }
    }
    let mut run = Run::begin_on(input.check().expect("a request"), dataset).expect("a run");
    let mut messages = PointMessages(Vec::new());
    run.train(&mut [&mut messages]).expect("trains");
    (run, messages.0)
}

#[test]
fn points_are_found_on_surfaces_by_training_photographs_alone_and_again_on_resuming() {
    let folder = folder();
    let dataset = without_points();
    let (run, messages) = begin_and_step(input(folder.path(), "run", 6), dataset.clone());
    let found = run.trainer().dataset.clone();
    let points = found.points.clone().expect("found");
    assert!(points.len() > 400, "{}", points.len());
    assert!(
        messages.len() == 1 && messages[0].contains(&format!("{} were found", points.len())),
        "{messages:?}"
    );
    assert!(found.test.iter().all(|view| found.views[*view].points_seen.is_empty()));
    let seeing = found
        .train
        .iter()
        .filter(|view| !found.views[**view].points_seen.is_empty());
    assert!(
        4 * seeing.count() > 3 * found.train.len(),
        "most photographs show points"
    );
    let errors = errors_of_depth(&found, &points);
    let sound = errors.iter().filter(|error| **error < MAX_DEPTH_ERROR).count();
    assert!(sound as f64 > 0.85 * errors.len() as f64, "{sound} of {}", errors.len());

    run.finish().expect("finishes");
    let again = TrainInput::of_run(folder.path().join("run")).expect("a run");
    let resumed = Run::resume_on(again.check().expect("a request"), dataset).expect("resumes");
    let again = &resumed.trainer().dataset;
    assert_eq!(again.points, Some(points));
    assert!(
        again
            .views
            .iter()
            .zip(&found.views)
            .all(|(a, b)| a.points_seen == b.points_seen)
    );
}

#[test]
fn points_are_not_found_where_they_are_given_not_wanted_or_nothing_matches() {
    let folder = folder();
    let points_of = |name: &str, dataset: &Dataset, match_points: bool| {
        let input = TrainInput {
            match_points,
            ..input(folder.path(), name, 2)
        };
        let (run, messages) = begin_and_step(input, dataset.clone());
        (run.trainer().dataset.points.clone(), messages)
    };
    let mut bare = without_points();
    let points = Some(PointCloud {
        positions: vec![Vec3::ZERO; 20],
        colors: vec![[128; 3]; 20],
    });
    let given = Dataset {
        points: points.clone(),
        ..bare.clone()
    };
    assert_eq!(points_of("given", &given, true), (points, vec![]));
    assert_eq!(points_of("unwanted", &bare, false), (None, vec![]));
    let mut fill = |channels: u32| {
        for view in &mut bare.views {
            view.photo = Arc::new(Photo {
                width: OPTIONS.width,
                height: OPTIONS.height,
                channels,
                data: vec![90; (channels * OPTIONS.width * OPTIONS.height) as usize],
                mask: None,
            });
        }
        bare.clone()
    };
    let (grey, transparent) = (fill(3), fill(4));
    let blender = |dataset: &Dataset| Dataset {
        kind: "Blender".into(),
        ..dataset.clone()
    };
    for (name, dataset) in [("grey", grey.clone()), ("photographs", blender(&grey))] {
        let (points, messages) = points_of(name, &dataset, true);
        assert!(points.is_none() && messages[0].contains("too few"), "{messages:?}");
    }
    assert_eq!(points_of("rendered", &blender(&transparent), true), (None, vec![]));
}

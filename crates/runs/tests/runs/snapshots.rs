//! The latest state, requested from another thread.

use crate::{begin, folder, scene, unwatched};
use irradia_runs::prelude::*;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

/// Notifies another thread of each step, and pauses after one step until it answers.
struct PauseAt {
    pause_after: u64,
    resume: Receiver<()>,
}

impl Observer for PauseAt {
    fn on_event(&mut self, event: &Event, _trainer: &Trainer) -> Signal {
        match event {
            Event::Step(report) if report.step == self.pause_after => Signal::Pause,
            _ => Signal::Continue,
        }
    }

    fn while_paused(&mut self, _trainer: &Trainer) -> Signal {
        match self.resume.try_recv() {
            Ok(()) => Signal::Continue,
            Err(_) => Signal::Pause,
        }
    }
}

/// Waits until the training runs.
fn first(snapshots: &Snapshots) -> Arc<Snapshot> {
    loop {
        match snapshots.newest() {
            Some(snapshot) => return snapshot,
            None => std::thread::sleep(Duration::from_millis(1)),
        }
    }
}

#[test]
fn a_snapshot_is_reused_until_a_step_is_made_and_does_not_change_the_run() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 30);
    let snapshots = run.snapshots();
    assert!(
        snapshots.newest().is_none() && snapshots.last().is_none(),
        "none before it runs"
    );
    let (resume, told) = channel();
    let viewer = std::thread::spawn(move || {
        let mut seen = vec![first(&snapshots)];
        while seen.last().is_some_and(|snapshot| snapshot.step < 10) {
            seen.push(snapshots.newest().expect("running"));
        }
        // Paused now: nothing changes, and requests are still answered.
        let paused = [snapshots.newest(), snapshots.newest()].map(|s| s.expect("running"));
        assert!(paused[0].step == 10 && Arc::ptr_eq(&paused[0], &paused[1]));
        assert!(Arc::ptr_eq(&paused[0], seen.last().expect("some")));
        resume.send(()).expect("the run waits");
        while seen.last().is_some_and(|snapshot| snapshot.step < 30) {
            seen.push(snapshots.newest().expect("running"));
        }
        (seen, snapshots)
    });
    let mut observer = PauseAt {
        pause_after: 10,
        resume: told,
    };
    run.train(&mut [&mut observer]).expect("trains");
    let (seen, snapshots) = viewer.join().expect("the viewer");
    for pair in seen.windows(2) {
        assert!(
            pair[0].step < pair[1].step || Arc::ptr_eq(&pair[0], &pair[1]),
            "newer, or the same"
        );
        assert!(Arc::ptr_eq(&pair[0].dataset, &pair[1].dataset) && Arc::ptr_eq(&pair[0].recipe, &pair[1].recipe));
        let cameras = [&pair[0], &pair[1]].map(|s| s.scene.cameras.clone().expect("of a training"));
        assert!(Arc::ptr_eq(&cameras[0], &cameras[1]) && cameras[0].len() == 4);
    }
    // It renders its own state, independent of later training.
    let early = &seen[0];
    let camera = early.scene.cameras.as_ref().expect("of a training")[0];
    assert!(early.scene.render(&camera).color != seen[seen.len() - 1].scene.render(&camera).color);

    // The last snapshot outlives the run, and equals the scene that the run wrote.
    run.finish().expect("finishes");
    let last = snapshots.newest().expect("the last");
    assert_eq!((last.step, last.total_steps), (30, 30));
    let written = Scene::read(folder.path().join("run")).expect("a scene");
    assert_eq!(last.scene.model.splats(), written.model.splats());
    assert!(scene(folder.path(), "run") == unwatched(folder.path(), 30));
}

#[test]
fn without_requests_the_last_state_is_kept_for_a_handle_only() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 2);
    drop(run.snapshots());
    run.train(&mut []).expect("trains");
    let late = run.snapshots();
    assert!(late.last().is_none(), "no request, no copy");
    let mut run = begin(folder.path(), "other", 2);
    let handle = run.snapshots();
    handle.request();
    assert!(handle.last().is_none(), "a request does not wait");
    run.train(&mut []).expect("trains");
    assert_eq!(handle.last().map(|snapshot| snapshot.step), Some(2));
}

#[test]
fn requests_do_not_wait_for_a_run_that_has_ended() {
    let folder = folder();
    let run = begin(folder.path(), "run", 2);
    let handle = run.snapshots();
    drop(run);
    assert!(handle.newest().is_none());
}

#[test]
fn a_run_can_be_moved_to_a_thread_and_its_handle_shared() {
    fn send<T: Send>() {}
    fn shared<T: Send + Sync + Clone>() {}
    send::<Run>();
    shared::<Snapshots>();
    shared::<Arc<Snapshot>>();
}

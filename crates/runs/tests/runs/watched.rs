//! Observers: stop, save and pause.

use crate::{begin, dataset, folder, input, scene, unwatched};
use irradia_runs::prelude::*;
use irradia_runs::train::EndReason;
use std::fs;
use std::time::{Duration, Instant};

/// Answers `answer` after step `at`, and keeps all events.
struct SignalAt {
    step: u64,
    answer: Signal,
    events: Vec<Event>,
}

impl SignalAt {
    fn new(step: u64, answer: Signal) -> Self {
        Self {
            step,
            answer,
            events: Vec::new(),
        }
    }
}

impl Observer for SignalAt {
    fn on_event(&mut self, event: &Event, _trainer: &Trainer) -> Signal {
        self.events.push(event.clone());
        match event {
            Event::Step(report) if report.step == self.step => self.answer,
            _ => Signal::Continue,
        }
    }
}

/// Pauses after a step for a while, saving meanwhile, and then continues or stops.
struct PauseObserver {
    after: u64,
    poll_count: u32,
    then: Signal,
    steps: Vec<u64>,
}

impl Observer for PauseObserver {
    fn on_event(&mut self, event: &Event, _trainer: &Trainer) -> Signal {
        match event {
            Event::Step(report) => {
                self.steps.push(report.step);
                if report.step == self.after {
                    return Signal::Pause;
                }
            }
            Event::Paused { step } | Event::Resumed { step } => assert_eq!(*step, self.after),
            _ => {}
        }
        Signal::Continue
    }

    fn while_paused(&mut self, trainer: &Trainer) -> Signal {
        assert_eq!(trainer.clock.step, self.after, "no step is made meanwhile");
        self.poll_count += 1;
        if self.poll_count < 4 { Signal::Pause } else { self.then }
    }
}

#[test]
fn a_stopped_run_is_saved_and_resumes_to_the_bytes_of_an_uninterrupted_one() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 12);
    let reason = run.train(&mut [&mut SignalAt::new(5, Signal::Stop)]).expect("trains");
    assert_eq!((reason, run.trainer().clock.step), (EndReason::Stopped, 5));
    let finished = run.finish().expect("finishes");
    assert!(!finished.complete && finished.report.steps == 5);
    let path = finished.folder.path().to_owned();
    assert!(path.join("checkpoints/step_5.safetensors").is_file());

    let of_run = || TrainInput::of_run(&path).expect("a run");
    let budget = TrainInput {
        steps: None,
        budget: Some(1e-9),
        ..of_run()
    };
    let error = Run::resume_on(budget.check().expect("a request"), dataset())
        .err()
        .expect("used up");
    assert!(
        error.to_string().starts_with("budget 0.000000001: the run has trained"),
        "{error}"
    );
    let limited = TrainInput {
        until_psnr: Some(90.0),
        ..of_run()
    };
    // As if the process died before its first step.
    drop(Run::resume_on(limited.check().expect("a request"), dataset()).expect("resumed"));
    assert_eq!(of_run().until_psnr, Some(90.0));
    let mut run = Run::resume_on(of_run().check().expect("a request"), dataset()).expect("resumed");
    run.train(&mut []).expect("trains");
    let finished = run.finish().expect("finishes");
    assert!(finished.complete);
    assert!(RunFolder::open(&path).expect("a run").1.complete);
    assert!(scene(folder.path(), "run") == unwatched(folder.path(), 12));
}

#[test]
fn a_resumed_run_knows_what_was_found_before_its_first_step() {
    let folder = folder();
    let request = input(folder.path(), "run", 60).check().expect("a request");
    let mut noted = dataset();
    noted.warnings.push("new poses are used".to_owned());
    let mut run = Run::begin_on(request, noted).expect("a run");
    run.train(&mut [&mut SignalAt::new(20, Signal::Stop)]).expect("trains");
    run.finish().expect("finishes");
    let request = TrainInput::of_run(folder.path().join("run")).expect("a run").check();
    let mut run = Run::resume_on(request.expect("a request"), dataset()).expect("a run");
    run.train(&mut []).expect("trains");
    let report = run.finish().expect("finishes").report;
    assert!(
        report.warnings.contains(&"new poses are used".to_owned()),
        "{:?}",
        report.warnings
    );
    assert!(report.total_seconds > report.seconds);
}

#[test]
fn a_stopped_run_may_be_trained_further_at_once() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 12);
    run.train(&mut [&mut SignalAt::new(5, Signal::Stop)]).expect("trains");
    run.train(&mut []).expect("trains");
    let report = run.finish().expect("finishes").report;
    assert!(scene(folder.path(), "run") == unwatched(folder.path(), 12));
    let seconds: f64 = report.stages.iter().map(|stage| stage.seconds).sum();
    let inside = report.breakdown.inside;
    let parts = [
        inside.steps,
        inside.density,
        inside.loading,
        inside.evaluating,
        inside.saving,
        inside.paused,
        inside.other,
    ];
    assert!((parts.iter().sum::<f64>() - report.seconds).abs() < 1e-9, "{inside:?}");
    assert!(report.seconds >= report.training_seconds && report.total_seconds > report.seconds);
    assert!(report.breakdown.beside.preparing > 0.0 && report.breakdown.beside.finishing > 0.0);
    assert!(
        (seconds - report.training_seconds).abs() < 1e-9,
        "each second is counted once"
    );
}

#[test]
fn save_writes_a_checkpoint_and_reports_it() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 6);
    let mut asks = SignalAt::new(3, Signal::Save);
    run.train(&mut [&mut asks]).expect("trains");
    let saved = |event: &Event| matches!(event, Event::Saved { step: 3, path } if path.ends_with("step_3.safetensors"));
    assert!(asks.events.iter().any(saved), "{:?}", asks.events);
    assert!(run.folder().file("checkpoints/step_3.safetensors").is_file());
}

#[test]
fn a_paused_run_waits_and_resumes_to_the_same_bytes() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 8);
    let mut pauses = PauseObserver {
        after: 3,
        poll_count: 0,
        then: Signal::Continue,
        steps: Vec::new(),
    };
    let started = Instant::now();
    // A save request in the same step is also followed.
    run.train(&mut [&mut SignalAt::new(3, Signal::Save), &mut pauses])
        .expect("trains");
    assert!(started.elapsed() > Duration::from_millis(40), "it waits between polls");
    assert_eq!((pauses.poll_count, pauses.steps.len()), (4, 8));
    assert!(run.folder().file("checkpoints/step_3.safetensors").is_file());
    let log = fs::read_to_string(run.folder().file("events.jsonl")).expect("events");
    for event in ["paused", "resumed"] {
        assert_eq!(log.matches(&format!("\"event\":\"{event}\"")).count(), 1, "{event}");
    }
    run.finish().expect("finishes");
    assert!(scene(folder.path(), "run") == unwatched(folder.path(), 8));
}

#[test]
fn a_paused_run_can_be_stopped() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 8);
    let mut pauses = PauseObserver {
        after: 3,
        poll_count: 0,
        then: Signal::Stop,
        steps: Vec::new(),
    };
    assert_eq!(run.train(&mut [&mut pauses]).expect("trains"), EndReason::Stopped);
    assert_eq!(pauses.steps, [1, 2, 3]);
    assert!(run.folder().file("checkpoints/step_3.safetensors").is_file());
}

/// Reports a warning once.
struct Warns(Option<String>);

impl Observer for Warns {
    fn on_event(&mut self, _event: &Event, _trainer: &Trainer) -> Signal {
        Signal::Continue
    }

    fn warning(&mut self) -> Option<String> {
        self.0.take()
    }
}

#[test]
fn an_observers_warning_reaches_the_others_and_the_report_once() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 3);
    let (mut warns, mut listens) = (Warns(Some("no sound".into())), SignalAt::new(0, Signal::Continue));
    run.train(&mut [&mut warns, &mut listens]).expect("trains");
    let warned = |event: &&Event| matches!(event, Event::Warned { message } if message == "no sound");
    assert_eq!(listens.events.iter().filter(warned).count(), 1);
    assert_eq!(run.finish().expect("finishes").report.warnings, ["no sound"]);
}

#[test]
fn a_stopped_evaluation_is_repeated_when_the_run_is_resumed() {
    let folder = folder();
    let mut run = begin(folder.path(), "run", 12);
    run.train(&mut []).expect("trains");
    let path = run.folder().path().to_owned();
    let stopped = run.finish_unless(&|| true);
    assert!(matches!(stopped, Err(RunError::EvaluationStopped)));
    assert!(path.join("scene.ply").is_file() && !path.join("report.json").exists());

    let request = TrainInput::of_run(&path).expect("a run").check().expect("a request");
    let mut run = Run::resume_on(request, dataset()).expect("resumed");
    assert_eq!(run.trainer().clock.step, 12);
    run.train(&mut []).expect("nothing is left to train");
    let finished = run.finish().expect("finishes");
    assert!(finished.complete && finished.report.psnr > 5.0 && finished.report.steps == 12);
    assert!(scene(folder.path(), "run") == unwatched(folder.path(), 12));
}

/// Requests a stop as soon as held-out views are evaluated.
struct StopRequester(Vec<Event>);

impl Observer for StopRequester {
    fn on_event(&mut self, event: &Event, _: &Trainer) -> Signal {
        self.0.push(event.clone());
        Signal::Continue
    }

    fn wants_stop(&self) -> bool {
        true
    }
}

#[test]
fn a_partial_evaluation_is_not_reported() {
    let folder = folder();
    let requested = TrainInput {
        set: vec!["eval_every=2".into()],
        ..crate::input(folder.path(), "run", 5)
    };
    let mut run = Run::begin_on(requested.check().expect("a request"), dataset()).expect("a run");
    let mut observer = StopRequester(Vec::new());
    run.train(&mut [&mut observer]).expect("trains");
    assert!(!observer.0.iter().any(|event| matches!(event, Event::Evaluated { .. })));
}

//! Progress of a run on the terminal: a bar, or plain lines without a terminal.

use crate::terminal::note;
use indicatif::{HumanDuration, ProgressBar, ProgressStyle};
use irradia_train::Trainer;
use irradia_train::eval::MAX_PSNR;
use irradia_train::event::{Event, Observer, Signal, StepReport};
use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Shows progress and forwards Ctrl-C.
pub struct Progress {
    bar: Option<ProgressBar>,
    stop: Arc<AtomicBool>,
    /// Moving average of the training views' squared error.
    mse: Option<f64>,
    held_out: Option<f64>,
    /// Time of the last plain line.
    last_line: Instant,
    started: Instant,
    first_step: u64,
    stage: String,
}

/// Interval of plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

impl Progress {
    /// `stop`, once set, ends the run at the next step.
    pub fn new(stop: Arc<AtomicBool>) -> Self {
        Self {
            bar: std::io::stderr().is_terminal().then(|| {
                let style = "{bar:16} {pos}/{len} {wide_msg}";
                ProgressBar::new(0).with_style(ProgressStyle::with_template(style).expect("a valid template"))
            }),
            stop,
            mse: None,
            held_out: None,
            last_line: Instant::now(),
            started: Instant::now(),
            first_step: 0,
            stage: String::new(),
        }
    }

    fn signal(&self) -> Signal {
        if self.stop.load(Ordering::Relaxed) {
            Signal::Stop
        } else {
            Signal::Continue
        }
    }

    fn print_line(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| note(line)),
            None => note(line),
        }
    }

    fn step(&mut self, report: &StepReport, trainer: &Trainer) {
        let mse = self.mse.map_or(report.mse, |mean| 0.95 * mean + 0.05 * report.mse);
        self.mse = Some(mse);
        let rate = (report.step - self.first_step) as f64 / self.started.elapsed().as_secs_f64().max(1e-9);
        let held_out = self.held_out.map_or(String::new(), |p| format!(" held-out {p:.2} dB"));
        let message = format!(
            "loss {:.4} psnr {:.2} dB{held_out} {} {rate:.1} steps/s {}",
            report.loss,
            (-10.0 * mse.log10()).clamp(f64::NEG_INFINITY, MAX_PSNR),
            format_size(report.splats as u64, report.parameters.map(|n| n as u64)),
            self.stage
        );
        match &self.bar {
            Some(bar) => {
                bar.set_length(trainer.total_steps());
                bar.set_position(report.step);
                bar.set_message(format!("eta {} {message}", eta(report.seconds_left_range)));
            }
            None if self.last_line.elapsed() >= LINE_INTERVAL => {
                note(format_args!(
                    "step {}/{} {message} eta {}",
                    report.step,
                    trainer.total_steps(),
                    eta(report.seconds_left_range)
                ));
                self.last_line = Instant::now();
            }
            None => {}
        }
    }
}

/// A range of seconds in words; one value if its ends are close.
fn eta([low, high]: [f64; 2]) -> String {
    let words = |seconds: f64| format!("{:#}", HumanDuration(Duration::from_secs(seconds.round() as u64)));
    let (from, to) = (words(low), words(high));
    if from == to || high < 1.3 * low {
        words((low * high).sqrt())
    } else {
        format!("{from} to {to}")
    }
}

/// The size of a scene: splats, or the parameters of a field.
pub fn format_size(splats: u64, parameters: Option<u64>) -> String {
    parameters.map_or_else(|| format!("{splats} splats"), |n| format!("{n} parameters"))
}

impl Observer for Progress {
    fn on_event(&mut self, event: &Event, trainer: &Trainer) -> Signal {
        match event {
            Event::Started {
                recipe,
                step,
                total_steps,
                splats,
                parameters,
                views,
            } => {
                self.first_step = *step;
                self.stage = trainer.stage_name().to_owned();
                if let Some(bar) = &self.bar {
                    bar.set_length(*total_steps);
                    bar.set_position(*step);
                }
                let size = format_size(*splats as u64, parameters.map(|n| n as u64));
                self.print_line(&format!("{recipe}: {size}, {views} views, {total_steps} steps"));
            }
            Event::StageEntered { stage, .. } => self.stage.clone_from(stage),
            Event::Step(report) => self.step(report, trainer),
            Event::Evaluated { psnr, .. } => self.held_out = Some(*psnr),
            Event::Decided { message } => self.print_line(message),
            Event::Warned { message } => self.print_line(&format!("warning: {message}")),
            Event::Finished { step, seconds, reason } => {
                if let Some(bar) = self.bar.take() {
                    bar.finish_and_clear();
                }
                self.print_line(&format!("{reason} after {step} steps, {seconds:.1} s of training"));
            }
            Event::Paused { step } => self.print_line(&format!("paused after {step} steps")),
            Event::Resumed { .. } => self.print_line("resumed"),
            Event::Densified { .. } | Event::Saved { .. } => {}
        }
        self.signal()
    }

    fn wants_stop(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn while_paused(&mut self, _trainer: &Trainer) -> Signal {
        self.signal()
    }
}

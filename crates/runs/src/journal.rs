//! The files that a run writes while training: `events.jsonl`, paces, checkpoints, and the curves for its report.

use crate::folder::PACES;
use crate::saver::Saver;
use crate::{RunError, RunFolder};
use irradia_train::Trainer;
use irradia_train::checkpoint::Checkpoint;
use irradia_train::event::{Event, Observer, Signal};
use irradia_train::paces::Paces;
use irradia_train::report::{CurvePoint, StageReport};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::Path;

/// Approximate number of points of a curve: more would not be visible.
const CURVE_POINTS: u64 = 1000;

/// An observer that writes the files of a run.
pub struct Journal {
    folder: RunFolder,
    events: File,
    /// Loss, PSNR and number of splats over the run.
    pub curve: Vec<CurvePoint>,
    /// The stages entered so far.
    pub stages: Vec<StageReport>,
    /// Warnings for the report.
    pub warnings: Vec<String>,
    /// Start of the current stage, seconds of training.
    stage_start: f64,
    non_finite: usize,
    paces: File,
    /// The last pace written.
    pace: Option<f64>,
    saver: Saver,
    failed: bool,
    /// The warning for [`Observer::warning`].
    warning: Option<String>,
}

/// `events.jsonl`, opened for appending.
fn open_for_append(path: &Path) -> Result<File, RunError> {
    let file = OpenOptions::new().create(true).append(true).open(path);
    file.map_err(RunError::io("write", path))
}

/// `pace.txt`, opened for appending after step `from`; later lines of an interrupted run are removed.
fn open_paces(folder: &RunFolder, from: u64) -> Result<File, RunError> {
    let path = folder.file(PACES);
    let text = fs::read_to_string(&path).unwrap_or_default();
    let step = |line: &str| line.split_once(' ').and_then(|(step, _)| step.parse::<u64>().ok());
    let lines = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    let kept: String = lines
        .take_while(|line| step(line).is_some_and(|step| step <= from))
        .collect();
    if kept.len() < text.len() {
        folder.write(PACES, kept.as_bytes())?;
    }
    open_for_append(&path)
}

impl Journal {
    /// Begins a journal, or resumes one after step `from`, in which case events of an interrupted run that will be repeated are removed.
    pub fn open(folder: &RunFolder, from: u64) -> Result<Self, RunError> {
        let path = folder.file("events.jsonl");
        let mut journal = Self {
            folder: folder.clone(),
            events: open_for_append(&path)?,
            curve: Vec::new(),
            stages: Vec::new(),
            warnings: Vec::new(),
            stage_start: 0.0,
            non_finite: 0,
            paces: open_paces(folder, from)?,
            pace: None,
            saver: Saver::default(),
            failed: false,
            warning: None,
        };
        let bytes = fs::read(&path).unwrap_or_default();
        let text = String::from_utf8_lossy(&bytes);
        let mut kept = String::new();
        for line in text.lines() {
            // A line truncated by a power failure, perhaps within a character, is not JSON: it and all later ones are removed.
            let Ok(value) = serde_json::from_str::<serde_json::Value>(line) else {
                break;
            };
            // Later events belong to steps that are made again, including those without a step of their own; a run that begins again repeats
            // all.
            if from == 0 || value["step"].as_u64().is_some_and(|step| step > from) {
                break;
            }
            journal.restore_event(&value);
            kept.push_str(line);
            kept.push('\n');
        }
        // The last line may also have lost its end only, and the next event would continue it.
        if kept.as_bytes() != bytes {
            folder.write("events.jsonl", kept.as_bytes())?;
            journal.events = open_for_append(&path)?;
        }
        Ok(journal)
    }

    /// Adds an earlier event to the curves.
    fn restore_event(&mut self, event: &serde_json::Value) {
        let step = event["step"].as_u64().unwrap_or(0);
        let seconds = event["seconds"].as_f64().unwrap_or(f64::NAN);
        match event["event"].as_str() {
            Some("step") => self.curve.push(CurvePoint {
                step,
                seconds,
                loss: event["loss"].as_f64().unwrap_or(f64::NAN),
                psnr: None,
                splats: event["splats"].as_u64().unwrap_or(0),
            }),
            Some("evaluated") => self.record_evaluation(
                step,
                seconds,
                event["psnr"].as_f64(),
                event["splats"].as_u64().unwrap_or(0),
            ),
            Some("warned") => self.warnings.extend(event["message"].as_str().map(str::to_owned)),
            Some("stage_entered") => self.begin_stage(event["stage"].as_str().unwrap_or("").to_owned(), step, seconds),
            _ => {}
        }
    }

    fn record_evaluation(&mut self, step: u64, seconds: f64, psnr: Option<f64>, splats: u64) {
        match self.curve.last_mut() {
            Some(point) if point.step == step => point.psnr = psnr,
            _ => self.curve.push(CurvePoint {
                step,
                seconds,
                loss: f64::NAN,
                psnr,
                splats,
            }),
        }
    }

    fn begin_stage(&mut self, name: String, step: u64, seconds: f64) {
        self.end_stage(step, seconds);
        self.stages.push(StageReport {
            name,
            first_step: step + 1,
            last_step: step + 1,
            seconds: 0.0,
        });
        self.stage_start = seconds;
    }

    fn end_stage(&mut self, step: u64, seconds: f64) {
        if let Some(last) = self.stages.last_mut() {
            last.last_step = step;
            last.seconds = seconds - self.stage_start;
        }
    }

    fn write(&mut self, event: &Event) {
        let line = serde_json::to_string(event).expect("an event is plain data") + "\n";
        let written = self.events.write_all(line.as_bytes());
        self.report_failure(written, "events.jsonl");
    }

    /// Records the pace of a step, if it differs from the previous step's.
    fn record_pace(&mut self, step: u64, pace: f64) {
        if self.pace != Some(pace) {
            self.pace = Some(pace);
            self.write_pace(step, pace);
        }
    }

    fn write_pace(&mut self, step: u64, pace: f64) {
        let written = self.paces.write_all(Paces::line(step, pace).as_bytes());
        self.report_failure(written, PACES);
    }

    /// A full disk must not end the training; it is reported once.
    fn report_failure(&mut self, written: io::Result<()>, file: &str) {
        if let Err(error) = written
            && !self.failed
        {
            self.failed = true;
            let path = self.folder.file(file);
            self.warning = Some(format!("cannot write {}: {error}; training continues", path.display()));
        }
    }

    /// Writes a checkpoint and waits until it is complete.
    ///
    /// # Errors
    /// One line.
    pub fn save_now(&mut self, trainer: &Trainer) -> Result<(), RunError> {
        let saved = self.saver.save_now(&self.folder, &Checkpoint::of(trainer));
        saved.map(drop).map_err(RunError::NotSaved)
    }

    /// Waits until the checkpoint that is being written is complete.
    ///
    /// # Errors
    /// One line, if it could not be written.
    pub fn finish_saving(&mut self) -> Result<(), RunError> {
        self.saver.wait();
        self.saver
            .take_failure()
            .map_or(Ok(()), |why| Err(RunError::NotSaved(why)))
    }

    /// All warnings, including counts.
    pub fn all_warnings(&self) -> Vec<String> {
        let counted = (self.non_finite > 0).then(|| {
            let times = self.non_finite;
            format!("{times} splat updates were skipped because of non-finite gradients")
        });
        self.warnings.iter().cloned().chain(counted).collect()
    }
}

impl Observer for Journal {
    fn on_event(&mut self, event: &Event, trainer: &Trainer) -> Signal {
        match event {
            Event::Step(report) => {
                self.non_finite += report.non_finite;
                if report.step == 1 && trainer.skipped > 0.0 {
                    self.write_pace(0, trainer.skipped);
                }
                self.record_pace(report.step, report.pace);
                let interval = (trainer.total_steps() / CURVE_POINTS).max(1);
                if self.curve.last().is_some_and(|last| report.step < last.step + interval) {
                    return Signal::Continue;
                }
                self.curve.push(CurvePoint {
                    step: report.step,
                    seconds: report.seconds,
                    loss: report.loss,
                    psnr: None,
                    splats: report.splats as u64,
                });
            }
            Event::Evaluated {
                step,
                seconds,
                psnr,
                splats,
                ..
            } => self.record_evaluation(*step, *seconds, Some(*psnr), *splats as u64),
            Event::StageEntered { stage, step, seconds } => self.begin_stage(stage.clone(), *step, *seconds),
            Event::Finished { step, seconds, .. } => self.end_stage(*step, *seconds),
            Event::Warned { message } => self.warnings.push(message.clone()),
            // Not on a GPU, where this would read the state back.
            Event::Started { .. } | Event::Densified { .. } if !trainer.engine.is_on_gpu() => {
                self.saver.prepare(trainer.engine.state(), trainer.recipe.max_splats);
            }
            Event::Started { .. }
            | Event::Decided { .. }
            | Event::Densified { .. }
            | Event::Saved { .. }
            | Event::Paused { .. }
            | Event::Resumed { .. } => {}
        }
        self.write(event);
        Signal::Continue
    }

    fn save(&mut self, trainer: &Trainer) -> Result<Option<String>, String> {
        self.saver.save(&self.folder, Checkpoint::of(trainer))
    }

    fn saved(&mut self) -> Option<(u64, String)> {
        self.saver.take_saved()
    }

    fn warning(&mut self) -> Option<String> {
        self.warning.take().or_else(|| self.saver.take_failure())
    }
}

/// Mean squared errors of the training views that the run in `folder` logged, step by step; empty without a log.
pub fn logged_errors(folder: &Path) -> Vec<f64> {
    let bytes = fs::read(folder.join("events.jsonl")).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let events = text
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    events
        .filter(|event| event["event"] == "step")
        .filter_map(|event| event["mse"].as_f64())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_of_steps_that_are_made_again_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events.jsonl");
        let lines = [
            r#"{"event":"warned","message":"little memory"}"#,
            r#"{"event":"stage_entered","stage":"warmup","step":0,"seconds":0.0}"#,
            r#"{"event":"step","step":5,"seconds":1.0,"loss":0.5,"splats":9}"#,
            r#"{"event":"step","step":6,"seconds":1.2,"loss":0.5,"splats":9}"#,
            r#"{"event":"warned","message":"of step 6"}"#,
        ];
        let resumed = |from: u64| {
            fs::write(&path, lines.map(|line| format!("{line}\n")).concat()).unwrap();
            let journal = Journal::open(&RunFolder::at(folder.path()), from).unwrap();
            let kept = fs::read_to_string(&path).unwrap().lines().count();
            (kept, journal.warnings, journal.stages.len(), journal.curve.len())
        };
        assert_eq!(resumed(5), (3, vec!["little memory".to_owned()], 1, 1));
        // A line that ends within a character.
        let cut = [
            lines.join("\n").as_bytes(),
            b"\n{\"event\":\"warned\",\"message\":\"\xc3",
        ]
        .concat();
        fs::write(&path, cut).unwrap();
        let journal = Journal::open(&RunFolder::at(folder.path()), 9).unwrap();
        assert_eq!((journal.warnings.len(), journal.curve.len()), (2, 2));
        assert_eq!(fs::read_to_string(&path).unwrap().lines().count(), lines.len());
        // They are reported again by the run that begins again.
        assert_eq!(resumed(0), (0, Vec::new(), 0, 0));
    }
}

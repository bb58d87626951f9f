//! A training run with its folder: begin or resume, train, finish.

use crate::evaluate::hold_out_readable;
use crate::folder::{REPEATED_PACES, RunRecord};
use crate::journal::Journal;
use crate::lock::FolderLock;
use crate::provenance::{ViewList, file_fingerprint};
use crate::scene_file::same_file;
use crate::snapshot::{SnapshotServer, Snapshots};
use crate::{RunError, RunFolder, SCENE, TrainRequest, background, moved_from_dataset, scene_path};
use irradia_compute::{Device, DeviceChoice};
use irradia_measure::Lpips;
use irradia_scene::Dataset;
use irradia_train::event::Observer;
use irradia_train::memory::default_limit;
use irradia_train::paces::Paces;
use irradia_train::report::Report;
use irradia_train::{EndReason, RunLimits, TrainOptions, Trainer, checkpoint};
use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// A training run with its folder. [`Run::train`] makes the steps, [`Run::finish`] writes the scene and the report.
///
/// ```
/// # let folder = tempfile::tempdir().unwrap();
/// # let (photos, run) = (folder.path().join("photos"), folder.path().join("run"));
/// # let options = SynthOptions { views: 4, width: 24, height: 16, ..SynthOptions::default() };
/// # write_synth_dataset(&photos, &options)?;
/// use irradia_runs::prelude::*;
///
/// let request = TrainInput { steps: Some(5), ..TrainInput::new(photos, run) }.check()?;
/// let mut run = Run::begin(request)?;
/// run.train(&mut [])?;
/// let report = run.finish()?.report;
/// assert!(report.psnr > 5.0 && report.steps == 5);
/// # Ok::<(), RunError>(())
/// ```
///
/// An [`Observer`] watches or controls a training run; another thread gets its latest state from [`Run::snapshots`].
pub struct Run {
    pub(crate) folder: RunFolder,
    pub(crate) request: TrainRequest,
    pub(crate) trainer: Trainer,
    pub(crate) journal: Journal,
    snapshots: SnapshotServer,
    pub(crate) unseen_lpips: Option<Lpips>,
    /// The paces of another run to repeat.
    paces: Option<Paces>,
    /// Seconds between the request and the first step.
    pub(crate) preparing: Option<f64>,
    /// What `run.json` holds.
    record: RunRecord,
    _lock: FolderLock,
}

/// How a run ended.
#[derive(Clone, Debug)]
pub struct Finished {
    /// The run's folder.
    pub folder: RunFolder,
    /// The content of `report.json`.
    pub report: Report,
    /// Whether the recipe was completed; otherwise the run can be resumed.
    pub complete: bool,
}

impl Run {
    /// Begins a run in a folder of its own.
    ///
    /// # Errors
    /// When the folder contains a run that the request does not replace, or the dataset cannot be trained on. In these cases nothing is
    /// written.
    pub fn begin(request: TrainRequest) -> Result<Self, RunError> {
        RunFolder::check_free(&request.input.out, request.input.overwrite)?;
        let dataset = request.read_dataset()?;
        Self::begin_on(request, dataset)
    }

    /// Begins a run on a dataset in memory. It can be resumed by [`Run::resume_on`] with the same dataset.
    ///
    /// # Errors
    /// Those of [`Run::begin`].
    pub fn begin_on(mut request: TrainRequest, mut dataset: Dataset) -> Result<Self, RunError> {
        let earlier = request.input.replay.as_ref().or(request.input.from.as_ref());
        match earlier.and_then(|earlier| RunFolder::containing(earlier)) {
            // The splats were trained on all others, or are to be trained again on the same ones.
            Some(run) if request.input.reading.holdout.is_none() => run.restore_holdout(&mut dataset)?,
            // A replay has the split of its run.
            Some(run) if request.input.from.is_some() => run.warn_of_trained_views(&mut dataset)?,
            _ => {}
        }
        // Before unreadable photographs are left out below: once they are restored, they are held out again.
        let views = ViewList::of(&dataset);
        request.apply_unhurried_changes()?;
        request.choose_background(&dataset)?;
        request.choose_length(&dataset);
        let (out, overwrite) = (&request.input.out, request.input.overwrite);
        RunFolder::check_replaceable(out, overwrite)?;
        if let Some(from) = &request.input.from
            && let Some(run) = RunFolder::containing(from)
            && same_file(run.path(), out)
        {
            return Err(RunError::Refused(format!(
                "{} would be removed before the new run has a checkpoint: choose another --out",
                from.display()
            )));
        }
        let from = request.input.from.as_deref().map(scene_path);
        let from_fingerprint = from.as_deref().map(file_fingerprint).transpose()?;
        if let Some(repeated) = &request.input.replay {
            let (folder, record) = RunFolder::open(repeated)?;
            check_same_data(&folder, folder.changed_views(&views)?, &request, &dataset)?;
            if let (Some(from), Some(then)) = (&from, record.from_fingerprint)
                && from_fingerprint != Some(then)
            {
                return Err(RunError::Refused(format!(
                    "{} has changed since {} began with it: the run cannot be repeated",
                    from.display(),
                    repeated.display()
                )));
            }
        }
        let existing_lock = FolderLock::acquire_existing(out)?;
        let paces = request.paces()?;
        let options = train_options(&request)?;
        hold_out_readable(&mut dataset);
        if dataset.test.is_empty()
            && let Some(psnr) = request.input.until_psnr
        {
            let message = "no view is held out, or none can be read, so PSNR cannot be measured";
            return Err(RunError::setting("until_psnr", psnr, message));
        }
        let (dataset, found) = request.with_points(dataset);
        let mut trainer = new_trainer(&request, Arc::new(dataset), options)?;
        found.into_iter().for_each(|message| trainer.add_decision(message));
        let (folder, lock) = RunFolder::create(out, overwrite, existing_lock)?;
        folder.write("recipe.toml", trainer.recipe.to_toml().as_bytes())?;
        folder.write_cameras(&trainer)?;
        folder.write_views(&views)?;
        folder.write_world(&trainer.dataset.world_from_dataset)?;
        if let Some(paces) = &paces {
            folder.write(REPEATED_PACES, paces.to_text().as_bytes())?;
        }
        // Last: a folder with this file has everything needed to resume.
        let record = RunRecord {
            input: request.input.clone(),
            complete: false,
            data_warnings: trainer.dataset.warnings.clone(),
            from_fingerprint,
        };
        folder.write_record(&record)?;
        Self::new(folder, lock, request, trainer, paces, record)
    }

    /// Resumes the run in the request's folder from its latest checkpoint. The request comes from
    /// [`TrainInput::of_run`](crate::TrainInput::of_run).
    ///
    /// # Errors
    /// When the folder contains no run or is in use, its checkpoint is damaged, its dataset cannot be read or has different views from
    /// those of the previous steps, or the request holds out others or has a budget that is used up already.
    pub fn resume(request: TrainRequest) -> Result<Self, RunError> {
        let dataset = request.read_dataset()?;
        Self::resume_on(request, dataset)
    }

    /// [`Run::resume`] on a dataset that has already been read.
    ///
    /// # Errors
    /// Those of [`Run::resume`].
    pub fn resume_on(request: TrainRequest, mut dataset: Dataset) -> Result<Self, RunError> {
        let (folder, mut record) = RunFolder::open(&request.input.out)?;
        let holdout = &request.input.reading.holdout;
        // A list, or the photographs of which every N-th is held out, may have changed since.
        if holdout.is_none() || *holdout == record.input.reading.holdout {
            folder.restore_holdout(&mut dataset)?;
        }
        let views = ViewList::of(&dataset);
        let lock = FolderLock::acquire(folder.path())?;
        folder.remove_leftovers()?;
        let options = train_options(&request)?;
        hold_out_readable(&mut dataset);
        let paces = match folder.repeated_paces()? {
            // Begun by an earlier version.
            None => request.paces()?,
            copied => copied,
        };
        // The world in which the previous steps were made; an earlier version may have chosen another one.
        let (dataset, _) = request.with_points(dataset.in_world(folder.world_from_dataset()?));
        let dataset = Arc::new(dataset);
        let trainer = match folder.newest_checkpoint()? {
            Some(path) => {
                let differences = folder.changed_views(&views)?;
                if let Some(requested) = holdout
                    && *holdout != record.input.reading.holdout
                    && !differences.is_empty()
                {
                    let message = format!(
                        "the run holds out other views ({}): omit it to hold out the same ones",
                        differences.join("; ")
                    );
                    return Err(RunError::setting("holdout", requested, message));
                }
                check_same_data(&folder, differences, &request, &dataset)?;
                read_checkpoint(&path, dataset, options)?
            }
            // Interrupted before its first checkpoint: no step depends on the earlier data.
            None => new_trainer(&request, dataset, options)?,
        };
        if let Some(budget) = request.input.budget
            && request.input.budget != record.input.budget
            && budget <= trainer.seconds
            && !trainer.finished()
        {
            let message = format!(
                "the run has trained for {:.0} s already; a budget includes them",
                trainer.seconds
            );
            return Err(RunError::setting("budget", budget, message));
        }
        folder.write_views(&views)?;
        // Reading the dataset again repeats some of its warnings, but not what was found out about its poses.
        let new = |line: &&String| !record.data_warnings.contains(line);
        let new: Vec<String> = trainer.dataset.warnings.iter().filter(new).cloned().collect();
        record.data_warnings.extend(new);
        // With what was changed to resume, should this process die.
        record.input = request.input.clone();
        folder.write_record(&record)?;
        Self::new(folder, lock, request, trainer, paces, record)
    }

    fn new(
        folder: RunFolder,
        lock: FolderLock,
        request: TrainRequest,
        trainer: Trainer,
        paces: Option<Paces>,
        record: RunRecord,
    ) -> Result<Self, RunError> {
        let unseen_lpips = request.input.unseen_lpips.as_ref().map(Lpips::load).transpose()?;
        let mut journal = Journal::open(&folder, trainer.clock.step)?;
        journal.warnings.extend(record.data_warnings.iter().cloned());
        journal.warnings.extend(request.warnings());
        Ok(Self {
            unseen_lpips,
            folder,
            request,
            trainer,
            journal,
            snapshots: SnapshotServer::new(),
            paces,
            preparing: None,
            record,
            _lock: lock,
        })
    }

    /// The current state of training.
    pub fn trainer(&self) -> &Trainer {
        &self.trainer
    }

    /// The request.
    pub fn request(&self) -> &TrainRequest {
        &self.request
    }

    /// Description of the training and evaluation background.
    pub fn background(&self) -> String {
        background::description(&self.trainer.recipe)
    }

    /// The folder.
    pub fn folder(&self) -> &RunFolder {
        &self.folder
    }

    /// A handle by which other threads get the latest state while [`Run::train`] runs.
    pub fn snapshots(&self) -> Snapshots {
        self.snapshots.handle()
    }

    /// Trains until the recipe is complete, a limit of the request is reached, or an observer returns
    /// [`Signal::Stop`](irradia_train::event::Signal::Stop); returns the reason. A stopped run may be trained further.
    ///
    /// # Errors
    /// When a photograph cannot be read; completed steps are still saved.
    pub fn train(&mut self, observers: &mut [&mut dyn Observer]) -> Result<EndReason, RunError> {
        let started = self.request.started;
        self.preparing.get_or_insert_with(|| started.elapsed().as_secs_f64());
        let limits = RunLimits {
            until_psnr: self.request.input.until_psnr,
            budget: self.request.input.budget,
            paces: self.paces.clone(),
        };
        let mut all: Vec<&mut dyn Observer> = Vec::with_capacity(observers.len() + 2);
        for observer in observers.iter_mut() {
            all.push(&mut **observer);
        }
        all.push(&mut self.journal);
        self.snapshots.open();
        all.push(&mut self.snapshots);
        let ended = irradia_train::run(&mut self.trainer, &limits, &mut all);
        self.snapshots.close(&self.trainer);
        // A failure is a warning here: the steps were made, and the end of the run is saved again.
        if let Err(error) = self.journal.finish_saving() {
            self.journal.warnings.push(error.to_string());
        }
        ended.map_err(|error| {
            // The first error is the one to report.
            let _ = self.save_unfinished();
            error.into()
        })
    }

    /// Writes the scene, evaluates it on the held-out views, and writes the report. A run that has not completed its
    /// recipe is saved so that it can be resumed.
    ///
    /// # Errors
    /// When a file cannot be written or a held-out photograph cannot be read.
    pub fn finish(self) -> Result<Finished, RunError> {
        self.finish_unless(&|| false)
    }

    /// [`Run::finish`], except that `stop`, polled after each view, ends the evaluation: [`RunError::EvaluationStopped`]. The run is
    /// then saved, and resuming it evaluates it again.
    ///
    /// # Errors
    /// Those of [`Run::finish`].
    pub fn finish_unless(mut self, stop: &dyn Fn() -> bool) -> Result<Finished, RunError> {
        let finishing = Instant::now();
        let saved = self.save_unfinished();
        self.write_scene()?;
        saved?;
        let report = self.report(finishing, stop);
        if report.is_err() && self.trainer.finished() {
            self.journal.save_now(&self.trainer)?;
        }
        let report = report?;
        self.write_report(&report)?;
        let complete = self.trainer.finished();
        self.folder.write_record(&RunRecord {
            input: self.request.input,
            complete,
            ..self.record
        })?;
        Ok(Finished {
            folder: self.folder,
            report,
            complete,
        })
    }

    fn save_unfinished(&mut self) -> Result<(), RunError> {
        if !self.trainer.finished() && self.trainer.clock.step > 0 {
            self.trainer.read_back()?;
            self.journal.save_now(&self.trainer)?;
        }
        Ok(())
    }
}

/// A trainer before its first step.
fn new_trainer(request: &TrainRequest, dataset: Arc<Dataset>, options: TrainOptions) -> Result<Trainer, RunError> {
    let mut recipe = request.recipe.clone();
    Ok(match request.initial_splats(&dataset)? {
        Some((splats, antialiased)) => {
            recipe.render.antialias |= antialiased;
            Trainer::from_splats(dataset, recipe, options, splats)?
        }
        None => Trainer::new(dataset, recipe, options)?,
    })
}

/// Opens the device of this name; see [`TrainInput::device`](crate::TrainInput::device).
///
/// # Errors
/// When there is no device of this name, or its driver fails.
pub fn open_device(name: &str) -> Result<Device, RunError> {
    let Ok(choice) = name.parse::<DeviceChoice>();
    Device::open(&choice).map_err(|error| RunError::setting("device", name, error.to_string()))
}

/// Rejects a dataset with `differences` from that of the run in `folder`, or with other poses.
fn check_same_data(
    folder: &RunFolder,
    mut differences: Vec<String>,
    request: &TrainRequest,
    dataset: &Dataset,
) -> Result<(), RunError> {
    if moved_from_dataset(&folder.file(SCENE), dataset).is_none() {
        differences.push("its views have other poses".to_owned());
    }
    if differences.is_empty() {
        return Ok(());
    }
    Err(RunError::DataChanged {
        folder: folder.path().to_owned(),
        data: request.input.data.clone(),
        differences: differences.join("; "),
    })
}

impl TrainRequest {
    /// Opens the device and reads the LPIPS networks, so that mistakes are reported before photographs are posed.
    ///
    /// # Errors
    /// When one of them cannot be used.
    pub fn check_resources(&self) -> Result<(), RunError> {
        train_options(self)?;
        self.input.unseen_lpips.as_ref().map(Lpips::load).transpose()?;
        Ok(())
    }
}

/// The trainer's options from the request; reads the LPIPS network and opens the device.
fn train_options(request: &TrainRequest) -> Result<TrainOptions, RunError> {
    let input = &request.input;
    Ok(TrainOptions {
        seed: input.seed,
        steps: input.steps,
        memory: input.memory.or_else(default_limit),
        lpips: input.lpips.as_ref().map(Lpips::load).transpose()?.map(Arc::new),
        device: open_device(&input.device)?,
    })
}

fn read_checkpoint(path: &Path, dataset: Arc<Dataset>, options: TrainOptions) -> Result<Trainer, RunError> {
    let bytes = fs::read(path).map_err(RunError::io("read", path))?;
    checkpoint::from_bytes(&bytes, dataset, options).map_err(|source| RunError::File {
        path: path.to_owned(),
        source,
    })
}

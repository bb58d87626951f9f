//! Compaction of a scene: the splats that matter least are removed, and the others are trained to replace them and to suit the file format.
//!
//! How much a splat matters is measured ([`irradia_splat::contribution`]). After the removal the scene is encoded and decoded twice: first
//! its harmonics are frozen at their decoded values, then everything but colours and opacities, and the remaining parameters are trained to
//! compensate for the rounding. SOG's palette and codebooks represent values that came from them exactly, so the final encoding loses next
//! to nothing.

mod interpolate;
mod tries;

use crate::cameras::write_own_cameras;
use crate::evaluate::hold_out_readable;
use crate::levels::write_scene;
use crate::{ReadingOptions, RunError, Scene, check_not_overwritten, read_vignette, residual_left_out, scene_path};
use interpolate::with_interpolated_views;
use irradia_edit::Transform;
use irradia_formats::{SplatFormat, WriteOptions, splat_file_size};
use irradia_train::model::Model;
use std::path::PathBuf;
use tries::{Measure, Tries};

/// The size limit of a compacted scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CompactTarget {
    /// Maximum number of splats.
    Splats(usize),
    /// Maximum size of the file, bytes.
    Bytes(u64),
}

/// A request to compact a scene, not validated.
#[derive(Clone, Debug)]
pub struct CompactInput {
    /// The scene: a run, or a splat file of any format.
    pub scene: PathBuf,
    /// The dataset on which the scene was trained.
    pub data: PathBuf,
    /// The file to write; its name selects the format.
    pub out: PathBuf,
    /// The size limit. Either this or `keep_psnr` is required.
    pub target: Option<CompactTarget>,
    /// PSNR that the result may lose on the training views, dB. Without a target, the smallest scene within this loss is searched; with a
    /// target, more splats are kept if this loss requires them.
    pub keep_psnr: Option<f64>,
    /// Training steps of a try.
    pub steps: u64,
    /// How the dataset is read, where that differs from the run that contains the scene.
    pub reading: ReadingOptions,
    /// How the file is written; options that are `None` are chosen for the number of splats.
    pub write: WriteOptions,
    /// Random seed.
    pub seed: u64,
}

impl CompactInput {
    /// Default steps of a try. On lund_door at a thirtieth of the bytes, 1,500 gain 0.3 dB on training views and nothing on held-out ones.
    pub const STEPS: u64 = 600;

    /// A request to make the scene `scene`, trained on `data`, as small as a `keep_psnr` of 0.2 allows.
    pub fn new(scene: impl Into<PathBuf>, data: impl Into<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self {
            scene: scene.into(),
            data: data.into(),
            out: out.into(),
            target: None,
            keep_psnr: Some(0.2),
            steps: Self::STEPS,
            reading: ReadingOptions::default(),
            write: WriteOptions::default(),
            seed: 0,
        }
    }

    fn check(&self) -> Result<SplatFormat, RunError> {
        let format = SplatFormat::of(&self.out)?;
        if !format.is_readable() {
            let message = format!("{format} files cannot be read back as splats: choose another format");
            return Err(RunError::setting("out", self.out.display(), message));
        }
        if self.steps < 10 {
            return Err(RunError::setting("steps", self.steps, "must be 10 or more"));
        }
        match (self.target, self.keep_psnr) {
            (None, None) => Err(RunError::Refused(
                "compact needs a target, or a PSNR to keep".to_owned(),
            )),
            (Some(CompactTarget::Splats(0) | CompactTarget::Bytes(0)), _) => {
                Err(RunError::setting("target", 0, "must be more than 0"))
            }
            (_, Some(db)) if !(db >= 0.0 && db.is_finite()) => {
                Err(RunError::setting("keep_psnr", db, "must be 0 dB or more"))
            }
            _ => Ok(format),
        }
    }
}

/// The result of a compaction; pairs are before and after.
#[derive(Clone, Debug)]
pub struct Compacted {
    /// Formats of the files.
    pub formats: [SplatFormat; 2],
    /// Sizes of the files, bytes.
    pub bytes: [u64; 2],
    /// Numbers of splats.
    pub splats: [usize; 2],
    /// Number of splats with harmonics above degree 0, after.
    pub with_harmonics: usize,
    /// Mean PSNR of training views, dB.
    pub psnr: [f64; 2],
    /// Mean PSNR of held-out views, dB; `None` if there are none.
    pub held_out_psnr: Option<[f64; 2]>,
    /// What the format cannot hold, and requests that could not be met, a line each.
    pub notes: Vec<String>,
}

/// Progress of [`compact`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CompactEvent {
    /// A step of a try was made.
    Step {
        /// Steps made, and all steps of this try.
        steps: [u64; 2],
        /// Splats now, and at the end of this try.
        splats: [usize; 2],
    },
    /// A try ended.
    Tried {
        /// Splats.
        splats: usize,
        /// Bytes of the file.
        bytes: u64,
        /// Mean PSNR of training views, dB.
        psnr: f64,
    },
}

/// Compacts a scene and writes it; nothing is written before the end. `on_event` receives the progress.
///
/// # Errors
/// When a setting is out of range, scene or dataset cannot be read, the scene has no splats, the target cannot be reached, or the output
/// cannot be written.
pub fn compact(input: &CompactInput, on_event: &mut dyn FnMut(CompactEvent)) -> Result<Compacted, RunError> {
    let format = input.check()?;
    let file = scene_path(&input.scene);
    check_not_overwritten(&file, &input.out)?;
    let mut scene = Scene::read(&file)?;
    if let Model::Splats { residual, .. } = &mut scene.model {
        // The output cannot hold it: what is lost is measured without it.
        *residual = None;
    }
    let Some(splats) = scene.model.splats().cloned() else {
        let message = format!("{} is a radiance field: only splats can be compacted", file.display());
        return Err(RunError::Refused(message));
    };
    let mut dataset = input.reading.read_for(&scene, &file, &input.data)?;
    hold_out_readable(&mut dataset);
    let mut notes = dataset.warnings.clone();
    notes.extend(residual_left_out(&file, "splat formats cannot hold it"));
    let measure = Measure::new(&dataset, scene.options, read_vignette(&file)?);
    let before = measure.train_psnr(&scene.model)?;
    let held_out_before = measure.held_out_psnr(&scene.model)?;
    let count = splats.len();
    let dataset = with_interpolated_views(dataset, &scene, measure.vignette());
    let mut tries = Tries::new(input, format, &scene, splats, dataset, &measure)?;
    let found = match input.target {
        Some(target) => {
            let found = match target {
                CompactTarget::Splats(most) => tries.train(most.min(count), on_event)?,
                CompactTarget::Bytes(most) => tries.fit_bytes(most, on_event)?,
            };
            match input.keep_psnr.map(|loss| before - loss) {
                Some(min_psnr) if found.psnr < min_psnr => {
                    notes.push(format!(
                        "the target would lose {:.2} dB on the training views: more splats are kept",
                        before - found.psnr
                    ));
                    tries.reset(&scene);
                    tries.find_smallest(found.splats.len(), min_psnr, on_event)?
                }
                _ => found,
            }
        }
        None => tries.find_smallest(1, before - input.keep_psnr.unwrap_or_default(), on_event)?,
    };
    if let Some(loss) = input.keep_psnr.filter(|loss| found.psnr < before - loss) {
        notes.push(format!("every try lost more than {loss} dB: all splats are kept"));
    }
    let held_out_after = measure.held_out_psnr(&Model::of_splats(&found.splats))?;
    notes.extend(write_scene(&input.out, &tries.cloud(&found.splats), &found.write)?);
    write_own_cameras(&file, &input.out, &Transform::IDENTITY)?;
    Ok(Compacted {
        formats: [SplatFormat::of(&file)?, format],
        bytes: [splat_file_size(&file)?, splat_file_size(&input.out)?],
        splats: [count, found.splats.len()],
        with_harmonics: found.count_with_harmonics(),
        psnr: [before, found.psnr],
        held_out_psnr: held_out_before.zip(held_out_after).map(Into::into),
        notes,
    })
}

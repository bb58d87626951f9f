//! Conversion of a scene from one splat format to another, and its cost: bytes, splats and, for lossy formats, PSNR.

use crate::cameras::{cameras_beside, write_own_cameras};
use crate::levels::write_scene;
use crate::orbit::orbit;
use crate::{RunError, check_not_overwritten, residual_left_out, scene_path};
use irradia_edit::Transform;
use irradia_formats::{SplatFormat, WriteOptions, read_splat_file, read_splats, splat_file_size};
use irradia_measure::psnr;
use irradia_scene::{GaussianCloud, Similarity};
use irradia_splat::{RenderOptions, Renderer, Splats};
use irradia_train::model::Model;
use std::path::Path;

/// Number of views around the scene in which it is compared.
pub const COMPARED_VIEWS: u32 = 12;
/// Width and height of a compared render, pixels.
const COMPARED_SIZE: (u32, u32) = (640, 480);

/// The result of a conversion.
#[derive(Clone, Debug)]
pub struct Conversion {
    /// Formats of input and output.
    pub formats: [SplatFormat; 2],
    /// Bytes of input and output.
    pub bytes: [u64; 2],
    /// Number of splats that were written.
    pub splats: usize,
    /// What was left out, and what the format cannot hold, a line each.
    pub notes: Vec<String>,
    /// PSNR between renders of the output and of the input, one per view, dB; infinite if they are equal. `None` for lossless formats, for
    /// formats that cannot be read back as splats, and if not requested.
    pub psnr: Option<Vec<f64>>,
}

/// Converts the scene `input`, a file, a folder of images or a run, to `output`, whose name selects the format. If `compares`, both
/// are rendered from [`COMPARED_VIEWS`] views around the scene.
///
/// # Errors
/// When a format is unknown, the output is the input, the input cannot be read, or the output cannot be written, in which case no partial file remains.
pub fn convert(input: &Path, output: &Path, options: &WriteOptions, compares: bool) -> Result<Conversion, RunError> {
    // Reading may take a while: an unknown output format is reported first.
    let to = SplatFormat::of(output)?;
    check_not_overwritten(input, output)?;
    let input = scene_path(input);
    let file = read_splat_file(&input)?;
    let before = splat_file_size(&input)?;
    let mut notes = file.warnings();
    notes.extend(residual_left_out(&input, "splat formats cannot hold it"));
    notes.extend(write_scene(output, &file.cloud, options)?);
    write_own_cameras(&input, output, &Transform::IDENTITY)?;
    let is_compared = compares && to.is_readable() && !to.is_lossless();
    Ok(Conversion {
        formats: [file.format, to],
        bytes: [before, splat_file_size(output)?],
        splats: file.cloud.len(),
        notes,
        psnr: is_compared.then(|| compare(&input, &file.cloud, output)).transpose()?,
    })
}

/// `cloud`, read from a file that may not record its world, in the world of `world_from_dataset`, in which it was written.
pub(crate) fn in_world(mut cloud: GaussianCloud, world_from_dataset: &Similarity) -> GaussianCloud {
    if cloud.world_from_dataset != *world_from_dataset {
        // The file has the dataset's unit and the world's origin.
        cloud.world_from_dataset = Similarity {
            scale: 1.0,
            center: world_from_dataset.center,
        };
        cloud.bring_to_world(*world_from_dataset);
    }
    cloud
}

/// PSNR of the output against the scene `before`, for each view around it.
fn compare(input: &Path, before: &GaussianCloud, output: &Path) -> Result<Vec<f64>, RunError> {
    let world = before.world_from_dataset;
    let after = in_world(read_splats(output)?, &world);
    // Both are rendered with the input's flag: if a format loses it, a note says so.
    let options = RenderOptions {
        antialias: before.antialiased,
        ..RenderOptions::default()
    };
    let [before, after] = [before, &after].map(|cloud| Model::of_splats(Splats::from_cloud(cloud)));
    let cameras = cameras_beside(input, &world);
    let cameras = orbit(before.splats(), cameras.as_deref(), COMPARED_VIEWS, Some(COMPARED_SIZE));
    let mut renderer = Renderer::new();
    let mut picture = |model: &Model, camera| {
        let frame = model.render(&mut renderer, camera, &options);
        frame.color.rounded_to_8_bits()
    };
    Ok(cameras
        .iter()
        .map(|camera| psnr(&picture(&after, camera), &picture(&before, camera)))
        .collect())
}

//! Descriptions of files and folders.

use crate::folder::{RESIDUAL, contains_run};
use crate::scene_file::{is_field, read_field, residual_beside, scene_path};
use crate::{Reading, ReadingOptions, RunError};
use irradia_field::encoding::PositionEncoding;
use irradia_field::{Field, Outside, Sampler};
use irradia_formats::{Description, FormatError, Kind, detect};
use std::path::Path;

/// A summary of the scene, run, dataset or point cloud at `path`. A dataset is read with the options `reading`, at full size if they give
/// no size.
///
/// # Errors
/// When it does not exist, cannot be read, is none of these, or is a run whose scene has not been written yet; when there are options for
/// something that is not a dataset.
pub fn describe(path: impl AsRef<Path>, reading: &ReadingOptions) -> Result<Description, RunError> {
    let scene = scene_path(path.as_ref());
    let is_scene = || is_field(&scene) || matches!(detect(&scene), Ok(Kind::Splats(_) | Kind::Points));
    if *reading != ReadingOptions::default() && is_scene() {
        let message = format!("{} is not a dataset: omit the options for reading one", scene.display());
        return Err(RunError::Refused(message));
    }
    let options = reading.with_fallback(Reading {
        max_side: None,
        ..Reading::default()
    });
    let options = options.check()?;
    if is_field(&scene) {
        let bytes = std::fs::metadata(&scene).map_or(0, |file| file.len());
        return Ok(describe_field(&read_field(&scene)?, bytes));
    }
    let mut description = irradia_formats::describe(&scene, &options).map_err(|error| {
        if scene.is_dir() && contains_run(&scene) {
            FormatError::NoScene(scene.clone())
        } else {
            error
        }
    })?;
    if let Some(field) = residual_beside(&scene)? {
        let adds = format!("{RESIDUAL}, {} parameters", field.len());
        description.facts.push(("reflections", adds));
    }
    Ok(description)
}

/// A summary of `field`, whose file has a size of `bytes`.
fn describe_field(field: &Field, bytes: u64) -> Description {
    let config = &field.config;
    let net = &config.net;
    let encoding = match &net.encoding {
        PositionEncoding::Frequency(f) => format!("frequencies of {} octaves", f.octaves),
        PositionEncoding::HashGrid(g) => format!(
            "hash grid of {} levels, {} to {} cells per side, {} features per corner, at most 2^{} corners per level",
            g.levels, g.coarsest, g.finest, g.features, g.log2_table
        ),
    };
    let color = net.color.map_or(String::new(), |color| {
        format!("; colour {} of {}", color.depth, color.width)
    });
    let sampler = match &config.sampler {
        Sampler::Occupancy(o) => format!("steps through an occupancy grid of {} cells per side", o.side),
        Sampler::Hierarchy { coarse, fine } => format!("hierarchy, {coarse} and {fine} more"),
        Sampler::Proposal { rounds, last } => {
            let rounds: Vec<String> = rounds.iter().map(|(_, n)| n.to_string()).collect();
            format!("proposals, {} and then {last}", rounds.join(", "))
        }
        Sampler::Given { mirrored: false } => "colours of splats, by viewing direction".to_owned(),
        Sampler::Given { mirrored: true } => "colours of splats, by reflected viewing direction".to_owned(),
    };
    let space = &field.space;
    let [x, y, z] = space.center;
    let cube = format!(
        "cube of half side {:.3} about ({x:.3}, {y:.3}, {z:.3})",
        1.0 / space.scale
    );
    let space = match &space.outside {
        Outside::Nothing => cube,
        Outside::Contracted => format!("{cube}, the rest of the world contracted around it"),
        Outside::Ndc(frustum) => format!("normalised device coordinates from depth {:.3}", frustum.near),
    };
    let background = config
        .background_degree
        .map_or("given when rendering".to_owned(), |degree| {
            format!("learnt, harmonics of degree {degree}")
        });
    let mut facts = vec![
        ("encoding", encoding),
        (
            "hidden layers",
            format!("density {} of {}{color}", net.depth, net.width),
        ),
        ("networks", field.nets.len().to_string()),
        ("sampler", sampler),
        ("space", space),
        ("background", background),
    ];
    if config.appearance() > 0 {
        let codes = format!("{} photographs, {} values each", config.images, config.appearance());
        facts.push(("appearance", codes));
    }
    facts.push(("file", format!("{:.1} MB", bytes as f64 * 1e-6)));
    Description {
        title: format!("radiance field with {} parameters", field.len()),
        facts,
        warnings: Vec::new(),
    }
}

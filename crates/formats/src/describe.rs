//! Descriptions of files and folders.

use crate::splats::ply::has_splats;
use crate::{
    DatasetFormat, DatasetOptions, FormatError, SplatFile, SplatFormat, read_dataset, read_points_ply, read_splat_file,
};
use glam::DVec3;
use irradia_scene::{Dataset, PointCloud, Similarity};
use std::fmt;
use std::path::Path;

/// The kind of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A splat scene.
    Splats(SplatFormat),
    /// A PLY with points that are not splats.
    Points,
    /// Posed photographs.
    Dataset(DatasetFormat),
}

/// Detects the kind of `path`: a folder or JSON file by its content, another file by extension and header.
///
/// # Errors
/// When it does not exist, or is of no known kind; the error says what was expected.
pub fn detect(path: &Path) -> Result<Kind, FormatError> {
    if let Ok(format @ SplatFormat::SogFolder) = SplatFormat::of(path) {
        return Ok(Kind::Splats(format));
    }
    if let Some(format) = DatasetFormat::recognise(path) {
        return Ok(Kind::Dataset(format));
    }
    if path.is_dir() {
        // The error lists what was expected.
        read_dataset(path, &DatasetOptions::default())?;
    }
    match SplatFormat::of_existing(path)? {
        SplatFormat::Ply | SplatFormat::PointsPly if !has_splats(path)? => Ok(Kind::Points),
        format => Ok(Kind::Splats(format)),
    }
}

/// A summary of a file or dataset: a title and facts, printed one per line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Description {
    /// What it is.
    pub title: String,
    /// Name and value of each fact.
    pub facts: Vec<(&'static str, String)>,
    /// What was skipped or assumed when reading.
    pub warnings: Vec<String>,
}

impl fmt::Display for Description {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}", self.title)?;
        for (name, value) in &self.facts {
            write!(f, "\n  {name:<14} {value}")?;
        }
        for warning in &self.warnings {
            write!(f, "\n  warning: {warning}")?;
        }
        Ok(())
    }
}

/// Reads `path`, a dataset with `options`, and summarises it.
///
/// # Errors
/// Those of [`detect`] and of reading it.
pub fn describe(path: &Path, options: &DatasetOptions) -> Result<Description, FormatError> {
    Ok(match detect(path)? {
        Kind::Splats(_) => describe_splats(&read_splat_file(path)?),
        Kind::Points => describe_points(&read_points_ply(path)?),
        Kind::Dataset(_) => describe_dataset(&read_dataset(path, options)?),
    })
}

fn describe_splats(file: &SplatFile) -> Description {
    let cloud = &file.cloud;
    Description {
        title: format!("{} with {} Gaussians", file.format, cloud.len()),
        facts: vec![
            ("SH degree", cloud.sh_degree.to_string()),
            ("antialiased", if cloud.antialiased { "yes" } else { "no" }.into()),
            (
                "centres within",
                extent(cloud.means.iter().copied(), &cloud.world_from_dataset),
            ),
        ],
        warnings: file.warnings(),
    }
}

fn describe_points(points: &PointCloud) -> Description {
    Description {
        title: format!("point cloud with {} points", points.len()),
        facts: vec![(
            "within",
            extent(points.positions.iter().map(|p| p.to_array()), &Similarity::IDENTITY),
        )],
        warnings: Vec::new(),
    }
}

fn describe_dataset(dataset: &Dataset) -> Description {
    let sizes = dataset
        .views
        .iter()
        .map(|v| (v.camera.intrinsics.width, v.camera.intrinsics.height));
    let area = |(width, height): &(u32, u32)| u64::from(*width) * u64::from(*height);
    let small = sizes.clone().min_by_key(area).unwrap_or_default();
    let large = sizes.max_by_key(area).unwrap_or_default();
    let size = if small == large {
        format!("{}x{}", small.0, small.1)
    } else {
        format!("{}x{} to {}x{}", small.0, small.1, large.0, large.1)
    };
    let points = dataset
        .points
        .as_ref()
        .map_or("none".to_owned(), |points| points.len().to_string());
    let centres = dataset.views.iter().map(|view| view.camera.pose.position.to_array());
    let world = dataset.world_from_dataset;
    let trained_in = (!world.is_identity()).then(|| {
        let DVec3 { x, y, z } = world.center;
        let origin = format!("a world centred on ({x:.3}, {y:.3}, {z:.3})");
        ("trained in", format!("{origin}, in units of {}", 1.0 / world.scale))
    });
    Description {
        title: format!("{} dataset with {} views", dataset.kind, dataset.views.len()),
        facts: [
            (
                "train, test",
                format!("{}, {}", dataset.train.len(), dataset.test.len()),
            ),
            ("image size", format!("{size} (undistorted)")),
            ("points", points),
            ("cameras within", extent(centres, &world)),
        ]
        .into_iter()
        .chain(trained_in)
        .collect(),
        warnings: dataset.warnings.clone(),
    }
}

/// The box around all finite points, in the dataset's coordinates.
fn extent(points: impl Iterator<Item = [f32; 3]>, world_from_dataset: &Similarity) -> String {
    let finite = points.filter(|p| p.iter().all(|v| v.is_finite()));
    let (low, high) = finite.fold(([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]), |(low, high), p| {
        (
            std::array::from_fn(|i| low[i].min(p[i])),
            std::array::from_fn(|i| high[i].max(p[i])),
        )
    });
    if low[0] > high[0] {
        return "nothing".into();
    }
    let corner = |p: [f32; 3]| {
        let p = world_from_dataset.invert(DVec3::from(p.map(f64::from)));
        format!("({:.3}, {:.3}, {:.3})", p.x, p.y, p.z)
    };
    format!("{} .. {}", corner(low), corner(high))
}

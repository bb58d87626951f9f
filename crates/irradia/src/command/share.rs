//! `irradia share`

use super::render::{CameraPath, film_from_path};
use super::size::file_size;
use super::warn;
use crate::Usage;
use crate::terminal::print_line;
use anyhow::Result;
use irradia_runs::formats::SplatFormat;
use irradia_runs::{Film, Scene, check_not_overwritten, residual_left_out, scene_path};
use irradia_viewer::{ShareOptions, share};
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
pub struct Args {
    /// The scene: a run, or a splat file of any format
    pub scene: PathBuf,
    /// The page to write, such as scene.html; with --folder the folder
    #[arg(long, short)]
    pub out: PathBuf,
    /// Title of the page; when absent the name of the scene
    #[arg(long)]
    pub title: Option<String>,
    /// A line below the title, such as who took the photographs
    #[arg(long, default_value = "")]
    pub credits: String,
    /// Largest size of the page, such as 10MB or 800kB: harmonics are left out first, then splats are merged
    #[arg(long, value_name = "SIZE", value_parser = file_size)]
    pub max: Option<u64>,
    /// A camera path, played until the page is touched: a file that the viewer or nerfstudio saved, or orbit, spiral or training
    /// (through the cameras)
    #[arg(long, value_name = "FILE|orbit|spiral|training")]
    pub path: Option<PathBuf>,
    /// Write a folder for a web server: page, scene and start picture
    #[arg(long)]
    pub folder: bool,
}

/// Frames of a flight that is not read from a file: ten seconds.
const FLIGHT_FRAMES: u32 = 300;

/// The flight along `path` around the scene that was read from `source`; an orbit or spiral ends where it began.
fn flight(path: &Path, source: &Path, scene: &Scene) -> Result<Film> {
    let path = CameraPath::of(path);
    let mut film = film_from_path(path, source, scene, FLIGHT_FRAMES, None)?;
    if matches!(path, CameraPath::Orbit | CameraPath::Spiral) {
        film.cameras.extend(film.cameras.first().copied());
    }
    if film.cameras.is_empty() {
        Err(Usage("the path is empty".into()).into())
    } else {
        Ok(film)
    }
}

impl Args {
    /// Arguments that write `scene` as the page `out`, with all defaults.
    pub fn of(scene: &Path, out: &Path) -> Self {
        Self {
            scene: scene.to_owned(),
            out: out.to_owned(),
            title: None,
            credits: String::new(),
            max: None,
            path: None,
            folder: false,
        }
    }
}

pub fn run(args: &Args) -> Result<()> {
    if args.folder && args.out.is_file() {
        return Err(Usage(format!(
            "--out {} is a file; name a folder for --folder",
            args.out.display()
        ))
        .into());
    }
    check_not_overwritten(&args.scene, &args.out)?;
    if !args.folder && SplatFormat::of(&args.out).is_ok() {
        return Err(Usage(format!(
            "--out {}: the name of a page ends in .html; irradia convert writes splat files",
            args.out.display()
        ))
        .into());
    }
    let scene = Scene::read(&args.scene)?;
    warn(&scene.notes);
    warn(&Vec::from_iter(residual_left_out(
        &scene_path(&args.scene),
        "a page cannot hold it",
    )));
    let name = || {
        args.scene
            .file_stem()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_default()
    };
    let options = ShareOptions {
        title: args.title.clone().unwrap_or_else(name),
        credits: args.credits.clone(),
        max_bytes: args.max,
        folder: args.folder,
        path: (args.path.as_deref())
            .map(|path| flight(path, &args.scene, &scene))
            .transpose()?,
    };
    let shared = share(&scene, &args.out, &options)?;
    let [splats, of] = shared.splats;
    let [degree, of_degree] = shared.degree;
    let mut lost = Vec::new();
    if degree < of_degree {
        lost.push(format!("harmonics of degree {of_degree} became degree {degree}"));
    }
    if splats < of {
        lost.push(format!("{} of {of} splats were merged with others", of - splats));
    }
    let lost = if lost.is_empty() {
        String::new()
    } else {
        format!("\n  lost           {}", lost.join(", "))
    };
    print_line(format_args!(
        "{}: {splats} splats of degree {degree}, {:.2} MB{lost}",
        args.out.display(),
        shared.bytes as f64 / 1e6
    ))
}

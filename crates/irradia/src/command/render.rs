//! `irradia render`

use super::depths::Depths;
use super::film::{self, FilmWriter};
use super::{DataArgs, Split, rendering_device, thread_count, use_threads, warn, with_option_names};
use crate::Usage;
use crate::interrupt::stop_flag;
use crate::terminal::print_line;
use anyhow::{Context, Result, bail};
use irradia_edit::Transform;
use irradia_runs::scene::{Camera, Image};
use irradia_runs::train::painter::Painter;
use irradia_runs::{
    FRAME_SIDE, Film, ReadingOptions, Scene, camera_names, file_stems, is_film_name, moved_from_run, scene_path,
    write_image,
};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

#[derive(clap::Args)]
#[command(group(clap::ArgGroup::new("cameras").required(true).args(["data", "orbit", "path"])))]
pub struct Args {
    /// The scene: RUN, or a file; background, filters and, with --data, held-out views and the size of the photographs are taken from the
    /// run that contains it
    pub scene: PathBuf,
    /// Render the views of this dataset
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// Views of the dataset to render
    #[arg(long, value_enum, default_value_t = Split::Test, conflicts_with_all = ["orbit", "path"])]
    pub split: Split,
    /// Render this number of frames on a circle around the scene, or back and forth on an arc if only one side was photographed
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub orbit: Option<u32>,
    /// Render a camera path: a file that the viewer or nerfstudio saved, or orbit, spiral or training (through the cameras)
    #[arg(long, value_name = "FILE|orbit|spiral|training")]
    pub path: Option<PathBuf>,
    /// Number of frames of --path orbit, spiral and training; 120 when absent
    #[arg(long, value_name = "N", conflicts_with_all = ["data", "orbit"], value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub frames: Option<u32>,
    /// Frames per second of a film; when absent those of the path, or 30
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=240))]
    pub fps: Option<u32>,
    /// Size of the frames of --orbit and --path; when absent that of the training images, or 1280x720
    #[arg(long, value_name = "WxH", value_parser = parse_frame_size, conflicts_with = "data")]
    pub size: Option<(u32, u32)>,
    /// Folder for the frames; with --orbit or --path also a film: .mp4 and .webm with ffmpeg, .gif without
    #[arg(long)]
    pub out: PathBuf,
    /// Also write depth: NAME.depth.png, near is bright, one range for all frames
    #[arg(long)]
    pub depth: bool,
    /// Also write alpha: NAME.alpha.png
    #[arg(long)]
    pub alpha: bool,
    /// Threads; all cores when absent
    #[arg(long, value_parser = thread_count())]
    pub threads: Option<usize>,
    /// Where the scene is rendered: cpu, gpu, auto (a real GPU if there is one), or a part of a GPU's name; see irradia devices
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    pub device: String,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// Frames of a path that is not read from a file: four seconds.
const PATH_FRAMES: u32 = 120;

/// `640x480`, of any size: each command has its own limits.
pub fn parse_size(text: &str) -> Result<(u32, u32), String> {
    text.split_once('x')
        .and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)))
        .ok_or_else(|| "expected a size such as 640x480".into())
}

/// The size of a frame.
fn parse_frame_size(text: &str) -> Result<(u32, u32), String> {
    let (width, height) = parse_size(text)?;
    if FRAME_SIDE.contains(&width) && FRAME_SIDE.contains(&height) {
        Ok((width, height))
    } else {
        let (least, most) = (FRAME_SIDE.start(), FRAME_SIDE.end());
        Err(format!("each side must be {least} to {most} pixels"))
    }
}

pub fn run(args: &Args) -> Result<()> {
    if args.data.is_none() && args.reading.options() != ReadingOptions::default() {
        let message = "--orbit and --path read no photographs: omit the options for reading them; --size sets the size of the frames";
        return Err(Usage(message.into()).into());
    }
    use_threads(args.threads)?;
    let mut scene = Scene::read(&args.scene)?;
    warn(&scene.notes);
    scene.options.depth = args.depth;
    if let Some(film) = film(args, &scene)? {
        if film::kind(&args.out).is_some() {
            return write_film(args, &scene, &film);
        }
        let frame_name = |i: usize| format!("frame_{i:04}");
        let count = film.cameras.len();
        let cameras = film.cameras.into_iter().enumerate();
        write_frames(
            args,
            &scene,
            cameras.map(|(i, camera)| (frame_name(i), camera)).collect(),
        )?;
        let next = args.out.join(frame_name(count) + ".png");
        if next.exists() {
            let next = next.display();
            warn(&[format!("{next} and later frames are of an earlier, longer path")]);
        }
        return Ok(());
    }
    let data = args.data.as_ref().expect("clap requires one of them");
    let dataset = args.reading.options().read_for(&scene, &args.scene, data);
    let dataset = dataset.map_err(with_option_names)?;
    warn(&dataset.warnings);
    let stems = file_stems(dataset.views.iter().map(|view| view.name.as_str()));
    let views = args.split.of(&dataset).into_iter();
    write_frames(
        args,
        &scene,
        views.map(|i| (stems[i].clone(), dataset.views[i].camera)).collect(),
    )
}

/// The cameras of --orbit and --path.
fn film(args: &Args, scene: &Scene) -> Result<Option<Film>> {
    if let Some(frames) = args.orbit {
        return Ok(Some(Film::orbit(scene, frames, args.size)));
    }
    let Some(path) = args.path.as_deref().map(CameraPath::of) else {
        return Ok(None);
    };
    if let (CameraPath::File(path), Some(frames)) = (path, args.frames) {
        let path = path.display();
        return Err(Usage(format!(
            "--frames {frames}: the number of frames of {path} is in the file: omit it"
        ))
        .into());
    }
    film_from_path(path, &args.scene, scene, args.frames.unwrap_or(PATH_FRAMES), args.size).map(Some)
}

/// What `--path` names.
#[derive(Clone, Copy)]
pub(super) enum CameraPath<'a> {
    Orbit,
    Spiral,
    Training,
    File(&'a Path),
}

impl<'a> CameraPath<'a> {
    pub(super) fn of(path: &'a Path) -> Self {
        match path.to_str() {
            Some("orbit") => Self::Orbit,
            Some("spiral") => Self::Spiral,
            Some("training") => Self::Training,
            _ => Self::File(path),
        }
    }
}

/// The cameras of `path` around the scene that was read from `source`; those that are not in a file have `frames` frames.
pub(super) fn film_from_path(
    path: CameraPath,
    source: &Path,
    scene: &Scene,
    frames: u32,
    size: Option<(u32, u32)>,
) -> Result<Film> {
    Ok(match path {
        CameraPath::Orbit => Film::orbit(scene, frames, size),
        CameraPath::Spiral => Film::spiral(scene, frames, size),
        CameraPath::Training => {
            let names = camera_names(&scene_path(source)).unwrap_or_default();
            let film = Film::training(scene, &names, frames, size);
            film.ok_or_else(|| Usage("--path training: the cameras of this scene are not known".into()))?
        }
        CameraPath::File(path) => {
            let k = scene.orbit_geometry().intrinsics;
            let moved = moved_from_run(&scene_path(source));
            let world_from_photographs = moved.then(&Transform::to_world(&scene.world_from_dataset));
            Film::read(path, &world_from_photographs, size, (k.width, k.height))?
        }
    })
}

/// Renders the scene on the device of the arguments.
fn painter<'m>(args: &Args, scene: &'m Scene) -> Result<Painter<'m>> {
    Ok(Painter::new(&scene.model, &rendering_device(&args.device)?)?)
}

fn write_film(args: &Args, scene: &Scene, film: &Film) -> Result<()> {
    if args.depth || args.alpha {
        return Err(Usage("depth and alpha are written as frames: name a folder with --out".into()).into());
    }
    let Some(first) = film.cameras.first() else {
        return Err(Usage("nothing to render: the path is empty".into()).into());
    };
    let k = first.intrinsics;
    let fps = args.fps.map_or(film.fps, |fps| fps as f32);
    let mut writer = FilmWriter::begin(&args.out, (k.width, k.height), fps)?;
    let mut painter = painter(args, scene)?;
    let stop = stop_flag();
    for camera in &film.cameras {
        if stop.load(Ordering::Relaxed) {
            bail!("interrupted: {} is not written", args.out.display());
        }
        writer.add(&painter.render(camera, &scene.options)?.color)?;
    }
    writer.finish()?;
    print_line(format_args!("{} frames in {}", film.cameras.len(), args.out.display()))
}

fn write_frames(args: &Args, scene: &Scene, cameras: Vec<(String, Camera)>) -> Result<()> {
    if cameras.is_empty() {
        return Err(Usage("nothing to render: no such views".into()).into());
    }
    let is_film = film::kind(&args.out).is_some() || is_film_name(&args.out);
    if is_film && !args.out.is_dir() {
        return Err(Usage(format!(
            "{}: a film needs --orbit or --path, and ends in .mp4, .webm or .gif; name a folder for the frames",
            args.out.display()
        ))
        .into());
    }
    if let Some(fps) = args.fps {
        let message = format!("--fps {fps}: single frames have no rate: omit it, or name a film with --out");
        return Err(Usage(message).into());
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    let mut painter = painter(args, scene)?;
    let mut depths = args.depth.then(|| Depths::begin(&args.out)).transpose()?;
    let write = |name: &str, what: &str, image: &Image| -> Result<()> {
        Ok(write_image(args.out.join(format!("{name}{what}.png")), image)?)
    };
    for (name, camera) in &cameras {
        let frame = painter.render(camera, &scene.options)?;
        let image = frame.color;
        write(name, "", &image)?;
        if let Some(depths) = &mut depths {
            let expected = frame.depth.iter().zip(&frame.alpha);
            let inverse = expected.map(|(d, a)| if *a > 0.5 { a / d } else { 0.0 });
            depths.add(name, (image.width, image.height), inverse)?;
        }
        if args.alpha {
            let alpha = Image::new(image.width, image.height, 1, frame.alpha);
            write(name, ".alpha", &alpha)?;
        }
    }
    if let Some(depths) = depths {
        depths.finish(|name, image| write(name, ".depth", image))?;
    }
    print_line(format_args!("{} frames in {}", cameras.len(), args.out.display()))
}

//! `irradia render`

use super::{DataArgs, Split, file_stem, thread_count, use_threads};
use crate::Usage;
use crate::run_folder::{cameras_beside, read_scene, render_knobs_beside, scene_of};
use crate::terminal::say;
use anyhow::{Context, Result};
use glam::Vec3;
use irradia_formats::write_png;
use irradia_scene::{Camera, Image, Intrinsics, Pose};
use irradia_splat::{RenderOptions, Renderer, Splats, init::focus_point};
use std::path::PathBuf;

#[derive(clap::Args)]
#[command(group(clap::ArgGroup::new("cameras").required(true).args(["data", "orbit"])))]
pub struct Args {
    /// The scene: RUN, or a file; background and filters are taken from the run it lies in
    pub scene: PathBuf,
    /// Render the views of this dataset
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// Which of its views
    #[arg(long, value_enum, default_value_t = Split::Test)]
    pub split: Split,
    /// Render so many frames of a circle around the scene instead
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub orbit: Option<u32>,
    /// Size of the orbit's frames; that of the training images, or 1280x720, when absent
    #[arg(long, value_name = "WxH", value_parser = parse_size, conflicts_with = "data")]
    pub size: Option<(u32, u32)>,
    /// Folder for the frames
    #[arg(long)]
    pub out: PathBuf,
    /// Write depth too: NAME.depth.png, near is bright, one range for all frames
    #[arg(long)]
    pub depth: bool,
    /// Write alpha too: NAME.alpha.png
    #[arg(long)]
    pub alpha: bool,
    /// Threads; all cores when absent
    #[arg(long, value_parser = thread_count())]
    pub threads: Option<usize>,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// `640x480`
pub fn parse_size(text: &str) -> Result<(u32, u32), String> {
    text.split_once('x')
        .and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)))
        .filter(|(w, h)| (1..=16384).contains(w) && (1..=16384).contains(h))
        .ok_or_else(|| "give a size such as 640x480, each side 1 to 16384".into())
}

pub fn run(args: &Args) -> Result<()> {
    use_threads(args.threads)?;
    let scene = scene_of(&args.scene);
    let (model, antialiased) = read_scene(&scene)?;
    let cameras: Vec<(String, Camera)> = match (&args.data, args.orbit) {
        (Some(data), _) => {
            let dataset = args.reading.read(data)?;
            let views = args.split.of(&dataset);
            views
                .iter()
                .map(|i| (file_stem(&dataset.views[*i].name), dataset.views[*i].camera))
                .collect()
        }
        (None, Some(frames)) => {
            let cameras = orbit(model.splats(), cameras_beside(&scene), frames, args.size);
            cameras
                .into_iter()
                .enumerate()
                .map(|(i, camera)| (format!("frame_{i:04}"), camera))
                .collect()
        }
        (None, None) => unreachable!("clap asks for one of them"),
    };
    if cameras.is_empty() {
        return Err(Usage("nothing to render: no such views".into()).into());
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
    let knobs = render_knobs_beside(&scene);
    let options = RenderOptions {
        background: knobs.background,
        antialias: knobs.antialias || antialiased,
        depth: args.depth,
        ..RenderOptions::default()
    };
    let mut renderer = Renderer::new();
    let mut depths = Vec::new();
    let write = |name: &str, what: &str, image: &Image| -> Result<()> {
        let path = args.out.join(format!("{name}{what}.png"));
        write_png(&path, image.width, image.height, image.channels, &image.to_u8())?;
        Ok(())
    };
    for (name, camera) in &cameras {
        let frame = model.render(&mut renderer, camera, &options);
        let image = frame.color;
        write(name, "", &image)?;
        let alpha = Image::new(image.width, image.height, 1, frame.alpha);
        if args.depth {
            let expected = frame.depth.iter().zip(&alpha.data);
            let inverse = expected.map(|(d, a)| if *a > 0.5 { a / d } else { 0.0 }).collect();
            depths.push(Image::new(image.width, image.height, 1, inverse));
        }
        if args.alpha {
            write(name, ".alpha", &alpha)?;
        }
    }
    // One range for all frames, of inverse depth: far things, which are many, then share few steps.
    let nearest = depths.iter().flat_map(|d| &d.data).fold(0.0f32, |m, v| m.max(*v));
    for ((name, _), mut image) in cameras.iter().zip(depths) {
        for value in &mut image.data {
            *value /= nearest.max(1e-20);
        }
        write(name, ".depth", &image)?;
    }
    say(format_args!("{} frames in {}", cameras.len(), args.out.display()))
}

/// A circle around what the training cameras looked at, at their mean distance and height; for a scene without them,
/// around the middle of the splats.
fn orbit(splats: Option<&Splats>, cameras: Option<Vec<Camera>>, frames: u32, size: Option<(u32, u32)>) -> Vec<Camera> {
    let cameras = cameras.filter(|c| !c.is_empty());
    let (center, up, radius, height, mut intrinsics) = match &cameras {
        Some(cameras) => {
            let center = focus_point(cameras);
            let n = cameras.len() as f32;
            let up = (cameras.iter().map(|c| c.pose.rotation * Vec3::NEG_Y).sum::<Vec3>() / n).normalize_or(Vec3::Z);
            let height = cameras.iter().map(|c| (c.pose.position - center).dot(up)).sum::<f32>() / n;
            let across = |c: &Camera| {
                let offset = c.pose.position - center;
                (offset - up * offset.dot(up)).length()
            };
            let radius = cameras.iter().map(across).sum::<f32>() / n;
            (center, up, radius, height, cameras[0].intrinsics)
        }
        None => {
            let middle = |c: usize| {
                let plane = splats.map_or(&[][..], |splats| &splats.means.plane(c)[..splats.len()]);
                let mut values: Vec<f32> = plane.iter().copied().filter(|v| v.is_finite()).collect();
                values.sort_unstable_by(f32::total_cmp);
                let at = |share: f32| {
                    values
                        .get((values.len() as f32 * share) as usize)
                        .copied()
                        .unwrap_or(0.0)
                };
                (at(0.5), at(0.9) - at(0.1))
            };
            let axes = [middle(0), middle(1), middle(2)];
            let size = axes.iter().map(|a| a.1).fold(1e-3, f32::max);
            // Most files of this kind come from COLMAP, whose y points down.
            (
                Vec3::from_array(axes.map(|a| a.0)),
                Vec3::NEG_Y,
                1.5 * size,
                0.4 * size,
                Intrinsics::from_fov_x(1280, 720, 1.0),
            )
        }
    };
    if let Some((width, height)) = size {
        let fov_x = 2.0 * (0.5 * intrinsics.width as f32 / intrinsics.fx).atan();
        intrinsics = Intrinsics::from_fov_x(width, height, fov_x);
    }
    // The circle starts where the first camera stood.
    let toward = cameras
        .as_ref()
        .map_or(up.any_orthonormal_vector(), |c| c[0].pose.position - center);
    let x = (toward - up * toward.dot(up)).normalize_or(up.any_orthonormal_vector());
    let y = up.cross(x);
    (0..frames)
        .map(|i| {
            let angle = std::f32::consts::TAU * i as f32 / frames as f32;
            let eye = center + radius * (x * angle.cos() + y * angle.sin()) + up * height;
            Camera::new(Pose::look_at(eye, center, up), intrinsics)
        })
        .collect()
}

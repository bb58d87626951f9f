//! `irradia eval`

use super::lpips::{lpips, unseen_lpips};
use super::{DataArgs, Split, data_for, rendering_device, thread_count, use_threads, warn, with_option_names};
use crate::Usage;
use crate::terminal::{note, print_line};
use anyhow::{Result, ensure};
use irradia_measure::{Evaluation, Lpips, LpipsNet, Networks};
use irradia_runs::formats::write_atomic;
use irradia_runs::train::eval::{EvalOptions, EvaluatedView, Metrics};
use irradia_runs::train::half_fit::HalfFit;
use irradia_runs::{
    Background, HOW_TO_GET_LPIPS, Scene, evaluate, file_stems, leave_out_unreadable, read_vignette, scene_path,
    unmeasured, write_image,
};
use serde_json::json;
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
pub struct Args {
    /// The scene: RUN, or a file; background, filters, held-out views and the size of the photographs are taken from the run that contains
    /// it
    pub scene: PathBuf,
    /// Dataset of photographs; when absent that of the run that contains the scene
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// Views to evaluate
    #[arg(long, value_enum, default_value_t = Split::Test)]
    pub split: Split,
    /// Fit these to the left half of each view, and also measure its right half
    #[arg(long, value_enum, value_delimiter = ',', value_name = "WHAT")]
    pub half_fit: Vec<HalfFitArg>,
    /// Write the figures to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the rendered views to this folder
    #[arg(long, value_name = "DIR")]
    pub save_images: Option<PathBuf>,
    /// LPIPS weights: a file, or a folder of them; see irradia lpips
    #[arg(long, value_name = "PATH")]
    pub lpips: Option<PathBuf>,
    /// Network of LPIPS: squeeze, alex or vgg; distances of different networks are not comparable
    #[arg(long, value_name = "NET")]
    pub lpips_net: Option<LpipsNet>,
    /// Threads; all cores when absent
    #[arg(long, value_parser = thread_count())]
    pub threads: Option<usize>,
    /// Where views are rendered: cpu, gpu, auto (a real GPU if there is one), or a part of a GPU's name; see irradia devices
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    pub device: String,
    /// Background of the scene: white, black, grey or a colour such as '#c8c0b4'; when absent that of its run, or what training would
    /// choose
    #[arg(long, value_name = "COLOR")]
    pub background: Option<Background>,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// Parameters that can be fitted to a held-out view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum HalfFitArg {
    /// An affine colour map.
    Exposure,
    /// The camera's pose.
    Pose,
}

impl Args {
    fn half_fit(&self) -> HalfFit {
        HalfFit {
            exposure: self.half_fit.contains(&HalfFitArg::Exposure),
            pose: self.half_fit.contains(&HalfFitArg::Pose),
        }
    }
}

pub fn run(args: &Args) -> Result<()> {
    use_threads(args.threads)?;
    let mut scene = Scene::read(&args.scene)?;
    warn(&scene.notes);
    let data = data_for(args.data.as_deref(), &args.scene)?;
    let dataset = args.reading.options().read_for(&scene, &args.scene, &data);
    let dataset = dataset.map_err(with_option_names)?;
    warn(&dataset.warnings);
    let background = match args.background {
        None if !has_background(&args.scene) => Background::default_for(&dataset, false)?,
        given => given,
    };
    if let Some(background) = background {
        scene.options.background = background.color();
    }
    let mut indices = args.split.of(&dataset);
    if indices.is_empty() {
        return Err(Usage(format!("{} has no such views; try --split all", data.display())).into());
    }
    let unreadable = leave_out_unreadable(&dataset, &mut indices);
    ensure!(!indices.is_empty(), unreadable.unwrap_or_default());
    warn(unreadable.as_slice());
    let lpips = lpips(args.lpips.as_ref(), args.lpips_net)?;
    if lpips.is_none() {
        note(format_args!(
            "LPIPS is not measured: no LPIPS weights found; {HOW_TO_GET_LPIPS}"
        ));
    }
    let unseen = match (args.lpips_net, &lpips) {
        (None, Some(first)) => unseen_lpips(args.lpips.as_ref(), first)?,
        _ => None,
    };
    let device = rendering_device(&args.device)?;
    let vignette = read_vignette(&scene_path(&args.scene))?;
    let nets = [&lpips, &unseen].map(|lpips| lpips.as_ref().map(Lpips::net));
    let options = EvalOptions {
        render: scene.options,
        metrics: Metrics::All(Networks {
            first: lpips.as_ref(),
            unseen: unseen.as_ref(),
        }),
        half_fit: args.half_fit(),
        vignette: vignette.as_ref(),
        device: &device,
    };
    let (mut rows, mut measured) = (Vec::new(), Vec::new());
    let stems = file_stems(dataset.views.iter().map(|view| view.name.as_str()));
    let mut stems = indices.iter().map(|i| &stems[*i]);
    let report_view = |view: &EvaluatedView| -> Result<()> {
        let m = view.metrics;
        let stem = stems.next().expect("one per view");
        measured.push((view.name.clone(), view.is_measured()));
        if view.is_measured() {
            print_line(figures(&view.name, &m, nets))?;
            rows.push(json!({
                "name": view.name, "psnr": m.psnr, "psnr_corrected": m.psnr_corrected, "ssim": m.ssim, "lpips": m.lpips, "unseen_lpips": m.unseen_lpips,
                "half_fit_psnr": m.half_fit_psnr,
            }));
        }
        if let Some(folder) = &args.save_images {
            write_image(folder.join(format!("{}.png", stem)), &view.render)?;
        }
        Ok(())
    };
    let mean = evaluate(&scene.model, &dataset, &indices, &options, report_view)?;
    let unmeasured = unmeasured(measured.iter().map(|(name, measured)| (name.as_str(), *measured)));
    if rows.is_empty() {
        return Err(Usage(unmeasured.unwrap_or_default()).into());
    }
    warn(unmeasured.as_slice());
    print_line(figures(&format!("mean of {}", rows.len()), &mean, nets))?;
    if let Some(path) = &args.json {
        let figures = json!({
            "scene": scene_path(&args.scene).to_string_lossy(), "data": data.to_string_lossy(),
            "splats": scene.model.splats().map(|splats| splats.len()),
            "parameters": scene.model.field().map(|field| field.len()),
            "psnr": mean.psnr, "psnr_corrected": mean.psnr_corrected, "ssim": mean.ssim, "lpips": mean.lpips, "lpips_net": nets[0].map(LpipsNet::name),
            "unseen_lpips": mean.unseen_lpips, "unseen_lpips_net": nets[1].map(LpipsNet::name),
            "half_fit_psnr": mean.half_fit_psnr, "views": rows,
        });
        let bytes = serde_json::to_vec_pretty(&figures)?;
        write_atomic(path, |out| out.write_all(&bytes))?;
    }
    Ok(())
}

/// Whether there is a recipe beside `scene`, as in the folder of an edited run, which gives its background.
fn has_background(scene: &Path) -> bool {
    scene_path(scene).with_file_name("recipe.toml").is_file()
}

/// One line of figures.
fn figures(name: &str, m: &Evaluation, nets: [Option<LpipsNet>; 2]) -> String {
    let mut line = format!(
        "{name:<40} PSNR {:6.2} dB  corrected {:6.2} dB  SSIM {:.4}",
        m.psnr, m.psnr_corrected, m.ssim
    );
    for (lpips, net) in [m.lpips, m.unseen_lpips].into_iter().zip(nets) {
        let Some((lpips, net)) = lpips.zip(net) else { continue };
        line += &format!("  LPIPS ({net}) {lpips:.4}");
    }
    if let Some(psnr) = m.half_fit_psnr {
        line += &format!("  after half fit {psnr:6.2} dB");
    }
    line
}

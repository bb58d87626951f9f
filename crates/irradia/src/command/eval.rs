//! `irradia eval`

use super::{DataArgs, Split, file_stem, lpips, thread_count, use_threads};
use crate::Usage;
use crate::run_folder::{read_scene, render_knobs_beside, scene_of};
use crate::terminal::say;
use anyhow::Result;
use irradia_formats::{write_atomic, write_png};
use irradia_splat::RenderOptions;
use irradia_train::eval::{EvalOptions, Metrics, evaluate_views, mean, mean_half_fit};
use irradia_train::half_fit::HalfFit;
use serde_json::json;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Args {
    /// The scene: RUN, or a file; background and filters are taken from the run it lies in
    pub scene: PathBuf,
    /// The photographs
    #[arg(long)]
    pub data: PathBuf,
    /// Which views
    #[arg(long, value_enum, default_value_t = Split::Test)]
    pub split: Split,
    /// Fit these on the left half of each view and measure its right half too
    #[arg(long, value_enum, value_delimiter = ',', value_name = "WHAT")]
    pub half_fit: Vec<HalfFitOf>,
    /// Write the figures here
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the rendered views here
    #[arg(long, value_name = "DIR")]
    pub save_images: Option<PathBuf>,
    /// LPIPS weights (lpips_squeeze.safetensors)
    #[arg(long, value_name = "FILE")]
    pub lpips: Option<PathBuf>,
    /// Threads; all cores when absent
    #[arg(long, value_parser = thread_count())]
    pub threads: Option<usize>,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// What may be fitted to a held-out view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum HalfFitOf {
    /// An affine map of colours.
    Exposure,
    /// The camera's pose.
    Pose,
}

impl Args {
    fn half_fit(&self) -> HalfFit {
        HalfFit {
            exposure: self.half_fit.contains(&HalfFitOf::Exposure),
            pose: self.half_fit.contains(&HalfFitOf::Pose),
        }
    }
}

pub fn run(args: &Args) -> Result<()> {
    use_threads(args.threads)?;
    let scene = scene_of(&args.scene);
    let (model, antialiased) = read_scene(&scene)?;
    let dataset = args.reading.read(&args.data)?;
    let indices = args.split.of(&dataset);
    if indices.is_empty() {
        return Err(Usage(format!("{} has no such views: try --split all", args.data.display())).into());
    }
    let lpips = lpips(args.lpips.as_ref())?;
    let knobs = render_knobs_beside(&scene);
    let options = RenderOptions {
        background: knobs.background,
        antialias: knobs.antialias || antialiased,
        ..RenderOptions::default()
    };
    let (mut rows, mut metrics, mut half_fits, mut outcome) = (Vec::new(), Vec::new(), Vec::new(), Ok(()));
    evaluate_views(
        &model,
        &dataset,
        &indices,
        &EvalOptions {
            render: options,
            metrics: Metrics::All(lpips.as_ref()),
            half_fit: args.half_fit(),
        },
        |view| {
            let m = view.metrics;
            let tail = m.lpips.map_or(String::new(), |l| format!("  LPIPS {l:.4}")) + &after_fit(view.half_fit_psnr);
            let line = format!("{:<40} PSNR {:6.2} dB  SSIM {:.4}{tail}", view.name, m.psnr, m.ssim);
            if let Err(error) = say(line) {
                outcome = Err(error);
            }
            rows.push(json!({ "name": view.name, "psnr": m.psnr, "ssim": m.ssim, "lpips": m.lpips, "half_fit_psnr": view.half_fit_psnr }));
            half_fits.extend(view.half_fit_psnr);
            metrics.push(m);
            if let Some(folder) = &args.save_images {
                let path = folder.join(format!("{}.png", file_stem(&view.name)));
                let image = &view.render;
                let written = std::fs::create_dir_all(folder)
                    .map_err(anyhow::Error::from)
                    .and_then(|()| Ok(write_png(&path, image.width, image.height, 3, &image.to_u8())?));
                if let Err(error) = written {
                    outcome = Err(error);
                }
            }
        },
    )?;
    outcome?;
    let mean = mean(&metrics);
    let half_fit = mean_half_fit(&half_fits);
    let tail = mean.lpips.map_or(String::new(), |l| format!("  LPIPS {l:.4}")) + &after_fit(half_fit);
    say(format_args!(
        "{:<40} PSNR {:6.2} dB  SSIM {:.4}{tail}",
        format!("mean of {}", metrics.len()),
        mean.psnr,
        mean.ssim
    ))?;
    if let Some(path) = &args.json {
        let figures = json!({
            "scene": scene, "data": args.data,
            "splats": model.splats().map(irradia_splat::Splats::len), "parameters": model.field().map(irradia_field::Field::len),
            "psnr": mean.psnr, "ssim": mean.ssim, "lpips": mean.lpips, "half_fit_psnr": half_fit, "views": rows,
        });
        let bytes = serde_json::to_vec_pretty(&figures)?;
        write_atomic(path, |out| out.write_all(&bytes))?;
    }
    Ok(())
}

fn after_fit(psnr: Option<f64>) -> String {
    psnr.map_or(String::new(), |psnr| format!("  after half fit {psnr:6.2} dB"))
}

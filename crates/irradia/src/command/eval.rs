//! `irradia eval`

use super::lpips::{HOW, lpips};
use super::{DataArgs, Split, file_stem, thread_count, use_threads};
use crate::Usage;
use crate::run_folder::{read_scene, render_knobs_beside, scene_of};
use crate::terminal::{note, say};
use anyhow::Result;
use irradia_formats::{write_atomic, write_png};
use irradia_measure::LpipsNet;
use irradia_splat::RenderOptions;
use irradia_train::eval::{Metrics, evaluate_views, mean};
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
    /// Write the figures here
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the rendered views here
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
    #[command(flatten)]
    pub reading: DataArgs,
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
    let lpips = lpips(args.lpips.as_ref(), args.lpips_net)?;
    if lpips.is_none() {
        note(format_args!(
            "LPIPS is not measured, since no weights were found: {HOW}"
        ));
    }
    let net = lpips.as_ref().map(|lpips| lpips.net());
    let in_words = |value: Option<f64>| {
        let pair = value.zip(net);
        pair.map_or(String::new(), |(value, net)| format!("  LPIPS ({net}) {value:.4}"))
    };
    let knobs = render_knobs_beside(&scene);
    let options = RenderOptions {
        background: knobs.background,
        antialias: knobs.antialias || antialiased,
        ..RenderOptions::default()
    };
    let (mut rows, mut metrics, mut outcome) = (Vec::new(), Vec::new(), Ok(()));
    evaluate_views(
        &model,
        &dataset,
        &indices,
        &options,
        Metrics::All(lpips.as_ref()),
        |view| {
            let m = view.metrics;
            let tail = in_words(m.lpips);
            let line = format!("{:<40} PSNR {:6.2} dB  SSIM {:.4}{tail}", view.name, m.psnr, m.ssim);
            if let Err(error) = say(line) {
                outcome = Err(error);
            }
            rows.push(json!({ "name": view.name, "psnr": m.psnr, "ssim": m.ssim, "lpips": m.lpips }));
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
    let tail = in_words(mean.lpips);
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
            "psnr": mean.psnr, "ssim": mean.ssim, "lpips": mean.lpips, "lpips_net": net.map(LpipsNet::name),
            "views": rows,
        });
        let bytes = serde_json::to_vec_pretty(&figures)?;
        write_atomic(path, |out| out.write_all(&bytes))?;
    }
    Ok(())
}

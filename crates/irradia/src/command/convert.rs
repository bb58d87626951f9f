//! `irradia convert`

use super::{note_lines, share, size_line};
use crate::Usage;
use crate::terminal::print_line;
use anyhow::Result;
use irradia_runs::formats::{Quality, SplatFormat, SpzVersion, WriteOptions};
use irradia_runs::{Conversion, Level, convert, level_file, write_levels};
use std::path::PathBuf;

/// The version that most programs read.
const DEFAULT_SPZ_VERSION: u8 = 3;

#[derive(clap::Args)]
pub struct Args {
    /// The scene to read: a splat file of any format, a folder of SOG images, or a run
    pub input: PathBuf,
    /// The file to write; its name selects the format: .ply, .compressed.ply, .points.ply, .spz, .splat, .ksplat, .sog, meta.json,
    /// .glb, .spz.glb, .gltf, .npz, or .html for a page like that of irradia share
    pub output: PathBuf,
    /// How much a lossy format may lose, if it offers a choice (.spz, .sog, .ksplat)
    #[arg(long, value_enum, default_value_t = QualityArg::Normal)]
    pub quality: QualityArg,
    /// Version of .spz files
    #[arg(long, value_name = "3|4", default_value_t = DEFAULT_SPZ_VERSION, value_parser = clap::value_parser!(u8).range(3..=4))]
    pub spz_version: u8,
    /// Also write levels of detail beside the output, such as scene.lod1.sog: a half, a quarter and an eighth of the splats, merged so that
    /// they look the same from afar
    #[arg(long)]
    pub lod: bool,
    /// Do not render the scene before and after to measure the loss
    #[arg(long)]
    pub no_compare: bool,
}

/// [`Quality`] on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum QualityArg {
    /// Smaller
    Low,
    /// The format's own default
    Normal,
    /// The most that the format allows
    High,
}

impl From<QualityArg> for Quality {
    fn from(quality: QualityArg) -> Self {
        match quality {
            QualityArg::Low => Self::Low,
            QualityArg::Normal => Self::Normal,
            QualityArg::High => Self::High,
        }
    }
}

pub fn run(args: &Args) -> Result<()> {
    let extension = args.output.extension().unwrap_or_default().to_ascii_lowercase();
    if extension == "html" || extension == "htm" {
        if args.lod {
            return Err(Usage("--lod: a page holds no levels of detail".into()).into());
        }
        if args.quality != QualityArg::Normal {
            return Err(Usage(
                "--quality: the splats of a page have a single precision; irradia share --max limits its size".into(),
            )
            .into());
        }
        return share::run(&share::Args::of(&args.input, &args.output));
    }
    let format = SplatFormat::of(&args.output)?;
    if args.spz_version != DEFAULT_SPZ_VERSION && format != SplatFormat::Spz {
        let version = args.spz_version;
        let message = format!(
            "--spz-version {version}: only .spz files are of a chosen version; the output is a {} file",
            format.suffix()
        );
        return Err(Usage(message).into());
    }
    if args.lod {
        // A format without levels is reported before anything is written.
        level_file(&args.output, 1)?;
    }
    let options = WriteOptions {
        quality: args.quality.into(),
        spz_version: match args.spz_version {
            4 => SpzVersion::V4,
            _ => SpzVersion::V3,
        },
        sog: None,
    };
    let conversion = convert(&args.input, &args.output, &options, !args.no_compare)?;
    print_line(format_args!(
        "{}: {} splats{}",
        args.output.display(),
        conversion.splats,
        lines(&conversion)
    ))?;
    if args.lod {
        for (level, made) in (1..).zip(write_levels(&args.input, &args.output, &options)?) {
            print_line(level_lines(level, &made))?;
        }
    }
    Ok(())
}

/// The summary of a level of detail, with its PSNR at the size it is meant for.
fn level_lines(level: u32, made: &Level) -> String {
    format!(
        "{}: {} splats, {:.3} MB\n  PSNR           {:.2} dB at 1/{} of the pixels, against the scene rendered at full size and shrunk ({:.2} dB \
         for as many splats sampled evenly, {:.2} dB for the whole scene rendered at that size)",
        made.path.display(),
        made.splats,
        made.bytes as f64 / 1e6,
        made.psnr,
        1 << level,
        made.subsample_psnr,
        made.whole_psnr
    )
}

/// What the conversion cost, one line each.
fn lines(conversion: &Conversion) -> String {
    let mut text = size_line(conversion.bytes, conversion.formats);
    if let Some(psnr) = &conversion.psnr {
        // Of all pixels together, so that identical views, of infinite PSNR, do not hide the others.
        let error = psnr.iter().map(|db| 10f64.powf(-0.1 * db)).sum::<f64>() / psnr.len() as f64;
        let mean = -10.0 * error.log10();
        let worst = psnr.iter().copied().fold(f64::INFINITY, f64::min);
        let views = psnr.len();
        text += &if worst.is_finite() {
            format!("\n  PSNR           {mean:.2} dB, worst {worst:.2} dB, of {views} views around it")
        } else {
            format!("\n  PSNR           all {views} views around it are identical")
        };
    }
    text + &note_lines(&conversion.notes)
}

//! `irradia compact`

use super::convert::QualityArg;
use super::size::file_size;
use super::{DataArgs, data_for, note_lines, size_line, thread_count, use_threads, with_option_names};
use crate::terminal::{note, print_line};
use anyhow::Result;
use irradia_runs::formats::WriteOptions;
use irradia_runs::{CompactEvent, CompactInput, CompactTarget, Compacted, compact};
use std::io::{IsTerminal, Write, stderr};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Args {
    /// The scene: a run, or a splat file of any format
    pub scene: PathBuf,
    /// Dataset of photographs on which it was trained; when absent that of the run that contains the scene
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// The file to write; its name selects the format, and .sog gives the smallest
    #[arg(long, short)]
    pub out: PathBuf,
    /// Largest size: bytes of the file, such as 5MB or 800kB, or splats, such as 200k
    #[arg(long, value_name = "SIZE|N", value_parser = parse_target, required_unless_present = "keep_psnr")]
    pub target: Option<CompactTarget>,
    /// Maximum loss of PSNR on the training views, dB; without a --target, the smallest scene within that loss is searched for
    #[arg(long, value_name = "DB")]
    pub keep_psnr: Option<f64>,
    /// Training steps for each number of splats tried
    #[arg(long, value_name = "N", default_value_t = CompactInput::STEPS)]
    pub steps: u64,
    /// How much the format may lose, if it offers a choice (.spz, .ksplat)
    #[arg(long, value_enum, default_value_t = QualityArg::Normal)]
    pub quality: QualityArg,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Threads; all cores when absent. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
    #[command(flatten)]
    pub reading: DataArgs,
}

/// `5MB`, `800kB`: bytes; `200k`, `1.5M`, `50000`: splats.
fn parse_target(text: &str) -> Result<CompactTarget, String> {
    let is_bytes = text.to_lowercase().ends_with('b');
    match file_size(text) {
        Ok(bytes) if is_bytes => Ok(CompactTarget::Bytes(bytes)),
        Ok(count) => Ok(CompactTarget::Splats(count as usize)),
        Err(_) => Err("expected bytes such as 5MB, or splats such as 200k".into()),
    }
}

pub fn run(args: &Args) -> Result<()> {
    use_threads(args.threads)?;
    let data = data_for(args.data.as_deref(), &args.scene)?;
    let input = CompactInput {
        target: args.target,
        keep_psnr: args.keep_psnr,
        steps: args.steps,
        reading: args.reading.options(),
        write: WriteOptions {
            quality: args.quality.into(),
            ..WriteOptions::default()
        },
        seed: args.seed,
        ..CompactInput::new(&args.scene, &data, &args.out)
    };
    let shows_steps = stderr().is_terminal();
    let compacted = compact(&input, &mut |event| match event {
        CompactEvent::Step { steps, splats } if shows_steps => {
            let _ = write!(stderr(), "\rstep {}/{}, {} splats\x1b[K", steps[0], steps[1], splats[0]);
        }
        CompactEvent::Step { .. } => {}
        CompactEvent::Tried { splats, bytes, psnr } => {
            let begin = if shows_steps { "\r" } else { "" };
            let end = if shows_steps { "\x1b[K" } else { "" };
            let megabytes = bytes as f64 / 1e6;
            note(format_args!(
                "{begin}tried {splats} splats: {megabytes:.3} MB, {psnr:.2} dB on training views{end}"
            ));
        }
    })
    .map_err(with_option_names)?;
    print_line(format_args!("{}:{}", args.out.display(), lines(&compacted)))
}

/// Figures before and after, one line each.
fn lines(done: &Compacted) -> String {
    let [splats, left] = done.splats;
    let mut text = size_line(done.bytes, done.formats);
    text += &format!(
        "\n  splats         {splats} -> {left}, {} of them with harmonics",
        done.with_harmonics
    );
    let mut add = |name: &str, [before, after]: [f64; 2]| {
        text += &format!("\n  {name:<14} {before:.2} -> {after:.2} dB ({:+.2})", after - before);
    };
    add("training PSNR", done.psnr);
    if let Some(psnr) = done.held_out_psnr {
        add("held-out PSNR", psnr);
    }
    text + &note_lines(&done.notes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_target_is_bytes_with_a_b_and_splats_without() {
        assert_eq!(parse_target("5MB"), Ok(CompactTarget::Bytes(5_000_000)));
        assert_eq!(parse_target("800kB"), Ok(CompactTarget::Bytes(800_000)));
        assert_eq!(parse_target("200k"), Ok(CompactTarget::Splats(200_000)));
        assert_eq!(parse_target("50000"), Ok(CompactTarget::Splats(50_000)));
        assert!(parse_target("small").is_err());
    }
}

//! `irradia doctor`

use super::pose::{print_findings, with_progress};
use super::{thread_count, use_threads, with_option_names};
use crate::terminal::print_line;
use anyhow::Result;
use clap::builder::RangedU64ValueParser;
use irradia_runs::{DoctorInput, doctor};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Args {
    /// Folders of photographs (JPEG, PNG, WebP, TIFF, HEIC, OpenEXR) and films, or film files; films and panoramas need --out
    #[arg(required = true)]
    pub photos: Vec<PathBuf>,
    /// Folder for doctor.html, with small pictures, and doctor.json; nothing is written when absent. Features and matches are kept
    /// there too: irradia pose with the same folder reuses them
    #[arg(long, value_name = "FOLDER")]
    pub out: Option<PathBuf>,
    /// Maximum number of features of a photograph; when absent 8192 for up to 25 photographs, 6144 for up to 35, else 4096
    #[arg(long, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..=65_536))]
    pub max_features: Option<usize>,
    /// Threads; all cores when absent. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
}

pub fn run(args: &Args) -> Result<()> {
    use_threads(args.threads)?;
    let input = DoctorInput {
        photos: args.photos.clone(),
        out: args.out.clone(),
        max_features: args.max_features,
    };
    let report = with_progress(|progress| doctor(&input, progress)).map_err(with_option_names)?;
    print_findings(&report.findings, |line| print_line(line))?;
    let page = args
        .out
        .as_ref()
        .map(|out| format!("; see {}", out.join("doctor.html").display()));
    print_line(format_args!(
        "{} photographs, {} in {:.1} s{}",
        report.photos,
        match report.findings.len() {
            0 => "nothing wrong found".to_owned(),
            1 => "1 finding".to_owned(),
            n => format!("{n} findings"),
        },
        report.seconds,
        page.unwrap_or_default()
    ))
}

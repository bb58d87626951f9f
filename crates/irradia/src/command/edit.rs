//! `irradia edit`

use super::convert::QualityArg;
use super::{note_lines, thread_count, use_threads, warn};
use crate::Usage;
use crate::terminal::{note, print_line};
use anyhow::{Context, Result};
use irradia_edit::{Edit, EditList, Shape};
use irradia_runs::formats::{SplatFormat, WriteOptions, write_atomic};
use irradia_runs::{AppliedEdit, Editing, same_file};
use std::path::{Path, PathBuf};

#[derive(clap::Args)]
#[command(after_long_help = OPERATIONS)]
pub struct Args {
    /// The scene to read: a splat file of any format, or a run
    pub input: PathBuf,
    /// Edits, made in this order after those of --edits: each one quoted argument, such as "delete sphere center=0,0,0 radius=1"
    #[arg(value_name = "OP")]
    pub ops: Vec<Edit>,
    /// The file to write, its name selects the format; or a folder, which also gets the cameras and the edits
    #[arg(long, short, value_name = "FILE|FOLDER")]
    pub out: Option<PathBuf>,
    /// Make the edits of this list first
    #[arg(long, value_name = "FILE")]
    pub edits: Option<PathBuf>,
    /// Write all edits as a list, with everything that was found automatically spelled out
    #[arg(long, value_name = "FILE")]
    pub save_edits: Option<PathBuf>,
    /// Report what the edits would do, and write no scene
    #[arg(long, conflicts_with = "out")]
    pub preview: bool,
    /// Write before.png and after.png, renderings from a camera beside the scene, to this folder
    #[arg(long, value_name = "FOLDER")]
    pub pictures: Option<PathBuf>,
    /// Edit the run itself: its scene, and its latest checkpoint, from which it can be resumed
    #[arg(long, conflicts_with_all = ["out", "preview"])]
    pub in_place: bool,
    /// How much a lossy format may lose, if it offers a choice (.spz, .sog, .ksplat)
    #[arg(long, value_enum, default_value_t = QualityArg::Normal, conflicts_with_all = ["preview", "in_place"])]
    pub quality: QualityArg,
    /// Threads; all cores when absent
    #[arg(long, value_name = "N", value_parser = thread_count())]
    pub threads: Option<usize>,
}

const OPERATIONS: &str = "\
An OP is an operation with its keys, then a selection: shapes with their keys, each added to it, or subtracted with a prefix -, or \
intersected with a prefix &. Operations that need no selection apply to the whole scene without one. Coordinates are those of the dataset.

Operations: delete, keep, move by=X,Y,Z, rotate axis=X,Y,Z degrees=D [about=X,Y,Z], scale factor=F [about=X,Y,Z], duplicate \
[by=X,Y,Z], merge file=SCENE, upright [up=X,Y,Z] [ground=X,Y,Z] [axis=y|-y|z], set-length from=X,Y,Z to=X,Y,Z length=L, recolor \
[exposure=] [temperature=] [tint=] [saturation=] [contrast=], opacity factor=F, reduce count=N, hide, show, lock, unlock, split name=NAME

Shapes: all, box center=X,Y,Z size=X,Y,Z [rotation=W,X,Y,Z], sphere center=X,Y,Z radius=R, half-space point=X,Y,Z normal=X,Y,Z, \
polygon camera.*=.. points=X,Y;X,Y;.. [visible=true], brush camera.*=.. points=X,Y;.. radius=R (docs/edit.md), color low=R,G,B \
high=R,G,B, opacity|size|elongation|views [min=] [max=], clusters [min=] [max=] [gap=], floaters [score=], subject [margin=], last (what \
the edit before selected or added); of the selection so far: invert, grow by=R, connected [gap=]

Examples:
  irradia edit run -o clean.ply \"delete floaters\"
  irradia edit run -o subject.spz \"keep subject\" \"upright\"
  irradia edit scene.ply -o out.ply \"delete box center=0,0,0 size=2,2,2 -sphere center=0,0,0 radius=0.5\" \"rotate axis=0,0,1 degrees=90\"";

pub fn run(args: &Args) -> Result<()> {
    if args.out.is_none() && !args.preview && !args.in_place {
        return Err(Usage("no output: name one with --out, or use --preview or --in-place".into()).into());
    }
    use_threads(args.threads)?;
    let mut list = match &args.edits {
        Some(path) => {
            let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
            EditList::parse(&text).map_err(|error| Usage(format!("{}: {error}", path.display())))?
        }
        None => EditList::default(),
    };
    list.edits.extend(args.ops.iter().cloned());
    if list.edits.is_empty() {
        return Err(Usage("no edits: give them as OP or with --edits FILE; see irradia edit --help".into()).into());
    }
    let mut editing = Editing::open(&args.input)?;
    warn(&editing.notes);
    let finds_floaters = |edit: &Edit| {
        let mut steps = edit.select.iter().flatten();
        steps.any(|step| matches!(step.shape, Shape::Floaters { .. }))
    };
    if editing.draft().photographs.is_some() && list.edits.iter().any(finds_floaters) {
        note("floaters are judged by the photographs of the run, which takes a minute or more");
    }
    let read = editing.notes.len();
    editing.apply(&list)?;
    warn(&editing.notes[read..]);
    let mut notes = Vec::new();
    if let Some(path) = &args.save_edits {
        check_list(path, args, &editing)?;
    }
    if let Some(out) = &args.out {
        let options = WriteOptions {
            quality: args.quality.into(),
            ..WriteOptions::default()
        };
        notes = editing.write(out, &options)?;
    }
    if let Some(folder) = &args.pictures {
        editing.write_pictures(folder)?;
    }
    if args.in_place {
        notes = editing.write_in_place()?;
    }
    if let Some(path) = &args.save_edits {
        let text = editing.list().to_toml();
        write_atomic(path, |file| file.write_all(text.as_bytes()))?;
    }
    let title = match &args.out {
        Some(out) => out.display().to_string(),
        None if args.in_place => args.input.display().to_string(),
        None => "preview".to_owned(),
    };
    let shown = editing.draft().len() - editing.draft().hidden.count();
    let edits: String = editing.applied().iter().map(line).collect();
    let notes = note_lines(&notes);
    print_line(format_args!("{title}: {shown} splats{edits}{notes}"))
}

/// Rejects a list of edits that would replace a scene that is read or written.
fn check_list(path: &Path, args: &Args, editing: &Editing) -> Result<()> {
    editing.check_output(path)?;
    if args.out.as_ref().is_some_and(|out| same_file(out, path)) || SplatFormat::of(path).is_ok() {
        return Err(Usage(format!(
            "--save-edits {}: name a file that is not a scene's, such as edits.toml",
            path.display()
        ))
        .into());
    }
    Ok(())
}

/// The summary line of an edit, with everything that was found automatically.
fn line(applied: &AppliedEdit) -> String {
    let [selected, of] = applied.selected;
    let edit = applied.edit.to_string();
    // Lists of points are long.
    let short: String = match edit.char_indices().nth(100) {
        Some((end, _)) => format!("{} ..", &edit[..end]),
        None => edit,
    };
    let percent = 100.0 * selected as f64 / of.max(1) as f64;
    format!("\n  {short}: {selected} of {of} splats ({percent:.2} %)")
}

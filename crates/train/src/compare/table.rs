//! The comparison as a plain table for a terminal and as Markdown.

use super::{Comparison, Entry, Milestone, Spread, published};
use crate::report::columns;

fn headings(comparison: &Comparison) -> Vec<String> {
    let mut headings: Vec<String> = ["scene", "recipe", "PSNR, dB", "SSIM"].map(str::to_owned).to_vec();
    headings.push(comparison.lpips_heading());
    headings.extend(comparison.unseen_lpips_heading());
    let rest = [
        "train, s",
        "CPU, s",
        "splats",
        "memory, MB",
        "loss rises",
        "error rises",
        "runs",
    ];
    headings.extend(rest.map(str::to_owned));
    headings
}

/// The table with aligned columns; errors and explanations follow it.
pub fn to_text(comparison: &Comparison) -> String {
    let mut text = columns(&[vec![headings(comparison)], rows(comparison)].concat(), 2);
    if let Some(lines) = marks_table(comparison) {
        text += &format!("\n{MARKS_TITLE}:\n{}", columns(&lines, 1));
    }
    for line in errors(comparison) {
        text += &format!("failed: {line}\n");
    }
    text += &published::to_text(comparison);
    for line in &comparison.notes {
        text += &format!("note: {line}\n");
    }
    text
}

/// Title of the table of [`marks_table`].
const MARKS_TITLE: &str = "Seconds of training until a recipe reaches the first one's final PSNR; in brackets, divided by the seconds of \
                     the first one's whole run";

/// One row per scene and one column per recipe, below their headings; `None` if there is nothing to show.
fn marks_table(comparison: &Comparison) -> Option<Vec<Vec<String>>> {
    let first = comparison.scenes.first()?;
    let name = &first.entries.first()?.recipe;
    let mut headings = vec!["scene".to_owned(), format!("{name} ends with"), "after".to_owned()];
    headings.extend(first.entries.iter().map(|entry| entry.recipe.clone()));
    let mut lines = vec![headings];
    for scene in &comparison.scenes {
        let Some(mark) = scene.mark else { continue };
        let mut cells = vec![
            scene.name.clone(),
            format!("{:.2} dB", mark.psnr),
            format!("{:.1} s", mark.seconds),
        ];
        cells.extend(scene.entries.iter().map(|entry| {
            let time = time(entry, entry.to_mark.as_ref());
            entry
                .mark_share
                .map_or(time.clone(), |share| format!("{time} ({share:.2})"))
        }));
        lines.push(cells);
    }
    (lines.len() > 1).then_some(lines)
}

/// The tables for a results page: one of figures, one of the times to each whole dB.
pub fn to_markdown(comparison: &Comparison) -> String {
    let mut text = format!("{}. {}.\n\n", comparison.conditions.join(", "), comparison.device);
    text += &markdown(&[vec![headings(comparison)], rows(comparison)].concat(), 2);
    text.push('\n');
    for line in errors(comparison) {
        text += &format!("- failed: {}\n", escaped(&line));
    }
    for line in &comparison.notes {
        text += &format!("- {}\n", escaped(line));
    }
    text += "Mean ± sample standard deviation over seeds. *Loss rises*: fraction of blocks of 25 logged steps (of fewer in \
             short runs) whose mean training loss is above that of the previous block; *error rises*: the same for the mean \
             squared error of the training views, which is comparable between recipes.\n";
    if let Some(lines) = published::lines(comparison) {
        text += &format!("\nCompared with published figures:\n\n{}\n", markdown(&lines, 2));
        for source in published::sources(comparison) {
            text += &format!("- {}\n", escaped(&source));
        }
    }
    if let Some(lines) = marks_table(comparison) {
        text += &format!("\n{MARKS_TITLE}:\n\n{}", markdown(&lines, 1));
    }
    for scene in &comparison.scenes {
        let Some(first) = scene.entries.first() else { continue };
        let whole: Vec<usize> = (0..first.reached.len())
            .filter(|i| first.reached[*i].psnr.fract() == 0.0)
            .collect();
        if whole.is_empty() {
            continue;
        }
        let headings = whole.iter().map(|i| format!("{:.0} dB", first.reached[*i].psnr));
        let headings: Vec<String> = std::iter::once("recipe".to_owned()).chain(headings).collect();
        text += &format!(
            "\nSeconds of training until the held-out PSNR is reached, {}:\n\n",
            escaped(&scene.name)
        );
        let rows = scene.entries.iter().map(|entry| {
            let times = whole.iter().map(|i| time(entry, entry.reached.get(*i)));
            std::iter::once(entry.recipe.clone()).chain(times).collect()
        });
        text += &markdown(&std::iter::once(headings).chain(rows).collect::<Vec<_>>(), 1);
    }
    text
}

/// Mean seconds to a level, and the number of runs that reached it, if not all.
fn time(entry: &Entry, level: Option<&Milestone>) -> String {
    let finished = entry.runs.iter().filter(|run| run.figures.is_some()).count();
    match level.and_then(|reached| reached.seconds) {
        None => "–".into(),
        Some(s) if s.runs < finished => format!("{:.1} ({} of {finished})", s.mean, s.runs),
        Some(s) => format!("{:.1}", s.mean),
    }
}

fn rows(comparison: &Comparison) -> Vec<Vec<String>> {
    let mut rows = Vec::new();
    let has_unseen = comparison.unseen_lpips_heading().is_some();
    for scene in &comparison.scenes {
        for entry in &scene.entries {
            let done = entry.runs.iter().filter(|run| run.figures.is_some()).count();
            let mut row = vec![
                scene.name.clone(),
                entry.recipe.clone(),
                number(entry.psnr, 2, 1.0),
                number(entry.ssim, 4, 1.0),
                number(entry.lpips, 4, 1.0),
            ];
            row.extend(has_unseen.then(|| number(entry.unseen_lpips, 4, 1.0)));
            row.extend([
                number(entry.seconds, 1, 1.0),
                number(entry.cpu_seconds, 1, 1.0),
                size(entry),
                number(entry.peak_memory, 0, 1e-6),
                number(entry.loss_rises, 2, 1.0),
                number(entry.error_rises, 2, 1.0),
                format!("{done}/{}", entry.runs.len()),
            ]);
            rows.push(row);
        }
    }
    if comparison.scenes.len() > 1 {
        for o in &comparison.overall {
            let dash = || "–".to_owned();
            let distance = |lpips: Option<f64>| lpips.map_or_else(dash, |l| format!("{l:.4}"));
            let mut row = vec![
                format!("mean of {}", o.scenes),
                o.recipe.clone(),
                format!("{:.2}", o.psnr),
                format!("{:.4}", o.ssim),
                distance(o.lpips),
            ];
            row.extend(has_unseen.then(|| distance(o.unseen_lpips)));
            row.extend([
                format!("{:.1}", o.seconds),
                dash(),
                o.parameters
                    .map_or_else(|| o.splats.map_or_else(dash, |n| format!("{n:.0}")), format_parameters),
                dash(),
                dash(),
                dash(),
                dash(),
            ]);
            rows.push(row);
        }
    }
    rows
}

/// Number of splats, or of parameters of a field.
fn size(entry: &Entry) -> String {
    let parameters = entry.parameters.map(|spread| format_parameters(spread.mean));
    parameters.unwrap_or_else(|| number(entry.splats, 0, 1.0))
}

fn format_parameters(parameters: f64) -> String {
    format!("{parameters:.0} parameters")
}

/// `scene, recipe, seed: error` of every failed run.
fn errors(comparison: &Comparison) -> Vec<String> {
    let mut lines = Vec::new();
    for scene in &comparison.scenes {
        for entry in &scene.entries {
            for run in &entry.runs {
                let error = run.error.as_ref();
                lines.extend(error.map(|e| format!("{}, {}, seed {}: {e}", scene.name, entry.recipe, run.seed)));
            }
        }
    }
    lines
}

fn number(spread: Option<Spread>, digits: usize, unit: f64) -> String {
    let Some(spread) = spread else { return "–".into() };
    let mean = format!("{:.digits$}", spread.mean * unit);
    spread
        .deviation
        .map_or(mean.clone(), |d| format!("{mean} ± {:.digits$}", d * unit))
}

/// A table whose first line is the header and whose first `left` columns are text.
fn markdown(lines: &[Vec<String>], left: usize) -> String {
    let mut text = String::new();
    for (number, cells) in lines.iter().enumerate() {
        text += &markdown_row(cells);
        if number == 0 {
            text += &format!("|{}{}\n", "---|".repeat(left), "---:|".repeat(cells.len() - left));
        }
    }
    text
}

fn markdown_row(cells: &[String]) -> String {
    let cells: Vec<String> = cells.iter().map(|cell| escaped(cell)).collect();
    format!("| {} |\n", cells.join(" | "))
}

/// Escapes text for a Markdown table.
fn escaped(text: &str) -> String {
    text.replace('|', "\\|").replace(['\n', '\r'], " ")
}

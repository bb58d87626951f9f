//! `irradia recipe keys`: what may stand in a recipe.

use crate::Usage;
use crate::terminal::say;
use anyhow::Result;
use irradia_train::recipe::keys::{Key, find, keys};

#[derive(clap::Args)]
pub struct Args {
    /// Only the keys with this in their name or description
    pub filter: Option<String>,
    /// Print a page of Markdown instead
    #[arg(long)]
    pub markdown: bool,
}

pub fn run(args: &Args) -> Result<()> {
    let keys = match &args.filter {
        None => keys(),
        Some(word) => find(word).map_err(|nearest| {
            Usage(format!(
                "no key of a recipe has `{word}` in it; the nearest is {nearest}"
            ))
        })?,
    };
    say(if args.markdown { markdown(&keys) } else { plain(&keys) }.trim_end())
}

/// Keys by section, in their order.
fn sections(keys: &[Key]) -> impl Iterator<Item = (&str, &[Key])> {
    let sections = keys.chunk_by(|a, b| a.section == b.section);
    sections.filter_map(|keys| Some((keys.first()?.section.as_str(), keys)))
}

fn plain(keys: &[Key]) -> String {
    let mut text = String::new();
    for (section, keys) in sections(keys) {
        text += &format!("{}\n\n", section.replace('`', ""));
        for key in keys {
            let default = match key.default.as_str() {
                "required" => "required".to_owned(),
                default => format!("default {default}"),
            };
            let facts: Vec<&str> = [&key.value, &default, &key.bounds]
                .into_iter()
                .map(String::as_str)
                .filter(|fact| !fact.is_empty())
                .collect();
            text += &format!("  {}: {}\n      {}\n", key.path, facts.join(", "), key.doc);
            if !key.source.is_empty() {
                text += &format!("      From {}.\n", key.source);
            }
        }
        text += "\n";
    }
    text
}

const INTRODUCTION: &str = "\
# Keys of a recipe

Written by `irradia recipe keys --markdown`; a test compares it with the program. `irradia recipe keys WORD` finds a key.

A recipe is a TOML file; `--set KEY=VALUE` changes one key. `STAGE` is a stage's name. A key of `params` holds over the whole
run, `stage.STAGE.params` has the same keys and holds over that stage. The value of a parameter is a number, a ramp
`{ from, to, shape }` with the shape `linear`, `log` or `cosine` (without `from` it goes on from the value in force), or
`{ steps = [[at, value], ..] }`.
";

fn markdown(keys: &[Key]) -> String {
    let mut text = INTRODUCTION.to_owned();
    for (section, keys) in sections(keys) {
        text += &format!("\n## {section}\n\n");
        let bounds = keys.iter().any(|key| !key.bounds.is_empty());
        let (heads, rule) = if bounds {
            (
                "| key | value | default | bounds | what it is | source |",
                "|---|---|---|---|---|---|",
            )
        } else {
            ("| key | value | default | what it is |", "|---|---|---|---|")
        };
        text += &format!("{heads}\n{rule}\n");
        for key in keys {
            let mut cells = vec![format!("`{}`", key.path), key.value.clone(), key.default.clone()];
            if bounds {
                cells.extend([key.bounds.clone(), key.doc.clone(), key.source.clone()]);
            } else {
                cells.push(key.doc.clone());
            }
            let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
            text += &format!("| {} |\n", cells.join(" | "));
        }
    }
    text
}

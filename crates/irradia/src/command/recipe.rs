//! `irradia recipe`

use super::recipe_keys;
use crate::terminal::print_line;
use anyhow::Result;
use irradia_runs::read_recipe;
use irradia_train::Recipe;
use irradia_train::recipe::{BUILT_IN, DensityControl, Exit, Group, Param, Represents, Stage};
use irradia_train::report::columns;
use irradia_train::schedule::{OutlinePoint, outline};

#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(clap::Subcommand)]
enum Action {
    /// List the built-in recipes
    List,
    /// Show the schedule of a recipe
    Show(ShowArgs),
    /// List the keys of recipes: each with unit, default, bounds and source
    Keys(recipe_keys::Args),
}

#[derive(clap::Args)]
pub struct ShowArgs {
    /// Built-in recipe or a .toml file
    #[arg(value_name = "NAME|FILE")]
    pub recipe: String,
    /// Override one key of the recipe, such as stage.grow.params.ssim_weight=0.3
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Fit the recipe into this number of steps
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
    /// Print the recipe as a .toml file to start from
    #[arg(long, conflicts_with = "steps")]
    pub toml: bool,
}

pub fn run(args: &Args) -> Result<()> {
    match &args.action {
        Action::List => list(),
        Action::Keys(args) => recipe_keys::run(args),
        Action::Show(args) => {
            let recipe = read_recipe(&args.recipe, &args.set)?;
            if args.toml {
                print_line(recipe.to_toml().trim_end())
            } else {
                print_line(plan(&recipe, args.steps.unwrap_or(recipe.total_steps())).trim_end())
            }
        }
    }
}

fn list() -> Result<()> {
    let mut lines = Vec::new();
    for (name, _) in BUILT_IN {
        let recipe = read_recipe(name, &[])?;
        lines.push(vec![
            name.to_owned(),
            format!("{} steps", recipe.total_steps()),
            recipe.about,
        ]);
    }
    print_line(columns(&lines, 3).trim_end())
}

/// Number of points in time at which parameters are shown, in addition to the ends of stages.
const OUTLINE_POINTS: usize = 6;

/// The schedule of `recipe` in `steps` steps, as tables.
fn plan(recipe: &Recipe, steps: u64) -> String {
    let pace = recipe.total_steps() as f64 / steps as f64;
    let points = outline(recipe, OUTLINE_POINTS);
    let mut text = format!("{}: {}\n{steps} steps", recipe.name, recipe.about);
    if steps != recipe.total_steps() {
        text += &format!(" instead of the recipe's {}", recipe.total_steps());
    }
    if recipe.stage.iter().any(|stage| stage.represents == Represents::Splats) {
        text += &format!(", at most {} splats", recipe.max_splats);
        if let Some(per_pixel) = recipe.splats_per_pixel {
            text += &format!(" or {per_pixel} per pixel of an image");
        }
    }
    text += "\n\n";
    text += &columns(&stages(recipe, &points, pace), 6);

    let (still, moving): (Vec<Param>, Vec<Param>) = Param::ALL.into_iter().partition(|param| {
        let value = |point: &OutlinePoint| point.values[*param];
        points.iter().all(|point| value(point) == value(&points[0]))
    });
    let shown = distinct(&points, pace);
    if !moving.is_empty() {
        let mut heads = vec!["step".to_owned()];
        heads.extend(shown.iter().map(|point| format!("{:.0}", point.time / pace)));
        let mut names = vec!["stage".to_owned()];
        names.extend(shown.iter().map(|point| recipe.stage[point.stage].name.clone()));
        let mut lines = vec![heads, names];
        for param in moving {
            let mut line = vec![param.name().to_owned()];
            line.extend(shown.iter().map(|point| format_number(point.values[param])));
            lines.push(line);
        }
        text += &format!("\nChanging parameters:\n{}", columns(&lines, 1));
    }
    let lines: Vec<Vec<String>> = still
        .iter()
        .filter(|param| points[0].values[**param] != 0.0)
        .map(|param| vec![param.name().to_owned(), format_number(points[0].values[*param])])
        .collect();
    text + &format!("\nConstant parameters:\n{}", columns(&lines, 1))
}

/// A line per stage: its steps, density control, losses, and early end.
fn stages(recipe: &Recipe, points: &[OutlinePoint], pace: f64) -> Vec<Vec<String>> {
    let heads = ["stage", "steps", "image scale", "losses", "density", "ends early"];
    let mut lines = vec![heads.map(str::to_owned).to_vec()];
    let mut start = 0.0;
    for (i, stage) in recipe.stage.iter().enumerate() {
        let end = start + stage.steps as f64;
        let within: Vec<&OutlinePoint> = points.iter().filter(|point| point.stage == i).collect();
        lines.push(vec![
            stage.name.clone(),
            format!("{:.0} - {:.0}", (start / pace).floor() + 1.0, end / pace),
            format_range(&within, Param::ImageScale),
            match stage.represents {
                Represents::Splats => losses(&within),
                Represents::Field => "squared error of rays".into(),
            },
            density(stage),
            stage.exit.map_or("-".into(), exit),
        ]);
        start = end;
    }
    lines
}

/// The value of a parameter in a stage, or its first and last.
fn format_range(within: &[&OutlinePoint], param: Param) -> String {
    let value = |point: Option<&&OutlinePoint>| point.map_or(0.0, |point| point.values[param]);
    let (first, last) = (value(within.first()), value(within.last()));
    if first == last {
        format_number(first)
    } else {
        format!("{} to {}", format_number(first), format_number(last))
    }
}

fn losses(within: &[&OutlinePoint]) -> String {
    let with_group = |group: Group| Param::ALL.into_iter().filter(move |param| param.row().group == group);
    let mut losses = Vec::new();
    for loss in with_group(Group::Loss) {
        if within.iter().all(|point| point.values[loss] == 0.0) {
            continue;
        }
        let named = |param: Param| {
            let name = param.name();
            let (name, kind) = name.rsplit_once('_').unwrap_or((name, ""));
            let name = if kind == "weight" { name } else { kind };
            format!("{name} {}", format_range(within, param))
        };
        let parts: Vec<String> = with_group(Group::PartOf(loss)).map(named).collect();
        let parts = if parts.is_empty() {
            String::new()
        } else {
            format!(" ({})", parts.join(", "))
        };
        losses.push(named(loss) + &parts);
    }
    losses.join(", ")
}

fn density(stage: &Stage) -> String {
    if stage.represents == Represents::Field {
        return "a radiance field".into();
    }
    let strategy = stage.density.map(|density| {
        let name = match density {
            DensityControl::Classic(knobs) if knobs.absolute => "classic, absolute",
            DensityControl::Classic(_) => "classic",
            DensityControl::Mcmc(_) => "mcmc",
            DensityControl::Taming(_) => "taming",
            DensityControl::Fast(_) => "fast",
        };
        format!("{name} every {}", density.every())
    });
    let merge = stage.merge.map(|merge| format!("merge every {}", merge.every));
    let parts: Vec<String> = strategy.into_iter().chain(merge).collect();
    if parts.is_empty() { "-".into() } else { parts.join(", ") }
}

fn exit(exit: Exit) -> String {
    match exit {
        Exit::Threshold { tau } => format!("error below {tau}"),
        Exit::Relative { ratio } => format!("error below {ratio} of its first value"),
        Exit::Plateau { drop, window } => {
            format!("relative decrease of the error below {drop} in {window} recipe steps")
        }
    }
}

/// The points, without the end of each stage that equals the start of the next one.
fn distinct(points: &[OutlinePoint], pace: f64) -> Vec<&OutlinePoint> {
    let step = |point: &OutlinePoint| (point.time / pace).round();
    let equal = |a: f64, b: f64| (a - b).abs() <= 1e-6 * a.abs();
    let same = |a: &OutlinePoint, b: &OutlinePoint| {
        step(a) == step(b) && Param::ALL.iter().all(|param| equal(a.values[*param], b.values[*param]))
    };
    let shown = points
        .iter()
        .enumerate()
        .filter(|(i, point)| points.get(i + 1).is_none_or(|next| !same(point, next)));
    shown.map(|(_, point)| point).collect()
}

/// Formats with three significant digits.
fn format_number(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    if (1e-3..1e6).contains(&value.abs()) {
        let digits = (2 - value.abs().log10().floor() as i32).max(0) as usize;
        let text = format!("{value:.digits$}");
        if text.contains('.') {
            return text.trim_end_matches('0').trim_end_matches('.').to_owned();
        }
        return text;
    }
    let text = format!("{value:.2e}");
    text.replace(".00e", "e").replace("0e", "e")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_short_and_right() {
        let cases = [
            (0.0, "0"),
            (1.0, "1"),
            (0.2, "0.2"),
            (0.001, "0.001"),
            (0.1234, "0.123"),
            (1234.0, "1234"),
            (1.6e-4, "1.6e-4"),
            (1e-15, "1e-15"),
            (20.0, "20"),
            (5e6, "5e6"),
        ];
        for (value, want) in cases {
            assert_eq!(format_number(value), want);
        }
    }

    #[test]
    fn every_built_in_recipe_has_a_plan_at_any_length() {
        for (name, _) in BUILT_IN {
            let recipe = read_recipe(name, &[]).unwrap();
            for steps in [1, 7, recipe.total_steps(), 100_000] {
                let text = plan(&recipe, steps);
                assert!(text.contains("image scale") && text.contains("rate_"), "{name}: {text}");
                assert!(!text.contains("NaN") && !text.contains("inf"), "{text}");
            }
        }
    }
}

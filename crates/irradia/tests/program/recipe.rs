//! `irradia recipe`: list, schedules and keys.

use crate::process::*;
use std::fs;

#[test]
fn recipes_are_listed_and_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let list = irradia(folder.path(), "recipe list").success();
    for name in ["classic", "mcmc", "fast", "curriculum"] {
        assert!(list.stdout.lines().any(|line| line.starts_with(name)), "{list:?}");
    }
    let shown = irradia(folder.path(), "recipe show classic --steps 3000").success();
    let line = |start: &str| {
        let found = shown.stdout.lines().find(|line| line.starts_with(start));
        found.unwrap_or_else(|| panic!("{start}: {shown:?}")).to_owned()
    };
    assert!(
        line("grow").contains("51 - 1500") && line("grow").contains("classic every 100"),
        "{shown:?}"
    );
    assert!(
        line("rate_means").ends_with("1.6e-6") && line("sh_degree").ends_with('3'),
        "{shown:?}"
    );
    assert!(line("rate_quats").ends_with("0.001"), "{shown:?}");
    let changed = "recipe show classic --set stage.grow.params.image_scale=0.5 \
                   --set stage.grow.exit={when='relative',ratio=0.5}";
    let changed = irradia(folder.path(), changed).success();
    let grow = changed.stdout.lines().find(|line| line.starts_with("grow"));
    assert!(
        grow.is_some_and(|line| line.contains("0.5") && line.ends_with("of its first value")),
        "{changed:?}"
    );
}

#[test]
fn the_page_of_keys_is_up_to_date() {
    let folder = tempfile::tempdir().expect("a folder");
    let printed = irradia(folder.path(), "recipe keys --markdown").success();
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/recipe-keys.md");
    let page = fs::read_to_string(page).expect("docs/recipe-keys.md");
    assert!(
        printed.stdout == page,
        "docs/recipe-keys.md is out of date: irradia recipe keys --markdown > docs/recipe-keys.md"
    );
}

#[test]
fn keys_are_found_by_a_part_of_their_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let found = irradia(folder.path(), "recipe keys ssim").success();
    assert!(
        found.stdout.contains("params.ssim_weight: fraction, default 0, 0 to 1") && !found.stdout.contains("init."),
        "{found:?}"
    );
    irradia(folder.path(), "recipe keys ssim_wieght").refused(2, &["ssim_wieght", "params.ssim_weight"]);
}

#[test]
fn a_shown_recipe_can_be_trained_with() {
    let folder = with_data();
    let toml = irradia(folder.path(), "recipe show fast --toml --set max_splats=4321").success();
    fs::write(folder.path().join("mine.toml"), &toml.stdout).expect("written");
    let again = irradia(folder.path(), "recipe show mine.toml --toml").success();
    assert!(
        again.stdout == toml.stdout && toml.stdout.contains("max_splats = 4321"),
        "{toml:?}"
    );
    irradia(folder.path(), "train data --recipe mine.toml --steps 3 --out run").success();
    irradia(folder.path(), "recipe show nonsense").refused(2, &["nonsense", "classic"]);
    irradia(folder.path(), "recipe show classic --set max_splat=3").refused(2, &["max_splats"]);
}

#[test]
fn a_perceptual_loss_without_weights_is_skipped_with_one_warning() {
    let folder = with_data();
    let change = "--set stage.grow.params.perceptual_weight={from=0.0,to=0.1}";
    let line = "train data --recipe classic --steps 12";
    let ended = irradia(folder.path(), &format!("{line} --out with {change}")).success();
    let warnings: Vec<&str> = ended.stderr.lines().filter(|line| line.contains("LPIPS")).collect();
    assert!(
        matches!(warnings[..], [one] if one.starts_with("warning: ") && one.contains("irradia lpips --import")),
        "{ended:?}"
    );
    let report = json(&folder.path().join("with/report.json"));
    assert!(
        report["warnings"].as_array().is_some_and(|list| list.len() == 1),
        "{}",
        report["warnings"]
    );
    let ended = irradia(folder.path(), &format!("{line} --out without")).success();
    assert!(!ended.stderr.contains("LPIPS"), "{ended:?}");
    assert!(scene(&folder.path().join("with")) == scene(&folder.path().join("without")));
}

#[test]
fn a_report_contains_the_schedule_of_the_run() {
    let folder = with_data();
    // Any error is below 2: the stage ends once all of the 8 views have been seen.
    let change = "--set stage.warmup.steps=10000 --set stage.warmup.exit={when='threshold',tau=2.0}";
    irradia(
        folder.path(),
        &format!("train data --recipe classic --steps 100 --out run {change}"),
    )
    .success();
    let report = json(&folder.path().join("run/report.json"));
    assert_eq!(report["stages"][0]["last_step"], 8, "{}", report["stages"]);
    let schedule = &report["schedule"];
    assert_eq!(schedule["done"], true);
    let numbers = |value: &serde_json::Value| -> Vec<f64> {
        let list = value.as_array().expect("numbers");
        list.iter().map(|number| number.as_f64().expect("a number")).collect()
    };
    let steps = numbers(&schedule["steps"]);
    assert!(steps.first() == Some(&0.0) && steps.last() == Some(&100.0), "{steps:?}");
    let knobs = schedule["knobs"].as_array().expect("knobs");
    let means = knobs.iter().find(|knob| knob["name"] == "rate.means").expect("a rate");
    let means = numbers(&means["values"]);
    // From 1.6e-4 to 1.6e-6 without a jump at the early end of the stage.
    assert!(
        means
            .windows(2)
            .all(|pair| pair[1] <= pair[0] && pair[1] > 0.8 * pair[0]),
        "{means:?}"
    );
    assert!((means[means.len() - 1] / 1.6e-6 - 1.0).abs() < 0.01, "{means:?}");
}

//! Tests of the recipes of published schedules against the rules of their authors' code, written out by hand.

use super::{Clock, StepMetrics, plan};
use crate::recipe::{DensityControl, Param, Recipe};
use std::ops::Range;

const STEPS: u64 = 30_000;

/// An action of a step, from 1.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Action {
    /// A stage begins with this step.
    Stage,
    /// One SH band more from this step on.
    Bands(u32),
    /// Statistics are gathered from this step on, or no longer.
    Gathers(bool),
    /// Noise on the means from this step on, or no longer.
    Noise(bool),
    /// A round of density control, and whether it removes splats oversized in the world.
    Densify { oversized: bool },
    /// A round of relocation and growth.
    Relocate,
    /// Opacities are lowered.
    Reset,
    /// The last round of density control was that of the step before.
    LastRound,
}

type Events = Vec<(u64, Action)>;

/// The actions of the recipe.
fn of_recipe(name: &str) -> Events {
    let recipe = Recipe::parse(name, Recipe::built_in(name).unwrap(), &[]).unwrap();
    let metrics = StepMetrics {
        error: 0.1,
        measured: None,
        views: 100,
    };
    let mut clock = Clock::new(&recipe);
    let mut events = Vec::new();
    let (mut bands, mut gathers, mut noise, mut last_round) = (0, false, false, 0);
    while !clock.finished(&recipe) {
        let plan = plan(&recipe, &clock);
        let step = clock.step + 1;
        if clock.stage_step == clock.step {
            events.push((step, Action::Stage));
        }
        if plan.sh_degree != bands {
            bands = plan.sh_degree;
            events.push((step, Action::Bands(bands)));
        }
        if plan.gathers.is_some() != gathers {
            gathers = !gathers;
            events.push((step, Action::Gathers(gathers)));
        }
        if (plan.value(Param::Noise) > 0.0) != noise {
            noise = !noise;
            events.push((step, Action::Noise(noise)));
        }
        if let Some(round) = plan.densify {
            last_round = step;
            let oversized = round.prune_large;
            events.push((
                step,
                match round.density {
                    DensityControl::Mcmc(_) => Action::Relocate,
                    _ => Action::Densify { oversized },
                },
            ));
        }
        if plan.reset_opacity.is_some() {
            events.push((step, Action::Reset));
        }
        assert!(plan.merge.is_none() && plan.image_scale == 1.0, "{name}: step {step}");
        clock.tick(&recipe, 1.0, metrics);
    }
    assert_eq!(clock.step, STEPS, "{name}");
    events.push((last_round + 1, Action::LastRound));
    events.sort_by_key(|(step, _)| *step);
    events
}

/// `train.py` of 3DGS (Kerbl et al. 2023), which Taming 3DGS follows except in how a round selects; a black background.
fn of_3dgs() -> Events {
    let (densify_from, densify_until, interval, reset_interval) = (500, 15_000, 100, 3000);
    let mut events = vec![(1, Action::Stage), (1, Action::Gathers(true))];
    let mut active_sh_degree = 0;
    for iteration in 1..=STEPS {
        if iteration == densify_from + 1 {
            events.push((iteration, Action::Stage));
        }
        if iteration == densify_until {
            events.push((iteration, Action::Stage));
        }
        if iteration.is_multiple_of(1000) && active_sh_degree < 3 {
            active_sh_degree += 1;
            events.push((iteration, Action::Bands(active_sh_degree)));
        }
        if iteration == densify_until {
            events.push((iteration, Action::Gathers(false)));
        }
        if iteration < densify_until {
            if iteration > densify_from && iteration.is_multiple_of(interval) {
                // `size_threshold`; its screen-size criterion compares zeroed sizes.
                let oversized = iteration > reset_interval;
                events.push((iteration, Action::Densify { oversized }));
            }
            if iteration.is_multiple_of(reset_interval) {
                events.push((iteration, Action::Reset));
            }
        }
    }
    events.push((14_901, Action::LastRound));
    events.sort_by_key(|(step, _)| *step);
    events
}

/// `train.py` of 3DGS-MCMC (Kheradmand et al. 2024), except for the last step, in which its optimiser is skipped.
fn of_mcmc() -> Events {
    let (densify_from, densify_until, interval) = (500, 25_000, 100);
    let mut events = vec![(1, Action::Stage), (1, Action::Noise(true))];
    let mut active_sh_degree = 0;
    for iteration in 1..=STEPS {
        if iteration == densify_from + 1 || iteration == densify_until {
            events.push((iteration, Action::Stage));
        }
        if iteration.is_multiple_of(1000) && active_sh_degree < 3 {
            active_sh_degree += 1;
            events.push((iteration, Action::Bands(active_sh_degree)));
        }
        if iteration < densify_until && iteration > densify_from && iteration.is_multiple_of(interval) {
            events.push((iteration, Action::Relocate));
        }
    }
    events.push((24_901, Action::LastRound));
    events.sort_by_key(|(step, _)| *step);
    events
}

fn compare(name: &str, got: &Events, published: &Events) {
    for (got, published) in got.iter().zip(published) {
        assert_eq!(got, published, "{name}");
    }
    assert_eq!(got.len(), published.len(), "{name}");
}

fn count(events: &Events, what: impl Fn(&Action) -> bool) -> usize {
    events.iter().filter(|(_, action)| what(action)).count()
}

#[test]
fn actions_in_30000_steps_match_the_published_code() {
    let published = of_3dgs();
    let resets: Vec<u64> = published
        .iter()
        .filter(|(_, action)| *action == Action::Reset)
        .map(|(step, _)| *step)
        .collect();
    assert_eq!(resets, [3000, 6000, 9000, 12_000]);
    let rounds = |oversized| count(&published, |action| *action == Action::Densify { oversized });
    assert_eq!((rounds(false), rounds(true)), (25, 119), "600 to 3000, 3100 to 14900");
    for name in ["classic", "absgrad", "taming"] {
        compare(name, &of_recipe(name), &published);
    }
    // Relocation needs no statistics, but gathering them costs hardly anything.
    let mut mcmc = of_recipe("mcmc");
    mcmc.retain(|(_, action)| !matches!(action, Action::Gathers(_)));
    assert_eq!(count(&mcmc, |action| *action == Action::Relocate), 244, "600 to 24900");
    compare("mcmc", &mcmc, &of_mcmc());
}

/// Means' rates are `get_expon_lr_func(1.6e-4, 1.6e-6, max_steps = 30000)` at the iteration, from 1; here at steps from 0.
#[test]
fn rates_are_the_published_ones() {
    for (name, opacities, sh_rest) in [
        ("classic", 0.05, 1.25e-4),
        ("absgrad", 0.05, 1.25e-4),
        ("mcmc", 0.05, 1.25e-4),
        ("taming", 0.025, 2.5e-4),
    ] {
        let recipe = Recipe::parse(name, Recipe::built_in(name).unwrap(), &[]).unwrap();
        for iteration in [1, 700, 15_000, 29_999] {
            let step = iteration - 1;
            let clock = Clock {
                step,
                time: step as f64,
                progress: step as f64,
                ..Clock::new(&recipe)
            };
            let rates = plan(&recipe, &clock).rates();
            let t = iteration as f64 / STEPS as f64;
            let means = (1.6e-4f64.ln() * (1.0 - t) + 1.6e-6f64.ln() * t).exp();
            let relative = f64::from(rates.means) / means - 1.0;
            // One step of 30,000 is a factor of 1.00015.
            assert!(relative.abs() < 1.6e-4, "{name} {iteration}: {relative:e}");
            let rest = [
                rates.quats,
                rates.log_scales,
                rates.opacities,
                rates.sh_dc,
                rates.sh_rest,
            ];
            assert_eq!(rest, [0.001, 0.005, opacities, 0.0025, sh_rest], "{name}");
        }
    }
}

/// `get_count_array` of Taming 3DGS: round i of 145 ends with the value at i of a parabola with its vertex at the last round.
#[test]
fn taming_adds_along_the_published_parabola() {
    let recipe = Recipe::parse("taming", Recipe::built_in("taming").unwrap(), &[]).unwrap();
    let (start, budget) = (10_000.0, 250_000.0);
    let published = |round: u64| {
        let (x, rounds) = (round as f64, 145.0);
        let slope = 2.0 * (budget - start) / rounds;
        let curve = (budget - start - slope * rounds) / (rounds * rounds);
        curve * x * x + slope * x + start
    };
    let mut count = start as usize;
    for round in 1..=144 {
        let step: u64 = 500 + 100 * round - 1;
        let clock = Clock {
            step,
            time: step as f64,
            stage: 1,
            stage_time: 500.0,
            stage_step: 500,
            ..Clock::new(&recipe)
        };
        let completed = plan(&recipe, &clock).densify.expect("a round").completed;
        count = irradia_splat::densify::taming::next_count(count, budget as usize, completed);
        let relative = count as f64 / published(round) - 1.0;
        // Rounds are one step of 100 to either side of the published points.
        assert!(
            relative.abs() < 0.01,
            "round {round}: {count}, published {}",
            published(round)
        );
    }
    assert_eq!(prune_rounds(&recipe), 1..28);
}

/// The rounds that prune: `iter_num < 27`, from 0.
fn prune_rounds(recipe: &Recipe) -> Range<u64> {
    match recipe.stage[1].density {
        Some(DensityControl::Taming(settings)) => 1..settings.prune_rounds + 1,
        _ => 0..0,
    }
}

//! Switches that remove one ingredient from a curriculum, so that its contribution can be measured.

use super::keys::documented;
use super::{Group, Param, Recipe};
use serde::{Deserialize, Serialize};

documented! {
    /// Which ingredients of a curriculum are active; all by default.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct Ingredients {
        /// Large splats are trained first (`trained_share`).
        #[serde(default = "on")]
        pub parameter_groups: bool,
        /// Images and the number of splats grow (`image_scale`, `count_share`).
        #[serde(default = "on")]
        pub data_schedule: bool,
        /// Losses change from stage to stage; otherwise the last stage's hold throughout.
        #[serde(default = "on")]
        pub loss_schedule: bool,
        /// Stages end early when their exit rule holds (`exit`).
        #[serde(default = "on")]
        pub adaptive_transitions: bool,
    }
}

fn on() -> bool {
    true
}

impl Default for Ingredients {
    fn default() -> Self {
        Self {
            parameter_groups: true,
            data_schedule: true,
            loss_schedule: true,
            adaptive_transitions: true,
        }
    }
}

impl Ingredients {
    /// Whether all are active.
    pub fn all_active(&self) -> bool {
        *self == Self::default()
    }

    /// Removes the inactive ingredients from `recipe`.
    pub(super) fn apply(self, recipe: &mut Recipe) {
        if !self.parameter_groups {
            remove(recipe, |param| param == Param::TrainedShare);
        }
        if !self.data_schedule {
            remove(recipe, |param| param.row().group == Group::Data);
        }
        if !self.loss_schedule {
            // The values of a parameter are those of the last stage that sets it.
            for param in Param::ALL.into_iter().filter(|param| param.is_loss_param()) {
                let last = recipe
                    .stage
                    .iter()
                    .rev()
                    .find_map(|stage| stage.params.get(&param).cloned());
                if let Some(knob) = last {
                    remove(recipe, |other| other == param);
                    recipe.params.insert(param, knob);
                }
            }
        }
        if !self.adaptive_transitions {
            for stage in &mut recipe.stage {
                stage.exit = None;
            }
        }
    }
}

fn remove(recipe: &mut Recipe, removed: impl Fn(Param) -> bool) {
    let stages = recipe.stage.iter_mut().map(|stage| &mut stage.params);
    for knobs in stages.chain([&mut recipe.params]) {
        knobs.retain(|param, _| !removed(*param));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_switch_removes_its_ingredient_and_no_other() {
        let text = Recipe::built_in("curriculum").unwrap();
        let whole = Recipe::parse("curriculum", text, &[]).unwrap();
        let without = |name: &str| Recipe::parse("curriculum", text, &[format!("ingredients.{name}=false")]).unwrap();
        let names = |recipe: &Recipe, param: Param| {
            let stages = recipe.stage.iter().map(|stage| &stage.params);
            stages.chain([&recipe.params]).any(|knobs| knobs.contains_key(&param))
        };
        let exits = |recipe: &Recipe| recipe.stage.iter().any(|stage| stage.exit.is_some());
        let stage_losses = |recipe: &Recipe| {
            let mut knobs = recipe.stage.iter().flat_map(|stage| stage.params.keys());
            knobs.any(|param| param.is_loss_param())
        };
        let found = |recipe: &Recipe| {
            [
                names(recipe, Param::TrainedShare),
                names(recipe, Param::ImageScale),
                stage_losses(recipe),
                exits(recipe),
            ]
        };
        assert_eq!(found(&whole), [true; 4]);
        assert_eq!(found(&without("parameter_groups")), [false, true, true, true]);
        assert_eq!(found(&without("data_schedule")), [true, false, true, true]);
        assert_eq!(found(&without("loss_schedule")), [true, true, false, true]);
        assert_eq!(found(&without("adaptive_transitions")), [true, true, true, false]);
        let again = Recipe::parse("again", &without("data_schedule").to_toml(), &[]).unwrap();
        assert_eq!(
            again,
            without("data_schedule"),
            "a resolved recipe parses to the same recipe"
        );
    }
}

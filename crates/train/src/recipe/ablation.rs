//! Switches that take one ingredient out of a curriculum, so that its share in the outcome can be measured.

use super::keys::documented;
use super::{Group, Param, Recipe};
use serde::{Deserialize, Serialize};

documented! {
    /// Which ingredients of a curriculum are in force; all when nothing is said.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct Ingredients {
        /// Large splats are trained first (`trained_share`).
        #[serde(default = "on")]
        pub parameter_groups: bool,
        /// Images and the number of splats grow (`image_scale`, `count_share`).
        #[serde(default = "on")]
        pub data_schedule: bool,
        /// Losses change from stage to stage; the last stage's hold throughout otherwise.
        #[serde(default = "on")]
        pub loss_schedule: bool,
        /// Stages end when they have done their work (`exit`).
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
    /// Whether nothing is switched off.
    pub fn are_all(&self) -> bool {
        *self == Self::default()
    }

    /// Takes out of `recipe` what is switched off.
    pub(super) fn apply(self, recipe: &mut Recipe) {
        if !self.parameter_groups {
            forget(recipe, |param| param == Param::TrainedShare);
        }
        if !self.data_schedule {
            forget(recipe, |param| param.row().group == Group::Data);
        }
        if !self.loss_schedule {
            // A knob that the last stage does not name holds from the last stage that does.
            for param in Param::ALL.into_iter().filter(|param| param.is_of_loss()) {
                let last = recipe
                    .stage
                    .iter()
                    .rev()
                    .find_map(|stage| stage.params.get(&param).cloned());
                if let Some(knob) = last {
                    forget(recipe, |other| other == param);
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

fn forget(recipe: &mut Recipe, forgotten: impl Fn(Param) -> bool) {
    let stages = recipe.stage.iter_mut().map(|stage| &mut stage.params);
    for knobs in stages.chain([&mut recipe.params]) {
        knobs.retain(|param, _| !forgotten(*param));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_switch_takes_out_its_ingredient_and_no_other() {
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
            knobs.any(|param| param.is_of_loss())
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
            "what a run writes down is read as the same"
        );
    }
}

//! The background of a scene.

use crate::RunError;
use irradia_scene::{Dataset, LoadError};
use irradia_train::recipe::{Knob, Param};
use irradia_train::{Recipe, TrainError};
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// Background of photographs with alpha, and of a scene's splats or field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// White in training and evaluation, like the published figures of NeRF's synthetic scenes.
    White,
    /// Black in training and evaluation.
    Black,
    /// A random colour per training step, white in evaluation.
    Random,
}

impl Background {
    /// The colour, sRGB, in evaluation.
    pub fn color(self) -> [f32; 3] {
        match self {
            Self::White | Self::Random => [1.0; 3],
            Self::Black => [0.0; 3],
        }
    }

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::White => "white",
            Self::Black => "black",
            Self::Random => "random",
        }
    }

    /// Sets this background in `recipe`. Where the recipe already trains over random colours, it still does.
    pub(crate) fn apply_to(self, recipe: &mut Recipe) {
        recipe.render.background = self.color();
        if self == Self::Random {
            for stage in &mut recipe.stage {
                stage.params.remove(&Param::RandomBackground);
            }
            recipe.params.insert(Param::RandomBackground, Knob::Const(1.0));
        }
    }

    /// The default for a dataset: white for Blender scenes with transparent photographs, judged by the first one; the
    /// recipe's own for others.
    ///
    /// # Errors
    /// When that photograph cannot be read.
    pub fn usual(dataset: &Dataset) -> Result<Option<Self>, RunError> {
        let first = dataset.train.first().filter(|_| dataset.kind == "Blender");
        let Some(first) = first else { return Ok(None) };
        let photo = dataset.views[*first].photo.load();
        let photo = photo.map_err(|error: LoadError| RunError::Train(TrainError::Photo(error)))?;
        let transparent = photo.alpha().is_some_and(|alpha| alpha.iter().any(|a| *a < 255));
        Ok(transparent.then_some(Self::White))
    }
}

impl FromStr for Background {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = [Self::White, Self::Black, Self::Random]
            .into_iter()
            .find(|background| background.name() == text);
        found.ok_or_else(|| "expected white, black or random".into())
    }
}

/// Description of the training and evaluation background of `recipe`.
pub(crate) fn in_words(recipe: &Recipe) -> String {
    let color = match recipe.render.background {
        [1.0, 1.0, 1.0] => "white".to_owned(),
        [0.0, 0.0, 0.0] => "black".to_owned(),
        [r, g, b] => format!("sRGB {r}, {g}, {b}"),
    };
    let params = std::iter::once(&recipe.params).chain(recipe.stage.iter().map(|stage| &stage.params));
    let random = params
        .filter_map(|params| params.get(&Param::RandomBackground))
        .any(|knob| *knob != Knob::Const(0.0));
    if random {
        format!("{color}; trained over random colours if photographs have alpha")
    } else {
        color
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn random_applies_to_every_stage_and_white_and_black_keep_the_recipes_own() {
        let recipe = |name: &str| Recipe::parse(name, Recipe::built_in(name).unwrap(), &[]).unwrap();
        for name in ["fast", "hybrid"] {
            let mut changed = recipe(name);
            Background::Random.apply_to(&mut changed);
            let moments = irradia_train::schedule::outline(&changed, 100);
            assert!(
                moments
                    .iter()
                    .all(|moment| moment.values[Param::RandomBackground] == 1.0),
                "{name}"
            );
            assert_eq!(changed.render.background, [1.0; 3]);
            assert!(in_words(&changed).contains("random"));
        }
        let mut black = recipe("hashgrid");
        Background::Black.apply_to(&mut black);
        assert_eq!(black, recipe("hashgrid"));
        let mut white = recipe("fast");
        Background::White.apply_to(&mut white);
        assert_eq!(in_words(&white), "white");
    }
}

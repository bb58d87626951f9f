//! The background of a scene.

use crate::RunError;
use irradia_scene::{Dataset, LoadError, Photo};
use irradia_train::recipe::{Knob, Param};
use irradia_train::{Recipe, TrainError};
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// Photographs that are asked about their border.
const SAMPLES: usize = 8;
/// Share of a photograph's outermost pixels that are white if its object is cut out: it may touch the border.
const BORDER_SHARE: f64 = 0.9;
/// Least value of a white pixel: compression leaves some noise.
const WHITE: u8 = 250;
/// Largest value of a dark pixel: a black cloth under a flash is no perfect black.
const DARK: u8 = 64;
/// Share of the outermost pixels that are dark where objects stand before black: in the mean of the photographs, and in each. Of 40 captures, one such had
/// 0.93 and 0.71, the others at most 0.41 in the median of their photographs.
const DARK_SHARES: [f64; 2] = [0.8, 0.5];

/// The share of the outermost pixels of `photo` of which each value `holds`.
fn border_share(photo: &Photo, holds: impl Fn(u8) -> bool) -> f64 {
    let channels = photo.channels as usize;
    let all_hold = |at: &usize| {
        photo.data[at * channels..][..channels]
            .iter()
            .all(|value| holds(*value))
    };
    photo.border().filter(all_hold).count() as f64 / photo.border().count().max(1) as f64
}

/// Whether nearly all of the outermost pixels of `photo` are white.
fn has_white_border(photo: &Photo) -> bool {
    border_share(photo, |value| value >= WHITE) >= BORDER_SHARE
}

/// The share of dark ones.
fn dark_share(photo: &Photo) -> f64 {
    border_share(photo, |value| value <= DARK)
}

/// Background of photographs with alpha, and of a scene's splats or field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// White in training and evaluation, like the published figures of NeRF's synthetic scenes.
    White,
    /// Black in training and evaluation.
    Black,
    /// Grey in training and evaluation, and the surfaces in front cover it: what is left to see of it matters least.
    Grey,
    /// A random colour per training step, white in evaluation.
    Random,
}

impl Background {
    /// The colour, sRGB, in evaluation.
    pub fn color(self) -> [f32; 3] {
        match self {
            Self::White | Self::Random => [1.0; 3],
            Self::Black => [0.0; 3],
            Self::Grey => [0.5; 3],
        }
    }

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::White => "white",
            Self::Black => "black",
            Self::Grey => "grey",
            Self::Random => "random",
        }
    }

    /// Sets this background in `recipe`. Where the recipe already trains over random colours, it still does. Before one that photographs
    /// show, surfaces need not cover it.
    pub(crate) fn apply_to(self, recipe: &mut Recipe) {
        recipe.render.background = self.color();
        if self != Self::Grey {
            recipe.unset(Param::CoverWeight);
        }
        if self == Self::Random {
            recipe.unset(Param::RandomBackground);
            recipe.params.insert(Param::RandomBackground, Knob::Const(1.0));
        }
    }

    /// The default for a dataset: white for Blender scenes with transparent photographs, judged by the first one, and for
    /// photographs without alpha of objects cut out on white, judged by eight of them; black where photographs without alpha are dark around their object; grey
    /// for others without alpha if the recipe wants surfaces to cover it (`covers`); otherwise the recipe's own.
    ///
    /// # Errors
    /// When one of these photographs cannot be read.
    pub fn usual(dataset: &Dataset, covers: bool) -> Result<Option<Self>, RunError> {
        let load = |view: &usize| {
            let photo = dataset.views[*view].photo.load();
            photo.map_err(|error: LoadError| RunError::Train(TrainError::Photo(error)))
        };
        let Some(first) = dataset.train.first() else {
            return Ok(None);
        };
        let first = load(first)?;
        if let Some(alpha) = first.alpha() {
            let transparent = dataset.kind == "Blender" && alpha.iter().any(|a| *a < 255);
            return Ok(transparent.then_some(Self::White));
        }
        let grey = covers.then_some(Self::Grey);
        let every = dataset.train.len().div_ceil(SAMPLES);
        let (mut first, mut dark) = (Some(first), Vec::new());
        let (mut all_white, mut all_dark) = (true, true);
        for view in dataset.train.iter().step_by(every) {
            let photo = first.take().map_or_else(|| load(view), Ok)?;
            let share = dark_share(&photo);
            dark.push(share);
            all_white &= has_white_border(&photo);
            all_dark &= share >= DARK_SHARES[1];
            if !all_white && !all_dark {
                return Ok(grey);
            }
        }
        let is_dark = all_dark && dark.iter().sum::<f64>() >= DARK_SHARES[0] * dark.len() as f64;
        Ok(match (all_white, is_dark) {
            (true, _) => Some(Self::White),
            (_, true) => Some(Self::Black),
            _ => grey,
        })
    }
}

impl FromStr for Background {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = [Self::White, Self::Black, Self::Grey, Self::Random]
            .into_iter()
            .find(|background| background.name() == text);
        found.ok_or_else(|| "expected white, black, grey or random".into())
    }
}

/// Description of the training and evaluation background of `recipe`.
pub(crate) fn in_words(recipe: &Recipe) -> String {
    let color = match recipe.render.background {
        [1.0, 1.0, 1.0] => "white".to_owned(),
        [0.0, 0.0, 0.0] => "black".to_owned(),
        [0.5, 0.5, 0.5] => "grey".to_owned(),
        [r, g, b] => format!("sRGB {r}, {g}, {b}"),
    };
    if recipe.uses(Param::RandomBackground) {
        format!("{color}; trained over random colours if photographs have alpha")
    } else {
        color
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use irradia_scene::{Camera, Intrinsics, Pose, View};
    use std::sync::Arc;

    #[test]
    fn a_cut_out_object_may_touch_the_border_of_its_photograph() {
        let photo = |value: &dyn Fn(u32, u32) -> u8| Photo {
            width: 40,
            height: 20,
            channels: 3,
            data: (0..800).flat_map(|i| [value(i % 40, i / 40); 3]).collect(),
            mask: None,
        };
        assert!(has_white_border(&photo(&|_, _| 252)));
        assert!(has_white_border(&photo(&|x, y| if (15..25).contains(&x) && y > 5 {
            90
        } else {
            255
        })));
        // A table in the lower third.
        assert!(!has_white_border(&photo(&|_, y| if y > 13 { 200 } else { 255 })));
        assert!(!has_white_border(&photo(&|_, _| 240)));
        assert_eq!(dark_share(&photo(&|_, _| 30)), 1.0);
        let table = dark_share(&photo(&|_, y| if y > 13 { 200 } else { 30 }));
        assert!((0.5..0.6).contains(&table), "{table}");
    }

    #[test]
    fn surfaces_cover_grey_and_no_background_that_photographs_show() {
        let covers = |background: Background| {
            let mut recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
            background.apply_to(&mut recipe);
            (recipe.uses(Param::CoverWeight), in_words(&recipe))
        };
        assert_eq!(covers(Background::Grey), (true, "grey".into()));
        assert_eq!(covers(Background::White), (false, "white".into()));
        assert_eq!(covers(Background::Black), (false, "black".into()));
    }

    #[test]
    fn photographs_without_alpha_get_grey_from_recipes_that_cover_it_and_what_they_show_around_objects() {
        let dataset = |value: u8, channels: u32| {
            let photo = Photo {
                width: 8,
                height: 8,
                channels,
                data: vec![value; 64 * channels as usize],
                mask: None,
            };
            let view = View::new(
                "a",
                Camera::new(
                    Pose::look_at(Vec3::NEG_Z, Vec3::ZERO, Vec3::NEG_Y),
                    Intrinsics::from_fov_x(8, 8, 1.0),
                ),
                Arc::new(photo),
            );
            Dataset {
                views: vec![view],
                train: vec![0],
                ..Dataset::default()
            }
        };
        let usual = |value, channels, covers| Background::usual(&dataset(value, channels), covers).unwrap();
        assert_eq!(usual(90, 3, true), Some(Background::Grey));
        assert_eq!(usual(90, 3, false), None);
        assert_eq!(usual(255, 3, true), Some(Background::White));
        assert_eq!(usual(25, 3, true), Some(Background::Black));
        assert_eq!(usual(90, 4, true), None, "alpha shows what is empty");
    }

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

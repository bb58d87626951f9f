//! The background of a scene.

use crate::RunError;
use irradia_scene::{Dataset, LoadError, Photo};
use irradia_train::recipe::{Knob, Param};
use irradia_train::{Recipe, TrainError};
use serde::{Deserialize, Serialize};
use std::fmt::{self, Display, Formatter};
use std::str::FromStr;

/// Number of photographs that are examined, and their longer side, pixels.
const SAMPLED_PHOTOS: usize = 8;
const SAMPLE_SIDE: f32 = 400.0;
/// Minimum share of white pixels at the border of a photograph whose object is cut out; the object may touch the border.
const MIN_WHITE_BORDER_SHARE: f64 = 0.9;
/// Minimum value of a white pixel: compression leaves some noise.
const MIN_WHITE: u8 = 250;
/// Minimum channel value of a white backdrop, which may be shaded and tinted, and maximum channel value of a black one, which a flash may
/// brighten. Anything in between, such as floors and tables, counts as a surface.
const MIN_WHITE_BACKDROP: u8 = 224;
const MAX_BLACK_BACKDROP: u8 = 64;
/// Maximum difference of a backdrop's pixels from its colour, in each channel: cloth and paper have folds and shading.
const MAX_BACKDROP_DIFFERENCE: u8 = 24;
/// Minimum share of border pixels that show the backdrop: averaged over the photographs, and in each.
const MIN_BACKDROP_SHARES: [f64; 2] = [0.8, 0.5];
/// Width of a mask's rim, pixels: near the edge of a generous mask, kept pixels still show what is behind the object.
const RIM_WIDTH: usize = 3;
/// Minimum share of border pixels that masks exclude if they exclude the surroundings of an object, and minimum share of rim pixels that
/// have the backdrop's colour, both averaged over the photographs. Measured: 0.79 and 0.98 for a medal in front of dark blue, 0.99 and
/// 0.63 for a plush dog in front of paper, 0.97 and 0.2 for a box cut out along its outlines; masks of people and of whatever holds the
/// camera exclude less of the border, and their rim shows the scene.
const MIN_EXCLUDED_SHARE: f64 = 0.6;
const MIN_RIM_SHARE: f64 = 0.5;

/// Colours of pixels at the edge of the known part of a photograph: at its border, or at the rim of its mask.
type Border = Vec<[u8; 3]>;

fn colors(photo: &Photo, at: impl Iterator<Item = usize>) -> Border {
    let channels = photo.channels as usize;
    at.map(|at| std::array::from_fn(|c| photo.data[at * channels + c]))
        .collect()
}

fn border(photo: &Photo) -> Border {
    colors(photo, photo.border())
}

/// The rim pixels of `mask`: those on its kept side if `keeps`, otherwise those on its excluded side.
fn rim(photo: &Photo, mask: &[u8], keeps: bool) -> Border {
    let (width, height) = (photo.width as usize, photo.height as usize);
    let around = |at: usize, end: usize| at.saturating_sub(RIM_WIDTH)..(at + RIM_WIDTH + 1).min(end);
    let is_kept = |at: usize| mask[at] != 0;
    let is_rim = |at: &usize| {
        let (x, y) = (at % width, at / width);
        let mut near = around(y, height).flat_map(|y| around(x, width).map(move |x| y * width + x));
        is_kept(*at) == keeps && near.any(|at| is_kept(at) != keeps)
    };
    colors(photo, (0..width * height).filter(is_rim))
}

/// The pixels that `mask` excludes.
fn excluded(photo: &Photo, mask: &[u8]) -> Border {
    colors(photo, (0..mask.len()).filter(|at| mask[*at] == 0))
}

/// The share of the pixels for which `holds` is true.
fn share(border: &Border, holds: impl Fn([u8; 3]) -> bool) -> f64 {
    border.iter().filter(|color| holds(**color)).count() as f64 / border.len().max(1) as f64
}

/// Whether nearly all of the pixels are white.
fn is_white(border: &Border) -> bool {
    share(border, |color| color.iter().all(|value| *value >= MIN_WHITE)) >= MIN_WHITE_BORDER_SHARE
}

/// The median of each channel.
fn median(colors: &[[u8; 3]]) -> [u8; 3] {
    std::array::from_fn(|c| {
        let mut values: Vec<u8> = colors.iter().map(|color| color[c]).collect();
        values.sort_unstable();
        values.get(values.len() / 2).copied().unwrap_or(0)
    })
}

/// The typical colour of `borders`: the median of their medians.
fn typical_color(borders: &[Border]) -> [u8; 3] {
    let medians: Vec<[u8; 3]> = borders.iter().map(|border| median(border)).collect();
    median(&medians)
}

/// For each of `borders`, the share of its pixels that are near `color`.
fn shares_near(borders: &[Border], color: [u8; 3]) -> Vec<f64> {
    let is_near = |other: [u8; 3]| {
        other
            .iter()
            .zip(color)
            .all(|(a, b)| a.abs_diff(b) <= MAX_BACKDROP_DIFFERENCE)
    };
    borders.iter().map(|border| share(border, is_near)).collect()
}

/// The colour of the backdrop behind an object, of which masks keep only a rim, if it has a single colour: splats then need not represent
/// it. Held-out PSNR of unmasked pixels, 480 pixels, 60 s, over grey and over the rim's colour: medal 18.3, 23.4 dB; dog 29.7, 30.9. The
/// rim contains the object's shadow, whereas the excluded pixels show the backdrop itself if it continues beyond the rim. With the rim's
/// colour and with that of the excluded pixels, 1,500 steps: dog 30.26, 30.81 dB; medal 24.32, 24.97; a temple, part of whose rim is
/// cloth in front of black, 2,000 steps: 32.12, 36.41.
fn masked_backdrop(photos: &[Photo]) -> Option<[u8; 3]> {
    let left_out = photos.iter().map(Photo::border_left_out).sum::<f64>() / photos.len() as f64;
    if left_out < MIN_EXCLUDED_SHARE {
        return None;
    }
    let of_each = |part: &dyn Fn(&Photo, &[u8]) -> Border| {
        let parts = photos
            .iter()
            .filter_map(|photo| Some(part(photo, photo.mask.as_deref()?)));
        parts.filter(|part| !part.is_empty()).collect::<Vec<Border>>()
    };
    let shows = |rims: &[Border], color: [u8; 3]| {
        let shares = shares_near(rims, color);
        shares.iter().sum::<f64>() >= MIN_RIM_SHARE * shares.len().max(1) as f64
    };
    let [kept, beside] = [true, false].map(|keeps| of_each(&|photo, mask| rim(photo, mask, keeps)));
    let backdrop = typical_color(&of_each(&excluded));
    if shows(&kept, typical_color(&beside)) && shows(&beside, backdrop) {
        return Some(backdrop);
    }
    let color = typical_color(&kept);
    shows(&kept, color).then_some(color)
}

/// The colour of the white or black cloth, paper or box that all photographs have around their object, if there is one.
fn backdrop(borders: &[Border]) -> Option<[u8; 3]> {
    let color = typical_color(borders);
    let shares = shares_near(borders, color);
    let is_possible = color.iter().all(|value| *value >= MIN_WHITE_BACKDROP)
        || color.iter().all(|value| *value <= MAX_BLACK_BACKDROP);
    let [in_mean, in_each] = MIN_BACKDROP_SHARES;
    let is_backdrop = is_possible
        && shares.iter().all(|share| *share >= in_each)
        && shares.iter().sum::<f64>() >= in_mean * shares.len() as f64;
    is_backdrop.then_some(color)
}

/// Background of photographs with alpha, and of a scene's splats or field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum Background {
    /// White in training and evaluation, like the published figures of NeRF's synthetic scenes.
    White,
    /// Black in training and evaluation.
    Black,
    /// Grey in training and evaluation, and trained surfaces cover it: grey does least harm where it still shows.
    Grey,
    /// A random colour per training step, white in evaluation.
    Random,
    /// This colour, sRGB, in training and evaluation.
    Color([u8; 3]),
}

/// A view's photograph at a size that suffices for its colours at large.
fn load_small(dataset: &Dataset, view: usize) -> Result<Photo, RunError> {
    let view = &dataset.views[view];
    let k = view.camera.intrinsics;
    let small = k.scaled((SAMPLE_SIDE / k.width.max(k.height) as f32).min(1.0));
    let photo = view.photo.load_at(small.width, small.height);
    photo.map_err(|error: LoadError| RunError::Train(TrainError::Photo(error)))
}

/// Whether a part of the photograph is transparent.
fn is_transparent(photo: &Photo) -> bool {
    photo.alpha().is_some_and(|alpha| alpha.iter().any(|a| *a < 255))
}

/// Whether `dataset` is a rendered scene, with exact poses and empty space that is transparent: it has the layout of Blender scenes, and its
/// first photograph is transparent somewhere. Others use the layout for photographs: a toy filmed with a phone (lambkin108/TensoRF_mydata),
/// 88 frames, 500 steps, has 16.75 dB if it is taken for a rendered scene, and 27.59 dB with matched points.
pub fn is_rendered(dataset: &Dataset) -> bool {
    let is_transparent = |view: &usize| load_small(dataset, *view).is_ok_and(|photo| is_transparent(&photo));
    dataset.kind == "Blender" && dataset.train.first().is_some_and(is_transparent)
}

impl Background {
    /// The colour, sRGB, in evaluation.
    pub fn color(self) -> [f32; 3] {
        match self {
            Self::White | Self::Random => [1.0; 3],
            Self::Black => [0.0; 3],
            Self::Grey => [0.5; 3],
            Self::Color(color) => color.map(|value| f32::from(value) / 255.0),
        }
    }

    /// Sets this background in `recipe`. A recipe that already trains over random colours still does. Surfaces need not cover a background
    /// that the photographs show.
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

    /// The default for a dataset:
    ///
    /// - white for Blender scenes with transparent photographs, judged by the first one;
    /// - white for opaque photographs of objects cut out on white, judged by about eight of them;
    /// - the colour of the backdrop if opaque photographs have one around their object, or at the rim of their masks;
    /// - grey for other opaque photographs if the recipe wants surfaces to cover it (`covers`);
    /// - otherwise the recipe's own (`None`).
    ///
    /// # Errors
    /// When one of these photographs cannot be read.
    pub fn default_for(dataset: &Dataset, covers: bool) -> Result<Option<Self>, RunError> {
        let load = |view: &usize| load_small(dataset, *view);
        let Some(first) = dataset.train.first() else {
            return Ok(None);
        };
        let first = load(first)?;
        if is_transparent(&first) {
            return Ok((dataset.kind == "Blender").then_some(Self::White));
        }
        let every = dataset.train.len().div_ceil(SAMPLED_PHOTOS);
        let others = dataset.train.iter().step_by(every).skip(1).map(load);
        let photos: Vec<Photo> = std::iter::once(Ok(first)).chain(others).collect::<Result<_, _>>()?;
        let borders: Vec<Border> = photos.iter().map(border).collect();
        if borders.iter().all(is_white) {
            return Ok(Some(Self::White));
        }
        // The mask of a wide lens only excludes what is outside its image circle.
        let is_wide = |view: &usize| dataset.views[*view].camera.intrinsics.lens.is_wide();
        let backdrop = if photos.iter().all(|photo| photo.mask.is_none()) {
            backdrop(&borders)
        } else if dataset.train.iter().any(is_wide) {
            None
        } else {
            masked_backdrop(&photos)
        };
        Ok(backdrop.map(Self::Color).or(covers.then_some(Self::Grey)))
    }
}

/// The name on the command line.
impl Display for Background {
    fn fmt(&self, f: &mut Formatter) -> fmt::Result {
        match self {
            Self::White => f.write_str("white"),
            Self::Black => f.write_str("black"),
            Self::Grey => f.write_str("grey"),
            Self::Random => f.write_str("random"),
            Self::Color([r, g, b]) => write!(f, "#{r:02x}{g:02x}{b:02x}"),
        }
    }
}

impl From<Background> for String {
    fn from(background: Background) -> Self {
        background.to_string()
    }
}

impl TryFrom<String> for Background {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl FromStr for Background {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // The American spelling is read as well.
        let name = if text == "gray" { "grey" } else { text };
        let named = [Self::White, Self::Black, Self::Grey, Self::Random]
            .into_iter()
            .find(|background| background.to_string() == name);
        let color = || {
            let is_hex = |digits: &&str| digits.len() == 6 && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
            let digits = text.strip_prefix('#').filter(is_hex)?;
            let value = u32::from_str_radix(digits, 16).ok()?;
            let [_, color @ ..] = value.to_be_bytes();
            Some(Self::Color(color))
        };
        named
            .or_else(color)
            .ok_or_else(|| "expected white, black, grey, random or a colour such as #c8c0b4".into())
    }
}

/// Description of the training and evaluation background of `recipe`.
pub(crate) fn description(recipe: &Recipe) -> String {
    let color = match recipe.render.background {
        [1.0, 1.0, 1.0] => "white".to_owned(),
        [0.0, 0.0, 0.0] => "black".to_owned(),
        [0.5, 0.5, 0.5] => "grey".to_owned(),
        color => Background::Color(color.map(|value| (255.0 * value).round() as u8)).to_string(),
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

    /// The border of a photograph of 40 x 20 grey values.
    fn border_of(value: &dyn Fn(u32, u32) -> u8) -> Border {
        border(&Photo {
            width: 40,
            height: 20,
            channels: 3,
            data: (0..800).flat_map(|i| [value(i % 40, i / 40); 3]).collect(),
            mask: None,
        })
    }

    #[test]
    fn a_cut_out_object_may_touch_the_border_of_its_photograph() {
        assert!(is_white(&border_of(&|_, _| 252)));
        assert!(is_white(&border_of(&|x, y| if (15..25).contains(&x) && y > 5 {
            90
        } else {
            255
        })));
        // A table in the lower third.
        assert!(!is_white(&border_of(&|_, y| if y > 13 { 200 } else { 255 })));
        assert!(!is_white(&border_of(&|_, _| 240)));
    }

    #[test]
    fn a_backdrop_is_around_the_object_in_every_photograph() {
        let cloth = |shade: u8| border_of(&move |x, _| shade + (x % 20) as u8);
        assert_eq!(backdrop(&[cloth(10), cloth(14), cloth(6)]), Some([20; 3]));
        let table = border_of(&|_, y| if y > 13 { 200 } else { 20 });
        assert_eq!(backdrop(&[cloth(10), cloth(10), table.clone()]), Some([20; 3]));
        assert_eq!(backdrop(&[table.clone(), table.clone(), cloth(10)]), None);
        assert_eq!(backdrop(&[cloth(10), cloth(60), cloth(10), cloth(10)]), None);
        assert_eq!(backdrop(&[cloth(230), cloth(226)]), Some([240; 3]));
        assert_eq!(backdrop(&[cloth(170), cloth(170)]), None, "a floor");
    }

    #[test]
    fn colours_are_written_as_they_are_read() {
        for text in ["white", "black", "grey", "random", "#0c0b0d"] {
            let background: Background = text.parse().unwrap();
            assert_eq!(background.to_string(), text);
            let json = serde_json::to_string(&background).unwrap();
            assert_eq!(json, format!("\"{text}\""));
            assert_eq!(serde_json::from_str::<Background>(&json).unwrap(), background);
        }
        assert_eq!("gray".parse(), Ok(Background::Grey));
        for text in ["pink", "#fff", "#+12345", "#0c0b0é", ""] {
            assert!(text.parse::<Background>().is_err(), "{text}");
        }
    }

    #[test]
    fn surfaces_cover_grey_and_no_background_that_photographs_show() {
        let covers = |background: Background| {
            let mut recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
            background.apply_to(&mut recipe);
            (recipe.uses(Param::CoverWeight), description(&recipe))
        };
        assert_eq!(covers(Background::Grey), (true, "grey".into()));
        assert_eq!(covers(Background::White), (false, "white".into()));
        assert_eq!(covers(Background::Black), (false, "black".into()));
    }

    #[test]
    fn photographs_without_alpha_get_grey_from_recipes_that_cover_it_and_what_they_show_around_objects() {
        let masked_dataset = |value: &dyn Fn(usize) -> u8, channels: u32, mask| {
            let photo = Photo {
                width: 8,
                height: 8,
                channels,
                data: (0..64 * channels as usize).map(value).collect(),
                mask,
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
        let usual = |value: &dyn Fn(usize) -> u8, channels, covers| {
            Background::default_for(&masked_dataset(value, channels, None), covers).unwrap()
        };
        let uniform = |value: u8| move |_: usize| value;
        let striped = |i: usize| if (i / 3).is_multiple_of(2) { 20 } else { 160 };
        assert_eq!(usual(&striped, 3, true), Some(Background::Grey));
        assert_eq!(usual(&striped, 3, false), None);
        assert_eq!(usual(&uniform(255), 3, true), Some(Background::White));
        assert_eq!(usual(&uniform(25), 3, true), Some(Background::Color([25; 3])));
        assert_eq!(usual(&uniform(90), 4, true), None, "alpha shows what is empty");

        // An object of 3 x 3 pixels, its backdrop, and masks that keep both, only the object, or all but a corner.
        let is_object = |at: usize| [at % 8, at / 8].iter().all(|i| (2..5).contains(i));
        let object = |i: usize| {
            if is_object(i / 3) {
                [90, 60, 20][i % 3] + 50 * ((i / 3) % 8 - 2) as u8
            } else {
                140
            }
        };
        let masked = |keeps: &dyn Fn(usize) -> bool| {
            let mask = (0..64).map(|at| if keeps(at) { 255 } else { 0 }).collect();
            Background::default_for(&masked_dataset(&object, 3, Some(mask)), true).unwrap()
        };
        let inside = |at: usize| [at % 8, at / 8].iter().all(|i| (1..7).contains(i));
        assert_eq!(masked(&inside), Some(Background::Color([140; 3])));
        // The object's shadow at the rim, and black painted over what a mask excludes.
        let at_rim = |rim: u8, outside: u8| {
            let value = move |i: usize| if inside(i / 3) { rim } else { outside };
            let mask = (0..64).map(|at| if inside(at) { 255 } else { 0 }).collect();
            Background::default_for(&masked_dataset(&value, 3, Some(mask)), true).unwrap()
        };
        assert_eq!(at_rim(130, 150), Some(Background::Color([150; 3])));
        assert_eq!(at_rim(130, 0), Some(Background::Color([130; 3])));
        assert_eq!(masked(&is_object), Some(Background::Grey), "the rim shows the object");
        assert_eq!(masked(&|at| at > 2), Some(Background::Grey), "nothing is cut out");
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
            assert!(description(&changed).contains("random"));
        }
        let mut black = recipe("hashgrid");
        Background::Black.apply_to(&mut black);
        assert_eq!(black, recipe("hashgrid"));
        let mut white = recipe("fast");
        Background::White.apply_to(&mut white);
        assert_eq!(description(&white), "white");
    }
}

//! A recipe: a training configuration, as a file. Raw TOML, then overrides, then this validated value.

mod ablation;
mod assignment;
mod check;
mod choice;
mod density;
mod field;
pub mod keys;
mod param;
mod table;

pub use ablation::Ingredients;
use assignment::apply;
pub use assignment::is_assigned;
pub use choice::Choice;
pub use density::{ClassicSettings, DensityControl, FastSettings, McmcSettings, MergeSettings, TamingSettings};
pub use field::{FieldSettings, FieldSpace, ResidualSettings};
use irradia_splat::regularize::Regularized;
use keys::documented;
pub use param::{Knob, Params, Shape, Values};
use serde::{Deserialize, Serialize};
pub use table::{Group, Param, Row};

/// The built-in recipes: name and text.
pub const BUILT_IN: [(&str, &str); 12] = [
    ("classic", include_str!("../../recipes/classic.toml")),
    ("absgrad", include_str!("../../recipes/absgrad.toml")),
    ("mcmc", include_str!("../../recipes/mcmc.toml")),
    ("mcmc-tuned", include_str!("../../recipes/mcmc-tuned.toml")),
    ("taming", include_str!("../../recipes/taming.toml")),
    ("fast", include_str!("../../recipes/fast.toml")),
    ("curriculum", include_str!("../../recipes/curriculum.toml")),
    ("curriculum-paper", include_str!("../../recipes/curriculum-paper.toml")),
    ("hashgrid", include_str!("../../recipes/hashgrid.toml")),
    ("nerf", include_str!("../../recipes/nerf.toml")),
    ("shiny", include_str!("../../recipes/shiny.toml")),
    ("hybrid", include_str!("../../recipes/hybrid.toml")),
];

/// Why a recipe is invalid: one line that names the key.
#[derive(Debug, thiserror::Error)]
pub enum RecipeError {
    /// No such built-in recipe.
    #[error("no recipe is called `{name}`; there are {known}, or give the path of a .toml file")]
    Unknown {
        /// The requested name.
        name: String,
        /// The known names.
        known: String,
    },
    /// Not TOML, or not of this structure.
    #[error("recipe {origin}: {message}")]
    Invalid {
        /// File or built-in name.
        origin: String,
        /// One line.
        message: String,
    },
    /// An invalid `--set`.
    #[error("--set {assignment}: {message}")]
    Override {
        /// As given.
        assignment: String,
        /// One line.
        message: String,
    },
}

documented! {
    /// A training configuration.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct Recipe {
        /// Short name.
        pub name: String,
        /// Description and origin.
        pub about: String,
        /// Maximum number of splats; at least 1.
        pub max_splats: usize,
        /// Maximum number of splats per pixel of a training image, averaged over views, above 0; no such limit when absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub splats_per_pixel: Option<f32>,
        /// Distance from each training camera within which splats up to 60 degrees from its axis are removed at every round of density
        /// control, as a fraction of the depth of the nearest points that its view sees (or of its depth bounds); at most a seventh of that
        /// where points that the view need not show are closer; 0 for none. If it is above 0 and photographs are at least 8 degrees apart, splats that only one of them
        /// sees, among other cameras and away from points, are moved far away.
        #[serde(default, skip_serializing_if = "is_default")]
        pub free_space: f32,
        /// The length to which `rate_means` is relative, in pixels of the training images at the distance of each splat from the camera of
        /// the step; 0: the largest distance of a camera from their mean, as in 3DGS, which says little about how large the scene is in the
        /// images.
        #[serde(default, skip_serializing_if = "is_default")]
        pub extent_pixels: f32,
        /// Exponent of the rates' dependence on the length of a run that is longer than the recipe: with 0.5 a run of four times the
        /// recipe's steps has half the rates; 0 for none.
        #[serde(default, skip_serializing_if = "is_default")]
        pub length_exponent: f32,
        /// Minimum number of steps per training photograph in a run without a number of steps or a budget, up to ten times the recipe's own
        /// length; 0: such a run always has the recipe's own length.
        #[serde(default, skip_serializing_if = "is_default")]
        pub visits: u64,
        /// Maximum number of steps per training photograph in a run without a number of steps, if adjacent photographs are 8 degrees apart
        /// or more, as seen from what they show; the run has at least a fifth of the recipe's own length. If they are closer, the limit
        /// applies to runs with a budget, grows in inverse proportion to the angle, and is at least the recipe's own length. A budget that
        /// allows more is not used up. 0: no limit.
        #[serde(default, skip_serializing_if = "is_default")]
        pub sparse_visits: u64,
        /// Assignments, each as for `--set`, for runs with neither a number of steps nor a budget: changes that pay only in runs of the
        /// recipe's length. Other settings take precedence.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        pub unhurried: Vec<String>,
        /// Steps between evaluations of the held-out views during training, of 32 of them if there are more; at least 1.
        pub eval_every: u64,
        /// Steps between checkpoints; at least 1.
        pub checkpoint_every: u64,
        /// How frames are rendered.
        pub render: RenderSettings,
        /// The first splats.
        pub init: InitSettings,
        /// Adam's constants.
        pub adam: AdamSettings,
        /// Options of the regularisers.
        #[serde(default, skip_serializing_if = "RegularizerSettings::is_default")]
        pub regularizers: RegularizerSettings,
        /// The active ingredients of a curriculum.
        #[serde(default, skip_serializing_if = "Ingredients::all_active")]
        pub ingredients: Ingredients,
        /// The radiance field of the stages that train one.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub field: Option<FieldSettings>,
        /// Train a separate exposure and white balance, an affine colour map, for each photograph; with `auto` if, after a tenth
        /// of the run, photographs differ in exposure beyond what adjacent cameras predict.
        #[serde(default, skip_serializing_if = "Choice::is_disabled")]
        pub exposure: Choice,
        /// Train the vignette of each lens, a polynomial in the distance from the principal point, the same in all of its photographs. The
        /// scene does not contain it; held-out views are compared with it.
        #[serde(default, skip_serializing_if = "is_default")]
        pub vignette: bool,
        /// Train a separate grid of affine colour maps for each photograph, by position and brightness: tone mapping.
        #[serde(default, skip_serializing_if = "is_default")]
        pub bilateral_grid: bool,
        /// Leave out photographs whose error, after a fifth of the run, is far beyond the others': wrong poses, or another scene.
        #[serde(default, skip_serializing_if = "is_default")]
        pub drop_misfits: bool,
        /// Hide from training what only one photograph shows, such as people who walk through; the first search is after 0.3 of the run.
        #[serde(default, skip_serializing_if = "is_default")]
        pub hide_transients: bool,
        /// Refine the cameras' poses.
        #[serde(default, skip_serializing_if = "is_default")]
        pub refine_poses: bool,
        /// A field that adds to the splats' colours.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub residual: Option<ResidualSettings>,
        /// A field of position, with a code for each photograph, that adds to the splats' colours what the light of the photograph changes;
        /// active if `rate_codes` is above 0, and left out on a GPU.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub appearance: Option<ResidualSettings>,
        /// Parameters over the whole run; a stage may override them.
        pub params: Params,
        /// Parameters that replace those of `params` if the data show where space is empty: the dataset has points, or the photographs have
        /// alpha, or masks that leave out all but an object. `--set` of the same parameter in `params` takes precedence.
        #[serde(default, skip_serializing_if = "Params::is_empty")]
        pub known_space: Params,
        /// The same, if masks leave out all but an object.
        #[serde(default, skip_serializing_if = "Params::is_empty")]
        pub cut_out: Params,
        /// The same, if the sky differs from photograph to photograph; `known_space` takes precedence.
        #[serde(default, skip_serializing_if = "Params::is_empty")]
        pub skies: Params,
        /// The same, if there are at least 50 training photographs with a mean of more than 0.8 million pixels; not for wide lenses.
        #[serde(default, skip_serializing_if = "Params::is_empty")]
        pub large: Params,
        /// The stages, in order.
        pub stage: Vec<Stage>,
    }
}

documented! {
    /// How frames are rendered.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct RenderSettings {
        /// Background colour, sRGB, each channel 0 to 1; images with alpha are composited over it.
        pub background: [f32; 3],
        /// Scale opacities by the area ratio of the 0.3 pixel dilation.
        pub antialias: bool,
        /// Limit the resolution of splats to the sampling rate of the training views (Mip-Splatting's 3D smoothing filter).
        #[serde(default)]
        pub smoothing_filter: bool,
    }
}

documented! {
    /// The first splats.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct InitSettings {
        /// Opacity, between 0 and 1.
        pub opacity: f32,
        /// Opacity of splats at random positions, most of them in empty space; `init.opacity` when absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub random_opacity: Option<f32>,
        /// Size as a factor on the distance to the nearest neighbours, above 0.
        pub scale: f32,
        /// Number of splats if the dataset has no points.
        pub random_points: usize,
    }
}

documented! {
    /// Adam's constants.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct AdamSettings {
        /// Decay of the first moment.
        pub beta1: f32,
        /// Decay of the second moment.
        pub beta2: f32,
        /// Added to the root of the second moment.
        pub epsilon: f32,
        /// `dense`: all splats step, with a gradient of zero if not visible in the frame, as in 3DGS. `sparse`: splats that are not
        /// visible keep parameters and moments.
        #[serde(default, skip_serializing_if = "AdamKind::is_sparse")]
        pub kind: AdamKind,
    }
}

/// Which splats Adam updates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AdamKind {
    /// Those with a gradient.
    #[default]
    Sparse,
    /// All.
    Dense,
}

impl AdamKind {
    fn is_sparse(&self) -> bool {
        *self == Self::Sparse
    }
}

documented! {
    /// Options of the regularisers.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct RegularizerSettings {
        /// The splats over which they are averaged: `visible`, those visible in the frame, or `all`.
        #[serde(default)]
        pub of: RegularizedKind,
        /// Unit of sizes, here and in `noise`: `extent`, the scene's, but at most the depth of what most views show, or `world`, the
        /// dataset's own.
        #[serde(default)]
        pub unit: LengthUnit,
    }
}

impl RegularizerSettings {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// Splats to regularise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RegularizedKind {
    /// Those visible in the frame.
    #[default]
    Visible,
    /// All.
    All,
}

impl From<RegularizedKind> for Regularized {
    fn from(kind: RegularizedKind) -> Self {
        match kind {
            RegularizedKind::Visible => Self::Visible,
            RegularizedKind::All => Self::All,
        }
    }
}

/// A unit of length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LengthUnit {
    /// The scene's extent, but at most the depth of what most views show.
    #[default]
    Extent,
    /// The dataset's own unit.
    World,
}

documented! {
    /// A part of the run.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct Stage {
        /// Short name, unique in the recipe.
        pub name: String,
        /// Its length in recipe steps, at least 1: `--steps` and `--budget` stretch or compress the whole run.
        pub steps: u64,
        /// What it trains, `splats` or `field`. Splats after a field begin as its surfaces.
        #[serde(default, skip_serializing_if = "Represents::is_splats")]
        pub represents: Represents,
        /// Parameters over this stage.
        #[serde(default)]
        pub params: Params,
        /// How splats are added and removed; absent: they are not.
        #[serde(default)]
        pub density: Option<DensityControl>,
        /// How adjacent splats are merged; absent: they are not.
        #[serde(default)]
        pub merge: Option<MergeSettings>,
        /// When the stage may end before its steps are completed; never if absent.
        #[serde(default)]
        pub exit: Option<Exit>,
    }
}

/// What a stage trains.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Represents {
    /// 3D Gaussians.
    #[default]
    Splats,
    /// A radiance field.
    Field,
}

impl Represents {
    fn is_splats(&self) -> bool {
        *self == Self::Splats
    }
}

documented! {
    /// When a stage may end early: rules on S, the mean L1 error over the training views (CurriculumGS's S_t), which is estimated
    /// continuously and measured at intervals.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(tag = "when", rename_all = "snake_case", deny_unknown_fields)]
    pub enum Exit {
        /// S falls below `tau`.
        Threshold {
            /// Mean absolute difference of colours in \[0, 1\].
            tau: f64,
        },
        /// S falls below `ratio` times its value when the stage had seen every view once at the present size: a tau without tuning.
        Relative {
            /// Fraction of the first S in the stage at the present image size.
            ratio: f64,
        },
        /// S has not fallen by the fraction `drop` within `window` recipe steps.
        Plateau {
            /// Fraction of the best S so far.
            drop: f64,
            /// Recipe steps.
            window: u64,
        },
    }
}

impl Recipe {
    /// The text of the built-in recipe `name`.
    ///
    /// # Errors
    /// When there is none, naming the known ones.
    pub fn built_in(name: &str) -> Result<&'static str, RecipeError> {
        BUILT_IN
            .iter()
            .find(|(n, _)| *n == name)
            .map(|(_, text)| *text)
            .ok_or_else(|| RecipeError::Unknown {
                name: name.to_owned(),
                known: BUILT_IN.map(|(n, _)| n).join(", "),
            })
    }

    /// Parses `text`, applies `overrides` (`stage.grow.params.ssim_weight=0.3`, `max_splats=50000`) and validates.
    ///
    /// # Errors
    /// One line that names the key and, for an unknown one, the nearest known one.
    pub fn parse(origin: &str, text: &str, overrides: &[String]) -> Result<Self, RecipeError> {
        let invalid = |message: String| RecipeError::Invalid {
            origin: origin.to_owned(),
            message,
        };
        let table: toml::Table = text
            .parse()
            .map_err(|e: toml::de::Error| invalid(format!("{}{}", one_line(&e), location(&e))))?;
        let mut root = toml::Value::Table(table);
        for assignment in overrides {
            apply(&mut root, assignment).map_err(|message| RecipeError::Override {
                assignment: assignment.clone(),
                message,
            })?;
        }
        let mut recipe = Self::deserialize(root).map_err(|e| {
            let message = format!("{}{}", suggest(&one_line(&e)), location(&e));
            let given: Vec<String> = overrides.iter().map(|o| format!("--set {o}")).collect();
            match &given[..] {
                [] => invalid(message),
                _ => invalid(format!("{message} (with {})", given.join(", "))),
            }
        })?;
        recipe.validate().map_err(invalid)?;
        let is_set = |param: &Param| is_assigned(overrides, &format!("params.{}", param.name()));
        for params in recipe.conditional_mut() {
            params.retain(|param, _| !is_set(param));
        }
        recipe.complete_sockets();
        let ingredients = recipe.ingredients;
        ingredients.apply(&mut recipe);
        Ok(recipe)
    }

    /// Adds a rate for components in sockets if the recipe has none: a value that falls over the run, like all others.
    fn complete_sockets(&mut self) {
        let mut default = |wanted: bool, param: Param, from: f64, to: f64| {
            if wanted {
                let shape = Shape::Log;
                let ramp = Knob::Ramp {
                    from: Some(from),
                    to,
                    shape,
                };
                self.params.entry(param).or_insert(ramp);
            }
        };
        let (exposure, grid, poses) = (self.exposure != Choice::No, self.bilateral_grid, self.refine_poses);
        // A photograph is used 30 to 100 times in a run, in which gains of 1.6 must be reachable.
        default(exposure, Param::RateExposure, 0.03, 0.001);
        default(exposure, Param::ExposureReg, 0.01, 0.001);
        // The vignette must be learned before splats explain it.
        default(self.vignette, Param::RateVignette, 0.01, 0.001);
        default(grid, Param::RateBilateral, 0.01, 0.0005);
        default(grid, Param::BilateralTv, 30.0, 30.0);
        // Half a degree (9e-3) within as many steps.
        default(poses, Param::RatePoses, 1e-3, 1e-5);
    }

    /// The resolved recipe as TOML, as written to the run's folder.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a recipe is always valid TOML")
    }

    /// A hash of the resolved recipe (FNV-1a, 64 bits, hexadecimal), which identifies runs of the same recipe.
    pub fn hash(&self) -> String {
        let hash = self.to_toml().bytes().fold(0xcbf2_9ce4_8422_2325u64, |h, b| {
            (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3)
        });
        format!("{hash:016x}")
    }

    /// Whether `param`, zero by default, has another value in some stage.
    pub fn uses(&self, param: Param) -> bool {
        let params = std::iter::once(&self.params).chain(self.stage.iter().map(|stage| &stage.params));
        params
            .filter_map(|params| params.get(&param))
            .any(|knob| *knob != Knob::Const(0.0))
    }

    /// The field for the light of photographs, if it is active.
    pub(crate) fn light(&self) -> Option<&ResidualSettings> {
        self.appearance.as_ref().filter(|_| self.uses(Param::RateCodes))
    }

    /// Removes `param` from the recipe and all stages, so that it has its default.
    pub fn unset(&mut self, param: Param) {
        let params = std::iter::once(&mut self.params).chain(self.stage.iter_mut().map(|stage| &mut stage.params));
        params.for_each(|params| drop(params.remove(&param)));
    }

    /// Puts SH bands up to `degree` in use from the first step on.
    pub(crate) fn keep_sh_bands(&mut self, degree: u32) {
        let param = Param::ShDegree;
        if let (false, Some(first)) = (self.params.contains_key(&param), self.stage.first_mut()) {
            // Not over the whole run, since that would replace what later stages carry over.
            let default = Knob::Const(param.row().default);
            first.params.entry(param).or_insert(default);
        }
        let raise = |params: &mut Params| {
            if let Some(knob) = params.get_mut(&param) {
                knob.raise_to(f64::from(degree));
            }
        };
        raise(&mut self.params);
        self.conditional_mut().into_iter().for_each(raise);
        self.stage.iter_mut().for_each(|stage| raise(&mut stage.params));
    }

    /// The tables of parameters that depend on the data.
    fn conditional_mut(&mut self) -> [&mut Params; 4] {
        [
            &mut self.known_space,
            &mut self.cut_out,
            &mut self.skies,
            &mut self.large,
        ]
    }

    /// Recipe steps of all stages.
    pub fn total_steps(&self) -> u64 {
        self.stage.iter().map(|s| s.steps).sum()
    }
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

fn one_line(error: &toml::de::Error) -> String {
    error.message().lines().collect::<Vec<_>>().join(" ")
}

/// The position of an error: line and column, or the key. Only the error's long form contains it.
fn location(error: &toml::de::Error) -> String {
    let long = error.to_string();
    let in_text = long.lines().next().and_then(|line| line.split_once(" at line "));
    let in_key = long.lines().find_map(|line| line.strip_prefix("in "));
    match (in_text, in_key) {
        (Some((_, position)), _) => format!(", at line {position}"),
        (None, Some(key)) => format!(", in {key}"),
        (None, None) => String::new(),
    }
}

/// Adds the nearest known key to serde's "unknown field `x`, expected one of `a`, `b`".
fn suggest(message: &str) -> String {
    let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
    if !message.starts_with("unknown") || names.len() < 2 {
        return message.to_owned();
    }
    let unknown = names[0];
    let nearest = names[1..]
        .iter()
        .min_by_key(|known| edit_distance(unknown, known))
        .expect("at least one");
    format!("unknown key `{unknown}`; the nearest known one is `{nearest}`")
}

/// Levenshtein distance.
fn edit_distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let substituted = diagonal + usize::from(ca != *cb);
            diagonal = row[j + 1];
            row[j + 1] = substituted.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(overrides: &[&str]) -> Result<Recipe, String> {
        let overrides: Vec<String> = overrides.iter().map(|s| (*s).to_owned()).collect();
        Recipe::parse("classic", Recipe::built_in("classic").unwrap(), &overrides).map_err(|e| e.to_string())
    }

    #[test]
    fn every_built_in_recipe_is_valid_and_round_trips() {
        for (name, text) in BUILT_IN {
            let recipe = Recipe::parse(name, text, &[]).unwrap();
            assert_eq!(recipe.name, name);
            assert!(Recipe::parse(name, text, &recipe.unhurried).is_ok());
            let again = Recipe::parse(name, &recipe.to_toml(), &[]).unwrap();
            assert_eq!((again.hash(), &again), (recipe.hash(), &recipe));
        }
    }

    #[test]
    fn overrides_reach_stages_by_name_and_change_the_hash() {
        let recipe = parse(&["stage.grow.params.ssim_weight=0.3", "max_splats=777", "name=mine"]).unwrap();
        let grow = recipe.stage.iter().find(|s| s.name == "grow").unwrap();
        assert_eq!(grow.params[&Param::SsimWeight], Knob::Const(0.3));
        assert_eq!((recipe.max_splats, recipe.name.as_str()), (777, "mine"));
        assert_ne!(recipe.hash(), parse(&[]).unwrap().hash());
        let ramp = parse(&["params.rate_means={ from = 1e-3, to = 1e-5, shape = 'cosine' }"]).unwrap();
        assert_eq!(
            ramp.params[&Param::RateMeans],
            Knob::Ramp {
                from: Some(1e-3),
                to: 1e-5,
                shape: Shape::Cosine
            }
        );
    }

    #[test]
    fn unknown_keys_are_rejected_with_the_nearest_known_one() {
        for (bad, near) in [
            ("max_splat=5", "max_splats"),
            ("params.ssim_wieght=0.2", "ssim_weight"),
            ("init.opacty=0.2", "opacity"),
            ("stage.grow.density.evry=3", "every"),
        ] {
            let message = parse(&[bad]).unwrap_err();
            assert!(
                message.contains(&format!("nearest known one is `{near}`")),
                "{bad}: {message}"
            );
        }
        assert!(
            parse(&["stage.groww.steps=3"])
                .unwrap_err()
                .contains("there are warmup, grow")
        );
    }

    #[test]
    fn invalid_values_are_rejected_by_name() {
        for (bad, part) in [
            ("stage.grow.steps=0", "stage.grow.steps"),
            ("params.ssim_weight=1.5", "params.ssim_weight: 1.5"),
            ("params.rate_means={ to = 0.0, shape = 'log' }", "log ramp"),
            ("params.sh_degree={ steps = [[5, 1]] }", "start at 0"),
            ("params.sh_degree={ steps = [[0, 1]], to = 3 }", "expected a number"),
            ("params.sh_degree=true", "in `params.sh_degree`"),
            ("init.opacity=1", "init.opacity"),
            ("adam.epsilon=0", "adam.epsilon"),
            ("adam.beta1=1", "adam.beta1"),
            ("nonsense", "key=value"),
            ("name.deeper=3", "inside a string"),
        ] {
            let message = parse(&[bad]).unwrap_err();
            assert!(message.contains(part) && !message.contains('\n'), "{bad}: {message}");
        }
        assert!(Recipe::built_in("clasic").unwrap_err().to_string().contains("classic"));
        assert!(Recipe::parse("x.toml", "name = ", &[]).is_err());
    }
}

//! Training requests: raw input, and the validated request.

use crate::pose::{find_points, lacks_points};
use crate::{Background, Reading, RunError, RunFolder, is_moved, moved_from_dataset, scene_path};
use irradia_compute::DeviceChoice;
use irradia_formats::{DEFAULT_MAX_SIDE, DatasetOptions, Lenses, read_dataset, read_splats};
use irradia_scene::{Dataset, sh};
use irradia_splat::Splats;
use irradia_train::Recipe;
use irradia_train::paces::Paces;
use irradia_train::recipe::{Param, Represents, is_assigned};
use irradia_train::schedule::{OutlinePoint, outline};
use serde::{Deserialize, Serialize};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// How to get LPIPS weights, in terms of the command line.
pub const HOW_TO_GET_LPIPS: &str = "import the weights once with irradia lpips --import FEATURES HEADS, or name a file or a \
                                    folder with --lpips or IRRADIA_LPIPS";

/// The default recipe: the best for its time on all scenes of RESULTS.md.
pub const DEFAULT_RECIPE: &str = "fast";

/// Maximum factor by which many photographs lengthen a recipe: 30,000 steps of `fast`, as many as 3DGS makes.
const MAX_LENGTH_FACTOR: u64 = 10;

/// A training request, not validated; stored in `run.json`. A new option is a field here, with its bounds in
/// [`TrainInput::check`].
///
/// ```
/// use irradia_runs::TrainInput;
///
/// let input = TrainInput { steps: Some(2000), ..TrainInput::new("photos", "run") };
/// assert_eq!(input.clone().check()?.recipe().name, "fast");
///
/// let nonsense = TrainInput { steps: Some(0), ..input };
/// assert_eq!(nonsense.check().unwrap_err().to_string(), "steps 0: must be 1 or more");
/// # Ok::<(), irradia_runs::RunError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainInput {
    /// The dataset's folder.
    pub data: PathBuf,
    /// The run's folder.
    #[serde(skip)]
    pub out: PathBuf,
    /// A built-in recipe, or a `.toml` file.
    #[serde(default = "default_recipe")]
    pub recipe: String,
    /// Overrides of the recipe, each `key=value`.
    #[serde(default)]
    pub set: Vec<String>,
    /// Maximum number of splats; the recipe's own limit if `None`.
    #[serde(default)]
    pub max_splats: Option<usize>,
    /// Number of steps into which the recipe is fitted; its own number if `None`.
    pub steps: Option<u64>,
    /// Seconds of training into which the recipe is fitted, all of them also if the run is resumed; not together with `steps`.
    pub budget: Option<f64>,
    /// The folder of a run whose steps are repeated at their recorded pace; not together with `steps` or `budget`.
    #[serde(default)]
    pub replay: Option<PathBuf>,
    /// Held-out PSNR at which to stop, dB.
    pub until_psnr: Option<f64>,
    /// Memory of the whole process, bytes; three quarters of what is free if `None`.
    #[serde(default)]
    pub memory: Option<usize>,
    /// Random seed.
    pub seed: u64,
    /// Weights of LPIPS. Without them a recipe's perceptual loss is skipped and reports have no LPIPS.
    #[serde(default)]
    pub lpips: Option<PathBuf>,
    /// Weights of a second network of LPIPS, which only scores: a recipe with a perceptual loss is trained on the first one.
    #[serde(default)]
    pub unseen_lpips: Option<PathBuf>,
    /// How the dataset is read.
    #[serde(flatten)]
    pub reading: Reading,
    /// The background of the scene. `None`: what [`Background::default_for`] finds in the photographs, otherwise the recipe's.
    #[serde(default)]
    pub background: Option<Background>,
    /// A scene with whose splats the training begins: a file or a run's folder, in the coordinates of the dataset.
    #[serde(default)]
    pub from: Option<PathBuf>,
    /// Whether to find points by matching the photographs if the dataset has none; otherwise splats begin at random positions.
    #[serde(default)]
    pub match_points: bool,
    /// Where the scene is trained: `cpu`, `gpu`, `auto` (a real GPU if there is one), or a part of a GPU's name.
    #[serde(default = "default_device")]
    pub device: String,
    /// Whether to replace an existing run in `out`.
    #[serde(skip)]
    pub overwrite: bool,
}

fn default_device() -> String {
    DeviceChoice::default().to_string()
}

fn default_recipe() -> String {
    DEFAULT_RECIPE.into()
}

impl TrainInput {
    /// A request to train on the dataset in `data` with the default recipe and to write the run to `out`.
    pub fn new(data: impl Into<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self {
            data: data.into(),
            out: out.into(),
            recipe: default_recipe(),
            set: Vec::new(),
            max_splats: None,
            steps: None,
            budget: None,
            replay: None,
            until_psnr: None,
            memory: None,
            seed: 0,
            lpips: None,
            unseen_lpips: None,
            reading: Reading::default(),
            background: None,
            from: None,
            match_points: true,
            device: default_device(),
            overwrite: false,
        }
    }

    /// The request of the run in the folder `out`, to resume it: its recipe is the resolved one in that folder. Photographs that were posed
    /// for the run are found in it wherever it was moved, and without its list of held-out views these are known by name. The dataset, limits
    /// and weights may be changed before [`TrainInput::check`].
    ///
    /// # Errors
    /// When the folder contains no run, or its `run.json` is damaged.
    pub fn of_run(out: impl AsRef<Path>) -> Result<Self, RunError> {
        let out = out.as_ref();
        let (folder, record) = RunFolder::open(out)?;
        let mut input = record.input;
        input.out = out.to_owned();
        input.recipe = folder.file("recipe.toml").display().to_string();
        input.set.clear();
        input.max_splats = None;
        if input.budget.is_some() {
            // A run may get a budget when it is resumed; the budget then replaces the steps.
            input.steps = None;
        }
        Ok(input)
    }

    /// A request to repeat the run in the folder `run` in the folder `out`: the same data, recipe and seed, each step at its recorded
    /// pace, so that the scene has the same bytes even if a budget set the pace by the clock.
    ///
    /// # Errors
    /// Those of [`TrainInput::of_run`].
    pub fn replay_of(run: impl AsRef<Path>, out: impl Into<PathBuf>) -> Result<Self, RunError> {
        let run = run.as_ref();
        Ok(Self {
            out: out.into(),
            steps: None,
            budget: None,
            replay: Some(std::path::absolute(run).unwrap_or_else(|_| run.to_owned())),
            ..Self::of_run(run)?
        })
    }

    /// All changes of the recipe.
    fn overrides(&self) -> Vec<String> {
        let most = self.max_splats.map(|n| format!("max_splats={n}"));
        self.set.iter().cloned().chain(most).collect()
    }

    /// The validated request: every setting in range, the recipe read and resolved. Neither the dataset nor the run's folder is
    /// accessed.
    ///
    /// # Errors
    /// [`RunError::Setting`] or [`RunError::Recipe`], for the first setting that is out of range.
    pub fn check(mut self) -> Result<TrainRequest, RunError> {
        let started = Instant::now();
        at_least_one("steps", self.steps)?;
        at_least_one("max_splats", self.max_splats)?;
        at_least_one("memory", self.memory)?;
        if let Some(seconds) = self.budget.filter(|seconds| !(*seconds > 0.0 && seconds.is_finite())) {
            return Err(RunError::setting("budget", seconds, "must be more than 0 seconds"));
        }
        if let (Some(steps), Some(_)) = (self.steps, self.budget) {
            return Err(RunError::setting("steps", steps, "cannot be combined with a budget"));
        }
        if let (Some(_), Some(steps)) = (&self.replay, self.steps) {
            return Err(RunError::setting("steps", steps, "cannot be combined with a replay"));
        }
        if let (Some(_), Some(budget)) = (&self.replay, self.budget) {
            return Err(RunError::setting("budget", budget, "cannot be combined with a replay"));
        }
        if let Some(psnr) = self.until_psnr.filter(|psnr| !psnr.is_finite()) {
            return Err(RunError::setting("until_psnr", psnr, "must be a number of dB"));
        }
        self.reading = self.reading.with_absolute_paths();
        let reading = self.reading.check()?;
        let recipe = read_recipe(&self.recipe, &self.overrides())?;
        self.data = absolute(self.data);
        self.lpips = self.lpips.map(absolute);
        self.unseen_lpips = self.unseen_lpips.map(absolute);
        if let Some(from) = &mut self.from {
            if recipe.stage[0].represents == Represents::Field {
                let message = format!("recipe {} begins with a field, not with splats", recipe.name);
                return Err(RunError::setting("from", from.display(), message));
            }
            *from = std::path::absolute(&from).unwrap_or(std::mem::take(from));
        }
        Ok(TrainRequest {
            input: self,
            recipe,
            reading,
            started,
        })
    }
}

pub(crate) fn absolute(path: PathBuf) -> PathBuf {
    std::path::absolute(&path).unwrap_or(path)
}

fn at_least_one<N: PartialOrd + From<u8> + Display>(name: &'static str, value: Option<N>) -> Result<(), RunError> {
    match value {
        Some(value) if value < N::from(1) => Err(RunError::setting(name, value, "must be 1 or more")),
        _ => Ok(()),
    }
}

/// The built-in recipe or `.toml` file `name`, modified by `overrides`, each `key=value`.
///
/// # Errors
/// [`RunError::Recipe`]; a file that cannot be read is [`RunError::Refused`].
pub fn read_recipe(name: &str, overrides: &[String]) -> Result<Recipe, RunError> {
    let text = if name.ends_with(".toml") {
        std::fs::read_to_string(name).map_err(|e| RunError::Refused(format!("cannot read recipe {name}: {e}")))?
    } else {
        Recipe::built_in(name)?.to_owned()
    };
    Ok(Recipe::parse(name, &text, overrides)?)
}

/// Whether the recipe's loss contains LPIPS at any time.
pub fn has_perceptual_loss(recipe: &Recipe) -> bool {
    let has_perceptual_weight = |moment: &OutlinePoint| moment.values[Param::PerceptualWeight] > 0.0;
    outline(recipe, 1000).iter().any(has_perceptual_weight)
}

/// A validated request, created by [`TrainInput::check`]; one request is one run.
#[derive(Debug)]
pub struct TrainRequest {
    pub(crate) input: TrainInput,
    pub(crate) recipe: Recipe,
    reading: DatasetOptions,
    /// Start time for a report's `total_seconds`.
    pub(crate) started: Instant,
}

impl TrainRequest {
    /// The input; its dataset's path is absolute.
    pub fn input(&self) -> &TrainInput {
        &self.input
    }

    /// The resolved recipe.
    pub fn recipe(&self) -> &Recipe {
        &self.recipe
    }

    /// Reads the dataset; the caller shows its `warnings`.
    ///
    /// # Errors
    /// When the folder contains no dataset that can be trained on.
    pub fn read_dataset(&self) -> Result<Dataset, RunError> {
        Ok(read_dataset(&self.input.data, &self.reading)?)
    }

    /// Whether a run on `dataset` finds points by matching its photographs, which takes a moment per photograph: it does if the dataset has
    /// no points and no initial splats are given. Rendered scenes need no points, since their alpha shows what is empty.
    pub fn should_match_points(&self, dataset: &Dataset) -> bool {
        self.input.match_points && self.input.from.is_none() && lacks_points(dataset)
    }

    /// `dataset`, with points added if [`Self::should_match_points`], and a message about what was found. The points are the same for any
    /// number of threads.
    pub(crate) fn with_points(&self, mut dataset: Dataset) -> (Dataset, Option<String>) {
        if !self.should_match_points(&dataset) {
            return (dataset, None);
        }
        // Small images show fewer features, and matching needs pinholes.
        let mut larger = self.reading.clone();
        (larger.downscale, larger.max_side, larger.lenses) = (1.0, Some(DEFAULT_MAX_SIDE), Lenses::Undistorted);
        let same_views = |larger: &Dataset| {
            let names = larger.views.iter().map(|view| &view.name);
            names.eq(dataset.views.iter().map(|view| &view.name))
        };
        let larger = if larger == self.reading {
            None
        } else {
            read_dataset(&self.input.data, &larger).ok().filter(same_views)
        };
        let message = match find_points(&mut dataset, larger.as_ref()) {
            Some(points) => format!("the dataset has no points: {points} were found by matching its photographs"),
            None => "the dataset has no points, and matching its photographs found too few".to_owned(),
        };
        (dataset, Some(message))
    }

    /// Parts of the request that cannot be satisfied, one line each.
    pub fn warnings(&self) -> Vec<String> {
        let missing = self.input.lpips.is_none() && has_perceptual_loss(&self.recipe);
        let line = || {
            format!(
                "recipe {} is trained without its perceptual loss: the run has no LPIPS weights; {HOW_TO_GET_LPIPS}",
                self.recipe.name
            )
        };
        missing.then(line).into_iter().collect()
    }

    /// If neither steps, budget nor replay are given, puts the recipe's changes for such runs before those of the input, which take
    /// precedence.
    pub(crate) fn apply_unhurried_changes(&mut self) -> Result<(), RunError> {
        let input = &mut self.input;
        let is_free = input.steps.is_none() && input.budget.is_none() && input.replay.is_none();
        if is_free && !self.recipe.unhurried.is_empty() {
            input.set.splice(0..0, self.recipe.unhurried.iter().cloned());
            self.recipe = read_recipe(&input.recipe, &input.overrides())?;
        }
        Ok(())
    }

    /// Sets the number of steps if the input gives neither steps, budget nor replay, and the recipe's own length would visit each
    /// photograph too rarely.
    pub(crate) fn choose_length(&mut self, dataset: &Dataset) {
        let own = self.recipe.total_steps();
        let wanted = self.recipe.visits.saturating_mul(dataset.train.len() as u64);
        let input = &mut self.input;
        if wanted > own && input.steps.is_none() && input.budget.is_none() && input.replay.is_none() {
            input.steps = Some(wanted.min(MAX_LENGTH_FACTOR * own));
        }
    }

    /// Sets the default background for the photographs if neither the input nor its overrides of the recipe set one.
    pub(crate) fn choose_background(&mut self, dataset: &Dataset) -> Result<(), RunError> {
        if self.input.replay.is_some() && self.input.background.is_none() {
            // The recipe of the run to repeat already contains it.
            return Ok(());
        }
        let is_set = is_assigned(&self.input.set, "render.background");
        if self.input.background.is_none() {
            if is_set {
                self.recipe.unset(Param::CoverWeight);
            } else {
                let covers = self.recipe.uses(Param::CoverWeight);
                self.input.background = Background::default_for(dataset, covers)?;
            }
        }
        if let Some(background) = self.input.background {
            background.apply_to(&mut self.recipe);
        }
        Ok(())
    }

    /// The initial splats, in the world of `dataset`, with room for all SH bands, and whether they need antialiasing.
    pub(crate) fn initial_splats(&self, dataset: &Dataset) -> Result<Option<(Splats, bool)>, RunError> {
        let Some(from) = &self.input.from else { return Ok(None) };
        let path = scene_path(from);
        match moved_from_dataset(&path, dataset) {
            Some(moved) if moved.is_identity() && !is_moved(&path) => {}
            Some(_) => {
                return Err(RunError::Refused(format!(
                    "{} was moved away from its photographs: start from a scene whose edits do not move all of it",
                    path.display()
                )));
            }
            None => {
                return Err(RunError::Refused(format!(
                    "{} was trained with other poses than those of {}: name the dataset on which it was trained",
                    path.display(),
                    self.input.data.display()
                )));
            }
        }
        let mut cloud = read_splats(&path)?;
        if cloud.is_empty() {
            return Err(RunError::Refused(format!(
                "{} contains no splats to start from",
                path.display()
            )));
        }
        if let Some(most) = self.input.max_splats.filter(|most| *most < cloud.len()) {
            return Err(RunError::setting(
                "max_splats",
                most,
                format!(
                    "{} has {} splats: reduce it first: irradia edit {0} -o fewer.ply \"reduce count={most}\"",
                    path.display(),
                    cloud.len()
                ),
            ));
        }
        cloud.bring_to_world(dataset.world_from_dataset);
        cloud.set_degree(sh::MAX_DEGREE);
        Ok(Some((Splats::from_cloud(&cloud), cloud.antialiased)))
    }

    /// The paces of the run to repeat.
    pub(crate) fn paces(&self) -> Result<Option<Paces>, RunError> {
        let run = self.input.replay.as_deref();
        run.map(|run| RunFolder::open(run)?.0.paces()).transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_without_a_given_length_has_the_changes_of_its_recipe_for_it() {
        let finest = |change: fn(&mut TrainInput)| {
            let mut input = TrainInput::new("photos", "run");
            input.recipe = "hashgrid".into();
            change(&mut input);
            let mut request = input.check().expect("valid");
            request.apply_unhurried_changes().expect("valid");
            let encoding = request.recipe.field.as_ref().expect("a field").net.encoding;
            (
                format!("{encoding:?}").contains("finest: 1024"),
                request.input.set.len(),
            )
        };
        assert_eq!(finest(|_| ()), (true, 2));
        assert_eq!(finest(|input| input.budget = Some(60.0)), (false, 0));
        assert_eq!(finest(|input| input.steps = Some(60)), (false, 0));
        let set = |input: &mut TrainInput| input.set = vec!["field.net.encoding.finest=512".into()];
        assert_eq!(finest(set), (false, 3), "what is set takes precedence");
    }

    #[test]
    fn a_background_that_is_set_in_any_form_is_kept() {
        for change in [
            " render.background=[1,0,0]",
            "render={background=[1,0,0],antialias=false}",
        ] {
            let mut input = TrainInput::new("photos", "run");
            input.set = vec![change.to_owned()];
            let mut request = input.check().expect("valid");
            request.choose_background(&Dataset::default()).expect("set");
            assert_eq!(request.recipe.render.background, [1.0, 0.0, 0.0], "{change}");
            assert!(!request.recipe.uses(Param::CoverWeight), "{change}");
        }
    }

    #[test]
    fn many_photographs_make_a_run_longer_unless_its_length_is_given() {
        let steps = |views: usize, input: TrainInput| {
            let mut request = input.check().expect("valid");
            request.choose_length(&Dataset {
                train: (0..views).collect(),
                ..Dataset::default()
            });
            request.input.steps
        };
        let input = || TrainInput::new("photos", "run");
        assert_eq!(steps(50, input()), None, "the recipe's own");
        assert_eq!(steps(100, input()), Some(6_000));
        assert_eq!(steps(5_000, input()), Some(30_000));
        let given = TrainInput {
            steps: Some(700),
            ..input()
        };
        assert_eq!(steps(100, given), Some(700));
        let budget = TrainInput {
            budget: Some(60.0),
            ..input()
        };
        assert_eq!(steps(100, budget), None);
        let published = TrainInput {
            recipe: "classic".into(),
            ..input()
        };
        assert_eq!(steps(5_000, published), None);
    }
}

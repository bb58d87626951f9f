//! Which values of a recipe are accepted.

use super::param::check_knob;
use super::{AdamSettings, DensityControl, Exit, MergeSettings, Recipe, Represents};

/// A number of a recipe: its key, its value, whether it is in range, and the range in words.
pub(super) type Checked = (&'static str, f32, bool, &'static str);

pub(super) fn at_least_one(key: &'static str, steps: u64) -> Checked {
    (key, steps as f32, steps >= 1, "1 or more")
}

pub(super) fn not_negative(key: &'static str, value: f32) -> Checked {
    (key, value, value >= 0.0, "0 or more")
}

pub(super) fn opacity(key: &'static str, value: f32) -> Checked {
    (key, value, (0.0..1.0).contains(&value), "at least 0 and below 1")
}

pub(super) fn reset_to(value: f32) -> Checked {
    ("reset_to", value, value > 0.0 && value < 1.0, "above 0 and below 1")
}

/// Names the first number that is out of range.
pub(super) fn check(values: &[Checked]) -> Result<(), String> {
    match values.iter().find(|(_, _, is_valid, _)| !is_valid) {
        Some((key, value, _, range)) => Err(format!("{key} is {value}: it must be {range}")),
        None => Ok(()),
    }
}

impl Recipe {
    /// Checks every value.
    ///
    /// # Errors
    /// One line that names the key.
    pub(super) fn validate(&self) -> Result<(), String> {
        let values = toml::Value::try_from(self).expect("a recipe is always valid TOML");
        check_finite(&values, "")?;
        let AdamSettings {
            beta1, beta2, epsilon, ..
        } = self.adam;
        for (name, beta) in [("beta1", beta1), ("beta2", beta2)] {
            if !(0.0..1.0).contains(&beta) {
                return Err(format!("adam.{name} = {beta} must be at least 0 and below 1"));
            }
        }
        if epsilon <= 0.0 {
            return Err(format!(
                "adam.epsilon = {epsilon} must be above 0: splats without a gradient would turn into NaN"
            ));
        }
        if self.stage.is_empty() {
            return Err("there must be at least one [[stage]]".into());
        }
        if self.max_splats == 0 || self.eval_every == 0 || self.checkpoint_every == 0 {
            return Err("max_splats, eval_every and checkpoint_every must be at least 1".into());
        }
        check(&[
            not_negative("free_space", self.free_space),
            not_negative("extent_pixels", self.extent_pixels),
            not_negative("length_exponent", self.length_exponent),
        ])?;
        if let Some(value) = self.splats_per_pixel.filter(|value| *value <= 0.0) {
            return Err(format!(
                "splats_per_pixel is {value}: it must be above 0, or absent for no such limit"
            ));
        }
        if let Some(value) = self
            .render
            .background
            .iter()
            .find(|value| !(0.0..=1.0).contains(*value))
        {
            return Err(format!(
                "render.background has a channel of {value}: each must be 0 to 1, such as in [1, 1, 1] for white"
            ));
        }
        let opacities = [self.init.opacity, self.init.random_opacity.unwrap_or(self.init.opacity)];
        if opacities.iter().any(|opacity| !(*opacity > 0.0 && *opacity < 1.0)) || self.init.scale <= 0.0 {
            return Err("init.opacity and random_opacity must be between 0 and 1 and init.scale above 0".into());
        }
        if let Some(field) = &self.field {
            field.validate()?;
        }
        for (name, settings, images) in [("residual", &self.residual, 0), ("appearance", &self.appearance, 1)] {
            if let Some(settings) = settings {
                settings.validate(name, images)?;
            }
        }
        for (i, stage) in self.stage.iter().enumerate() {
            self.validate_order(i)?;
            if stage.steps == 0 {
                return Err(format!("stage.{}.steps must be at least 1", stage.name));
            }
            if self.stage[..i].iter().any(|s| s.name == stage.name) {
                return Err(format!("two stages are called {}", stage.name));
            }
            let density = stage.density.as_ref().map_or(Ok(()), DensityControl::validate);
            density.map_err(|why| format!("stage.{}.density.{why}", stage.name))?;
            let merge = stage.merge.as_ref().map_or(Ok(()), MergeSettings::validate);
            merge.map_err(|why| format!("stage.{}.merge.{why}", stage.name))?;
            let sensible = match stage.exit {
                None => true,
                Some(Exit::Threshold { tau }) => tau > 0.0,
                Some(Exit::Relative { ratio }) => ratio > 0.0 && ratio < 1.0,
                Some(Exit::Plateau { drop, window }) => (0.0..1.0).contains(&drop) && window > 0,
            };
            if !sensible {
                return Err(format!(
                    "stage.{}.exit: tau and window must be above 0, ratio and drop between 0 and 1",
                    stage.name
                ));
            }
        }
        let everywhere = [
            ("params".to_owned(), &self.params),
            ("known_space".to_owned(), &self.known_space),
            ("cut_out".to_owned(), &self.cut_out),
            ("skies".to_owned(), &self.skies),
            ("large".to_owned(), &self.large),
        ];
        let stages = self
            .stage
            .iter()
            .map(|s| (format!("stage.{}.params", s.name), &s.params));
        for (place, params) in everywhere.into_iter().chain(stages) {
            for (param, knob) in params {
                check_knob(*param, knob).map_err(|why| format!("{place}.{}: {why}", param.name()))?;
            }
        }
        Ok(())
    }

    /// Checks that what stage `i` trains can follow the stage before it.
    fn validate_order(&self, i: usize) -> Result<(), String> {
        let stage = &self.stage[i];
        let before = i.checked_sub(1).map(|before| self.stage[before].represents);
        let name = &stage.name;
        match (stage.represents, before) {
            (Represents::Field, _) if self.field.is_none() => {
                Err(format!("stage.{name} trains a field, but there is no [field]"))
            }
            (Represents::Field, Some(Represents::Splats)) => Err(format!("stage.{name}: a field cannot follow splats")),
            (Represents::Field, _) if stage.density.is_some() || stage.merge.is_some() => {
                Err(format!("stage.{name}: a field has neither density control nor merging"))
            }
            (Represents::Splats, Some(Represents::Field)) if self.field.as_ref().is_none_or(|f| f.points == 0) => Err(
                format!("stage.{name} begins with splats on a field's surfaces: set their number in field.points"),
            ),
            _ => Ok(()),
        }
    }
}

/// Checks that every number in `value` is finite; `path` is its key.
fn check_finite(value: &toml::Value, path: &str) -> Result<(), String> {
    let key = |name: &str| {
        if path.is_empty() {
            name.to_owned()
        } else {
            format!("{path}.{name}")
        }
    };
    match value {
        toml::Value::Float(value) if !value.is_finite() => Err(format!("{path}: {value} is not a finite number")),
        toml::Value::Table(table) => table.iter().try_for_each(|(name, item)| check_finite(item, &key(name))),
        // Stages are known by name.
        toml::Value::Array(items) => items.iter().try_for_each(|item| {
            let name = item.get("name").and_then(toml::Value::as_str);
            check_finite(item, &name.map_or_else(|| path.to_owned(), key))
        }),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_without_a_meaning_are_rejected_by_name() {
        for (name, bad, says) in [
            ("fast", "init.scale=nan", "init.scale: NaN is not a finite number"),
            ("fast", "init.scale=1e300", "init.scale: inf is not a finite number"),
            ("fast", "init.scale=0", "init.scale above 0"),
            (
                "fast",
                "render.background=[nan,0,0]",
                "render.background: NaN is not a finite number",
            ),
            (
                "fast",
                "render.background=[0.5,-3,0]",
                "render.background has a channel of -3: ",
            ),
            ("fast", "render.background=[255,0,0]", "each must be 0 to 1"),
            (
                "fast",
                "splats_per_pixel=nan",
                "splats_per_pixel: NaN is not a finite number",
            ),
            ("fast", "splats_per_pixel=-1", "splats_per_pixel is -1: "),
            (
                "fast",
                "params.rate_means=inf",
                "params.rate_means: inf is not a finite number",
            ),
            (
                "fast",
                "params.rate_means={ to = inf }",
                "params.rate_means.to: inf is not a finite number",
            ),
            (
                "fast",
                "stage.grow.density.error_threshold=nan",
                "stage.grow.density.error_threshold: NaN is not a finite number",
            ),
            (
                "fast",
                "stage.grow.density.floor=-5",
                "stage.grow.density.floor is -5: it must be 0 or more",
            ),
            (
                "fast",
                "stage.grow.density.every=0",
                "stage.grow.density.every is 0: it must be 1 or more",
            ),
            (
                "classic",
                "stage.grow.density.reset_to=1",
                "stage.grow.density.reset_to is 1: ",
            ),
            (
                "mcmc",
                "stage.grow.density.growth=0.5",
                "stage.grow.density.growth is 0.5: ",
            ),
            (
                "taming",
                "stage.grow.density.edge_share=2",
                "stage.grow.density.edge_share is 2: ",
            ),
            (
                "taming",
                "stage.grow.density.score_error=-1",
                "stage.grow.density.score_error is -1: ",
            ),
            (
                "classic",
                "stage.grow.merge={ every = 100, distance = -1, color = 0.1 }",
                "stage.grow.merge.distance is -1: ",
            ),
            (
                "classic",
                "stage.grow.exit={ when = 'threshold', tau = inf }",
                "stage.grow.exit.tau: inf is not a finite number",
            ),
            (
                "hashgrid",
                "field.opaque_density_bias=nan",
                "field.opaque_density_bias: NaN is not a finite number",
            ),
        ] {
            let text = Recipe::built_in(name).expect("built in");
            let error = Recipe::parse(name, text, &[bad.to_owned()]).expect_err(bad).to_string();
            assert!(error.contains(says) && !error.contains('\n'), "{bad}: {error}");
        }
    }
}

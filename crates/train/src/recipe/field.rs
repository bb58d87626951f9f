//! The knobs of a radiance field.

use super::keys::documented;
use irradia_field::net::NetShape;
use irradia_field::{FieldConfig, Outside, Sampler, Space};
use serde::{Deserialize, Serialize};

documented! {
    /// A radiance field, for the stages that train one.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct FieldKnobs {
        /// Where it lives: `auto`, `bounded`, `unbounded` or `ndc`.
        #[serde(default)]
        pub space: FieldSpace,
        /// Samples of a step: the number of rays follows from it.
        pub samples: usize,
        /// Decay of Adam's second moment.
        pub beta2: f32,
        /// Splats that a later stage of splats begins with at most; 0 without such a stage.
        #[serde(default)]
        pub points: usize,
        /// Degree in direction, 0 to 3, of a background that is learnt with the field, for photographs without alpha; absent: what
        /// lies behind is fixed or random.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub background_degree: Option<u32>,
        /// Takes the place of the networks' `density_bias` where photographs have no alpha: there is something in each of their
        /// pixels, and a field that begins dense enough to hide what lies behind learns at once; absent: as it is.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub opaque_density_bias: Option<f32>,
        /// The network that gives out colour: `encoding`, `width`, `depth`, `skip`, `geometry`, `activation`, `density_bias`, `color`;
        /// see `NetShape` of the crate `irradia-field`.
        pub net: NetShape,
        /// Where along a ray samples lie: `kind` is `occupancy`, `hierarchy` or `proposal`; see `Sampler` of the crate `irradia-field`.
        pub sampler: Sampler,
    }
}

documented! {
    /// A small field that adds a view-dependent colour to splats: reflections that harmonics cannot hold.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct ResidualKnobs {
        /// Decay of Adam's second moment.
        pub beta2: f32,
        /// Whether it is asked by the direction that a mirror would show, across the splat's shortest axis, and not by that of
        /// view (Ref-NeRF, Verbin et al. 2022): what surroundings a place reflects then depends little on the place.
        pub mirrored: bool,
        /// Its network, as `field.net`, of which the density is not used.
        pub net: NetShape,
    }
}

impl ResidualKnobs {
    pub(super) fn validate(&self) -> Result<(), String> {
        if !(0.0..1.0).contains(&self.beta2) {
            return Err("residual.beta2 must lie between 0 and 1".into());
        }
        let checked = FieldConfig::residual(self.net, self.mirrored).check();
        checked.map_err(|error| format!("residual: {error}"))
    }
}

/// Where a field lives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FieldSpace {
    /// `ndc` where every view names its depth bounds (LLFF captures), `bounded` where every photograph has alpha,
    /// `unbounded` elsewhere.
    #[default]
    Auto,
    /// The cube that the cameras look at.
    Bounded,
    /// That cube, and the rest of the world contracted around it (mip-NeRF 360).
    Unbounded,
    /// Normalised device coordinates of a forward-facing capture (NeRF).
    Ndc,
}

impl FieldKnobs {
    /// For `images` photographs in `space`: steps grow with distance only where space is unbounded, and behind photographs with
    /// alpha (`transparent`) there is nothing to learn or to hide.
    pub fn config(&self, images: usize, space: &Space, transparent: bool) -> FieldConfig {
        let mut sampler = self.sampler.clone();
        if let (Sampler::Occupancy(occupancy), false) = (&mut sampler, space.outside == Outside::Contracted) {
            occupancy.steps.cone = 0.0;
        }
        let bias = self.opaque_density_bias.filter(|_| !transparent);
        FieldConfig {
            net: NetShape {
                density_bias: bias.unwrap_or(self.net.density_bias),
                ..self.net
            },
            sampler,
            images,
            background_degree: self.background_degree.filter(|_| !transparent),
        }
    }

    pub(super) fn validate(&self) -> Result<(), String> {
        if self.samples == 0 || !(0.0..1.0).contains(&self.beta2) {
            return Err("field.samples must be at least 1 and field.beta2 between 0 and 1".into());
        }
        if matches!(self.sampler, Sampler::Given { .. }) {
            return Err("field.sampler cannot be given points: say occupancy, hierarchy or proposal".into());
        }
        self.config(1, &Space::contracted([0.0; 3], 1.0), false)
            .check()
            .map_err(|error| error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use crate::recipe::Recipe;
    use irradia_field::Space;

    #[test]
    fn a_field_begins_denser_where_photographs_are_opaque() {
        let recipe = Recipe::parse("hashgrid", Recipe::built_in("hashgrid").unwrap(), &[]).unwrap();
        let knobs = recipe.field.unwrap();
        let space = Space::contracted([0.0; 3], 1.0);
        let bias = |transparent| knobs.config(1, &space, transparent).net.density_bias;
        assert_eq!(bias(true), knobs.net.density_bias);
        assert_eq!(Some(bias(false)), knobs.opaque_density_bias);
        assert!(bias(false) > bias(true));
    }
}

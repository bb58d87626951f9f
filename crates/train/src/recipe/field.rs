//! The parameters of a radiance field.

use super::keys::documented;
use irradia_field::net::NetShape;
use irradia_field::{FieldConfig, Outside, Sampler, Space};
use serde::{Deserialize, Serialize};

documented! {
    /// A radiance field, for the stages that train one.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct FieldSettings {
        /// The space of the field: `auto`, `bounded`, `unbounded` or `ndc`.
        #[serde(default)]
        pub space: FieldSpace,
        /// Samples per step: the number of rays follows from it.
        pub samples: usize,
        /// Decay of Adam's second moment.
        pub beta2: f32,
        /// Maximum number of splats on its surfaces, with which a later stage of splats begins; 0 without such a stage.
        #[serde(default)]
        pub points: usize,
        /// Degree in direction, 0 to 3, of a background learnt with the field, for photographs without alpha; absent: the background
        /// is constant or random.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub background_degree: Option<u32>,
        /// Replaces the networks' `density_bias` if photographs have no alpha: each pixel shows a surface, and a field that is dense
        /// enough initially to hide the background learns at once; absent: `density_bias` is used.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        pub opaque_density_bias: Option<f32>,
        /// The network that outputs colour: `encoding`, `width`, `depth`, `skip`, `geometry`, `activation`, `density_bias`, `color`;
        /// see `NetShape` of the crate `irradia-field`.
        pub net: NetShape,
        /// How samples are placed along a ray: `kind` is `occupancy`, `hierarchy` or `proposal`; see `Sampler` of the crate
        /// `irradia-field`.
        pub sampler: Sampler,
    }
}

documented! {
    /// A small field that adds a view-dependent colour to splats: reflections that harmonics cannot represent.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct ResidualSettings {
        /// Decay of Adam's second moment.
        pub beta2: f32,
        /// Whether it is queried by the viewing direction reflected across the splat's shortest axis instead of the viewing direction
        /// (Ref-NeRF, Verbin et al. 2022): the reflected surroundings then depend little on the position.
        pub mirrored: bool,
        /// Its network, as `field.net`; its density is unused.
        pub net: NetShape,
    }
}

impl ResidualSettings {
    /// `name` is that of the table, `images` the number of photographs with appearance codes, 0 for none.
    pub(super) fn validate(&self, name: &str, images: usize) -> Result<(), String> {
        if !(0.0..1.0).contains(&self.beta2) {
            return Err(format!("{name}.beta2 must be between 0 and 1"));
        }
        let checked = FieldConfig::residual(self.net, self.mirrored, images).check();
        checked.map_err(|error| format!("{name}: {error}"))
    }
}

/// The space of a field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FieldSpace {
    /// `ndc` if all cameras face forward, towards a scene whose nearest depth is known from depth bounds or points; otherwise
    /// `bounded` if photographs have alpha, else `unbounded`.
    #[default]
    Auto,
    /// The cube on which the cameras focus.
    Bounded,
    /// That cube, and the rest of the world contracted around it (mip-NeRF 360).
    Unbounded,
    /// Normalised device coordinates of a forward-facing capture (NeRF).
    Ndc,
}

impl FieldSettings {
    /// Configuration for `images` photographs in `space`: steps grow with distance only in unbounded space, and photographs with
    /// alpha (`transparent`) have no background to learn or to hide.
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
            return Err(
                "field.sampler = \"given\" is only for residual fields; use occupancy, hierarchy or proposal".into(),
            );
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
    fn a_field_is_initially_denser_if_photographs_are_opaque() {
        let recipe = Recipe::parse("hashgrid", Recipe::built_in("hashgrid").unwrap(), &[]).unwrap();
        let settings = recipe.field.unwrap();
        let space = Space::contracted([0.0; 3], 1.0);
        let bias = |transparent| settings.config(1, &space, transparent).net.density_bias;
        assert_eq!(bias(true), settings.net.density_bias);
        assert_eq!(Some(bias(false)), settings.opaque_density_bias);
        assert!(bias(false) > bias(true));
    }
}

//! A radiance field and its parameters.

use crate::background::{background_color, coefficient_count};
use crate::config::{FieldConfig, Sampler};
use crate::net::{Net, NetParameters, NetShape};
use crate::sample::OccupancyGrid;
use crate::space::Space;
use crate::tensors::{Tensors, fill, fill_one, named};
use irradia_scene::Rng;

/// Standard deviation of the first appearance codes of a residual field.
const CODE_DEVIATION: f32 = 0.1;

/// An invalid [`FieldConfig`] or list of tensors.
#[derive(Debug, thiserror::Error)]
pub enum FieldError {
    /// The configuration is invalid.
    #[error("field: {what} is {value}; {hint}")]
    Config {
        /// The offending setting.
        what: &'static str,
        /// Its value.
        value: String,
        /// What is allowed.
        hint: &'static str,
    },
    /// A tensor is missing or its size does not match the configuration.
    #[error("field: tensor {name} has {found} values, expected {expected}; was it written with another configuration?")]
    Tensor {
        /// Its name.
        name: String,
        /// Number of values found, 0 if the tensor is missing.
        found: usize,
        /// Number of values expected.
        expected: usize,
    },
}

/// A radiance field.
#[derive(Clone, Debug)]
pub struct Field {
    /// Its configuration.
    pub config: FieldConfig,
    /// The space it is defined in.
    pub space: Space,
    /// Its networks, in order of evaluation.
    pub nets: Vec<Net>,
    /// Their parameters.
    pub parameters: Vec<NetParameters<f32>>,
    /// Appearance codes `[images, appearance]`.
    pub codes: Vec<f32>,
    /// The background's harmonics `[(degree + 1)^2, 3]`, empty if none is learnt: see [`crate::background_color`].
    pub background: Vec<f32>,
    /// The occupancy grid of [`Sampler::Occupancy`].
    pub occupancy: Option<OccupancyGrid>,
}

impl Field {
    /// A randomly initialised field.
    ///
    /// # Errors
    /// When the configuration is invalid.
    pub fn new(config: FieldConfig, space: Space, seed: u64) -> Result<Self, FieldError> {
        config.check()?;
        let nets: Vec<Net> = config.nets().into_iter().map(Net::new).collect();
        let parameters = nets
            .iter()
            .enumerate()
            .map(|(i, net)| net.init(&mut Rng::new(seed, 0xf1e1d + i as u64)))
            .collect();
        let codes = config.images * config.appearance();
        let occupancy = match &config.sampler {
            Sampler::Occupancy(o) => Some(OccupancyGrid::new(o.side)),
            _ => None,
        };
        let background = vec![0.0; coefficient_count(config.background_degree)];
        Ok(Self {
            config,
            space,
            nets,
            parameters,
            codes: vec![0.0; codes],
            background,
            occupancy,
        })
    }

    /// A field for [`crate::residual_at`], initialised to add nothing to any colour. If its network takes codes, those of the `images`
    /// photographs are random, because codes that start equal would stay equal.
    ///
    /// # Errors
    /// When the configuration of its network is invalid.
    pub fn residual(net: NetShape, mirrored: bool, images: usize, space: Space, seed: u64) -> Result<Self, FieldError> {
        let mut field = Self::new(FieldConfig::residual(net, mirrored, images), space, seed)?;
        field.nets[0].zero_color(&mut field.parameters[0]);
        let mut rng = Rng::new(seed, 0xc0de);
        field.codes.fill_with(|| CODE_DEVIATION * rng.normal());
        Ok(field)
    }

    /// Number of trained parameters.
    pub fn len(&self) -> usize {
        let net = |p: &NetParameters<f32>| p.table.len() + p.density.len() + p.color.len();
        self.parameters.iter().map(net).sum::<usize>() + self.codes.len() + self.background.len()
    }

    /// Whether there are no parameters; never true.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Names, shapes and values of all tensors: together with configuration and space, enough to restore the field.
    pub fn tensors(&self) -> Tensors<'_> {
        let mut list = named("", &self.parameters, [&self.codes, &self.background]);
        if let Some(grid) = &self.occupancy {
            list.push(("occupancy".into(), vec![grid.side; 3], &grid.density));
        }
        list
    }

    /// Restores a field from [`Self::tensors`].
    ///
    /// # Errors
    /// When the configuration is invalid, or a tensor is missing or has another size.
    pub fn from_tensors(
        config: FieldConfig,
        space: Space,
        mut get: impl FnMut(&str) -> Option<Vec<f32>>,
    ) -> Result<Self, FieldError> {
        let mut field = Self::new(config, space, 0)?;
        let lists = [&mut field.codes, &mut field.background];
        fill("", &mut field.parameters, lists.map(Vec::as_mut_slice), &mut get)?;
        if let Some(grid) = &mut field.occupancy {
            let mut density = grid.density.clone();
            fill_one("occupancy", &mut density, &mut get)?;
            grid.density = density;
            field.mark_occupied();
        }
        Ok(field)
    }

    /// The appearance code of a photograph; zeros, the mean code, for `None` and for photographs not trained on.
    pub(crate) fn code(&self, image: Option<u32>) -> Vec<f32> {
        let size = self.config.appearance();
        let at = image.map_or(usize::MAX, |image| image as usize * size);
        self.codes
            .get(at..at.saturating_add(size))
            .map_or_else(|| vec![0.0; size], <[f32]>::to_vec)
    }

    /// The learnt background colour in the unit world `direction`, sRGB; `None` if the field has none.
    pub(crate) fn background_toward(&self, direction: [f32; 3]) -> Option<[f32; 3]> {
        (!self.background.is_empty()).then(|| background_color(&self.background, direction))
    }

    /// The networks' transposed weights, for the backward pass.
    pub(crate) fn transposed(&self) -> Vec<NetParameters<f32>> {
        self.nets
            .iter()
            .zip(&self.parameters)
            .map(|(net, parameters)| net.transposed(parameters))
            .collect()
    }

    /// Recomputes the occupancy bits from the cells' densities.
    pub(crate) fn mark_occupied(&mut self) {
        if let (Some(grid), Sampler::Occupancy(o)) = (&mut self.occupancy, &self.config.sampler) {
            let space = &self.space;
            grid.threshold(o.thickness, |u| o.steps.near(space.from_unit(u)));
        }
    }
}

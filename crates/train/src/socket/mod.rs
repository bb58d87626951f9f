//! Sockets: the places in a splat step for further trained components.
//!
//! | socket | provides | receives |
//! |---|---|---|
//! | before projection | a [`Placement`]: the camera, and the splats if they move | gradients of the camera and of the moved splats |
//! | at colour | a colour to add to each splat in view, by its [`irradia_splat::Surface`] | the gradients of these colours |
//! | after blending | the frame as the photograph shows it: a sky behind it, then its lens's vignette, then an exposure, then a grid of exposures | the gradient of that frame, which it converts to that of the scene's frame |
//!
//! Each occupant has its forward pass, the vector-Jacobian product beside it, its own Adam, and named tensors. Code that saves
//! runs (checkpoints, resume, files beside the scene) accesses occupants through [`Occupant`] alone, and rendering goes through
//! [`Sockets`]: a new one is a file here, a field of [`Sockets`] and an arm in the method of its socket.

mod appearance;
mod bilateral;
mod color_field;
mod exposure;
mod per_view;
mod poses;
mod residual;
mod sky;
mod vignette;

pub use appearance::Appearance;
pub(crate) use appearance::lit_colors;
pub use bilateral::BilateralGrid;
pub use exposure::Exposure;
pub(crate) use per_view::PerViewAdam;
pub use poses::PoseRefinement;
pub(crate) use poses::{corrected, tangent_gradient};
pub use residual::{Residual, added_colors};
pub use sky::{Sky, background_of_sky};
pub use vignette::Vignette;

use crate::objective::Objective;
use crate::recipe::{Choice, Param, Recipe};
use crate::schedule::StepPlan;
use crate::tensor_file::{NamedTensor, TensorSource};
use crate::trainer::TrainError;
use irradia_field::Space;
use irradia_scene::{Camera, Dataset};
use irradia_splat::{Engine, Placement, RenderOptions};
use rayon::prelude::*;

/// Names of the files that occupants may write beside a scene, in the order of [`Sockets::occupants`].
pub const FILES: [&str; 7] = [
    PoseRefinement::FILE,
    Residual::FILE,
    Appearance::FILE,
    Exposure::FILE,
    BilateralGrid::FILE,
    Sky::FILE,
    Vignette::FILE,
];

/// The planes of `frame` `[3, H, W]` in pieces of `length` pixels, for all threads.
fn pixel_chunks(frame: &mut [f32], length: usize) -> impl IndexedParallelIterator<Item = [&mut [f32]; 3]> {
    let (red, rest) = frame.split_at_mut(frame.len() / 3);
    let (green, blue) = rest.split_at_mut(rest.len() / 2);
    let chunks = red.par_chunks_mut(length).zip(green.par_chunks_mut(length));
    let chunks = chunks.zip(blue.par_chunks_mut(length));
    chunks.map(|((red, green), blue)| [red, green, blue])
}

/// The sum of the gradients of all pieces, in their order.
fn sum_of<const N: usize>(chunks: &[[f64; N]]) -> [f32; N] {
    let mut total = [0.0f64; N];
    for sum in chunks {
        for (total, sum) in total.iter_mut().zip(sum) {
            *total += sum;
        }
    }
    total.map(|v| v as f32)
}

/// The sum of the colours that two occupants add to the splats in view, of which either may be absent.
pub(crate) fn sum_of_colors(a: Option<Vec<[f32; 3]>>, b: Option<Vec<[f32; 3]>>) -> Vec<[f32; 3]> {
    match (a, b) {
        (Some(mut colors), Some(others)) => {
            for (color, other) in colors.iter_mut().zip(others) {
                *color = std::array::from_fn(|c| color[c] + other[c]);
            }
            colors
        }
        (a, b) => a.or(b).unwrap_or_default(),
    }
}

/// The last of the `layers` that are present, else `frame`: the input of the next layer.
fn topmost<'a>(frame: &'a [f32], layers: &[(bool, &'a Vec<f32>)]) -> &'a [f32] {
    let last = layers.iter().rev().find(|(is_present, _)| *is_present);
    last.map_or(frame, |(_, layer)| layer)
}

/// The part of a socket's occupant that is saved with a run.
pub trait Occupant {
    /// Prefix of its tensors' names in a checkpoint, and name of its file beside the scene.
    fn name(&self) -> &'static str;

    /// Parameters, moments and counts.
    fn tensors(&self) -> Vec<NamedTensor>;

    /// Restores the result of [`Self::tensors`].
    ///
    /// # Errors
    /// One line, when a tensor is missing or has another shape.
    fn restore(&mut self, tensors: TensorSource) -> Result<(), String>;

    /// A safetensors file to write beside the scene; `None` if untrained.
    fn export(&self) -> Option<Vec<u8>>;
}

/// The occupants, by socket.
#[derive(Default)]
pub struct Sockets {
    /// Before projection: the cameras' poses.
    pub poses: Option<PoseRefinement>,
    /// At colour: a small field.
    pub residual: Option<Residual>,
    /// At colour: the light of each photograph.
    pub appearance: Option<Appearance>,
    /// After blending: the lenses' vignettes.
    pub vignette: Option<Vignette>,
    /// After blending: each photograph's exposure.
    pub exposure: Option<Exposure>,
    /// After blending: each photograph's local changes of colour.
    pub bilateral: Option<BilateralGrid>,
    /// After blending: the sky behind the splats.
    pub sky: Option<Sky>,
    /// The frame over [`Sky`], `[3, H, W]`.
    over_sky: Vec<f32>,
    /// The frame after [`Vignette`], `[3, H, W]`.
    vignetted: Vec<f32>,
    /// The frame after [`Exposure`], `[3, H, W]`.
    exposed: Vec<f32>,
    /// The frame after [`BilateralGrid`], `[3, H, W]`.
    locally_exposed: Vec<f32>,
}

impl Sockets {
    /// The occupants that `recipe` requests, untrained. `transparent`: photographs have alpha.
    ///
    /// # Errors
    /// If the cameras do not determine a space for a residual field.
    pub fn new(recipe: &Recipe, dataset: &Dataset, transparent: bool, seed: u64) -> Result<Self, TrainError> {
        let space = || {
            let cameras: Vec<Camera> = dataset.train.iter().map(|i| dataset.views[*i].camera).collect();
            Space::around(&cameras, !transparent).ok_or(TrainError::NoSpace)
        };
        let residual = match &recipe.residual {
            Some(settings) => Some(Residual::new(settings, space()?, seed)?),
            None => None,
        };
        let appearance = match recipe.light() {
            Some(settings) => Some(Appearance::new(settings, dataset.views.len(), space()?, seed)?),
            None => None,
        };
        Ok(Self {
            appearance,
            poses: recipe.refine_poses.then(|| PoseRefinement::new(dataset)),
            residual,
            vignette: recipe.vignette.then(|| Vignette::new(dataset)).flatten(),
            exposure: (recipe.exposure == Choice::Yes).then(|| Exposure::new(dataset.views.len(), &dataset.train)),
            bilateral: recipe
                .bilateral_grid
                .then(|| BilateralGrid::new(dataset.views.len(), &dataset.train)),
            sky: recipe.uses(Param::RateSky).then(|| Sky::new(dataset)),
            over_sky: Vec::new(),
            vignetted: Vec::new(),
            exposed: Vec::new(),
            locally_exposed: Vec::new(),
        })
    }

    /// All occupants, for saving.
    pub fn occupants(&self) -> Vec<&dyn Occupant> {
        let poses = self.poses.as_ref().map(|o| o as &dyn Occupant);
        let residual = self.residual.as_ref().map(|o| &o.0 as &dyn Occupant);
        let vignette = self.vignette.as_ref().map(|o| o as &dyn Occupant);
        let exposure = self.exposure.as_ref().map(|o| o as &dyn Occupant);
        let bilateral = self.bilateral.as_ref().map(|o| o as &dyn Occupant);
        let sky = self.sky.as_ref().map(|o| o as &dyn Occupant);
        let appearance = self.appearance.as_ref().map(|o| &o.0 as &dyn Occupant);
        [poses, residual, appearance, exposure, bilateral, sky, vignette]
            .into_iter()
            .flatten()
            .collect()
    }

    /// All occupants, for restoring.
    pub fn occupants_mut(&mut self) -> Vec<&mut dyn Occupant> {
        let poses = self.poses.as_mut().map(|o| o as &mut dyn Occupant);
        let residual = self.residual.as_mut().map(|o| &mut o.0 as &mut dyn Occupant);
        let appearance = self.appearance.as_mut().map(|o| &mut o.0 as &mut dyn Occupant);
        let vignette = self.vignette.as_mut().map(|o| o as &mut dyn Occupant);
        let exposure = self.exposure.as_mut().map(|o| o as &mut dyn Occupant);
        let bilateral = self.bilateral.as_mut().map(|o| o as &mut dyn Occupant);
        let sky = self.sky.as_mut().map(|o| o as &mut dyn Occupant);
        [poses, residual, appearance, exposure, bilateral, sky, vignette]
            .into_iter()
            .flatten()
            .collect()
    }

    /// Whether there are none: a step then trains only the splats.
    pub fn is_empty(&self) -> bool {
        self.poses.is_none() && !self.any_at_color() && !self.any_after_blending()
    }

    /// Whether there are any at colour.
    pub fn any_at_color(&self) -> bool {
        self.residual.is_some() || self.appearance.is_some()
    }

    /// Whether there are any after blending.
    pub fn any_after_blending(&self) -> bool {
        self.sky.is_some() || self.vignette.is_some() || self.exposure.is_some() || self.bilateral.is_some()
    }

    /// The files to write beside the scene: name and bytes.
    pub fn files(&self) -> Vec<(String, Vec<u8>)> {
        let file = |occupant: &dyn Occupant| Some((format!("{}.safetensors", occupant.name()), occupant.export()?));
        self.occupants().into_iter().filter_map(file).collect()
    }

    /// Before projection: the camera of `view`, with refinements.
    pub fn place(&self, view: usize, camera: &Camera) -> Placement {
        match &self.poses {
            Some(poses) => poses.refined(view, camera).into(),
            None => (*camera).into(),
        }
    }

    /// Renders `placement`, with colours added at colour, and sky and colour maps applied after blending; [`Self::frame_color`] is the
    /// result.
    pub fn render(
        &mut self,
        engine: &mut Engine,
        view: usize,
        placement: Placement,
        options: &RenderOptions,
        plan: &StepPlan,
    ) {
        let camera = placement.camera;
        let over_black = RenderOptions {
            background: [0.0; 3],
            ..*options
        };
        let options = if self.sky.is_some() { &over_black } else { options };
        let residual = self.residual.as_ref().filter(|residual| residual.is_active(plan));
        let appearance = self.appearance.as_ref().filter(|appearance| appearance.is_active(plan));
        if residual.is_some() || appearance.is_some() {
            let center = placement.camera.pose.position;
            engine.project(placement, options);
            let surfaces = engine.surfaces_in_view();
            let reflected = residual.map(|residual| residual.colors(center, &surfaces));
            let lit = appearance.map(|appearance| appearance.colors(view, center, &surfaces));
            engine.composite(&sum_of_colors(reflected, lit));
        } else {
            engine.render(placement, options);
        }
        let mut color = engine.frame().color;
        if let Some(sky) = &self.sky {
            sky.composite_behind(view, &camera, [color, engine.frame().alpha], &mut self.over_sky);
            color = &self.over_sky;
        }
        if let Some(vignette) = &self.vignette {
            vignette.apply(&camera.intrinsics, color, &mut self.vignetted);
            color = &self.vignetted;
        }
        if let Some(exposure) = &self.exposure {
            exposure.apply(view, color, &mut self.exposed);
            color = &self.exposed;
        }
        if let Some(bilateral) = &self.bilateral {
            let width = camera.intrinsics.width as usize;
            bilateral.apply(view, width, color, &mut self.locally_exposed);
        }
    }

    /// The last frame's colour as the photograph shows it, `[3, H, W]`.
    pub fn frame_color<'a>(&'a self, engine: &'a Engine) -> &'a [f32] {
        let layers = [
            (self.sky.is_some(), &self.over_sky),
            (self.vignette.is_some(), &self.vignetted),
            (self.exposure.is_some(), &self.exposed),
            (self.bilateral.is_some(), &self.locally_exposed),
        ];
        topmost(engine.frame().color, &layers)
    }

    /// Whether the camera's gradient is needed.
    pub fn needs_camera_gradient(&self) -> bool {
        self.poses.is_some()
    }

    /// One step of the occupants after blending. The gradient of [`Self::frame_color`] in `objective` becomes that of the scene's own
    /// colours, and of its coverage.
    pub fn step_after_blending(
        &mut self,
        engine: &Engine,
        view: usize,
        camera: &Camera,
        objective: &mut Objective,
        plan: &StepPlan,
    ) {
        let frame = engine.frame();
        let layers = [
            (self.sky.is_some(), &self.over_sky),
            (self.vignette.is_some(), &self.vignetted),
            (self.exposure.is_some(), &self.exposed),
        ];
        if let Some(bilateral) = &mut self.bilateral {
            let (rate, weight) = (plan.value(Param::RateBilateral), plan.value(Param::BilateralTv));
            let (color, width) = (topmost(frame.color, &layers), camera.intrinsics.width as usize);
            bilateral.step(view, width, color, objective.v_color_mut(), rate, weight);
        }
        if let Some(exposure) = &mut self.exposure {
            let (rate, weight) = (plan.value(Param::RateExposure), plan.value(Param::ExposureReg));
            let color = topmost(frame.color, &layers[..2]);
            exposure.step(view, color, objective.v_color_mut(), rate, weight);
        }
        if let Some(vignette) = &mut self.vignette {
            let color = topmost(frame.color, &layers[..1]);
            let rate = plan.value(Param::RateVignette);
            vignette.step(&camera.intrinsics, color, objective.v_color_mut(), rate);
        }
        if let Some(sky) = &mut self.sky {
            let (v_color, v_alpha) = objective.v_color_and_alpha();
            sky.step(view, camera, frame.alpha, v_color, v_alpha, plan.value(Param::RateSky));
        }
    }

    /// One step of the occupants before projection and at colour, after the frame's backward pass. `camera` is the rendered camera,
    /// `length_unit` the length in world units that counts as much as one radian.
    pub fn step_before_blending(
        &mut self,
        engine: &mut Engine,
        view: usize,
        camera: &Camera,
        length_unit: f32,
        plan: &StepPlan,
    ) {
        let residual = self.residual.as_mut().filter(|residual| residual.is_active(plan));
        let appearance = self.appearance.as_mut().filter(|appearance| appearance.is_active(plan));
        if residual.is_some() || appearance.is_some() {
            let (surfaces, v_colors) = engine.color_gradients();
            let center = camera.pose.position;
            if let Some(residual) = residual {
                residual.step(center, &surfaces, &v_colors, plan);
            }
            if let Some(appearance) = appearance {
                appearance.step(view, center, &surfaces, &v_colors, plan);
            }
        }
        if let (Some(poses), Some(gradient)) = (&mut self.poses, engine.camera_gradient()) {
            poses.step(view, camera, &gradient, plan.value(Param::RatePoses), length_unit);
        }
    }
}

//! Splats in training, as a step asks for them: the narrow interface behind which a device sits.
//!
//! A step never reads a splat, a footprint or a gradient by itself. It asks for a frame, for the surfaces in view, for the
//! gradients of added colours: whole lists, which a device can compute where its data lies and hand over late or in bulk.
//! What edits single splats (density control, first splats, files) takes the state with [`Engine::state_mut`], rarely.

use crate::densify::mcmc;
use crate::regularize::{self, Regularized, Regularizers};
use crate::render::{CameraGradient, FramePlanes, OutputGradient, RenderOptions, Renderer, SplatGradients, ViewParams};
use crate::{Optimizer, Rates, SplatState, Splats, Statistics, Surface};
use irradia_scene::{Camera, sh};

/// The state of splats in training with the renderer and the gradients of the last frame, on this machine's processor.
pub struct Engine {
    state: SplatState,
    renderer: Renderer,
    gradients: SplatGradients,
    /// What the last frame showed in place of the state's splats.
    moved: Option<Splats>,
}

/// What a frame is taken of, and from where.
#[derive(Clone, Debug)]
pub struct Placement {
    /// The camera.
    pub camera: Camera,
    /// The splats as they lie at this time in this view; as the state has them when `None`.
    pub moved: Option<Splats>,
}

impl From<Camera> for Placement {
    fn from(camera: Camera) -> Self {
        Self { camera, moved: None }
    }
}

/// What one update does with the gradients of the last backward pass.
#[derive(Clone, Copy, Debug)]
pub struct Update {
    /// Statistics of density control to add up.
    pub statistics: Option<Statistics>,
    /// Losses of the splats themselves.
    pub regularizers: Regularizers,
    /// Of which splats they are a mean.
    pub regularized: Regularized,
    /// Their unit of length, world units.
    pub regularizer_unit: f32,
    /// Fraction of the visible splats whose place and shape are trained, the largest first.
    pub trained_fraction: f32,
    /// Learning rates; that of the means in world units.
    pub rates: Rates,
    /// SH bands that are trained.
    pub sh_degree: u32,
    /// What makes a step of gradients.
    pub optimizer: Optimizer,
    /// Noise on the means of faint splats.
    pub noise: Option<Noise>,
    /// Largest condition number of a covariance.
    pub condition_cap: Option<f32>,
}

/// Noise of one step (3DGS-MCMC).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Standard deviation at a covariance of 1, world units.
    pub amount: f32,
    /// Random seed of the run.
    pub seed: u64,
    /// Steps made before this one.
    pub step: u64,
}

impl Engine {
    /// Of `state`, with nothing rendered.
    pub fn new(state: SplatState) -> Self {
        Self {
            state,
            renderer: Renderer::new(),
            gradients: SplatGradients::default(),
            moved: None,
        }
    }

    /// How many splats.
    pub fn len(&self) -> usize {
        self.state.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.state.is_empty()
    }

    /// Parameters, moments and statistics.
    pub fn state(&self) -> &SplatState {
        &self.state
    }

    /// Likewise, to be edited or replaced between two steps.
    pub fn state_mut(&mut self) -> &mut SplatState {
        &mut self.state
    }

    /// From the next frame on, convolves every splat with the 3D smoothing filter that the state holds, or with none.
    pub fn use_filter(&mut self, on: bool) {
        let filter = if on { self.state.filter.plane(0) } else { &[] };
        self.renderer.set_filter(filter);
    }

    /// Renders a frame.
    pub fn render(&mut self, placement: Placement, options: &RenderOptions) {
        self.moved = placement.moved;
        let splats = self.moved.as_ref().unwrap_or(&self.state.splats);
        self.renderer
            .render(splats, &ViewParams::new(&placement.camera), options);
    }

    /// The first half of a frame to whose colours something is added; [`Self::composite`] is the second.
    pub fn project(&mut self, placement: Placement, options: &RenderOptions) {
        self.moved = placement.moved;
        let splats = self.moved.as_ref().unwrap_or(&self.state.splats);
        self.renderer
            .project(splats, &ViewParams::new(&placement.camera), options);
    }

    /// What the splats in view of the last [`Self::project`] stand for, in ascending order of splats.
    pub fn surfaces_in_view(&self) -> Vec<Surface> {
        self.rendered().surfaces(self.renderer.in_view())
    }

    /// Adds `[r, g, b]` to the colour of each splat in view, and blends.
    pub fn composite(&mut self, added: &[[f32; 3]]) {
        self.renderer.add_colors(added);
        self.renderer.composite();
    }

    /// The last frame.
    pub fn frame(&self) -> FramePlanes<'_> {
        self.renderer.frame()
    }

    /// Splats that touched the last frame.
    pub fn visible(&self) -> usize {
        self.renderer.visible()
    }

    /// Splat-pixel pairs that the last frame's blending visited. Counting walks all tiles: not for every step.
    pub fn pairs(&self) -> u64 {
        self.renderer.pairs()
    }

    /// Gradients of the last frame, which stay here until [`Self::update`].
    pub fn backward(&mut self, v_out: &OutputGradient) {
        let splats = self.moved.as_ref().unwrap_or(&self.state.splats);
        self.renderer.backward(splats, v_out, &mut self.gradients);
    }

    /// Splats whose gradient of the last backward pass was not finite.
    pub fn non_finite(&self) -> usize {
        self.gradients.non_finite
    }

    /// Gradient of the camera, where the last backward pass was asked for it.
    pub fn camera_gradient(&self) -> Option<CameraGradient> {
        self.gradients.camera
    }

    /// The splats' gradients of the last backward pass: for what moved the splats, to take back to where they were.
    pub fn gradients_mut(&mut self) -> &mut SplatGradients {
        &mut self.gradients
    }

    /// The surfaces whose added colour has a gradient, with that gradient, in ascending order of splats. What hides behind
    /// others has none, and is most of what is in view.
    pub fn color_gradients(&self) -> (Vec<Surface>, Vec<[f32; 3]>) {
        let planes = [0, 1, 2].map(|c| self.gradients.splats.sh.plane(c));
        let v_of = |i: u32| planes.map(|plane| plane[i as usize] / sh::C0 as f32);
        let with_gradient = |i: &u32| self.gradients.active[*i as usize] > 0.0 && v_of(*i) != [0.0; 3];
        let seen = self.renderer.in_view().iter().copied().filter(with_gradient);
        let (seen, v_colors): (Vec<u32>, Vec<[f32; 3]>) = seen.map(|i| (i, v_of(i))).unzip();
        (self.rendered().surfaces(&seen), v_colors)
    }

    /// Statistics, regularisers, Adam, noise and the cap on conditions, in this order, with the last gradients.
    pub fn update(&mut self, update: &Update) {
        let (level, gradients) = (self.renderer.level, &mut self.gradients);
        if let (Some(statistics), Some([width, height])) = (update.statistics, self.renderer.size()) {
            let renderer = &self.renderer;
            let extent = |i: usize| renderer.screen_extent(i).map_or(0.0, |e| e[0].max(e[1]));
            self.state
                .gather_statistics(statistics, gradients, width, height, extent);
        }
        // Without weights there is no gradient that splats out of view could have.
        let regularizers = (!update.regularizers.is_zero()).then_some(&update.regularizers);
        if let Some(weights) = regularizers {
            regularize::add_gradients(
                level,
                &self.state.splats,
                weights,
                update.regularized,
                update.regularizer_unit,
                gradients,
            );
        }
        if update.trained_fraction < 1.0 {
            regularize::rest_small(&self.state.splats, update.trained_fraction, gradients);
        }
        let regularized = regularizers.map_or(Regularized::Visible, |_| update.regularized);
        self.state.step(
            level,
            gradients,
            regularized,
            &update.rates,
            update.sh_degree,
            update.optimizer,
        );
        if let Some(Noise { amount, seed, step }) = update.noise {
            mcmc::add_noise(&mut self.state, amount, seed, step);
        }
        if let Some(limit) = update.condition_cap {
            regularize::cap_condition(&mut self.state.splats, limit);
        }
    }

    /// What the last frame showed.
    fn rendered(&self) -> &Splats {
        self.moved.as_ref().unwrap_or(&self.state.splats)
    }
}

//! Splats in training as a step accesses them: a narrow interface that a device can implement.
//!
//! A step never reads single splats, footprints or gradients. It requests a frame, the surfaces in view, the gradients of added
//! colours: whole lists, which a device can compute where its data resides and return late or in bulk. Code that edits single
//! splats (initialisation, files) runs rarely and takes the whole state with [`Engine::state_mut`]; density control runs more often and
//! takes only the columns on which it depends, with [`Engine::edit_density`].

use crate::densify::mcmc;
#[cfg(feature = "gpu")]
use crate::gpu::{DeviceGradient, GpuTraining};
use crate::regularize::{self, AngleCap, Regularized, Regularizers};
use crate::render::{
    CameraGradient, ChunkBounds, FramePlanes, OutputGradient, RenderOptions, Renderer, SplatGradients, ViewParams,
};
use crate::{Optimizer, Rates, SplatState, Splats, Statistics, Surface};
#[cfg(feature = "gpu")]
use irradia_compute::gpu::Array;
use irradia_compute::{Device, DeviceError};
use irradia_scene::{Camera, sh};
use rayon::prelude::*;
use std::sync::OnceLock;

/// The state of splats in training with the renderer and the gradients of the last frame, on the CPU or on a GPU.
///
/// Frames that the GPU does not support, those with added colours or moved splats, bring the state back to the CPU, where it stays.
pub struct Engine {
    /// Empty while the GPU's state is newer.
    state: OnceLock<SplatState>,
    #[cfg(feature = "gpu")]
    gpu: Option<Box<GpuTraining>>,
    filters: bool,
    renderer: Renderer,
    gradients: SplatGradients,
    /// The splats of the last frame, if they were not the state's.
    moved: Option<Splats>,
    /// Bounds of the state's splats, unless `edited`.
    bounds: ChunkBounds,
    /// Whether the state may have been edited since the bounds were updated.
    edited: bool,
}

/// The camera and the splats of a frame.
#[derive(Clone, Debug)]
pub struct Placement {
    /// The camera.
    pub camera: Camera,
    /// The splats as moved for this time and view; `None` for those of the state.
    pub moved: Option<Splats>,
}

impl From<Camera> for Placement {
    fn from(camera: Camera) -> Self {
        Self { camera, moved: None }
    }
}

/// How one update uses the gradients of the last backward pass.
#[derive(Clone, Copy, Debug)]
pub struct Update {
    /// Statistics of density control to accumulate.
    pub statistics: Option<Statistics>,
    /// Weights of the regularisers.
    pub regularizers: Regularizers,
    /// The splats over which regularisers are averaged.
    pub regularized: Regularized,
    /// Unit of length of the regularisers, world units.
    pub regularizer_unit: f32,
    /// Fraction of the visible splats whose position and shape are trained, the largest first.
    pub trained_fraction: f32,
    /// Learning rates; that of the means in world units.
    pub rates: Rates,
    /// SH bands that are trained.
    pub sh_degree: u32,
    /// How gradients become steps.
    pub optimizer: Optimizer,
    /// Noise added to the means of faint splats.
    pub noise: Option<Noise>,
    /// Largest condition number of a covariance.
    pub condition_cap: Option<f32>,
    /// Largest size as seen from the camera.
    pub angle_cap: Option<AngleCap>,
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
    /// For `state`, with no frame rendered.
    pub fn new(state: SplatState) -> Self {
        Self {
            state: OnceLock::from(state),
            #[cfg(feature = "gpu")]
            gpu: None,
            filters: false,
            renderer: Renderer::new(),
            gradients: SplatGradients::default(),
            moved: None,
            bounds: ChunkBounds::default(),
            edited: true,
        }
    }

    /// Continues on `device`.
    ///
    /// # Errors
    /// When the device refuses the kernels.
    pub fn use_device(&mut self, device: &Device) -> Result<(), DeviceError> {
        self.use_cpu();
        match device {
            Device::Cpu => {}
            #[cfg(feature = "gpu")]
            Device::Gpu(gpu) => self.gpu = Some(Box::new(GpuTraining::new(gpu.clone())?)),
        }
        Ok(())
    }

    /// Whether the state is on a GPU.
    pub fn is_on_gpu(&self) -> bool {
        #[cfg(feature = "gpu")]
        return self.gpu.is_some();
        #[cfg(not(feature = "gpu"))]
        false
    }

    /// Reports a failure of the device, after which the state and everything derived from it are unspecified.
    ///
    /// # Errors
    /// When the device has failed.
    pub fn check_device(&self) -> Result<(), DeviceError> {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            let checked = gpu.renderer.gpu().check();
            return checked.map_err(|error| error.at_splats(self.len()));
        }
        Ok(())
    }

    /// Maximum number of splats: as many as fit in the largest arrays of a GPU, given the last frame's tile entries per splat.
    /// No limit on the CPU.
    pub fn max_splats(&self) -> usize {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            let on_device = gpu.renderer.sh_degree();
            return gpu.max_splats(self.state.get().map_or(on_device, |state| state.splats.sh_degree()));
        }
        usize::MAX
    }

    /// Continues on the CPU.
    fn use_cpu(&mut self) {
        #[cfg(feature = "gpu")]
        {
            self.state();
            if self.gpu.take().is_some() {
                self.set_filter();
            }
        }
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        #[cfg(feature = "gpu")]
        if let (None, Some(gpu)) = (self.state.get(), &self.gpu) {
            return gpu.len();
        }
        self.state().len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Parameters, moments and statistics; read back from a GPU on the first call after an update.
    pub fn state(&self) -> &SplatState {
        self.state.get_or_init(|| self.read_back())
    }

    #[cfg(feature = "gpu")]
    fn read_back(&self) -> SplatState {
        self.gpu.as_ref().expect("the state is somewhere").download()
    }

    #[cfg(not(feature = "gpu"))]
    fn read_back(&self) -> SplatState {
        unreachable!("without a GPU the state is here")
    }

    /// Parameters, moments and statistics, to be edited or replaced between two steps.
    pub fn state_mut(&mut self) -> &mut SplatState {
        self.state();
        self.edited = true;
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &mut self.gpu {
            gpu.stale = true;
        }
        self.state.get_mut().expect("just filled")
    }

    /// Edits the state between two steps as density control does, based on geometry, statistics and filter. Harmonics and moments may
    /// be moved, copied from splat to splat and set to zero, but `edit` must neither read their values nor set others: on a GPU they
    /// stay on the device, and the columns that `edit` sees hold other values.
    pub fn edit_density<R>(&mut self, edit: impl FnOnce(&mut SplatState) -> R) -> R {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = self.gpu.as_mut().filter(|gpu| !gpu.stale) {
            self.state = OnceLock::new();
            let mut state = gpu.download_numbered();
            let result = edit(&mut state);
            gpu.upload_numbered(&state);
            return result;
        }
        edit(self.state_mut())
    }

    /// From the next frame on, convolves every splat with the state's 3D smoothing filter, or with none.
    pub fn use_filter(&mut self, on: bool) {
        self.filters = on;
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &mut self.gpu {
            gpu.renderer.filters = on;
            return;
        }
        self.set_filter();
    }

    /// Passes the filter to the CPU's renderer.
    fn set_filter(&mut self) {
        self.state();
        let filter = if self.filters {
            cpu_state(&self.state).filter.plane(0)
        } else {
            &[]
        };
        self.renderer.set_filter(filter);
        self.edited = true;
    }

    /// Renders a frame.
    pub fn render(&mut self, placement: Placement, options: &RenderOptions) {
        if placement.moved.is_some() {
            self.use_cpu();
        }
        self.moved = placement.moved;
        self.render_view(&ViewParams::new(&placement.camera), options);
    }

    /// Renders a frame of the splats that were placed last, for any pinhole camera.
    pub fn render_view(&mut self, view: &ViewParams, options: &RenderOptions) {
        #[cfg(feature = "gpu")]
        if self.gpu.is_some() {
            self.on_gpu().render(view, options);
            return;
        }
        self.update_bounds();
        let (splats, bounds) = placed_splats(cpu_state(&self.state), self.moved.as_ref(), &self.bounds);
        self.renderer.render_within(splats, bounds, view, options);
    }

    /// Begins a frame of the state's splats on the GPU, without waiting for the numbers of visible splats and of entries: until
    /// [`Self::finish_frame`], only the device knows them.
    ///
    /// # Panics
    /// When the engine is on the CPU.
    #[cfg(feature = "gpu")]
    pub fn render_ahead(&mut self, camera: &Camera, options: &RenderOptions) {
        self.moved = None;
        self.on_gpu().render_ahead(&ViewParams::new(camera), options);
    }

    /// Waits for the last [`Self::render_ahead`] and returns whether there was room for it on the device. If not, the frame and everything
    /// derived from it are void: the backward pass and the update have changed nothing, and must be repeated after another frame.
    #[cfg(feature = "gpu")]
    #[must_use]
    pub fn finish_frame(&mut self) -> bool {
        self.gpu.as_mut().is_none_or(|gpu| gpu.renderer.finish_frame())
    }

    /// The GPU's training, with the latest state.
    #[cfg(feature = "gpu")]
    fn on_gpu(&mut self) -> &mut GpuTraining {
        let gpu = self.gpu.as_mut().expect("the engine is on a GPU");
        if gpu.stale {
            let state = self.state.get().expect("what was edited is here");
            gpu.upload(state, self.filters);
        }
        gpu
    }

    /// The first half of a frame with added colours; [`Self::composite`] is the second.
    pub fn project(&mut self, placement: Placement, options: &RenderOptions) {
        self.use_cpu();
        self.moved = placement.moved;
        self.update_bounds();
        let (splats, bounds) = placed_splats(cpu_state(&self.state), self.moved.as_ref(), &self.bounds);
        self.renderer
            .project_within(splats, bounds, &ViewParams::new(&placement.camera), options);
    }

    /// Updates the bounds of the state's splats, if those splats are drawn.
    fn update_bounds(&mut self) {
        if self.moved.is_none() && std::mem::take(&mut self.edited) {
            let renderer = &self.renderer;
            self.bounds.update(
                renderer.level,
                &cpu_state(&self.state).splats,
                renderer.filter(),
                |_| true,
            );
        }
    }

    /// The surfaces in view of the last [`Self::project`], in ascending order of splats.
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
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            return gpu.renderer.frame();
        }
        self.renderer.frame()
    }

    /// Pixels of the last frame.
    pub fn pixels(&self) -> usize {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            return gpu.renderer.pixels();
        }
        let [width, height] = self.renderer.size().unwrap_or_default();
        width as usize * height as usize
    }

    /// Splats that touched the last frame.
    pub fn visible(&self) -> usize {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            return gpu.renderer.visible();
        }
        self.renderer.visible()
    }

    /// Intersections of splats and tiles in the last frame.
    pub fn intersections(&self) -> usize {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            return gpu.renderer.intersections();
        }
        self.renderer.intersections()
    }

    /// Splat-pixel pairs visited by blending in the last frame; on a GPU, all pixels of each touched tile. Counting walks all tiles, which
    /// is too slow for every step.
    pub fn pairs(&self) -> u64 {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            return gpu.renderer.pairs();
        }
        self.renderer.pairs()
    }

    /// Computes the gradients of the last frame, which stay here until [`Self::update`].
    pub fn backward(&mut self, v_out: &OutputGradient) {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &mut self.gpu {
            return gpu.backward(v_out);
        }
        let splats = self.moved.as_ref().unwrap_or(&cpu_state(&self.state).splats);
        self.renderer.backward(splats, v_out, &mut self.gradients);
    }

    /// The planes of the last frame on a GPU, and an array for those of its gradients, `[3 + 1 + 1 (+ 1), H, W]`: colour, alpha, depth, and
    /// the error to gather. `None` on the CPU.
    #[cfg(feature = "gpu")]
    pub fn device_frame(&mut self) -> Option<[&Array; 2]> {
        self.gpu.as_mut().map(|gpu| gpu.frame_and_gradients())
    }

    /// As [`Self::backward`], with the gradients written to [`Self::device_frame`].
    ///
    /// # Panics
    /// When the engine is on the CPU.
    #[cfg(feature = "gpu")]
    pub fn backward_on_device(&mut self, of: &DeviceGradient) {
        self.gpu.as_mut().expect("there is a device frame").propagate(of);
    }

    /// Number of splats whose gradient was not finite in the last backward pass; on a GPU, in the one before.
    pub fn non_finite(&self) -> usize {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            return gpu.non_finite();
        }
        self.gradients.non_finite
    }

    /// Gradient of the camera, if the last backward pass computed it.
    pub fn camera_gradient(&self) -> Option<CameraGradient> {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            return gpu.camera_gradient();
        }
        self.gradients.camera
    }

    /// The splats' gradients of the last backward pass, read back from a GPU: for tests and tools.
    pub fn read_gradients(&mut self) -> &SplatGradients {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &self.gpu {
            gpu.read_gradients(&mut self.gradients);
        }
        &self.gradients
    }

    /// The surfaces whose added colour has a gradient, with that gradient, in ascending order of splats. Occluded surfaces, most of
    /// those in view, have none.
    pub fn color_gradients(&self) -> (Vec<Surface>, Vec<[f32; 3]>) {
        let planes = [0, 1, 2].map(|c| self.gradients.splats.sh.plane(c));
        let v_of = |i: u32| planes.map(|plane| plane[i as usize] / sh::C0 as f32);
        let with_gradient = |i: &u32| self.gradients.active[*i as usize] > 0.0 && v_of(*i) != [0.0; 3];
        let seen = self.renderer.in_view().par_iter().copied().filter(with_gradient);
        let (seen, v_colors): (Vec<u32>, Vec<[f32; 3]>) = seen.map(|i| (i, v_of(i))).unzip();
        (self.rendered().surfaces(&seen), v_colors)
    }

    /// Applies statistics, regularisers, Adam, noise and the caps, in this order, with the last gradients.
    pub fn update(&mut self, update: &Update) {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = &mut self.gpu {
            gpu.update(update);
            self.state = OnceLock::new();
            return;
        }
        let state = self.state.get_mut().expect("on the CPU the state is here");
        let (level, gradients) = (self.renderer.level, &mut self.gradients);
        if let (Some(statistics), Some([width, height])) = (update.statistics, self.renderer.size()) {
            let renderer = &self.renderer;
            let extent = |i: usize| renderer.screen_extent(i).map_or(0.0, |e| e[0].max(e[1]));
            state.gather_statistics(statistics, gradients, width, height, extent);
        }
        // With weights of zero, splats out of view have no gradient.
        let regularizers = (!update.regularizers.is_zero()).then_some(&update.regularizers);
        if let Some(weights) = regularizers {
            regularize::add_gradients(
                level,
                &state.splats,
                weights,
                update.regularized,
                update.regularizer_unit,
                gradients,
            );
        }
        let regularized = regularizers.map_or(Regularized::Visible, |_| update.regularized);
        if update.trained_fraction < 1.0 {
            regularize::freeze_small(&state.splats, update.trained_fraction, regularized, gradients);
        }
        state.step(
            level,
            gradients,
            regularized,
            &update.rates,
            update.sh_degree,
            update.optimizer,
        );
        if let Some(Noise { amount, seed, step }) = update.noise {
            mcmc::add_noise(state, amount, seed, step);
        }
        if let Some(limit) = update.condition_cap {
            regularize::cap_condition(&mut state.splats, limit);
        }
        // Splats only shrink, so that their bounds remain valid.
        if let Some(cap) = &update.angle_cap {
            regularize::cap_angle(&mut state.splats, cap);
        }
        let only_active = !update.optimizer.dense
            && regularized == Regularized::Visible
            && update.noise.is_none()
            && update.condition_cap.is_none();
        let (renderer, counts) = (&self.renderer, &self.gradients.counts);
        self.bounds
            .update(renderer.level, &state.splats, renderer.filter(), |chunk| {
                !only_active || counts[chunk] > 0
            });
    }

    /// The splats of the last frame.
    fn rendered(&self) -> &Splats {
        self.moved.as_ref().unwrap_or(&cpu_state(&self.state).splats)
    }
}

/// The state of an engine on the CPU.
fn cpu_state(state: &OnceLock<SplatState>) -> &SplatState {
    state.get().expect("on the CPU the state is here")
}

/// The splats of a frame, and their bounds if they have any.
fn placed_splats<'a>(
    state: &'a SplatState,
    moved: Option<&'a Splats>,
    bounds: &'a ChunkBounds,
) -> (&'a Splats, Option<&'a ChunkBounds>) {
    match moved {
        Some(moved) => (moved, None),
        None => (&state.splats, Some(bounds)),
    }
}

//! Splats in training on the GPU: their state, the backward pass and the update.

use super::frame::{FRAME_PLANES, GEOMETRY, GpuRenderer, Last, SplatsShape, flag, read_geometry, write_geometry};
use super::moves::Moves;
use crate::engine::Update;
use crate::regularize::{Regularized, size_limit};
use crate::render::{CHUNK, CameraGradient, Gather, OutputGradient, RenderOptions, basis_at};
use crate::{SplatGradients, SplatState, Splats, Statistics, ViewParams};
use irradia_compute::gpu::{Array, Gpu, WORKGROUP_SIZE, Work, flags};
use irradia_compute::{DeviceError, Planes};
use irradia_scene::sh;
use std::sync::Arc;

/// Planes of the splats' gradients: geometry, colour, screen, gathered.
pub(super) const GRADIENTS: usize = GEOMETRY + 7;
/// Sums of blending per slot.
const SUMS: usize = 12;
/// Threads of a workgroup of `project_vjp.wgsl`, which needs many registers.
const VJP_GROUP: usize = 64;
/// Components of the camera's gradient, for each visible splat.
const CAMERA_COMPONENTS: usize = 15;

/// Bits of `Update.flags` in `update.wgsl`.
mod update_flag {
    pub const DENSE: u32 = 1;
    pub const ALL: u32 = 2;
    pub const NOISE: u32 = 4;
    pub const CAP: u32 = 8;
    pub const FREEZE: u32 = 16;
    pub const GRADIENT: u32 = 32;
    pub const ABSOLUTE: u32 = 64;
    pub const ERROR: u32 = 128;
    pub const DISTANCE: u32 = 256;
    pub const ANGLE: u32 = 512;
}

/// Which gradients a frame on the device has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceGradient {
    /// Of alpha.
    pub alpha: bool,
    /// Of the accumulated depth.
    pub depth: bool,
    /// What else to accumulate per splat, for these statistics.
    pub gather: Option<Statistics>,
    /// Whether to compute the camera's gradient.
    pub camera: bool,
}

/// The twin of the CPU's state, renderer and gradients.
pub(crate) struct GpuTraining {
    pub renderer: GpuRenderer,
    /// First moments, then second ones.
    pub(super) moments_geometry: Array,
    /// First and second moments: with the harmonics, the largest arrays of a state.
    pub(super) moments_harmonics: [Array; 2],
    statistics: Array,
    v_frame: Array,
    pub(super) sums: Array,
    pub(super) v_splats: Array,
    v_camera: Array,
    v_camera_sums: Array,
    update: Array,
    pub(super) moves: Moves,
    camera: Option<CameraGradient>,
    /// Whether the host's state was edited since it was uploaded.
    pub stale: bool,
}

impl GpuTraining {
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, DeviceError> {
        let array = |label| Array::zeros(&gpu, label, 0);
        Ok(Self {
            moments_geometry: array("moments of geometry"),
            moments_harmonics: ["first moments of harmonics", "second moments of harmonics"].map(array),
            statistics: array("statistics"),
            v_frame: array("gradients of the frame"),
            sums: array("sums of blending"),
            v_splats: array("gradients of splats"),
            v_camera: array("gradients of the camera"),
            v_camera_sums: array("sums of the camera's gradients"),
            update: Array::zeros(&gpu, "update", UPDATE_WORDS),
            moves: Moves::new(&gpu),
            camera: None,
            stale: true,
            renderer: GpuRenderer::new(gpu)?,
        })
    }

    /// Maximum number of splats of `degree` for which the device's largest array suffices: for a state, and for frames with twice as many
    /// entries per splat as the last one, since views differ.
    pub fn max_splats(&self, degree: u32) -> usize {
        let words = (self.renderer.gpu.info().largest_array / 4) as usize;
        let by_state = words / (3 * sh::coefficients(degree)).max(2 * GEOMETRY);
        let count = self.renderer.shape.count;
        let by_entries = match 2 * self.renderer.intersections() {
            0 => usize::MAX,
            entries => (words / SUMS).saturating_mul(count) / entries,
        };
        // Planes are padded.
        by_state.saturating_sub(Planes::ALIGN).min(by_entries).max(1)
    }

    /// Uploads the whole state.
    pub fn upload(&mut self, state: &SplatState, filters: bool) {
        self.renderer.upload(&state.splats, state.filter.plane(0));
        self.renderer.filters = filters;
        let gpu = &self.renderer.gpu;
        self.moments_geometry.reserve(gpu, 2 * GEOMETRY * state.splats.stride());
        for (i, moment) in state.moments.iter().enumerate() {
            write_geometry(gpu, &self.moments_geometry, i * GEOMETRY, moment);
            let harmonics = &mut self.moments_harmonics[i];
            harmonics.reserve(gpu, moment.sh.as_slice().len());
            harmonics.write(gpu, 0, moment.sh.as_slice());
        }
        self.upload_statistics(state);
        self.stale = false;
    }

    pub(super) fn upload_statistics(&mut self, state: &SplatState) {
        let gpu = &self.renderer.gpu;
        self.statistics.reserve(gpu, state.statistics.as_slice().len());
        self.statistics.write(gpu, 0, state.statistics.as_slice());
        self.v_splats.reserve(gpu, GRADIENTS * state.splats.stride());
    }

    /// Reads back the whole state.
    pub fn download(&self) -> SplatState {
        let gpu = &self.renderer.gpu;
        let SplatsShape { count, degree, .. } = self.renderer.shape;
        let zeros = || Splats::zeros(count, degree);
        let mut state = SplatState {
            splats: zeros(),
            moments: [zeros(), zeros()],
            ..SplatState::default()
        };
        self.renderer.harmonics.read(gpu, 0, state.splats.sh.as_mut_slice());
        for (i, moment) in state.moments.iter_mut().enumerate() {
            read_geometry(gpu, &self.moments_geometry, i * GEOMETRY, moment);
            self.moments_harmonics[i].read(gpu, 0, moment.sh.as_mut_slice());
        }
        self.download_density_columns(&mut state);
        state
    }

    /// Reads the columns on which density control depends: geometry, statistics and filter.
    pub(super) fn download_density_columns(&self, state: &mut SplatState) {
        let gpu = &self.renderer.gpu;
        let count = self.renderer.shape.count;
        read_geometry(gpu, &self.renderer.geometry, 0, &mut state.splats);
        state.statistics = Planes::zeros(SplatState::STATISTICS, count);
        self.statistics.read(gpu, 0, state.statistics.as_mut_slice());
        state.filter = Planes::zeros(1, count);
        self.renderer.filter.read(gpu, 0, state.filter.as_mut_slice());
    }

    pub fn len(&self) -> usize {
        self.renderer.shape.count
    }

    pub fn render(&mut self, view: &ViewParams, options: &RenderOptions) {
        self.renderer.draw_whole(view, options, true);
    }

    /// As [`Self::render`], without waiting for it.
    pub fn render_ahead(&mut self, view: &ViewParams, options: &RenderOptions) {
        self.renderer.draw(view, options, true);
    }

    /// The planes of the last frame, and an array for those of its gradients: red, green, blue, alpha, depth, and the error to gather.
    pub fn frame_and_gradients(&mut self) -> [&Array; 2] {
        let pixels = self.renderer.last.as_ref().expect("render comes first").pixels();
        self.v_frame.reserve(&self.renderer.gpu, (FRAME_PLANES + 1) * pixels);
        [&self.renderer.planes, &self.v_frame]
    }

    /// The gradients of the last frame, which stay on the device until the update.
    pub fn backward(&mut self, v_out: &OutputGradient) {
        let pixels = self.renderer.last.as_ref().expect("render comes first").pixels();
        assert_eq!(v_out.color.len(), 3 * pixels, "a colour gradient per pixel");
        let gpu = self.renderer.gpu.clone();
        let [_, v_frame] = self.frame_and_gradients();
        v_frame.write(&gpu, 0, v_out.color);
        if let Some(alpha) = v_out.alpha {
            v_frame.write(&gpu, 3 * pixels, alpha);
        }
        if let Some(depth) = v_out.depth {
            v_frame.write(&gpu, 4 * pixels, depth);
        }
        if let Gather::Error(error) = v_out.gather {
            v_frame.write(&gpu, 5 * pixels, error);
        }
        self.propagate(&DeviceGradient {
            alpha: v_out.alpha.is_some(),
            depth: v_out.depth.is_some(),
            gather: match v_out.gather {
                Gather::Nothing => None,
                Gather::Absolute => Some(Statistics::AbsoluteGradient),
                Gather::Error(_) => Some(Statistics::Error),
            },
            camera: v_out.camera,
        });
    }

    /// As [`Self::backward`], with the gradients written to the array of [`Self::frame_and_gradients`].
    pub fn propagate(&mut self, of: &DeviceGradient) {
        let renderer = &mut self.renderer;
        let last = renderer.last.clone().expect("render comes first");
        assert!(last.trains, "a frame of a training");
        let gpu = renderer.gpu.clone();
        let bits = [
            (of.alpha, flag::ALPHA),
            (of.depth, flag::DEPTH),
            (of.gather == Some(Statistics::AbsoluteGradient), flag::GATHER_ABSOLUTE),
            (of.gather == Some(Statistics::Error), flag::GATHER_ERROR),
            (of.camera, flag::CAMERA),
        ];
        let more = flags(&bits);
        let count = renderer.shape.count;
        if of.camera {
            self.v_camera.reserve(&gpu, CAMERA_COMPONENTS * count);
        }
        renderer.add_flags(&last, more);
        self.sums.reserve(&gpu, SUMS * last.room);

        let mut work = Work::new(&gpu);
        self.blend_vjp(&mut work, &last);
        self.project_vjp(&mut work);
        work.submit();
        self.camera = of.camera.then(|| self.sum_camera(&last));
    }

    /// From the gradients of pixels to the sums of each slot.
    pub(super) fn blend_vjp(&self, work: &mut Work, last: &Last) {
        let renderer = &self.renderer;
        work.run(
            &renderer.kernels.blend_vjp,
            &[
                &renderer.view,
                &renderer.ranges,
                &renderer.slots,
                &renderer.splat_of_slot,
                &renderer.footprints,
                &renderer.first_segments,
                &renderer.tile_of_segment,
                &renderer.reached,
                &renderer.states,
                &renderer.planes,
                &self.v_frame,
                &self.sums,
            ],
            last.segments(),
        );
    }

    /// From the sums of slots to the gradients of splats.
    pub(super) fn project_vjp(&self, work: &mut Work) {
        let renderer = &self.renderer;
        work.clear(&renderer.found.part(2, 1), 1);
        work.run(
            &renderer.kernels.project_vjp,
            &[
                &renderer.view,
                &renderer.places,
                &renderer.firsts,
                &renderer.touched,
                &self.sums,
                &renderer.footprints,
                &renderer.geometry,
                &renderer.harmonics,
                &renderer.filter,
                &self.v_splats,
                &renderer.visible,
                &renderer.found,
                &self.v_camera,
            ],
            renderer.shape.count.div_ceil(VJP_GROUP),
        );
    }

    /// Sums the camera's gradients: over 256 splats each on the device, then these sums in order, in double precision.
    fn sum_camera(&mut self, last: &Last) -> CameraGradient {
        let gpu = &self.renderer.gpu;
        let groups = last.found[0].div_ceil(WORKGROUP_SIZE as usize);
        self.v_camera_sums.reserve(gpu, CAMERA_COMPONENTS * groups);
        let mut work = Work::new(gpu);
        work.run(
            &self.renderer.kernels.sum_camera,
            &[&self.renderer.view, &self.v_camera, &self.v_camera_sums],
            groups,
        );
        work.submit();
        let mut sums = [0.0f64; CAMERA_COMPONENTS];
        for of_group in self
            .v_camera_sums
            .to_vec::<[f32; CAMERA_COMPONENTS]>(gpu, CAMERA_COMPONENTS * groups)
        {
            for (sum, value) in sums.iter_mut().zip(of_group) {
                *sum += f64::from(value);
            }
        }
        let view = &last.view;
        view.gradient(
            std::array::from_fn(|i| std::array::from_fn(|j| sums[3 * i + j])),
            std::array::from_fn(|i| sums[9 + i]),
            std::array::from_fn(|i| sums[12 + i]),
        )
    }

    /// Splats whose gradient was not finite in the backward pass before the last frame.
    pub fn non_finite(&self) -> usize {
        self.renderer.last.as_ref().map_or(0, |last| last.non_finite)
    }

    pub fn camera_gradient(&self) -> Option<CameraGradient> {
        self.camera
    }

    /// Reads back the gradients of the last backward pass; those of the harmonics are computed here from those of colours.
    pub fn read_gradients(&self, gradients: &mut SplatGradients) {
        let gpu = &self.renderer.gpu;
        let SplatsShape { count, stride, degree } = self.renderer.shape;
        let last = self.renderer.last.as_ref().expect("render comes first");
        gradients.splats = Splats::zeros(count, degree);
        read_geometry(gpu, &self.v_splats, 0, &mut gradients.splats);
        let (mut v_color, mut means) = (vec![0.0f32; 3 * stride], vec![0.0f32; 3 * stride]);
        self.v_splats.read(gpu, GEOMETRY * stride, &mut v_color);
        self.renderer.geometry.read(gpu, 0, &mut means);
        let used = degree.min(last.options.sh_degree);
        for i in 0..count {
            let mean = [0, 1, 2].map(|c| means[c * stride + i]);
            let basis = basis_at(used, mean, last.view.center());
            for plane in 0..gradients.splats.sh.count() {
                let v = basis[plane / 3] * v_color[plane % 3 * stride + i];
                gradients.splats.sh.set(plane, i, v);
            }
        }
        gradients.screen = Planes::zeros(2, count);
        gradients.gathered = Planes::zeros(2, count);
        self.v_splats
            .read(gpu, (GEOMETRY + 3) * stride, gradients.screen.as_mut_slice());
        self.v_splats
            .read(gpu, (GEOMETRY + 5) * stride, gradients.gathered.as_mut_slice());
        let mut visible = vec![0u32; stride];
        self.renderer.visible.read(gpu, 0, &mut visible[..count]);
        gradients.active = visible.iter().map(|visible| *visible as f32).collect();
        gradients.counts = visible.chunks(CHUNK).map(|chunk| chunk.iter().sum()).collect();
        gradients.camera = self.camera;
        let mut found = [0u32; 3];
        self.renderer.found.read(gpu, 0, &mut found);
        gradients.non_finite = found[2] as usize;
    }

    /// The twin of the CPU's update.
    pub fn update(&mut self, update: &Update) {
        let Some(last) = self.renderer.last.clone() else { return };
        let words = self.update_words(update, [last.view.width, last.view.height]);
        let renderer = &self.renderer;
        let gpu = &renderer.gpu;
        self.update.write(gpu, 0, &words);
        let groups = renderer.shape.count.div_ceil(WORKGROUP_SIZE as usize);
        let mut work = Work::new(gpu);
        work.run(
            &renderer.kernels.update_harmonics,
            &[
                &renderer.view,
                &self.update,
                &renderer.visible,
                &renderer.geometry,
                &self.v_splats,
                &renderer.harmonics,
                &self.moments_harmonics[0],
                &self.moments_harmonics[1],
            ],
            groups,
        );
        work.run(
            &renderer.kernels.update_geometry,
            &[
                &renderer.view,
                &self.update,
                &renderer.visible,
                &renderer.footprints,
                &self.v_splats,
                &renderer.geometry,
                &self.moments_geometry,
                &self.statistics,
            ],
            groups,
        );
        work.submit();
    }

    fn update_words(&self, update: &Update, size: [u32; 2]) -> [u32; UPDATE_WORDS] {
        let SplatsShape { count, stride, degree } = self.renderer.shape;
        let step = &update.optimizer.step;
        let rate = |rate| step.device_rate(rate);
        let rates = &update.rates;
        let regularizers = &update.regularizers;
        let is_regularized = !regularizers.is_zero();
        let all = is_regularized && update.regularized == Regularized::All;
        let limit = if update.trained_fraction < 1.0 {
            self.freeze_threshold(update.trained_fraction)
        } else {
            None
        };
        let noise = update.noise;
        let largest = update.angle_cap.map_or(1.0, |cap| cap.largest);
        let bits = [
            (update.optimizer.dense, update_flag::DENSE),
            (all, update_flag::ALL),
            (noise.is_some(), update_flag::NOISE),
            (update.condition_cap.is_some(), update_flag::CAP),
            (limit.is_some(), update_flag::FREEZE),
            (update.statistics == Some(Statistics::Gradient), update_flag::GRADIENT),
            (
                update.statistics == Some(Statistics::AbsoluteGradient),
                update_flag::ABSOLUTE,
            ),
            (update.statistics == Some(Statistics::Error), update_flag::ERROR),
            (rates.means_from.is_some(), update_flag::DISTANCE),
            (update.angle_cap.is_some(), update_flag::ANGLE),
        ];
        let floats = [
            [rates.means, rates.quats, rates.log_scales, rates.opacities].map(rate),
            [rate(rates.sh_dc), rate(rates.sh_rest), largest.ln(), 0.0],
            step.device_rule(),
            regularizers
                .per_splat(f64::from(update.regularizer_unit), 1.0)
                .map(|weight| weight as f32),
            [
                0.5 * size[0] as f32,
                0.5 * size[1] as f32,
                limit.unwrap_or(0.0),
                noise.map_or(0.0, |noise| noise.amount),
            ],
        ];
        let seed = noise.map_or(0, |noise| {
            (noise.seed as u32) ^ (noise.step as u32).wrapping_mul(0x9e37_79b9)
        });
        let span = update.condition_cap.map_or(0.0, |limit| 0.5 * limit.max(1.0).ln());
        let coefficients = sh::coefficients(update.sh_degree.min(degree));
        let integers = [
            count as u32,
            stride as u32,
            coefficients as u32,
            3 * sh::coefficients(degree) as u32,
            flags(&bits),
            seed,
            span.to_bits(),
            0,
        ];
        let mut words = [0; UPDATE_WORDS];
        let floats = floats.as_flattened().iter().map(|v| v.to_bits());
        for (to, word) in words.iter_mut().zip(floats.chain(integers)) {
            *to = word;
        }
        words
    }

    /// The size below which splats are frozen: all but the largest `fraction` of the visible ones, as in `regularize::freeze_small`.
    fn freeze_threshold(&self, fraction: f32) -> Option<f32> {
        let gpu = &self.renderer.gpu;
        let SplatsShape { count, stride, .. } = self.renderer.shape;
        let mut scales = vec![0.0f32; 3 * stride];
        self.renderer.geometry.read(gpu, 7 * stride, &mut scales);
        let visible: Vec<u32> = self.renderer.visible.to_vec(gpu, count);
        let size = |i: usize| (0..3).map(|c| scales[c * stride + i]).fold(f32::MIN, f32::max);
        size_limit((0..count).filter(|i| visible[*i] != 0).map(size).collect(), fraction)
    }
}

/// Words of `Update` in `update.wgsl`.
const UPDATE_WORDS: usize = 28;

//! Places a run on its device, and computes the losses of a step where its frame is: on a GPU, if the GPU supports all of them.

use crate::field_step::is_field;
use crate::objective::{ObjectiveValues, Reference};
use crate::recipe::Recipe;
use crate::schedule::StepPlan;
use crate::trainer::{TrainError, Trainer};
use irradia_compute::{Device, DeviceError};
use irradia_scene::Camera;
use irradia_splat::{Engine, RenderOptions, Update};
#[cfg(feature = "gpu")]
use {
    crate::objective::{cover_weight, photometric_weights},
    crate::recipe::Param,
    irradia_measure::gpu::{DeviceFrame, ExtraTerms, GpuLoss},
    irradia_measure::{Target, Truth},
    irradia_splat::{DeviceGradient, Statistics},
};

/// Puts the engine of the splats on the device if the recipe's splats, `first_splats` at first, can be trained there in views of `cameras`.
/// Returns lines to report about the devices of the splats and of the recipe's field, which is placed later.
pub(crate) fn use_device(
    engine: &mut Engine,
    device: &Device,
    recipe: &Recipe,
    first_splats: usize,
    cameras: &[Camera],
) -> Result<Vec<String>, DeviceError> {
    if device.is_cpu() {
        return Ok(Vec::new());
    }
    let fields = (0..recipe.stage.len()).filter(|stage| is_field(recipe, *stage)).count();
    let mut decisions = Vec::new();
    if fields < recipe.stage.len() {
        decisions.push(if recipe.residual.is_some() {
            format!("splats with a residual field are trained on the CPU, not on {device}")
        } else if !cameras.iter().all(Camera::is_pinhole) {
            format!("splats in photographs with distortion or a rolling shutter are trained on the CPU, not on {device}")
        } else {
            engine.use_device(device)?;
            let limit = engine.max_splats();
            if first_splats > limit {
                engine.use_device(&Device::Cpu)?;
                format!("splats are trained on the CPU: {device} has room for {limit} of {first_splats} (--max-splats {limit})")
            } else if recipe.max_splats > limit {
                format!("splats are trained on {device}, which has room for {limit}")
            } else {
                format!("splats are trained on {device}")
            }
        });
    }
    if fields > 0 {
        decisions.push(if supports_field(recipe) {
            format!("the field is trained on {device}")
        } else {
            format!("the field is trained on the CPU, not on {device}, which only supports hash grids with occupancy")
        });
    }
    Ok(decisions)
}

/// Whether the recipe's field can be trained on a GPU.
#[cfg(feature = "gpu")]
fn supports_field(recipe: &Recipe) -> bool {
    let space = irradia_field::Space::contracted([0.0; 3], 1.0);
    let config = recipe.field.as_ref().map(|settings| settings.config(1, &space, false));
    config.is_some_and(|config| irradia_field::gpu::supports(&config))
}

#[cfg(not(feature = "gpu"))]
fn supports_field(_: &Recipe) -> bool {
    false
}

impl Trainer {
    /// Reads the state back from its device, before it is written.
    ///
    /// # Errors
    /// If the device has failed: what it returned must not be saved.
    pub fn read_back(&self) -> Result<(), TrainError> {
        self.engine.state();
        if let Some(field) = &self.field {
            field.state();
        }
        self.check_device()
    }

    /// The error of the device, if it has failed.
    pub(crate) fn check_device(&self) -> Result<(), TrainError> {
        if let Some(field) = &self.field {
            field.check_device()?;
        }
        Ok(self.engine.check_device()?)
    }
}

/// Evaluates losses on the device of a run.
pub(crate) struct DeviceLoss {
    #[cfg(feature = "gpu")]
    gpu: Option<GpuLoss>,
}

/// Whether a step's losses need the frame on the host: for random backgrounds, or losses that a GPU lacks.
#[cfg(feature = "gpu")]
fn needs_host(reference: &Reference, plan: &StepPlan, has_lpips: bool) -> bool {
    let weighs = |param| plan.value(param) > 0.0;
    reference.background.is_some()
        || weighs(Param::CoarseWeight)
        || weighs(Param::PerceptualWeight) && has_lpips
        || weighs(Param::AlphaWeight) && reference.photo.alpha.is_some()
        || weighs(Param::MaskWeight) && reference.left_out.is_some()
        || weighs(Param::DepthMapWeight) && reference.depth_map.is_some()
        || weighs(Param::NormalMapWeight) && reference.normal_map.is_some()
        || weighs(Param::SmoothWeight)
        || plan.edge_share > 0.0
}

#[cfg(feature = "gpu")]
impl DeviceLoss {
    /// For `device`.
    pub fn new(device: &Device) -> Result<Self, DeviceError> {
        let gpu = match device {
            Device::Cpu => None,
            Device::Gpu(gpu) => Some(GpuLoss::new(gpu.clone())?),
        };
        Ok(Self { gpu })
    }

    /// A whole step of the state's splats: frame, losses, backward pass and update. Nothing waits for the device before all of it is
    /// submitted, and then only for the values of the losses. `None` if they need the host.
    pub fn whole_step(
        &mut self,
        engine: &mut Engine,
        (camera, options): (&Camera, &RenderOptions),
        reference: &Reference,
        plan: &StepPlan,
        update: &Update,
        has_lpips: bool,
    ) -> Option<ObjectiveValues> {
        if self.gpu.is_none() || !engine.is_on_gpu() || needs_host(reference, plan, has_lpips) {
            return None;
        }
        loop {
            engine.render_ahead(camera, options);
            let values = self.begin(engine, reference, plan, false)?;
            engine.update(update);
            let values = values.finish();
            if engine.finish_frame() {
                return Some(values);
            }
        }
    }

    /// The losses of the last frame, and its backward pass; `None` if they need the host.
    pub fn step(
        &mut self,
        engine: &mut Engine,
        reference: &Reference,
        plan: &StepPlan,
        camera: bool,
        has_lpips: bool,
    ) -> Option<ObjectiveValues> {
        if needs_host(reference, plan, has_lpips) {
            return None;
        }
        Some(self.begin(engine, reference, plan, camera)?.finish())
    }

    /// Submits the losses of the last frame, and its backward pass. `None` on the CPU.
    fn begin(
        &mut self,
        engine: &mut Engine,
        reference: &Reference,
        plan: &StepPlan,
        camera: bool,
    ) -> Option<PendingValues<'_>> {
        let loss = self.gpu.as_mut()?;
        let [planes, v_planes] = engine.device_frame()?;
        let photo = reference.photo;
        let target = Target {
            width: photo.width as usize,
            height: photo.height as usize,
            truth: Truth::Rgb8(&photo.rgb),
            mask: photo.mask.as_deref(),
        };
        let depth_weight = plan.value(Param::DepthWeight);
        let extra = ExtraTerms {
            depths: reference.depths,
            depth_weight,
            cover_weight: cover_weight(photo, plan),
            error: plan.gathers == Some(Statistics::Error),
        };
        let frame = DeviceFrame { planes, v_planes };
        loss.begin(&frame, &target, &photometric_weights(plan), &extra);
        let has_depth = !reference.depths.is_empty();
        engine.backward_on_device(&DeviceGradient {
            alpha: has_depth || cover_weight(photo, plan) > 0.0,
            depth: has_depth,
            gather: plan.gathers.filter(|what| *what != Statistics::Gradient),
            camera,
        });
        Some(PendingValues { loss, depth_weight })
    }
}

/// Losses that the device is still computing.
#[cfg(feature = "gpu")]
struct PendingValues<'a> {
    loss: &'a mut GpuLoss,
    depth_weight: f32,
}

#[cfg(feature = "gpu")]
impl PendingValues<'_> {
    fn finish(self) -> ObjectiveValues {
        let values = self.loss.finish();
        ObjectiveValues {
            total: values.photometric.total + f64::from(self.depth_weight) * values.depth,
            l1: values.photometric.l1,
            mse: values.photometric.mse,
        }
    }
}

#[cfg(not(feature = "gpu"))]
impl DeviceLoss {
    /// For the CPU.
    pub fn new(_: &Device) -> Result<Self, DeviceError> {
        Ok(Self {})
    }

    /// Losses always need the host.
    pub fn whole_step(
        &mut self,
        _: &mut Engine,
        _: (&Camera, &RenderOptions),
        _: &Reference,
        _: &StepPlan,
        _: &Update,
        _: bool,
    ) -> Option<ObjectiveValues> {
        None
    }

    /// Losses always need the host.
    pub fn step(&mut self, _: &mut Engine, _: &Reference, _: &StepPlan, _: bool, _: bool) -> Option<ObjectiveValues> {
        None
    }
}

#[cfg(all(test, feature = "gpu"))]
mod tests {
    use super::*;
    use irradia_compute::DeviceChoice;
    use irradia_scene::sh;
    use irradia_splat::{SplatState, Splats};

    #[test]
    fn more_splats_than_a_gpu_has_room_for_are_trained_on_the_cpu_and_fewer_within_its_limit() {
        let Some(device) = irradia_testkit::gpu_or_skip(|| Device::open(&DeviceChoice::Gpu)) else {
            return;
        };
        let recipe = Recipe::parse("mcmc", Recipe::built_in("mcmc").unwrap(), &[]).unwrap();
        let decision_for = |splats: usize| {
            let mut engine = Engine::new(SplatState::new(Splats::zeros(0, sh::MAX_DEGREE)));
            let decision = use_device(&mut engine, &device, &recipe, splats, &[])
                .unwrap()
                .remove(0);
            (engine.is_on_gpu(), engine.max_splats(), decision)
        };
        let (is_on_gpu, most, decision) = decision_for(1000);
        assert!(is_on_gpu && decision.contains("trained on the GPU"), "{decision}");
        let Device::Gpu(gpu) = &device else { unreachable!() };
        assert!(
            192 * most as u64 <= gpu.info().largest_array,
            "harmonics of degree 3 take 192 bytes a splat"
        );
        let (is_on_gpu, any, decision) = decision_for(most + 1);
        assert!(!is_on_gpu && any == usize::MAX);
        assert!(
            decision.contains("on the CPU") && decision.contains(&format!("--max-splats {most}")),
            "{decision}"
        );
    }
}

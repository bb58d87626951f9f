//! A field in training, on the CPU or on a GPU.

use crate::batch::TrainView;
use crate::state::FieldState;
use crate::train::{StepLoss, StepOptions, train_views};
use irradia_compute::{Device, DeviceError};
#[cfg(feature = "gpu")]
use {crate::gpu::GpuFieldTraining, std::sync::OnceLock};

/// The state of a field in training, on the CPU or on a GPU: the counterpart of splats' `Engine`.
pub struct FieldEngine {
    /// On a GPU, its parameters and moments stay at their initial values; everything else is up to date.
    state: FieldState,
    #[cfg(feature = "gpu")]
    gpu: Option<OnGpu>,
}

#[cfg(feature = "gpu")]
struct OnGpu {
    training: Box<GpuFieldTraining>,
    /// The whole state, if it has been read back since the last step.
    read: OnceLock<FieldState>,
}

impl FieldEngine {
    /// Continues with `state`: on a GPU if `device` is one and GPUs support the field.
    ///
    /// # Errors
    /// When the device refuses the kernels.
    #[cfg_attr(not(feature = "gpu"), allow(unused_variables))]
    pub fn new(state: FieldState, device: &Device) -> Result<Self, DeviceError> {
        Ok(Self {
            #[cfg(feature = "gpu")]
            gpu: match device {
                Device::Gpu(gpu) if crate::gpu::supports(&state.field.config) => Some(OnGpu {
                    training: Box::new(GpuFieldTraining::new(gpu.clone(), &state)?),
                    read: OnceLock::new(),
                }),
                _ => None,
            },
            state,
        })
    }

    /// Checks for failures of the device, after which the state is unspecified.
    ///
    /// # Errors
    /// The failure, if there was one.
    pub fn check_device(&self) -> Result<(), DeviceError> {
        #[cfg(feature = "gpu")]
        if let Some(on) = &self.gpu {
            return on.training.gpu().check();
        }
        Ok(())
    }

    /// Number of trained parameters.
    pub fn len(&self) -> usize {
        self.state.field.len()
    }

    /// Whether there are no parameters; never true.
    pub fn is_empty(&self) -> bool {
        self.state.field.is_empty()
    }

    /// The field with its moments; read back from a GPU on the first call after a step.
    pub fn state(&self) -> &FieldState {
        #[cfg(feature = "gpu")]
        if let Some(on) = &self.gpu {
            return on.read.get_or_init(|| on.training.download(&self.state));
        }
        &self.state
    }

    /// Like [`crate::train_views`].
    pub fn train_views(&mut self, views: &[TrainView], options: &StepOptions) -> StepLoss {
        #[cfg(feature = "gpu")]
        if let Some(on) = &mut self.gpu {
            on.read.take();
            return on_gpu(&mut self.state, &mut on.training, views, options);
        }
        train_views(&mut self.state, views, options)
    }
}

#[cfg(feature = "gpu")]
fn on_gpu(
    state: &mut FieldState,
    training: &mut GpuFieldTraining,
    views: &[TrainView],
    options: &StepOptions,
) -> StepLoss {
    use crate::query::update_occupancy_by;
    use crate::train::{EMPTY_CELL_DIVISOR, draw, set_rays, updates_occupancy};

    let batch = draw(state, views, options);
    let loss = training.step(state, &batch, options);
    state.scratch.batch = batch;
    if updates_occupancy(&loss, options) {
        update_occupancy_by(state, false, EMPTY_CELL_DIVISOR, options.seed, |field, points| {
            training.densities(field, points)
        });
        training.upload_occupancy(&state.field);
    }
    set_rays(state, &loss, options);
    loss
}

//! Renders one model repeatedly.

#[cfg(feature = "gpu")]
use crate::model::field_options;
use crate::model::{Frame, Model, RenderOptions};
use irradia_compute::{Device, DeviceError};
use irradia_scene::Camera;
use irradia_splat::Renderer;
#[cfg(feature = "gpu")]
use {
    irradia_field::gpu::{GpuFieldRenderer, supports},
    irradia_splat::GpuRenderer,
};

/// Renders a model on a device: on a GPU, if the GPU supports the model.
pub struct Painter<'m> {
    model: &'m Model<'m>,
    renderer: Renderer,
    #[cfg(feature = "gpu")]
    gpu: Option<OnGpu>,
}

#[cfg(feature = "gpu")]
enum OnGpu {
    Splats(Box<GpuRenderer>),
    Field(Box<GpuFieldRenderer>),
}

impl<'m> Painter<'m> {
    /// A painter of `model`, which is uploaded once.
    ///
    /// # Errors
    /// When the device refuses the kernels, or has too little memory for the model.
    #[cfg_attr(not(feature = "gpu"), allow(unused_variables))]
    pub fn new(model: &'m Model<'m>, device: &Device) -> Result<Self, DeviceError> {
        Ok(Self {
            renderer: Renderer::new(),
            #[cfg(feature = "gpu")]
            gpu: on_gpu(model, device)?,
            model,
        })
    }

    /// Renders the view of `camera`.
    ///
    /// # Errors
    /// When the device fails.
    pub fn render(&mut self, camera: &Camera, options: &RenderOptions) -> Result<Frame, DeviceError> {
        #[cfg(feature = "gpu")]
        match (&mut self.gpu, self.model) {
            // The kernels of splats are those of a pinhole.
            (Some(OnGpu::Splats(gpu)), _) if camera.is_pinhole() => {
                gpu.render(&irradia_splat::ViewParams::new(camera), options);
                let frame = Frame::of_planes(gpu.frame(), camera);
                gpu.gpu().check()?;
                return Ok(frame);
            }
            (Some(OnGpu::Field(gpu)), Model::Field(field)) => {
                return Ok(Frame::of_view(
                    gpu.render(field, camera, &field_options(options))?,
                    camera,
                ));
            }
            _ => {}
        }
        Ok(self.model.render(&mut self.renderer, camera, options))
    }
}

#[cfg(feature = "gpu")]
fn on_gpu(model: &Model, device: &Device) -> Result<Option<OnGpu>, DeviceError> {
    let Device::Gpu(gpu) = device else {
        return Ok(None);
    };
    Ok(match model {
        Model::Splats { splats, residual: None } => {
            let mut renderer = GpuRenderer::new(gpu.clone())?;
            renderer.upload(splats, &[]);
            gpu.check()?;
            Some(OnGpu::Splats(Box::new(renderer)))
        }
        Model::Field(field) if supports(&field.config) => {
            Some(OnGpu::Field(Box::new(GpuFieldRenderer::new(gpu.clone(), field)?)))
        }
        _ => None,
    })
}

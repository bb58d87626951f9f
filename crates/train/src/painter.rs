//! Renders one model again and again.

use crate::model::{Frame, Model, RenderOptions};
use irradia_compute::{Device, DeviceError};
use irradia_scene::Camera;
use irradia_splat::Renderer;

/// Renders a model on a device: on a GPU, if it consists of splats alone.
pub struct Painter<'m> {
    model: &'m Model<'m>,
    renderer: Renderer,
    #[cfg(feature = "gpu")]
    gpu: Option<irradia_splat::GpuRenderer>,
}

impl<'m> Painter<'m> {
    /// For `model`, whose splats are uploaded once.
    ///
    /// # Errors
    /// When the device refuses the kernels, or has too little memory for the splats.
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
        if let Some(gpu) = &mut self.gpu {
            gpu.render(&irradia_splat::ViewParams::new(camera), options);
            let frame = Frame::of_planes(gpu.frame(), camera);
            gpu.gpu().check()?;
            return Ok(frame);
        }
        Ok(self.model.render(&mut self.renderer, camera, options))
    }
}

#[cfg(feature = "gpu")]
fn on_gpu(model: &Model, device: &Device) -> Result<Option<irradia_splat::GpuRenderer>, DeviceError> {
    let (Device::Gpu(gpu), Model::Splats { splats, residual: None }) = (device, model) else {
        return Ok(None);
    };
    let mut renderer = irradia_splat::GpuRenderer::new(gpu.clone())?;
    renderer.upload(splats, &[]);
    gpu.check()?;
    Ok(Some(renderer))
}

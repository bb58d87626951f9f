//! Rendering of a field on a GPU: the twin of [`crate::render_view`], without normals.

use super::{Batch, GpuField, RAY_GROUP};
use crate::field::Field;
use crate::render::view::{FieldView, RenderOptions, camera_ray};
use crate::space::Measure;
use irradia_compute::DeviceError;
use irradia_compute::gpu::{Array, Gpu, Work};
use irradia_scene::Camera;
use rayon::prelude::*;
use std::sync::Arc;

/// Maximum number of rays per batch.
const MAX_BATCH_RAYS: usize = 1 << 15;

/// A field on a GPU, for rendering.
pub struct GpuFieldRenderer {
    field: GpuField,
    pixels: Array,
    /// Number of rays per batch, reduced when their samples do not fit.
    batch: usize,
}

impl GpuFieldRenderer {
    /// Uploads `field`.
    ///
    /// # Errors
    /// When the device refuses a kernel, or has too little memory.
    ///
    /// # Panics
    /// When GPUs do not support the field: see [`super::supports`].
    pub fn new(gpu: Arc<Gpu>, field: &Field) -> Result<Self, DeviceError> {
        Ok(Self {
            pixels: Array::zeros(&gpu, "pixels", 0),
            field: GpuField::new(gpu, field)?,
            batch: MAX_BATCH_RAYS,
        })
    }

    /// Renders the uploaded field as `camera` sees it. Normals are not computed.
    ///
    /// # Errors
    /// When the device fails.
    pub fn render(
        &mut self,
        field: &Field,
        camera: &Camera,
        options: &RenderOptions,
    ) -> Result<FieldView, DeviceError> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let count = width as usize * height as usize;
        let mut planes = vec![0.0f32; 6 * count];
        let mut cosines = vec![0.0f32; count];
        let mut at = 0;
        while at < count {
            let rays = self.batch.min(count - at);
            let batch = batch_of(field, camera, options, at, &mut cosines[at..at + rays]);
            let max_rays = self.field.max_rays(&batch);
            if rays > max_rays && rays > 1 {
                self.batch = max_rays.max(1);
                continue;
            }
            let samples = self.field.march(&batch);
            if samples > self.field.max_batch_samples() && rays > 1 {
                self.batch = rays / 2;
                continue;
            }
            let pixels = self.pixels_of(&batch, samples);
            for (plane, from) in planes.chunks_exact_mut(count).zip(pixels.chunks_exact(rays)) {
                plane[at..at + rays].copy_from_slice(from);
            }
            at += rays;
        }
        self.field.gpu.check()?;
        let (color, rest) = planes.split_at(3 * count);
        let depth = |plane: usize| {
            let along = rest[plane * count..][..count].iter().zip(&cosines);
            along.map(|(distance, cosine)| distance * cosine).collect()
        };
        Ok(FieldView {
            width,
            height,
            color: color.to_vec(),
            alpha: rest[..count].to_vec(),
            depth: depth(1),
            median_depth: depth(2),
            normals: Vec::new(),
        })
    }

    fn pixels_of(&mut self, batch: &Batch, samples: usize) -> Vec<f32> {
        let (field, rays) = (&mut self.field, batch.rays.len());
        let gpu = field.gpu.clone();
        field.prepare(batch, samples);
        self.pixels.reserve(&gpu, 6 * rays);
        let mut work = Work::new(&gpu);
        field.evaluate(&mut work, rays, samples);
        let arrays = field.composited(&[&self.pixels]);
        work.run(&field.kernels.pixels, &arrays, rays.div_ceil(RAY_GROUP));
        work.submit();
        self.pixels.to_vec(&gpu, 6 * rays)
    }
}

/// The rays of as many pixels as `cosines`, starting at pixel `first`; writes the depth per world unit along each ray to `cosines`.
fn batch_of(field: &Field, camera: &Camera, options: &RenderOptions, first: usize, cosines: &mut [f32]) -> Batch {
    let width = camera.intrinsics.width as usize;
    let [red, green, blue] = options.background;
    let rays = cosines
        .par_iter_mut()
        .enumerate()
        .map(|(i, cosine)| {
            let [x, y] = [(first + i) % width, (first + i) / width].map(|v| v as f32 + 0.5);
            let (ray, along) = camera_ray(field, camera, x, y);
            *cosine = along;
            let measure = match ray.measure {
                Measure::Linear(scale) => [scale, 0.0, 0.0, 1.0],
                Measure::Ndc { start, near, length } => [start, near, length, 0.0],
            };
            GpuField::ray(&ray, 0.5, measure, [red, green, blue, 1.0])
        })
        .collect();
    Batch {
        rays,
        weights: [0.0; 2],
    }
}

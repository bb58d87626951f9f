//! The losses of a training step on any GPU: L1, SSIM and squared error against an 8-bit photograph, sparse depths, and the error of each
//! pixel. The twin of [`crate::PhotometricLoss`] and of the metric [`crate::DepthLoss`].

use crate::loss::job::Gains;
use crate::window::{RADIUS, TAPS, half_window};
use crate::{DepthSample, LossValues, LossWeights, Target, Truth};
use irradia_compute::DeviceError;
use irradia_compute::gpu::{Array, GRID, Gpu, Kernel, Readback, Shader, Work, flags};
use std::sync::Arc;

const TARGET: &str = include_str!("shaders/target.wgsl");
const TILING: &str = include_str!("shaders/tile.wgsl");
const PHOTO: &str = include_str!("shaders/photo.wgsl");
const SUM: &str = include_str!("shaders/sum_group.wgsl");
const SHADERS: [Shader; 3] = [
    Shader {
        name: "ssim_maps",
        parts: &[GRID, TARGET, TILING, PHOTO, SUM, include_str!("shaders/ssim_maps.wgsl")],
    },
    Shader {
        name: "gradient",
        parts: &[GRID, TARGET, TILING, PHOTO, SUM, include_str!("shaders/gradient.wgsl")],
    },
    Shader {
        name: "total",
        parts: &[TARGET, SUM, include_str!("shaders/total.wgsl")],
    },
];

/// Words of `Target` in `target.wgsl` before the window's.
const TARGET_WORDS: usize = 12;
/// Width and height of a tile, pixels.
const TILE: usize = 16;
/// Planes of a frame's gradients: red, green, blue, alpha, depth, error.
pub const GRADIENT_PLANES: usize = 6;

/// Bits of `Target.flags` in `target.wgsl`.
mod flag {
    pub const MASK: u32 = 1;
    pub const SSIM: u32 = 2;
    pub const ERROR: u32 = 4;
}

/// A frame on the device, and room for its gradients.
#[derive(Clone, Copy)]
pub struct DeviceFrame<'a> {
    /// Planes `[5, H, W]`: red, green, blue, alpha, depth.
    pub planes: &'a Array,
    /// Planes `[GRADIENT_PLANES, H, W]`.
    pub v_planes: &'a Array,
}

/// The terms of the loss other than colours.
#[derive(Clone, Copy, Debug)]
pub struct ExtraTerms<'a> {
    /// Known depths in world units; those that are not positive and finite, or are outside the image, do not count.
    pub depths: &'a [DepthSample],
    /// Weight of their loss.
    pub depth_weight: f32,
    /// Weight of the mean of 1 - alpha over all pixels, with 0 at masked ones. This term is in the gradients, not in the values.
    pub cover_weight: f32,
    /// Whether to write the plane of errors: the mean absolute difference of each pixel.
    pub error: bool,
}

/// The values of the losses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceValues {
    /// The loss of colours.
    pub photometric: LossValues,
    /// The loss of depth, unweighted.
    pub depth: f64,
}

/// Computes the losses and their gradients; reuses its memory.
#[derive(Debug)]
pub struct GpuLoss {
    gpu: Arc<Gpu>,
    kernels: [Kernel; 3],
    task: Array,
    photo: Array,
    mask: Array,
    maps: Array,
    sums: Array,
    samples: Array,
    totals: Array,
    readback: Readback,
    /// Weights and number of values of the comparison in flight.
    begun: (LossWeights, f64),
}

impl GpuLoss {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// When the device rejects one.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, DeviceError> {
        let array = |label| Array::zeros(&gpu, label, 0);
        let loss = Self {
            kernels: SHADERS.each_ref().map(|shader| Kernel::new(&gpu, shader)),
            task: Array::zeros(&gpu, "target", TARGET_WORDS + window_words().len()),
            photo: array("photograph"),
            mask: array("mask"),
            maps: array("maps of SSIM"),
            sums: array("sums of tiles"),
            samples: array("samples of depth"),
            totals: Array::zeros(&gpu, "totals", 5),
            readback: Readback::new(&gpu, 5),
            begun: (LossWeights::photometric(0.0), 0.0),
            gpu,
        };
        loss.task.write(&loss.gpu, TARGET_WORDS, &window_words());
        loss.gpu.check()?;
        Ok(loss)
    }

    /// Compares `frame`, sets its gradients, and reads the values back: [`Self::begin`] and [`Self::finish`].
    ///
    /// # Panics
    /// As [`Self::begin`].
    pub fn evaluate(
        &mut self,
        frame: &DeviceFrame,
        target: &Target,
        weights: &LossWeights,
        extra: &ExtraTerms,
    ) -> DeviceValues {
        self.begin(frame, target, weights, extra);
        self.finish()
    }

    /// Compares `frame` and sets its gradients, without waiting for it.
    ///
    /// # Panics
    /// When the truth is not 8-bit, or its length differs from the target's size: a bug in the caller.
    pub fn begin(&mut self, frame: &DeviceFrame, target: &Target, weights: &LossWeights, extra: &ExtraTerms) {
        let gpu = &*self.gpu;
        let (width, height) = (target.width, target.height);
        let Truth::Rgb8(truth) = target.truth else {
            panic!("a photograph of 8 bits");
        };
        assert_eq!(truth.len(), 3 * width * height, "a photograph of the target's size");
        let count = 3.0 * target.weight();
        let tiles = [width, height].map(|side| side.div_ceil(TILE));
        let groups = 3 * tiles[0] * tiles[1];
        write_bytes(gpu, &mut self.photo, truth);
        if let Some(mask) = target.mask {
            write_bytes(gpu, &mut self.mask, mask);
        }
        let flags = flags(&[
            (target.mask.is_some(), flag::MASK),
            (weights.ssim != 0.0, flag::SSIM),
            (extra.error, flag::ERROR),
        ]);
        let samples = packed(extra.depths, width * height);
        self.samples.reserve(gpu, samples.len());
        self.samples.write(gpu, 0, &samples);
        // With nothing to compare, gradients are zero.
        let gains = if count > 0.0 {
            Gains::of(weights, count)
        } else {
            Gains::NONE
        };
        let gains = [gains.l1 as f32, gains.ssim as f32, gains.mse as f32, extra.depth_weight].map(f32::to_bits);
        let sizes = [
            width as u32,
            height as u32,
            tiles[0] as u32,
            (tiles[0] * tiles[1]) as u32,
        ];
        let cover = extra.cover_weight / (width * height).max(1) as f32;
        let more = [flags, samples.len() as u32 / 3, cover.to_bits(), 0];
        self.task.write(gpu, 0, &[sizes, gains, more]);
        self.maps.reserve(gpu, 9 * width * height);
        self.sums.reserve(gpu, 3 * groups);

        let mut work = Work::new(gpu);
        let [maps, gradient, total] = &self.kernels;
        if weights.ssim != 0.0 {
            let arrays = [
                &self.task,
                frame.planes,
                &self.photo,
                &self.mask,
                &self.maps,
                &self.sums,
            ];
            work.run(maps, &arrays, groups);
        }
        work.run(
            gradient,
            &[
                &self.task,
                frame.planes,
                &self.photo,
                &self.mask,
                &self.maps,
                &self.sums,
                frame.v_planes,
            ],
            groups,
        );
        work.run(
            total,
            &[
                &self.task,
                frame.planes,
                &self.sums,
                &self.samples,
                frame.v_planes,
                &self.totals,
            ],
            1,
        );
        work.submit_reading(&self.totals, &mut self.readback);
        self.begun = (*weights, count);
    }

    /// The values of the last comparison. Waits for these alone: the device may already have more work queued.
    pub fn finish(&mut self) -> DeviceValues {
        let mut totals = [0.0f32; 5];
        self.readback.take(&self.gpu, &mut totals);
        let (weights, count) = &self.begun;
        let [l1, mse, dissimilarity, depth, norm] = totals.map(f64::from);
        DeviceValues {
            photometric: LossValues::of_sums(
                [l1, mse, dissimilarity],
                weights,
                if *count > 0.0 { *count } else { 1.0 },
            ),
            depth: if norm > 0.0 { depth / norm } else { 0.0 },
        }
    }
}

/// `Target.window` in `target.wgsl`: 14 values in a row serve the windows of four neighbours.
fn window_words() -> [f32; 4 * (TAPS + 3)] {
    let half = half_window();
    std::array::from_fn(|i| {
        let tap = (i / 4).wrapping_sub(i % 4);
        if tap < TAPS {
            half[tap.abs_diff(RADIUS)] as f32
        } else {
            0.0
        }
    })
}

/// Samples that may count, sorted by pixel: pixel, depth and weight.
fn packed(samples: &[DepthSample], pixels: usize) -> Vec<u32> {
    let good = |value: f32| value > 0.0 && value.is_finite();
    let mut counted: Vec<&DepthSample> = samples
        .iter()
        .filter(|s| good(s.depth) && good(s.weight) && (s.pixel as usize) < pixels)
        .collect();
    counted.sort_by_key(|s| s.pixel);
    counted
        .into_iter()
        .flat_map(|s| [s.pixel, s.depth.to_bits(), s.weight.to_bits()])
        .collect()
}

/// Writes bytes as words, four bytes each.
fn write_bytes(gpu: &Gpu, to: &mut Array, bytes: &[u8]) {
    to.reserve(gpu, bytes.len().div_ceil(4));
    let (words, rest) = bytes.as_chunks::<4>();
    to.write(gpu, 0, words);
    if !rest.is_empty() {
        let mut last = [0; 4];
        last[..rest.len()].copy_from_slice(rest);
        to.write(gpu, words.len(), &[last]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DepthGradient, DepthKind, DepthLoss, DepthPlanes, PhotometricLoss};
    use irradia_compute::gpu::Wanted;
    use irradia_scene::Rng;

    #[test]
    fn every_shader_is_valid() {
        for shader in SHADERS {
            irradia_testkit::validate_shader(shader.name, &shader.source());
        }
    }

    #[test]
    fn losses_and_gradients_agree_with_the_cpu() {
        let Some(gpu) = irradia_testkit::gpu_or_skip(|| Gpu::open(&Wanted::Any)) else {
            return;
        };
        let mut loss = GpuLoss::new(gpu.clone()).unwrap();
        let mut rng = Rng::new(3, 3);
        for (width, height) in [(1, 1), (37, 21), (83, 61)] {
            let pixels = width * height;
            let truth: Vec<u8> = (0..3 * pixels).map(|_| rng.range(0.0, 255.9) as u8).collect();
            let mask: Vec<u8> = (0..pixels).map(|i| [0, 255, 255, 128][i % 4]).collect();
            let planes: Vec<f32> = (0..5 * pixels)
                .map(|i| {
                    if i < 4 * pixels {
                        rng.range(0.0, 1.1)
                    } else {
                        rng.range(0.5, 3.0)
                    }
                })
                .collect();
            let samples: Vec<DepthSample> = (0..pixels as u32)
                .map(|i| DepthSample {
                    // Some pixels twice, one outside.
                    pixel: (i / 2 * 5) % (pixels as u32 + 1),
                    depth: 0.5 + i as f32 % 3.0,
                    weight: i as f32 % 2.0 + 0.5,
                })
                .collect();
            for (ssim, mask) in [(0.2, None), (0.2, Some(&mask[..])), (0.0, None)] {
                let weights = LossWeights {
                    mse: 0.3,
                    ..LossWeights::photometric(ssim)
                };
                let target = Target {
                    width,
                    height,
                    truth: Truth::Rgb8(&truth),
                    mask,
                };
                let mut expected = vec![0.0f32; 6 * pixels];
                let (v_color, rest) = expected.split_at_mut(3 * pixels);
                let values = PhotometricLoss::new().evaluate(&planes[..3 * pixels], &target, &weights, v_color);
                let (v_alpha, rest) = rest.split_at_mut(pixels);
                let (v_depth, errors) = rest.split_at_mut(pixels);
                let depth_planes = DepthPlanes {
                    depth: &planes[4 * pixels..],
                    alpha: &planes[3 * pixels..4 * pixels],
                };
                let mut gradient = DepthGradient {
                    depth: &mut *v_depth,
                    alpha: &mut *v_alpha,
                };
                let metric = DepthKind::Metric;
                let depth = DepthLoss::default().evaluate(depth_planes, &samples, metric, 0.7, &mut gradient);
                for (i, v) in v_alpha.iter_mut().enumerate() {
                    *v -= 0.3 / pixels as f32 * mask.map_or(1.0, |mask| f32::from(mask[i]) / 255.0);
                }
                for (i, error) in errors.iter_mut().enumerate() {
                    if mask.is_none_or(|mask| mask[i] > 0) {
                        let of = |c: usize| (planes[c * pixels + i] - f32::from(truth[3 * i + c]) / 255.0).abs();
                        *error = (of(0) + of(1) + of(2)) / 3.0;
                    }
                }
                let frame = DeviceFrame {
                    planes: &Array::of(&gpu, "frame", &planes),
                    v_planes: &Array::of(&gpu, "gradients", &vec![9.0f32; 6 * pixels]),
                };
                let extra = ExtraTerms {
                    depths: &samples,
                    depth_weight: 0.7,
                    cover_weight: 0.3,
                    error: true,
                };
                let got = loss.evaluate(&frame, &target, &weights, &extra);
                let near =
                    |a: f64, b: f64, what: &str| assert!((a - b).abs() < 1e-5 * b.abs().max(1.0), "{what}: {a} {b}");
                near(got.photometric.total, values.total, "total");
                near(got.photometric.l1, values.l1, "L1");
                near(got.photometric.mse, values.mse, "squares");
                near(got.depth, depth.loss, "depth");
                assert_eq!(got.photometric.ssim.is_some(), values.ssim.is_some());
                let gradients: Vec<f32> = frame.v_planes.to_vec(&gpu, 6 * pixels);
                for plane in 0..6 {
                    let (got, expected) = (
                        &gradients[plane * pixels..][..pixels],
                        &expected[plane * pixels..][..pixels],
                    );
                    let scale = expected.iter().fold(1e-9f32, |m, v| m.max(v.abs()));
                    for (i, (a, b)) in got.iter().zip(expected).enumerate() {
                        assert!(
                            (a - b).abs() < 2e-4 * scale,
                            "{width} x {height}, plane {plane}, pixel {i}: {a} {b}"
                        );
                    }
                }
            }
        }
        gpu.check().unwrap();
    }
}

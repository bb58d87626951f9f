//! What cameras see of each splat.

use crate::draft::gather_gray;
use crate::{Draft, Selection};
use glam::Vec3;
use irradia_scene::Camera;
use irradia_splat::{Gather, OutputGradient, RenderOptions, Renderer, SplatGradients, Splats, ViewParams};
use rayon::prelude::*;

/// Length of the longer side of the pictures, pixels.
const MAX_SIDE: f32 = 480.0;
/// Minimum sum of its blending weights, in pixels, for a splat to count as seen. The sum is 0 for a splat hidden behind others.
pub(crate) const MIN_VISIBLE_WEIGHT: f32 = 0.25;
/// Pixels with a lower alpha have no depth.
const MIN_DEPTH_ALPHA: f32 = 0.5;

/// Renders small pictures of some splats.
pub(crate) struct Observer {
    splats: Splats,
    /// Index of each splat in the draft.
    indices: Vec<u32>,
    /// Number of splats of the draft.
    count: usize,
    options: RenderOptions,
    renderer: Renderer,
    gradients: SplatGradients,
    zeros: Vec<f32>,
}

/// Mean depth along +Z in each pixel of a picture.
pub(crate) struct Depths {
    camera: Camera,
    /// `[H, W]`, world units; infinite where alpha is below [`MIN_DEPTH_ALPHA`].
    depth: Vec<f32>,
}

impl Depths {
    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.depth.len()
    }

    /// The depth that the picture shows in the direction of a point, and the point's own; `None` if it is outside the picture.
    pub fn at(&self, point: Vec3) -> Option<[f32; 2]> {
        let (pixel, depth) = self.camera.sees(point)?;
        let at = pixel.y as usize * self.camera.intrinsics.width as usize + pixel.x as usize;
        Some([self.depth[at], depth])
    }
}

impl Observer {
    /// An observer of the splats `of`.
    pub fn new(draft: &Draft, of: &Selection) -> Self {
        let indices = of.indices();
        Self {
            // Colours do not matter.
            splats: Splats::from_cloud(&gather_gray(&draft.cloud, &indices)),
            indices,
            count: draft.len(),
            options: RenderOptions {
                antialias: draft.cloud.antialiased,
                depth: true,
                ..RenderOptions::default()
            },
            renderer: Renderer::new(),
            gradients: SplatGradients::default(),
            zeros: Vec::new(),
        }
    }

    fn render(&mut self, camera: &Camera) -> Camera {
        let k = camera.intrinsics;
        let longest = k.width.max(k.height) as f32;
        let camera = Camera {
            intrinsics: k.scaled((MAX_SIDE / longest).min(1.0)),
            ..*camera
        };
        self.renderer
            .render(&self.splats, &ViewParams::new(&camera), &self.options);
        camera
    }

    /// The depths that `camera` sees.
    pub fn depths(&mut self, camera: &Camera) -> Depths {
        let camera = self.render(camera);
        let pixels = self.renderer.depth().iter().zip(self.renderer.alpha());
        let mean = |(depth, alpha): (&f32, &f32)| {
            if *alpha >= MIN_DEPTH_ALPHA {
                depth / alpha
            } else {
                f32::INFINITY
            }
        };
        Depths {
            camera,
            depth: pixels.map(mean).collect(),
        }
    }

    /// The sum of each splat's blending weights in the view of `camera`, pixels; zero for splats that are not rendered.
    pub fn weights(&mut self, camera: &Camera) -> Vec<f32> {
        self.render(camera);
        let pixels = self.renderer.alpha().len();
        self.zeros.resize(3 * pixels, 0.0);
        // The backward pass adds up blending weights for density control.
        let gradient = OutputGradient {
            gather: Gather::Error(&self.zeros[..pixels]),
            ..OutputGradient::of_color(&self.zeros[..3 * pixels])
        };
        self.renderer.backward(&self.splats, &gradient, &mut self.gradients);
        let mut weights = vec![0.0; self.count];
        for (i, number) in self.indices.iter().enumerate() {
            if self.gradients.active[i] > 0.0 {
                weights[*number as usize] = self.gradients.gathered.get(1, i);
            }
        }
        weights
    }
}

/// The number of the draft's cameras that see each splat.
pub(crate) fn count_seeing_views(draft: &Draft) -> Vec<u32> {
    let mut observer = Observer::new(draft, &draft.visible());
    let mut views = vec![0; draft.len()];
    for camera in &draft.cameras {
        let weights = observer.weights(camera);
        let each = views.par_iter_mut().zip(weights).with_min_len(1024);
        each.for_each(|(views, weight)| *views += u32::from(weight >= MIN_VISIBLE_WEIGHT));
    }
    views
}

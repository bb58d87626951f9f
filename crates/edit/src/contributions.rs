//! How much each splat shows in pictures.

use crate::Draft;
use irradia_scene::Camera;
use irradia_splat::{Gather, OutputGradient, RenderOptions, Renderer, SplatGradients, Splats, ViewParams};

/// Longest side of the pictures, pixels.
const SIDE: f32 = 480.0;
/// From how many pixels on a splat counts as seen; their blending weights count, so that a hidden splat has none.
const SEEN: f32 = 0.25;

/// The sum of a splat's blending weights over the pixels of one picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Weight(pub f32);

impl Weight {
    pub fn is_seen(self) -> bool {
        self.0 >= SEEN
    }
}

/// Renders pictures of the splats that are not hidden, for their weights.
pub(crate) struct Observer {
    splats: Splats,
    /// The draft's number of each splat.
    numbers: Vec<u32>,
    count: usize,
    options: RenderOptions,
    renderer: Renderer,
    gradients: SplatGradients,
    zeros: Vec<f32>,
}

impl Observer {
    pub fn new(draft: &Draft) -> Self {
        let mut shown = draft.hidden.clone();
        shown.invert();
        let numbers = shown.indices();
        Self {
            splats: Splats::from_cloud(&crate::draft::gather(&draft.cloud, &numbers)),
            numbers,
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

    /// `camera` with a picture of at most [`SIDE`] pixels.
    pub fn small(camera: &Camera) -> Camera {
        let k = camera.intrinsics;
        let longest = k.width.max(k.height) as f32;
        Camera {
            intrinsics: k.scaled((SIDE / longest).min(1.0)),
            ..*camera
        }
    }

    /// The weight of every splat in the picture of `camera`; hidden ones have none.
    pub fn weights(&mut self, camera: &Camera) -> Vec<Weight> {
        let camera = Self::small(camera);
        let k = camera.intrinsics;
        let pixels = k.width as usize * k.height as usize;
        self.zeros.resize(3 * pixels, 0.0);
        self.renderer
            .render(&self.splats, &ViewParams::new(&camera), &self.options);
        // The backward pass adds up weights for density control.
        let gradient = OutputGradient {
            gather: Gather::Error(&self.zeros[..pixels]),
            ..OutputGradient::of_color(&self.zeros)
        };
        self.renderer.backward(&self.splats, &gradient, &mut self.gradients);
        let mut weights = vec![Weight::default(); self.count];
        for (i, number) in self.numbers.iter().enumerate() {
            if self.gradients.active[i] > 0.0 {
                weights[*number as usize] = Weight(self.gradients.gathered.get(1, i));
            }
        }
        weights
    }
}

/// The weight of every splat in one picture.
pub(crate) fn weights_in(draft: &Draft, camera: &Camera) -> Vec<Weight> {
    Observer::new(draft).weights(camera)
}

//! The result of a run: splats or a field. All code that renders them differently is here.

use crate::lights::Light;
use crate::socket::{added_colors, sum_of_colors};
use irradia_field::{Field, FieldView, render_view};
use irradia_scene::{Camera, Image};
use irradia_splat::{FramePlanes, Renderer, Splats, ViewParams};
use std::borrow::Cow;

/// A scene that can be rendered.
#[derive(Clone, Debug)]
pub enum Model<'a> {
    /// 3D Gaussians.
    Splats {
        /// The Gaussians.
        splats: Cow<'a, Splats>,
        /// The field that adds to their colours.
        residual: Option<Box<Field>>,
    },
    /// A radiance field.
    Field(Cow<'a, Field>),
}

/// Renders the view of `camera` into the buffers of `renderer`, with the colours that `residual` and `light` add; the light's exposure is
/// applied by [`Light::exposed`].
pub fn render_splats(
    splats: &Splats,
    residual: Option<&Field>,
    light: Option<Light>,
    renderer: &mut Renderer,
    camera: &Camera,
    options: &RenderOptions,
) {
    let view = ViewParams::new(camera);
    let light = light.filter(Light::adds_colors);
    if residual.is_none() && light.is_none() {
        return renderer.render(splats, &view, options);
    }
    renderer.project(splats, &view, options);
    let (center, surfaces) = (camera.pose.position, splats.surfaces(renderer.in_view()));
    let reflected = residual.map(|field| added_colors(field, center, &surfaces));
    let lit = light.and_then(|light| light.added_colors(center, &surfaces));
    renderer.add_colors(&sum_of_colors(reflected, lit));
    renderer.composite();
}

/// How a [`Model`] is rendered; options that do not apply to its kind are ignored.
pub type RenderOptions = irradia_splat::RenderOptions;

/// A rendered frame of a [`Model`].
#[derive(Clone, Debug)]
pub struct Frame {
    /// Colour over the background, `[H, W, 3]`, sRGB.
    pub color: Image,
    /// Coverage of each pixel, `[H * W]`.
    pub alpha: Vec<f32>,
    /// Depth along the camera's +Z times alpha, `[H * W]`, world units; empty if not requested.
    pub depth: Vec<f32>,
}

impl Frame {
    /// From the planes of a renderer.
    pub(crate) fn of_planes(planes: FramePlanes, camera: &Camera) -> Self {
        Self {
            color: interleaved(planes.color, camera),
            alpha: planes.alpha.to_vec(),
            depth: planes.depth.to_vec(),
        }
    }

    /// From the view of a field.
    pub(crate) fn of_view(view: FieldView, camera: &Camera) -> Self {
        let depth = view.depth.iter().zip(&view.alpha).map(|(depth, alpha)| depth * alpha);
        Self {
            color: interleaved(&view.color, camera),
            depth: depth.collect(),
            alpha: view.alpha,
        }
    }
}

/// The options of a field.
pub(crate) fn field_options(options: &RenderOptions) -> irradia_field::RenderOptions {
    irradia_field::RenderOptions {
        background: options.background,
        image: None,
        normals: false,
    }
}

/// `[H, W, 3]` from `[3, H, W]`.
fn interleaved(planes: &[f32], camera: &Camera) -> Image {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let pixels = width as usize * height as usize;
    let data = (0..3 * pixels).map(|i| planes[(i % 3) * pixels + i / 3]).collect();
    Image::new(width, height, 3, data)
}

impl<'a> Model<'a> {
    /// A scene of Gaussians alone.
    pub fn of_splats(splats: impl Into<Cow<'a, Splats>>) -> Self {
        Model::Splats {
            splats: splats.into(),
            residual: None,
        }
    }

    /// Renders the view of `camera`; `renderer` reuses its buffers from frame to frame.
    pub fn render(&self, renderer: &mut Renderer, camera: &Camera, options: &RenderOptions) -> Frame {
        match self {
            Model::Splats { splats, residual } => {
                render_splats(splats, residual.as_deref(), None, renderer, camera, options);
                Frame::of_planes(renderer.frame(), camera)
            }
            Model::Field(field) => {
                let view = render_view(field, camera, &field_options(options));
                Frame::of_view(view, camera)
            }
        }
    }

    /// The same model, owned; only borrowed parts are copied.
    pub fn into_owned(self) -> Model<'static> {
        match self {
            Model::Splats { splats, residual } => Model::Splats {
                splats: Cow::Owned(splats.into_owned()),
                residual,
            },
            Model::Field(field) => Model::Field(Cow::Owned(field.into_owned())),
        }
    }

    /// The Gaussians, if it consists of splats.
    pub fn splats(&self) -> Option<&Splats> {
        match self {
            Model::Splats { splats, .. } => Some(splats),
            Model::Field(_) => None,
        }
    }

    /// The field, if it is one.
    pub fn field(&self) -> Option<&Field> {
        match self {
            Model::Splats { .. } => None,
            Model::Field(field) => Some(field),
        }
    }
}

//! What a run makes: splats or a field. Every place that renders them differently is here.

use crate::socket::added_colors;
use irradia_field::{Field, render_view};
use irradia_scene::{Camera, Image};
use irradia_splat::{Renderer, Splats, ViewParams};
use std::borrow::Cow;

/// A scene that can be rendered.
#[derive(Clone, Debug)]
pub enum Model<'a> {
    /// 3D Gaussians.
    Splats {
        /// The Gaussians.
        splats: Cow<'a, Splats>,
        /// What adds to their colours.
        residual: Option<Box<Field>>,
    },
    /// A radiance field.
    Field(Cow<'a, Field>),
}

/// How a [`Model`] is rendered; what does not concern its kind is ignored.
pub type RenderOptions = irradia_splat::RenderOptions;

/// What a camera sees of a [`Model`].
#[derive(Clone, Debug)]
pub struct Frame {
    /// Colour over the background, `[H, W, 3]`, sRGB.
    pub color: Image,
    /// How much of each pixel is covered, `[H * W]`.
    pub alpha: Vec<f32>,
    /// Depth along the camera's +Z times alpha, `[H * W]`, world units; empty where it was not asked for.
    pub depth: Vec<f32>,
}

impl Model<'_> {
    /// What `camera` sees; `renderer` keeps its buffers from frame to frame.
    pub fn render(&self, renderer: &mut Renderer, camera: &Camera, options: &RenderOptions) -> Frame {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let pixels = width as usize * height as usize;
        let image = |planes: &[f32]| {
            let data = (0..3 * pixels).map(|i| planes[(i % 3) * pixels + i / 3]).collect();
            Image::new(width, height, 3, data)
        };
        match self {
            Model::Splats { splats, residual } => {
                let view = ViewParams::new(camera);
                match residual {
                    Some(field) => {
                        renderer.project(splats, &view, options);
                        let surfaces = splats.surfaces(renderer.in_view());
                        renderer.add_colors(&added_colors(field, camera.pose.position, &surfaces));
                        renderer.composite();
                    }
                    None => renderer.render(splats, &view, options),
                }
                Frame {
                    color: image(renderer.color()),
                    alpha: renderer.alpha().to_vec(),
                    depth: if options.depth {
                        renderer.depth().to_vec()
                    } else {
                        Vec::new()
                    },
                }
            }
            Model::Field(field) => {
                let options = irradia_field::RenderOptions {
                    background: options.background,
                    image: None,
                    normals: false,
                };
                let view = render_view(field, camera, &options);
                let depth = view.depth.iter().zip(&view.alpha).map(|(depth, alpha)| depth * alpha);
                Frame {
                    color: image(&view.color),
                    depth: depth.collect(),
                    alpha: view.alpha,
                }
            }
        }
    }

    /// The same model, owned; only what is borrowed is copied.
    pub fn into_owned(self) -> Model<'static> {
        match self {
            Model::Splats { splats, residual } => Model::Splats {
                splats: Cow::Owned(splats.into_owned()),
                residual,
            },
            Model::Field(field) => Model::Field(Cow::Owned(field.into_owned())),
        }
    }

    /// Gaussians, where that is what it is.
    pub fn splats(&self) -> Option<&Splats> {
        match self {
            Model::Splats { splats, .. } => Some(splats),
            Model::Field(_) => None,
        }
    }

    /// The field, where that is what it is.
    pub fn field(&self) -> Option<&Field> {
        match self {
            Model::Splats { .. } => None,
            Model::Field(field) => Some(field),
        }
    }
}

//! The picture of a camera: colours, depth, alpha, normals, counts, ellipses, or the error against a photograph.

use crate::editing::moved_camera;
use crate::importance::by_importance;
use crate::message::{Mode, Picked, PickedSplat, Shot};
use crate::pace::Detail;
use crate::palette;
use crate::subject::Edition;
use crate::views::Views;
use glam::{Vec2, Vec3};
use irradia_field::{Field, render_view};
use irradia_runs::psnr_8_bits;
use irradia_scene::{Camera, Intrinsics, LoadError, Photo, sh};
use irradia_splat::render::Shape;
use irradia_splat::{RenderOptions, Renderer, Splats};
use irradia_train::lights::Light;
use irradia_train::model::{Model, render_splats};
use rayon::prelude::*;
use std::borrow::Cow;

/// Rows of a field that are drawn between two checks whether the picture is still wanted.
const STRIP_ROWS: u32 = 32;
/// Opacity of a splat outside the clipping box, before the sigmoid: far below 1/255.
const HIDDEN_LOGIT: f32 = -30.0;
/// Error that is drawn in the last colour of the map.
const MAX_ERROR: f32 = 0.25;
/// Coverage below which a pixel has no depth.
const MIN_DEPTH_ALPHA: f32 = 0.5;

/// A picture, 8 bits, `[H, W, 3]`.
pub(crate) struct Picture {
    pub width: u32,
    pub height: u32,
    pub rgb: Vec<u8>,
    /// Values at both ends of the colour map, if there is one.
    pub range: Option<[f32; 2]>,
}

/// A frame as planes of `[H * W]`.
struct Planes {
    /// Three planes.
    color: Vec<f32>,
    alpha: Vec<f32>,
    /// Expected depth; empty if not requested.
    depth: Vec<f32>,
}

/// Draws pictures; reuses its buffers from picture to picture.
pub(crate) struct Painter<'a> {
    views: &'a Views,
    renderer: Renderer,
    /// The most important splats of a version, most important first.
    important: Option<ImportantSplats>,
    /// Splats that differ from the scene's: clipped, selected, or coloured by their normals.
    altered: Option<(Alteration, Splats)>,
    /// The last photograph that was read, by its view; `None` if it cannot be.
    photo: Option<(usize, Option<Photo>)>,
}

struct ImportantSplats {
    /// Of the splats.
    version: u64,
    /// Their indices in the scene.
    order: Vec<u32>,
    splats: Splats,
}

#[derive(Clone, Copy, PartialEq)]
struct Alteration {
    version: u64,
    part: Part,
    clip: Option<[[f32; 3]; 2]>,
    normals: bool,
    /// Whether selected splats are tinted.
    highlight: bool,
}

/// The part of the scene that is altered.
#[derive(Clone, Copy, PartialEq)]
enum Part {
    /// [`Painter::important`].
    Important,
    /// A level of detail; 0 is the scene itself.
    Level(usize),
}

/// The splats to draw if nothing is altered.
struct ChosenSplats<'a> {
    part: Part,
    splats: &'a Splats,
    /// Their indices in the scene, if they are the most important ones.
    order: Option<&'a [u32]>,
}

/// Whether levels of detail may replace the scene: not if individual splats are shown, or selected ones are tinted.
fn has_levels(edition: &Edition, shot: &Shot) -> bool {
    !edition.levels.all().is_empty() && shot.mode == Mode::Color && !(shot.highlight && edition.selected.is_some())
}

impl<'a> Painter<'a> {
    /// A painter of a scene with these views.
    pub fn new(views: &'a Views) -> Self {
        Self {
            views,
            renderer: Renderer::default(),
            important: None,
            altered: None,
            photo: None,
        }
    }

    /// Prepares what pictures of this detail need, once per version.
    pub fn prepare(&mut self, edition: &Edition, shot: &Shot, detail: &Detail) {
        if detail.splats == 1.0
            || has_levels(edition, shot)
            || self
                .important
                .as_ref()
                .is_some_and(|important| important.version == edition.splats_version)
        {
            return;
        }
        self.important = edition.scene().model.splats().map(|splats| {
            let count = (splats.len() as f32 * Detail::MAX_PARTIAL_SPLATS).ceil() as usize;
            let mut order = by_importance(splats);
            order.truncate(count);
            ImportantSplats {
                version: edition.splats_version,
                splats: splats.gather(&order),
                order,
            }
        });
    }

    /// Draws `shot` in this detail, after [`Self::prepare`]; `None` if it is no longer wanted, or its photograph has not been read.
    pub fn paint(
        &mut self,
        edition: &Edition,
        shot: &Shot,
        detail: &Detail,
        wanted: &(dyn Fn() -> bool + Sync),
    ) -> Option<Picture> {
        let scene = edition.scene();
        let mut camera = shot.camera;
        camera.intrinsics = camera.intrinsics.scaled(detail.pixels.sqrt());
        let [width, height] = [camera.intrinsics.width, camera.intrinsics.height];
        let options = RenderOptions {
            background: shot.background.unwrap_or(scene.options.background),
            depth: shot.mode == Mode::Depth,
            blend: !matches!(shot.mode, Mode::Count | Mode::Ellipses | Mode::Rings | Mode::Points),
            ..scene.options
        };
        let has_normals = shot.mode == Mode::Normals;
        let (rgb, range) = match &scene.model {
            Model::Splats { splats, residual } => {
                let important = self.important.take();
                let number = if detail.moving && has_levels(edition, shot) {
                    edition.levels.choose(&camera, detail.splats)
                } else {
                    0
                };
                let level = edition.levels.get(number);
                let few = important.as_ref().filter(|_| detail.splats < 1.0 && level.is_none());
                let options = RenderOptions {
                    sh_degree: if has_normals { 0 } else { options.sh_degree },
                    first: few.map_or(usize::MAX, |_| (detail.splats * splats.len() as f32) as usize),
                    ..options
                };
                let chosen = match few {
                    Some(important) => ChosenSplats {
                        part: Part::Important,
                        splats: &important.splats,
                        order: Some(&important.order),
                    },
                    None => ChosenSplats {
                        part: Part::Level(number),
                        splats: level.unwrap_or(splats),
                        order: None,
                    },
                };
                let altered = self.altered(edition, shot, &chosen);
                let splats = altered.as_ref().map_or(chosen.splats, |(_, splats)| splats);
                let residual = residual.as_deref().filter(|_| !has_normals);
                let light = light_of(edition, shot.light).filter(|_| !has_normals);
                render_splats(splats, residual, light, &mut self.renderer, &camera, &options);
                let drawn = self.splats_picture(shot, &options, [width, height], light);
                (self.altered, self.important) = (altered, important);
                drawn?
            }
            Model::Field(field) => {
                let planes = field_planes(field, &camera, &options, has_normals, wanted)?;
                self.planes_picture(shot, &planes, options.background, [width, height])?
            }
        };
        Some(Picture {
            width,
            height,
            rgb,
            range,
        })
    }

    /// The splats to draw instead of `chosen`, made for this camera; `None` if nothing is altered.
    fn altered(&mut self, edition: &Edition, shot: &Shot, chosen: &ChosenSplats) -> Option<(Alteration, Splats)> {
        let has_colors = matches!(shot.mode, Mode::Color | Mode::Ellipses | Mode::Rings | Mode::Points);
        let selected = edition.selected.as_deref().filter(|_| shot.highlight && has_colors);
        let alteration = Alteration {
            version: edition.version,
            part: chosen.part,
            clip: shot.clip,
            normals: shot.mode == Mode::Normals,
            highlight: selected.is_some(),
        };
        if alteration.clip.is_none() && !alteration.normals && !alteration.highlight {
            return None;
        }
        let kept = self.altered.take().filter(|(kept, _)| *kept == alteration);
        let (_, mut altered) = kept.unwrap_or_else(|| {
            let mut altered = alter(chosen.splats, &alteration);
            if let Some(selected) = selected {
                tint(&mut altered, |i| {
                    selected[chosen.order.map_or(i, |order| order[i] as usize)]
                });
            }
            (alteration, altered)
        });
        if alteration.normals {
            orient_normals(&mut altered, shot.camera.pose.position);
        }
        Some((alteration, altered))
    }

    fn splats_picture(
        &mut self,
        shot: &Shot,
        options: &RenderOptions,
        size: [u32; 2],
        light: Option<Light>,
    ) -> Option<(Vec<u8>, Option<[f32; 2]>)> {
        let shape = match shot.mode {
            Mode::Ellipses => Some(Shape::Ellipses),
            Mode::Rings => Some(Shape::Rings),
            Mode::Points => Some(Shape::Points),
            _ => None,
        };
        if let Some(shape) = shape {
            return Some((to_rgb(&self.renderer.shapes(shape, options.background)), None));
        }
        if shot.mode == Mode::Count {
            return Some(counts_picture(&self.renderer.counts()));
        }
        let color = apply_exposure(light, self.renderer.color());
        if matches!(shot.mode, Mode::Color | Mode::Normals) {
            return Some((to_rgb(&color), None));
        }
        let alpha = self.renderer.alpha().to_vec();
        let depth = self
            .renderer
            .depth()
            .iter()
            .zip(&alpha)
            .map(|(d, a)| d / a.max(1e-6))
            .collect();
        let planes = Planes {
            color: color.into_owned(),
            alpha,
            depth,
        };
        self.planes_picture(shot, &planes, options.background, size)
    }

    fn planes_picture(
        &self,
        shot: &Shot,
        planes: &Planes,
        background: [f32; 3],
        [width, height]: [u32; 2],
    ) -> Option<(Vec<u8>, Option<[f32; 2]>)> {
        Some(match shot.mode {
            Mode::Depth => depth_picture(&planes.depth, &planes.alpha),
            Mode::Alpha => {
                let grey = planes.alpha.iter().map(|a| [to_8_bits(*a); 3]);
                (grey.flatten().collect(), Some([0.0, 1.0]))
            }
            Mode::Error => {
                let (view, photo) = self.photo.as_ref()?;
                let photo = photo.as_ref().filter(|_| Some(*view) == shot.view)?;
                let truth = photo.resized(width, height).over(background);
                error_picture(&planes.color, &truth)
            }
            // A field has no splats: colours are drawn instead of counts and shapes.
            _ => (to_rgb(&planes.color), None),
        })
    }

    /// Reads the photograph of view `index`, which pictures of errors need. Returns whether there is one.
    ///
    /// # Errors
    /// When it cannot be read; for the same view, once.
    pub fn read_photo(&mut self, index: usize) -> Result<bool, LoadError> {
        if let Some((_, photo)) = self.photo.as_ref().filter(|(kept, _)| *kept == index) {
            return Ok(photo.is_some());
        }
        let source = self.views.0.get(index).and_then(|view| view.photo.as_ref());
        let (photo, outcome) = match source.map(|source| source.load()) {
            Some(Ok(photo)) => (Some(photo), Ok(true)),
            Some(Err(error)) => (None, Err(error)),
            None => (None, Ok(false)),
        };
        self.photo = Some((index, photo));
        outcome
    }

    /// PSNR of the scene against the photograph of view `index`, in that one's light, dB; `None` without a photograph.
    pub fn score(&mut self, edition: &Edition, index: usize) -> Option<f64> {
        let views = self.views;
        let view = views.0.get(index)?;
        let scene = edition.scene();
        let photo = view.photo.as_ref()?.load().ok()?;
        let camera = moved_camera(&view.camera, &edition.placement);
        let k = &camera.intrinsics;
        let truth = photo.resized(k.width, k.height);
        let (truth, mask) = (truth.over(scene.options.background), truth.mask);
        let render = match &scene.model {
            Model::Splats { splats, residual } => {
                let light = light_of(edition, view.trained.then_some(index));
                let residual = residual.as_deref();
                render_splats(splats, residual, light, &mut self.renderer, &camera, &scene.options);
                to_rgb(&apply_exposure(light, self.renderer.color()))
            }
            Model::Field(_) => {
                let frame = scene.model.render(&mut self.renderer, &camera, &scene.options);
                frame.color.to_u8()
            }
        };
        psnr_8_bits(&render, &truth, mask.as_deref())
    }

    /// What is at the pixel `(x, y)` of `shot`.
    pub fn pick(&mut self, edition: &Edition, shot: &Shot, x: f32, y: f32, tag: String) -> Picked {
        let scene = edition.scene();
        let k = &shot.camera.intrinsics;
        let nothing = Picked {
            tag,
            ..Picked::default()
        };
        if !(x >= 0.0 && y >= 0.0 && x < k.width as f32 && y < k.height as f32) {
            return nothing;
        }
        let pixel = Vec2::new(x.floor() + 0.5, y.floor() + 0.5);
        let (depth, splat) = match &scene.model {
            Model::Splats { splats, residual } => {
                let whole = ChosenSplats {
                    part: Part::Level(0),
                    splats,
                    order: None,
                };
                let plain = Shot {
                    mode: Mode::Color,
                    highlight: false,
                    ..*shot
                };
                let options = RenderOptions {
                    blend: false,
                    ..scene.options
                };
                let altered = self.altered(edition, &plain, &whole);
                let drawn = altered.as_ref().map_or(whole.splats, |(_, splats)| splats);
                render_splats(
                    drawn,
                    residual.as_deref(),
                    None,
                    &mut self.renderer,
                    &shot.camera,
                    &options,
                );
                self.altered = altered;
                let hits = self.renderer.hits(x as u32, y as u32);
                let mut transmittance = 1.0;
                let surface = hits.iter().find(|hit| {
                    transmittance -= hit.weight;
                    transmittance < 0.5
                });
                let best = hits.iter().max_by(|a, b| a.weight.total_cmp(&b.weight));
                let depth = surface.map(|hit| hit.depth);
                (depth, best.map(|best| picked_splat(splats, best, hits.len())))
            }
            Model::Field(field) => {
                let camera = pixel_of(&shot.camera, x.floor(), y.floor());
                let options = irradia_field::RenderOptions::default();
                let depth = render_view(field, &camera, &options).median_depth[0];
                ((depth > 0.0).then_some(depth), None)
            }
        };
        let (from, direction) = shot.camera.ray(pixel);
        let along = direction.dot(shot.camera.pose.rotation * Vec3::Z);
        Picked {
            point: depth.map(|depth| (from + direction * (depth / along)).to_array()),
            depth,
            splat,
            ..nothing
        }
    }
}

/// The light of `view`, if it is known.
fn light_of(edition: &Edition, view: Option<usize>) -> Option<Light<'_>> {
    edition.lights.as_deref()?.of_view(view?)
}

/// `color` `[3, H, W]` in the exposure of `light`.
fn apply_exposure<'c>(light: Option<Light>, color: &'c [f32]) -> Cow<'c, [f32]> {
    light.map_or(Cow::Borrowed(color), |light| light.exposed(color))
}

fn picked_splat(splats: &Splats, hit: &irradia_splat::render::Hit, of: usize) -> PickedSplat {
    let i = hit.splat as usize;
    let mut scales: [f32; 3] = std::array::from_fn(|c| splats.log_scales.get(c, i).exp());
    scales.sort_unstable_by(|a, b| b.total_cmp(a));
    PickedSplat {
        index: hit.splat,
        of,
        mean: splats.mean(i),
        scales,
        opacity: splats.opacity(i),
        color: hit.color.map(|c| c.min(1.0)),
        base: std::array::from_fn(|c| sh::color_from_dc(splats.sh.get(c, i))),
        depth: hit.depth,
        weight: hit.weight,
    }
}

/// The camera of the single pixel `(x, y)`.
fn pixel_of(camera: &Camera, x: f32, y: f32) -> Camera {
    let k = camera.intrinsics;
    Camera {
        intrinsics: Intrinsics {
            width: 1,
            height: 1,
            cx: k.cx - x,
            cy: k.cy - y,
            ..k
        },
        ..*camera
    }
}

/// A copy of `splats`, hidden outside the clipping box and coloured by normals as requested.
fn alter(splats: &Splats, alteration: &Alteration) -> Splats {
    let n = splats.len();
    let mut altered = if alteration.normals {
        let mut plain = Splats::zeros(n, 0);
        plain.means.clone_from(&splats.means);
        plain.quats.clone_from(&splats.quats);
        plain.log_scales.clone_from(&splats.log_scales);
        plain.opacity_logits.clone_from(&splats.opacity_logits);
        let normals: Vec<[f32; 3]> = (0..n).into_par_iter().map(|i| splats.shortest_axis(i)).collect();
        for c in 0..3 {
            for (to, normal) in plain.sh.plane_mut(c).iter_mut().zip(&normals) {
                // The colour is half of the normal plus a half.
                *to = sh::dc_from_color(0.5 + 0.5 * normal[c]);
            }
        }
        plain
    } else {
        splats.clone()
    };
    if let Some([low, high]) = alteration.clip {
        for i in 0..n {
            let mean = splats.mean(i);
            if (0..3).any(|c| mean[c] < low[c] || mean[c] > high[c]) {
                altered.opacity_logits.set(0, i, HIDDEN_LOGIT);
            }
        }
    }
    altered
}

/// Mixes the colour of selected splats with [`palette::SELECTED`], as `project.frag` does.
fn tint(splats: &mut Splats, is_selected: impl Fn(usize) -> bool + Sync) {
    const SHARE: f32 = palette::SELECTED_SHARE;
    let n = splats.len();
    let selected: Vec<usize> = (0..n).into_par_iter().filter(|i| is_selected(*i)).collect();
    for plane in 0..splats.sh.count() {
        let values = splats.sh.plane_mut(plane);
        for i in &selected {
            values[*i] *= 1.0 - SHARE;
            if let Some(target) = palette::SELECTED.get(plane) {
                values[*i] += SHARE * sh::dc_from_color(*target);
            }
        }
    }
}

/// Turns normals, kept as harmonics of degree 0, towards the camera at `center`.
fn orient_normals(splats: &mut Splats, center: Vec3) {
    for i in 0..splats.len() {
        let outward = Vec3::from(splats.mean(i)) - center;
        let normal = Vec3::from_array(std::array::from_fn(|c| splats.sh.get(c, i)));
        if normal.dot(outward) > 0.0 {
            for (c, value) in normal.to_array().into_iter().enumerate() {
                splats.sh.set(c, i, -value);
            }
        }
    }
}

/// Renders a view of a field strip by strip, as long as it is wanted.
fn field_planes(
    field: &Field,
    camera: &Camera,
    options: &RenderOptions,
    normals: bool,
    wanted: &(dyn Fn() -> bool + Sync),
) -> Option<Planes> {
    let k = camera.intrinsics;
    let row = k.width as usize;
    let pixels = row * k.height as usize;
    let mut planes = Planes {
        color: vec![0.0; 3 * pixels],
        alpha: Vec::with_capacity(pixels),
        depth: Vec::with_capacity(pixels),
    };
    for top in (0..k.height).step_by(STRIP_ROWS as usize) {
        if !wanted() {
            return None;
        }
        let strip = Camera {
            intrinsics: Intrinsics {
                height: STRIP_ROWS.min(k.height - top),
                cy: k.cy - top as f32,
                ..k
            },
            ..*camera
        };
        let drawn = render_view(
            field,
            &strip,
            &irradia_field::RenderOptions {
                background: options.background,
                image: None,
                normals,
            },
        );
        let (from, len) = (top as usize * row, drawn.alpha.len());
        for c in 0..3 {
            let to = &mut planes.color[c * pixels + from..][..len];
            if normals {
                let plane = drawn.normals[c * len..][..len].iter().zip(&drawn.alpha);
                for (to, (normal, alpha)) in to.iter_mut().zip(plane) {
                    *to = (0.5 + 0.5 * normal) * alpha + options.background[c] * (1.0 - alpha);
                }
            } else {
                to.copy_from_slice(&drawn.color[c * len..][..len]);
            }
        }
        planes.alpha.extend(drawn.alpha);
        planes.depth.extend(drawn.depth);
    }
    Some(planes)
}

fn to_8_bits(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn to_8_bit_color(color: [f32; 3]) -> [u8; 3] {
    color.map(to_8_bits)
}

/// Three planes as interleaved 8 bits.
fn to_rgb(planes: &[f32]) -> Vec<u8> {
    let pixels = planes.len() / 3;
    let [red, green, blue] = [0, 1, 2].map(|c| &planes[c * pixels..][..pixels]);
    let mut rgb = vec![0; 3 * pixels];
    rgb.par_chunks_mut(3 * 4096).enumerate().for_each(|(chunk, to)| {
        let from = chunk * 4096;
        for (i, to) in to.chunks_exact_mut(3).enumerate() {
            to[0] = to_8_bits(red[from + i]);
            to[1] = to_8_bits(green[from + i]);
            to[2] = to_8_bits(blue[from + i]);
        }
    });
    rgb
}

/// The next value below (or above, if `up`) of a grid of ten per decade, so that a scale does not flicker.
fn rounded_to_grid(value: f32, up: bool) -> f32 {
    let at = 10.0 * value.log10();
    10f32.powf(if up { at.ceil() } else { at.floor() } / 10.0)
}

/// Depth in logarithmic colours, near is light, between the 1st and the 99th percentile.
fn depth_picture(depth: &[f32], alpha: &[f32]) -> (Vec<u8>, Option<[f32; 2]>) {
    let covered = || {
        depth
            .iter()
            .zip(alpha)
            .filter(|(d, a)| **a > MIN_DEPTH_ALPHA && **d > 0.0)
    };
    let mut sample: Vec<f32> = covered().step_by(7).map(|(d, _)| *d).collect();
    sample.sort_unstable_by(f32::total_cmp);
    let at = |share: f32| sample.get((sample.len() as f32 * share) as usize).copied();
    let (Some(near), Some(far)) = (at(0.01), at(0.99)) else {
        return (vec![0; 3 * depth.len()], None);
    };
    let (near, far) = (rounded_to_grid(near, false), rounded_to_grid(far, true));
    let scale = 1.0 / (far / near).ln().max(1e-6);
    let color = |(d, a): (&f32, &f32)| {
        if *a > MIN_DEPTH_ALPHA && *d > 0.0 {
            to_8_bit_color(palette::sequential(1.0 - (d / near).ln() * scale))
        } else {
            [0; 3]
        }
    };
    let rgb = depth.iter().zip(alpha).flat_map(color).collect();
    (rgb, Some([near, far]))
}

/// Counts in logarithmic colours up to the next power of two.
fn counts_picture(counts: &[f32]) -> (Vec<u8>, Option<[f32; 2]>) {
    let most = counts.iter().copied().fold(1.0, f32::max);
    let most = 2f32.powf(most.log2().ceil());
    let scale = 1.0 / (1.0 + most).ln();
    let color = |count: &f32| to_8_bit_color(palette::sequential((1.0 + count).ln() * scale));
    (counts.iter().flat_map(color).collect(), Some([0.0, most]))
}

/// The mean absolute difference over the channels.
fn error_picture(color: &[f32], truth: &[u8]) -> (Vec<u8>, Option<[f32; 2]>) {
    let pixels = color.len() / 3;
    let error = |i: usize| {
        let channel = |c: usize| (color[c * pixels + i].clamp(0.0, 1.0) - f32::from(truth[3 * i + c]) / 255.0).abs();
        to_8_bit_color(palette::heat((0..3).map(channel).sum::<f32>() / 3.0 / MAX_ERROR))
    };
    ((0..pixels).flat_map(error).collect(), Some([0.0, MAX_ERROR]))
}

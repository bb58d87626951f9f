//! Inspection of a frame: the number of splats in each pixel, splats as solid ellipses or rings, and the splats at one pixel. All of
//! it reads the projection and the bins of the last frame, so that it shows what was drawn.
//!
//! `m` is the squared Mahalanobis distance of a pixel to a splat's centre, in standard deviations of its footprint.

use super::bin::{BAND_BLOCKS, BLOCK_HEIGHT, BLOCK_WIDTH, TILE};
use super::blend::{ALPHA_MAX, Footprint2d, LOG2_ALPHA_MIN, TRANSMITTANCE_MIN};
use super::{Renderer, corner};
use rayon::prelude::*;
use std::f32::consts::LN_2;

/// How splats are drawn in [`Renderer::shapes`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// Opaque ellipses of 1.5 standard deviations with a darker rim.
    Ellipses,
    /// The rims alone, translucent.
    Rings,
    /// Discs of 1.5 pixels at the centres.
    Points,
}

/// A splat's part in one pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index of the splat.
    pub splat: u32,
    /// Its alpha in the pixel.
    pub alpha: f32,
    /// Its share of the pixel's colour.
    pub weight: f32,
    /// [Depth](irradia_scene::Intrinsics::depth) of its centre, world units.
    pub depth: f32,
    /// Its colour as seen from the camera, after clamping at 0.
    pub color: [f32; 3],
}

/// Squared distance of an ellipse's border, and of its rim's inner edge.
const BORDER_SQUARED: f32 = 1.5 * 1.5;
const RIM_SQUARED: f32 = 1.3 * 1.3;
/// Radius of a point, pixels.
const POINT_RADIUS: f32 = 1.5;

/// log2 of alpha at the pixel centre `(x, y)`, before the cap.
fn log2_alpha(s: &Footprint2d, x: f32, y: f32) -> f32 {
    let [a, b, c] = s.quadratic;
    let (dx, dy) = (x - s.xy[0], y - s.xy[1]);
    a * dx * dx + b * dx * dy + c * dy * dy + s.log2_opacity
}

impl Renderer {
    /// The number of splats whose alpha reaches 1/255 in each pixel of the last frame, `[H, W]`, those behind opaque ones included.
    ///
    /// # Panics
    /// When nothing was rendered.
    pub fn counts(&self) -> Vec<f32> {
        let [counts] = self.by_pixel([0.0], |[count], s, x, y| {
            *count += f32::from(u8::from(log2_alpha(s, x, y) >= LOG2_ALPHA_MIN as f32));
            true
        });
        counts
    }

    /// The last frame with its splats drawn as `shape` over `background`: `[3, H, W]`.
    ///
    /// # Panics
    /// When nothing was rendered.
    pub fn shapes(&self, shape: Shape, background: [f32; 3]) -> Vec<f32> {
        if shape == Shape::Points {
            return self.points(background);
        }
        let is_ring = shape == Shape::Rings;
        // Colour so far, and the transmittance.
        let planes = self.by_pixel([0.0, 0.0, 0.0, 1.0], |[r, g, b, t], s, x, y| {
            let m = 2.0 * LN_2 * (s.log2_opacity - log2_alpha(s, x, y));
            let (alpha, shade) = match (m <= BORDER_SQUARED, m >= RIM_SQUARED, is_ring) {
                (false, ..) | (_, false, true) => return true,
                (_, true, true) => (0.6, 1.0),
                (_, rim, false) => (1.0, if rim { 0.7 } else { 1.0 }),
            };
            for (to, from) in [r, g, b].into_iter().zip(s.color) {
                *to += *t * alpha * shade * from;
            }
            *t *= 1.0 - alpha;
            *t > TRANSMITTANCE_MIN as f32
        });
        let [r, g, b, t] = planes;
        let over = |plane: Vec<f32>, background: f32| -> Vec<f32> {
            plane.iter().zip(&t).map(|(color, t)| color + t * background).collect()
        };
        [over(r, background[0]), over(g, background[1]), over(b, background[2])].concat()
    }

    /// The nearest splat's point in each pixel. Bins list faint splats in fewer pixels than their points cover, so these are found without
    /// them.
    fn points(&self, background: [f32; 3]) -> Vec<f32> {
        let view = self.view.as_ref().expect("projection comes first");
        let (width, height) = (view.width as usize, view.height as usize);
        let mut nearest = vec![(u32::MAX, background); width * height];
        // The pixels whose centres may lie within a point about `center`.
        let covered = |center: f32, size: usize| {
            let [first, last] = [-POINT_RADIUS, POINT_RADIUS].map(|radius| center + radius - 0.5);
            first.ceil() as usize..size.min((last + 1.0).floor() as usize)
        };
        for (s, key) in self.footprints.iter().zip(&self.depth_keys) {
            if *key == u32::MAX {
                continue;
            }
            for y in covered(s.xy[1], height) {
                for x in covered(s.xy[0], width) {
                    let (dx, dy) = (x as f32 + 0.5 - s.xy[0], y as f32 + 0.5 - s.xy[1]);
                    let pixel = &mut nearest[y * width + x];
                    if *key < pixel.0 && dx * dx + dy * dy <= POINT_RADIUS * POINT_RADIUS {
                        *pixel = (*key, s.color);
                    }
                }
            }
        }
        let plane = |c: usize| nearest.iter().map(move |(_, color)| color[c]);
        (0..3).flat_map(plane).collect()
    }

    /// The splats that contribute to the pixel in column `x`, row `y` of the last frame, front to back.
    ///
    /// # Panics
    /// When nothing was rendered.
    pub fn hits(&self, x: u32, y: u32) -> Vec<Hit> {
        let mut hits = Vec::new();
        let view = self.view.as_ref().expect("projection comes first");
        if x >= view.width || y >= view.height {
            return hits;
        }
        let (tile_x, tile_y) = (x as usize / TILE, y as usize / TILE);
        let mut transmittance = 1.0f32;
        for entry in self.bins.tile(tile_y * self.bins.tiles_x + tile_x) {
            let s = &self.footprints[entry.splat as usize];
            let p = log2_alpha(s, x as f32 + 0.5, y as f32 + 0.5);
            if p < LOG2_ALPHA_MIN as f32 {
                continue;
            }
            let alpha = p.exp2().min(ALPHA_MAX as f32);
            let weight = alpha * transmittance;
            if transmittance - weight <= TRANSMITTANCE_MIN as f32 {
                break;
            }
            transmittance -= weight;
            hits.push(Hit {
                splat: entry.splat,
                alpha,
                weight,
                depth: s.depth,
                color: s.color,
            });
        }
        hits
    }

    /// Folds `add` front to back over the splats of each pixel until it returns false. `[N]` planes of `[H, W]`.
    fn by_pixel<const N: usize>(
        &self,
        start: [f32; N],
        add: impl Fn(&mut [f32; N], &Footprint2d, f32, f32) -> bool + Sync,
    ) -> [Vec<f32>; N] {
        let view = self.view.as_ref().expect("projection comes first");
        let (width, height) = (view.width as usize, view.height as usize);
        let tiles: Vec<Vec<[f32; N]>> = (0..self.bins.tile_count())
            .into_par_iter()
            .map(|tile| {
                let corner = corner(&self.bins, tile);
                let mut pixels = vec![start; TILE * TILE];
                let mut live = vec![true; TILE * TILE];
                for entry in self.bins.tile(tile) {
                    let s = &self.footprints[entry.splat as usize];
                    let mut blocks = entry.blocks;
                    while blocks != 0 {
                        let block = blocks.trailing_zeros() as usize;
                        blocks &= blocks - 1;
                        let left = block / BAND_BLOCKS * BLOCK_WIDTH;
                        let top = block % BAND_BLOCKS * BLOCK_HEIGHT;
                        for i in 0..BLOCK_WIDTH * BLOCK_HEIGHT {
                            let (x, y) = (left + i % BLOCK_WIDTH, top + i / BLOCK_WIDTH);
                            let at = y * TILE + x;
                            if live[at] {
                                let (x, y) = (corner[0] + x as f32 + 0.5, corner[1] + y as f32 + 0.5);
                                live[at] = add(&mut pixels[at], s, x, y);
                            }
                        }
                    }
                }
                pixels
            })
            .collect();
        std::array::from_fn(|n| {
            let at = |i: usize| {
                let (x, y) = (i % width, i / width);
                let tile = y / TILE * self.bins.tiles_x + x / TILE;
                tiles[tile][y % TILE * TILE + x % TILE][n]
            };
            (0..width * height).into_par_iter().map(at).collect()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RenderOptions, Splats, ViewParams, logit};
    use irradia_scene::{Camera, Intrinsics, Pose, sh};

    fn rendered() -> Renderer {
        rendered_with(&RenderOptions::default())
    }

    /// Two splats on the axis of a camera, the nearer one red with opacity 0.8, the farther one green with 0.5.
    fn rendered_with(options: &RenderOptions) -> Renderer {
        let mut splats = Splats::zeros(2, 0);
        for (i, (z, opacity)) in [(2.0, 0.8), (3.0, 0.5)].into_iter().enumerate() {
            splats.means.plane_mut(2)[i] = z;
            splats.quats.plane_mut(0)[i] = 1.0;
            for c in 0..3 {
                splats.log_scales.plane_mut(c)[i] = 0.1f32.ln();
                splats.sh.plane_mut(c)[i] = sh::dc_from_color(f32::from(u8::from(c == i)));
            }
            splats.opacity_logits.plane_mut(0)[i] = logit(opacity);
        }
        let camera = Camera::new(
            Pose {
                rotation: glam::Quat::IDENTITY,
                position: glam::Vec3::ZERO,
            },
            Intrinsics::from_fov_x(41, 41, 1.0),
        );
        let mut renderer = Renderer::new();
        renderer.render(&splats, &ViewParams::new(&camera), options);
        renderer
    }

    #[test]
    fn nothing_need_be_blended() {
        let (blended, binned) = (
            rendered(),
            rendered_with(&RenderOptions {
                blend: false,
                ..RenderOptions::default()
            }),
        );
        assert!(binned.color().is_empty());
        assert_eq!(binned.hits(20, 20), blended.hits(20, 20));
        assert_eq!(binned.counts(), blended.counts());
        for shape in [Shape::Ellipses, Shape::Rings, Shape::Points] {
            assert_eq!(
                binned.shapes(shape, [0.0; 3]),
                blended.shapes(shape, [0.0; 3]),
                "{shape:?}"
            );
        }
    }

    #[test]
    fn hits_are_front_to_back_with_the_weights_of_the_picture() {
        let renderer = rendered();
        let hits = renderer.hits(20, 20);
        let order: Vec<u32> = hits.iter().map(|hit| hit.splat).collect();
        assert_eq!(order, [0, 1]);
        assert!((hits[0].weight - 0.8).abs() < 1e-3 && (hits[1].weight - 0.2 * 0.5).abs() < 1e-3);
        assert_eq!((hits[0].depth, hits[1].depth), (2.0, 3.0));
        let sum: f32 = hits.iter().map(|hit| hit.weight).sum();
        assert!((sum - renderer.alpha()[20 * 41 + 20]).abs() < 1e-5);
        assert!(renderer.hits(0, 0).is_empty() && renderer.hits(41, 0).is_empty());
    }

    #[test]
    fn counts_are_those_of_the_hits() {
        let renderer = rendered();
        let counts = renderer.counts();
        for (x, y) in [(20, 20), (0, 0), (26, 20), (20, 29)] {
            // Nothing is opaque here, so that no splat is hidden.
            assert_eq!(
                counts[y * 41 + x] as usize,
                renderer.hits(x as u32, y as u32).len(),
                "{x} {y}"
            );
        }
        assert_eq!(counts[20 * 41 + 20], 2.0);
    }

    #[test]
    fn shapes_are_solid_where_the_nearest_splat_is() {
        let renderer = rendered();
        let at = |plane: &[f32], channel: usize, x: usize| plane[channel * 41 * 41 + 20 * 41 + x];
        let ellipses = renderer.shapes(Shape::Ellipses, [0.0, 0.0, 1.0]);
        assert!(
            (at(&ellipses, 0, 20) - 1.0).abs() < 1e-3,
            "the red one hides all behind it"
        );
        assert!(at(&ellipses, 1, 20) < 1e-3 && at(&ellipses, 2, 20) < 1e-3);
        assert_eq!(at(&ellipses, 2, 2), 1.0, "background");
        let points = renderer.shapes(Shape::Points, [0.0; 3]);
        assert!(at(&points, 0, 20) > 0.99 && at(&points, 0, 23) == 0.0);
        let rings = renderer.shapes(Shape::Rings, [0.0; 3]);
        assert_eq!(at(&rings, 0, 20), 0.0, "rings are hollow");
        assert!(rings[..41 * 41].iter().any(|red| *red > 0.5));
    }

    #[test]
    fn points_of_faint_splats_are_whole_across_borders_of_tiles() {
        // Barely visible and smaller than a pixel, near a corner of four tiles.
        let mut splats = Splats::zeros(1, 0);
        splats.means.set(2, 0, 2.0);
        splats.quats.set(0, 0, 1.0);
        (0..3).for_each(|c| splats.log_scales.set(c, 0, -9.0));
        (0..3).for_each(|c| splats.sh.set(c, 0, sh::dc_from_color(1.0)));
        splats.opacity_logits.set(0, 0, logit(0.005));
        let pose = Pose {
            rotation: glam::Quat::IDENTITY,
            position: glam::Vec3::ZERO,
        };
        let intrinsics = Intrinsics {
            cx: 31.9,
            cy: 32.2,
            ..Intrinsics::from_fov_x(64, 64, 1.0)
        };
        let mut renderer = Renderer::new();
        let view = ViewParams::new(&Camera::new(pose, intrinsics));
        renderer.render(&splats, &view, &RenderOptions::default());
        let points = renderer.shapes(Shape::Points, [0.0; 3]);
        for (i, red) in points[..64 * 64].iter().enumerate() {
            let center = glam::Vec2::new((i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5);
            let is_within = center.distance(glam::Vec2::new(31.9, 32.2)) <= 1.5;
            assert_eq!(*red > 0.5, is_within, "{center}");
        }
    }
}

//! Undistortion of photographs to pinhole images: same focal lengths, cropped so that every pixel is valid.

use crate::Pixels;
use glam::{DQuat, DVec2, DVec3};
use irradia_scene::{Intrinsics, Lens, Part};
use std::f64::consts::PI;
use std::sync::LazyLock;

/// Spacing of the grid on which the lens is evaluated, pixels; in between, it is interpolated. The error is the second
/// derivative of the mapping times 8, a few thousandths of a pixel for photographic lenses.
const GRID_SPACING: u32 = 8;
/// Maximum size of an undistorted image relative to the photograph (COLMAP's `max_scale`); a fisheye's rim would otherwise
/// stretch to infinity.
const MAX_SCALE: f64 = 2.0;
/// Minimum side of a crop, pixels.
const MIN_CROP_SIDE: i64 = 16;

/// The mapping from the photographs of one camera to pinhole images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Undistortion {
    /// The camera of the photographs.
    source: Intrinsics,
    /// The camera of the results.
    pinhole: Intrinsics,
    /// Rotation from the results' axes to the photographs'.
    rotation: DQuat,
    interpolation: Interpolation,
}

/// How values between pixels are interpolated.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Interpolation {
    /// From 2 x 2 pixels, as COLMAP and OpenCV undistort, so that figures are comparable with those of other programs.
    Bilinear,
    /// From 6 x 6 pixels with Lanczos's kernel, which keeps detail as fine as the pixels. Measured on `synth`'s room (photographs by a
    /// fisheye, held-out views by a pinhole, 3,000 steps): 39.04 dB bilinearly, 39.62 with 4 x 4 pixels (Keys 1981), 39.81 with 6 x 6.
    Lanczos,
}

impl Undistortion {
    /// The pinhole with the source's axes and focal lengths, cropped to the largest upright rectangle in which every pixel lies
    /// in the photograph; `None` when there is no such rectangle.
    pub fn plan(source: &Intrinsics) -> Option<Self> {
        let half = DVec2::new(f64::from(source.width), f64::from(source.height)) * (0.5 * MAX_SCALE);
        let (cx, cy) = (f64::from(source.cx), f64::from(source.cy));
        let largest = Crop {
            left: (cx - half.x) as i64,
            top: (cy - half.y) as i64,
            right: (cx + half.x) as i64,
            bottom: (cy + half.y) as i64,
        };
        let largest_radius = (half.x / f64::from(source.fx)).hypot(half.y / f64::from(source.fy));
        let max_radius = source.lens.reach_on_plane(largest_radius);
        let whole = Self {
            source: *source,
            pinhole: Intrinsics {
                lens: Lens::Pinhole,
                ..*source
            },
            rotation: DQuat::IDENTITY,
            interpolation: Interpolation::Bilinear,
        };
        whole.cropped(largest, |p| p.length() < max_radius)
    }

    /// The image of `pinhole` rotated by `rotation` (from its axes to the photographs'), cropped as by [`Undistortion::plan`] to the
    /// directions, in the photographs' axes, for which `shows` is true.
    pub fn rotated(
        source: &Intrinsics,
        pinhole: Intrinsics,
        rotation: DQuat,
        shows: impl Fn(DVec3) -> bool,
    ) -> Option<Self> {
        let whole = Self {
            source: *source,
            pinhole,
            rotation,
            interpolation: Interpolation::Lanczos,
        };
        let largest = Crop {
            left: 0,
            top: 0,
            right: i64::from(pinhole.width),
            bottom: i64::from(pinhole.height),
        };
        whole.cropped(largest, |p| shows(rotation * p.extend(1.0)))
    }

    /// `self` cropped within `largest` (in pixels of its image) so that every pixel lies in the photograph and `is_shown` is true for
    /// every point of the undistorted plane.
    ///
    /// The rectangle is found by peeling: starting from a box that is certainly too large, the side with the largest fraction
    /// outside is moved in until all four sides are inside. The valid region has no holes, so the interior is valid, too.
    fn cropped(self, largest: Crop, is_shown: impl Fn(DVec2) -> bool) -> Option<Self> {
        let valid = |x: f64, y: f64| is_shown(self.pinhole.plane_of(DVec2::new(x, y))) && self.is_in_photograph(x, y);
        let mut crop = largest;
        let step = (i64::from(self.source.width.max(self.source.height)) / 256).max(1);
        loop {
            let outside = Side::ALL.map(|side| crop.outside(side, 64, valid));
            let worst_side = (0..4).max_by_key(|i| outside[*i]).expect("four sides");
            if outside[worst_side] == 0 {
                break;
            }
            crop.shrink(Side::ALL[worst_side], step);
            if crop.right - crop.left < MIN_CROP_SIDE || crop.bottom - crop.top < MIN_CROP_SIDE {
                return None;
            }
        }
        // Peeling overshoots by less than a step: add single rows and columns back, sampled more densely.
        for side in Side::ALL {
            for _ in 0..step {
                let mut larger = crop;
                larger.shrink(side, -1);
                if !largest.contains(&larger) || Side::ALL.iter().any(|side| larger.outside(*side, 256, valid) > 0) {
                    break;
                }
                crop = larger;
            }
        }
        Some(Self {
            pinhole: Intrinsics {
                width: (crop.right - crop.left) as u32,
                height: (crop.bottom - crop.top) as u32,
                cx: (f64::from(self.pinhole.cx) - crop.left as f64) as f32,
                cy: (f64::from(self.pinhole.cy) - crop.top as f64) as f32,
                ..self.pinhole
            },
            ..self
        })
    }

    /// The camera of the results.
    pub fn pinhole(&self) -> Intrinsics {
        self.pinhole
    }

    /// The rotation from the results' axes to the photographs'.
    pub fn rotation(&self) -> DQuat {
        self.rotation
    }

    /// Whether the results show the position `(x, y)` of the photograph, pixels.
    pub fn shows(&self, x: f64, y: f64) -> bool {
        let direction = self.source.lens.direction(self.source.plane_of(DVec2::new(x, y)));
        let ray = direction.map(|direction| self.rotation.inverse() * direction);
        ray.filter(|ray| ray.z > 0.0).is_some_and(|ray| {
            let k = &self.pinhole;
            let at = k.pixel_of(ray.truncate() / ray.z);
            (0.0..=f64::from(k.width)).contains(&at.x) && (0.0..=f64::from(k.height)).contains(&at.y)
        })
    }

    /// Position in the photograph of a position in the results, both as fractions of the sides; `None` beyond the photograph, or
    /// where the lens does not map the direction to a pixel.
    pub fn position_in_photo(&self, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        let at = self.source_position(x * f64::from(self.pinhole.width), y * f64::from(self.pinhole.height))?;
        let position = [
            at.x / f64::from(self.source.width),
            at.y / f64::from(self.source.height),
        ];
        position.iter().all(|at| (0.0..=1.0).contains(at)).then_some(position)
    }

    /// Whether the photographs wrap around, from the right edge to the left one.
    pub fn wraps(&self) -> bool {
        self.source.lens == Lens::Equirectangular
    }

    /// Position in the photograph, pixels, of a position in the results; `None` where the lens does not map the direction to a pixel.
    fn source_position(&self, x: f64, y: f64) -> Option<DVec2> {
        let direction = self.rotation * self.pinhole.plane_of(DVec2::new(x, y)).extend(1.0);
        Some(self.source.pixel_of(self.source.lens.project(direction)?))
    }

    /// Whether a position in the results lies between the centres of the photograph's outermost pixels. Every position lies in a
    /// panorama, which wraps around.
    fn is_in_photograph(&self, x: f64, y: f64) -> bool {
        let within = |at: f64, side: u32| (0.5..=f64::from(side) - 0.5).contains(&at);
        self.source_position(x, y)
            .is_some_and(|at| self.wraps() || within(at.x, self.source.width) && within(at.y, self.source.height))
    }

    /// Undistorts an image at the source's size or a fraction of it; the result is at the same fraction of its full size.
    pub fn apply(&self, from: &Pixels) -> Pixels {
        self.apply_to_part(from, Part::whole([from.width, from.height]))
    }

    /// Like [`Undistortion::apply`], for an image of which only `part` is the photograph.
    pub fn apply_to_part(&self, from: &Pixels, part: Part) -> Pixels {
        match from.channels {
            1 => self.apply_channels::<1>(from, part),
            3 => self.apply_channels::<3>(from, part),
            _ => self.apply_channels::<4>(from, part),
        }
    }

    fn apply_channels<const C: usize>(&self, from: &Pixels, part: Part) -> Pixels {
        // Pixels of the source per pixel of `from`, and pixels of the full-size result per pixel of this one; 1 at full size.
        let per_source = [
            f64::from(self.source.width) / part.size[0],
            f64::from(self.source.height) / part.size[1],
        ];
        let side = |full: u32, step: f64| ((f64::from(full) / step) as u32).max(1);
        let (width, height) = (
            side(self.pinhole.width, per_source[0]),
            side(self.pinhole.height, per_source[1]),
        );
        let per_result = [
            f64::from(self.pinhole.width) / f64::from(width),
            f64::from(self.pinhole.height) / f64::from(height),
        ];
        // Not interpolated for panoramas: longitudes jump behind the camera, and all meet at the poles.
        let wraps = self.wraps();
        let grid = if wraps { 1 } else { GRID_SPACING };
        let grid_columns = width.div_ceil(grid) + 1;
        let grid_row = |y: u32| -> Vec<[f32; 2]> {
            (0..grid_columns)
                .map(|column| {
                    let center = [column * grid, y].map(|at| f64::from(at) + 0.5);
                    let at = self.source_position(center[0] * per_result[0], center[1] * per_result[1]);
                    // `None` only for points of the grid beyond the result.
                    let at = at.unwrap_or(DVec2::new(f64::from(self.source.cx), f64::from(self.source.cy)));
                    [0, 1].map(|axis| (part.start[axis] + at[axis] / per_source[axis] - 0.5) as f32)
                })
                .collect()
        };
        let mut data = Vec::with_capacity(width as usize * height as usize * C);
        let mut upper = grid_row(0);
        for first in (0..height).step_by(grid as usize) {
            let lower = grid_row(first + grid);
            for y in first..(first + grid).min(height) {
                let t = (y - first) as f32 / grid as f32;
                let lerp = |i: usize, axis: usize| upper[i][axis] + (lower[i][axis] - upper[i][axis]) * t;
                for column in 0..grid_columns as usize - 1 {
                    let start = [lerp(column, 0), lerp(column, 1)];
                    let end = [lerp(column + 1, 0), lerp(column + 1, 1)];
                    let slope = [(end[0] - start[0]) / grid as f32, (end[1] - start[1]) / grid as f32];
                    for i in 0..grid.min(width - column as u32 * grid) {
                        let at = [start[0] + slope[0] * i as f32, start[1] + slope[1] * i as f32];
                        data.extend(match self.interpolation {
                            Interpolation::Bilinear => sample::<C, 2>(from, at, wraps, |t| [1.0 - t, t]),
                            Interpolation::Lanczos => sample::<C, 6>(from, at, wraps, lanczos),
                        });
                    }
                }
            }
            upper = lower;
        }
        Pixels {
            width,
            height,
            channels: from.channels,
            data,
        }
    }
}

/// The weighted sum of the `N` x `N` pixels around a position. `weights(t)` are the weights along an axis, at the fraction `t` of the
/// way between the two middle pixels. Pixels beyond the image repeat its border or, with `wraps`, continue at the opposite side. With
/// 4 channels, colour is weighted by alpha.
fn sample<const C: usize, const N: usize>(
    from: &Pixels,
    at: [f32; 2],
    wraps: bool,
    weights: impl Fn(f32) -> [f32; N],
) -> [u8; C] {
    let (width, height) = (from.width as isize, from.height as isize);
    let x = if wraps {
        at[0]
    } else {
        at[0].clamp(0.0, (width - 1) as f32)
    };
    let y = at[1].clamp(0.0, (height - 1) as f32);
    let (left, top) = (x.floor(), y.floor());
    let taps_before = N as isize / 2 - 1;
    let columns: [usize; N] = std::array::from_fn(|i| {
        let column = left as isize + i as isize - taps_before;
        (if wraps {
            column.rem_euclid(width)
        } else {
            column.clamp(0, width - 1)
        }) as usize
    });
    let (u, v) = (weights(x - left), weights(y - top));
    let mut sums = [0f32; C];
    let mut color_weight = 0.0;
    for (i, v) in v.into_iter().enumerate() {
        let row = (top as isize + i as isize - taps_before).clamp(0, height - 1) * width;
        for (column, u) in columns.into_iter().zip(u) {
            let start = (row as usize + column) * C;
            let pixel: &[u8; C] = from.data[start..start + C].try_into().expect("C values");
            let weight = u * v;
            let color = if C == 4 { weight * f32::from(pixel[3]) } else { weight };
            color_weight += color;
            for c in 0..C {
                sums[c] += f32::from(pixel[c]) * if c < 3 { color } else { weight };
            }
        }
    }
    if C == 4 {
        let scale = if color_weight > 0.0 { 1.0 / color_weight } else { 0.0 };
        sums[..3].iter_mut().for_each(|v| *v *= scale);
    }
    // Values below 0 or above 255 saturate.
    sums.map(|v| (v + 0.5) as u8)
}

/// Lanczos's kernel of three lobes at the six pixels around a position, at the fraction `t` of the way from the third to the fourth,
/// normalised to a sum of 1. From a table, since sines would take most of the time.
fn lanczos(t: f32) -> [f32; 6] {
    const STEPS: usize = 256;
    static TABLE: LazyLock<Vec<[f32; 6]>> = LazyLock::new(|| {
        let at = |step: usize| {
            let weights: [f64; 6] = std::array::from_fn(|i| {
                let distance = PI * (step as f64 / STEPS as f64 + 2.0 - i as f64);
                let sinc = |v: f64| if v == 0.0 { 1.0 } else { v.sin() / v };
                sinc(distance) * sinc(distance / 3.0)
            });
            let sum: f64 = weights.iter().sum();
            weights.map(|weight| (weight / sum) as f32)
        };
        (0..=STEPS).map(at).collect()
    });
    TABLE[(t * STEPS as f32).round() as usize]
}

#[derive(Clone, Copy, Debug)]
struct Crop {
    left: i64,
    top: i64,
    right: i64,
    bottom: i64,
}

#[derive(Clone, Copy, Debug)]
enum Side {
    Left,
    Top,
    Right,
    Bottom,
}

impl Side {
    const ALL: [Self; 4] = [Self::Left, Self::Top, Self::Right, Self::Bottom];
}

impl Crop {
    /// Number of the `samples` + 1 pixel centres along a side that are outside the photograph.
    fn outside(&self, side: Side, samples: u32, valid: impl Fn(f64, f64) -> bool) -> usize {
        let (left, top) = (self.left as f64 + 0.5, self.top as f64 + 0.5);
        let (right, bottom) = (self.right as f64 - 0.5, self.bottom as f64 - 0.5);
        let count = (0..=samples).filter(|i| {
            let t = f64::from(*i) / f64::from(samples);
            let (x, y) = (left + (right - left) * t, top + (bottom - top) * t);
            !match side {
                Side::Left => valid(left, y),
                Side::Top => valid(x, top),
                Side::Right => valid(right, y),
                Side::Bottom => valid(x, bottom),
            }
        });
        count.count()
    }

    fn contains(&self, other: &Self) -> bool {
        self.left <= other.left && self.top <= other.top && self.right >= other.right && self.bottom >= other.bottom
    }

    fn shrink(&mut self, side: Side, by: i64) {
        match side {
            Side::Left => self.left += by,
            Side::Top => self.top += by,
            Side::Right => self.right -= by,
            Side::Bottom => self.bottom -= by,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(lens: Lens) -> Intrinsics {
        Intrinsics {
            width: 320,
            height: 240,
            fx: 250.0,
            fy: 255.0,
            cx: 150.0,
            cy: 125.0,
            lens,
        }
    }

    const LENSES: [Lens; 4] = [
        Lens::Opencv {
            k: [-0.25, 0.06, 0.0, 0.0, 0.0, 0.0],
            p: [0.001, -0.002],
        },
        Lens::Opencv {
            k: [0.2, 0.01, 0.0, 0.0, 0.0, 0.0],
            p: [0.0, 0.0],
        },
        Lens::Opencv {
            k: [0.3, 0.1, 0.01, 0.25, 0.02, 0.0],
            p: [0.0, 0.001],
        },
        Lens::fisheye([0.02, -0.01, 0.003, -0.0005]),
    ];

    #[test]
    fn the_crop_is_valid_throughout_and_cannot_grow() {
        for lens in LENSES {
            let source = camera(lens);
            let plan = Undistortion::plan(&source).unwrap();
            let valid = |x: i64, y: i64| plan.is_in_photograph(x as f64 + 0.5, y as f64 + 0.5);
            let (w, h) = (i64::from(plan.pinhole.width), i64::from(plan.pinhole.height));
            assert!((0..h).all(|y| (0..w).all(|x| valid(x, y))), "{lens:?} {plan:?}");
            assert!(
                (0..h).any(|y| !valid(-2, y)) && (0..h).any(|y| !valid(w + 1, y)),
                "{lens:?} {plan:?}"
            );
            assert!(
                (0..w).any(|x| !valid(x, -2)) && (0..w).any(|x| !valid(x, h + 1)),
                "{lens:?} {plan:?}"
            );
            assert!(w * h > 320 * 240 / 2, "{lens:?} {plan:?}");
        }
    }

    /// The value of an image that is smooth over the *undistorted* plane, so that undistortion must reproduce it.
    fn pattern(p: DVec2) -> [f64; 3] {
        [
            128.0 + 150.0 * p.x,
            128.0 + 150.0 * p.y,
            128.0 + 90.0 * (4.0 * p.x + 3.0 * p.y).sin(),
        ]
    }

    #[test]
    fn a_photograph_taken_through_the_lens_is_straightened() {
        for lens in LENSES {
            let source = camera(lens);
            let mut photo = Pixels {
                width: 320,
                height: 240,
                channels: 3,
                data: Vec::new(),
            };
            for y in 0..240 {
                for x in 0..320 {
                    let distorted = source.plane_of(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
                    let p = lens.undistort(distorted).unwrap_or_default();
                    photo.data.extend(pattern(p).map(|v| v.round() as u8));
                }
            }
            let plan = Undistortion::plan(&source).unwrap();
            let pinhole = plan.pinhole();
            let straight = plan.apply(&photo);
            assert_eq!((straight.width, straight.height), (pinhole.width, pinhole.height));
            let mut worst = 0f64;
            for (i, pixel) in straight.data.chunks_exact(3).enumerate() {
                let (x, y) = (i as u32 % pinhole.width, i as u32 / pinhole.width);
                let expected = pattern(pinhole.plane_of(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)));
                for c in 0..3 {
                    worst = worst.max((f64::from(pixel[c]) - expected[c].clamp(0.0, 255.0)).abs());
                }
            }
            // Two roundings to 8 bits, and curvature between bilinear samples.
            assert!(worst < 1.6, "{lens:?} {worst}");
        }
    }

    #[test]
    fn a_fold_is_excluded_and_a_lens_without_a_valid_crop_is_rejected() {
        let folding = camera(Lens::Opencv {
            k: [-0.9, 0.0, 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
        });
        let plan = Undistortion::plan(&folding).unwrap();
        // d(r - 0.9 r^3)/dr = 0 at r = 0.6086.
        let pinhole = plan.pinhole();
        let corner = pinhole.plane_of(DVec2::new(0.5, 0.5));
        assert!(corner.length() < 0.6086, "{corner}");
        let outside = Intrinsics {
            cx: 5000.0,
            ..camera(Lens::Opencv {
                k: [0.1, 0.0, 0.0, 0.0, 0.0, 0.0],
                p: [0.0; 2],
            })
        };
        assert_eq!(Undistortion::plan(&outside), None);
        let wild = camera(Lens::fisheye([f64::NAN; 4]));
        assert_eq!(Undistortion::plan(&wild), None);
    }

    #[test]
    fn a_half_turn_fisheye_stays_within_twice_the_size() {
        let source = Intrinsics {
            fx: 100.0,
            fy: 100.0,
            cx: 160.0,
            cy: 120.0,
            ..camera(Lens::fisheye([0.0; 4]))
        };
        let pinhole = Undistortion::plan(&source).unwrap().pinhole();
        assert!(
            pinhole.width <= 640 && pinhole.height <= 480 && pinhole.width > 320,
            "{pinhole:?}"
        );
    }
}

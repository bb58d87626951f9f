//! Projection through a lens: of the mean exactly, and of the Gaussian around it by the lens's Jacobian at the mean, as in EWA splatting
//! (Zwicker et al. 2001) for the pinhole. This allows training on distorted photographs as they are.
//!
//! Lenses are written once, as functions of [`Jet`]s, which carry first and second derivatives along: the Jacobian needs the first, its
//! vector-Jacobian product the second.

use super::project::dot;
use glam::DVec2;
use irradia_compute::simd::{Double, Lanes, Mask, Scalar, Simd};
use irradia_compute::unroll;
use irradia_scene::{Camera, Lens, RollingShutter};
use std::ops::{Add, Mul};

/// Perspective lenses are evaluated up to this multiple of the largest radius of the image's border on the undistorted plane; beyond it
/// they are continued by their tangent, similar to gsplat's limit on the Jacobian of pinholes. Beyond a fold they show nothing.
const MAX_RADIUS_FACTOR: f64 = 1.3;
/// Points that the middle row's camera does not see may be seen by other rows: wide lenses that move are evaluated up to this multiple
/// of their angle.
const MAX_ANGLE_FACTOR: f64 = 1.1;
/// Positions along each side of an image at which its largest radius or angle is searched.
const SIDE_SAMPLES: u32 = 16;

/// A lens other than a pinhole at rest, and how far from its axis it is evaluated.
#[derive(Clone, Debug, PartialEq)]
pub struct LensParams {
    lens: Lens,
    shutter: Option<RollingShutter>,
    /// Width and height of the image, pixels.
    size: [u32; 2],
    /// The radius on the undistorted plane, or for wide lenses the cosine of the angle.
    limit: f64,
    /// Whether nothing is shown beyond the limit.
    ends: bool,
}

impl LensParams {
    /// The lens and the shutter of `camera`; `None` for a pinhole at rest.
    pub fn new(camera: &Camera) -> Option<Self> {
        if camera.is_pinhole() {
            return None;
        }
        let (k, lens) = (&camera.intrinsics, camera.intrinsics.lens);
        let size = DVec2::new(f64::from(k.width), f64::from(k.height));
        let border = (0..=SIDE_SAMPLES).flat_map(|i| {
            let t = f64::from(i) / f64::from(SIDE_SAMPLES);
            [[t, 0.0], [t, 1.0], [0.0, t], [1.0, t]]
        });
        let directions = border.map(|place| lens.direction(k.plane_of(DVec2::from(place) * size)));
        let (limit, ends) = if lens.is_wide() {
            let angles = directions.map(|d| d.map_or(f64::INFINITY, |d| d.truncate().length().atan2(d.z)));
            let moved = camera.shutter.map_or(1.0, |_| MAX_ANGLE_FACTOR);
            let largest = moved * angles.fold(0.0, f64::max);
            (largest.min(lens.reach_in_angle()).cos(), true)
        } else {
            let known = directions.flatten().map(|d| d.truncate().length() / d.z);
            let limit = MAX_RADIUS_FACTOR * known.fold(0.0, f64::max);
            let reach = lens.reach_on_plane(limit);
            (limit.min(reach), reach < limit)
        };
        Some(Self {
            lens,
            shutter: camera.shutter,
            size: [k.width, k.height],
            limit,
            ends,
        })
    }

    /// Whether the lens also shows what is behind the camera.
    pub fn is_wide(&self) -> bool {
        self.lens.is_wide()
    }

    /// Pixel coordinates and depth of `x`, a position in the camera; `None` if the lens does not show it.
    pub(crate) fn project(&self, x: [f64; 3], focal: [f64; 2], principal: [f64; 2]) -> Option<([f64; 2], f64)> {
        let at = self.lanes(Double).at(x, focal, principal);
        at.visible.then_some((at.xy, at.depth))
    }

    #[inline(always)]
    pub(super) fn lanes<S: Simd>(&self, simd: S) -> LensLanes<S::F> {
        let model = match self.lens {
            Lens::Pinhole => LensModel::None,
            Lens::Equirectangular => LensModel::Equirectangular,
            Lens::Opencv { k, p } => LensModel::Opencv {
                k: unroll!(i in 6 => simd.splat(k[i])),
                p: unroll!(i in 2 => simd.splat(p[i])),
            },
            Lens::Fisheye { k, p, s } => LensModel::Fisheye {
                k: unroll!(i in 4 => simd.splat(k[i])),
                p: unroll!(i in 2 => simd.splat(p[i])),
                s: unroll!(i in 2 => simd.splat(s[i])),
            },
            Lens::Fov { omega } => {
                // At 0 the model is a pinhole; the bound keeps `scale / omega` at 1 there.
                let omega = omega.max(1e-6);
                LensModel::Fov {
                    scale: simd.splat(2.0 * (0.5 * omega).tan()),
                    omega: simd.splat(omega),
                }
            }
        };
        let shutter = self.shutter.as_ref().map(|shutter| {
            let axis = shutter.first.axis();
            let length = f64::from(self.size[axis]);
            let forwards = if shutter.first.is_reversed() { -1.0 } else { 1.0 };
            let [translation, rotation] = [shutter.translation, shutter.rotation].map(|v| v.as_dvec3().to_array());
            ShutterLanes {
                axis,
                middle: simd.splat(0.5 * length),
                rate: simd.splat(forwards / length),
                translation: unroll!(i in 3 => simd.splat(translation[i])),
                rotation: unroll!(i in 3 => simd.splat(rotation[i])),
            }
        });
        LensLanes {
            model,
            shutter,
            limit: simd.splat(self.limit),
            ends: self.ends,
        }
    }
}

/// [`LensParams`] broadcast to all lanes.
pub(super) struct LensLanes<F> {
    model: LensModel<F>,
    shutter: Option<ShutterLanes<F>>,
    limit: F,
    ends: bool,
}

/// A [`RollingShutter`] broadcast to all lanes.
struct ShutterLanes<F> {
    /// The image axis along which time passes.
    axis: usize,
    /// The pixel coordinate of time 0.
    middle: F,
    /// Time per pixel.
    rate: F,
    translation: [F; 3],
    rotation: [F; 3],
}

/// The models of [`Lens`], with their coefficients.
enum LensModel<F> {
    None,
    Equirectangular,
    Opencv { k: [F; 6], p: [F; 2] },
    Fisheye { k: [F; 4], p: [F; 2], s: [F; 2] },
    Fov { scale: F, omega: F },
}

/// The values and derivatives of a lens at a position in the camera.
pub(super) struct LensAt<F: Lanes> {
    /// Pixel coordinates.
    pub xy: [F; 2],
    /// See [`Intrinsics::depth`].
    pub depth: F,
    /// The Jacobian of the pixel coordinates.
    pub jacobian: [[F; 3]; 2],
    /// Whether the lens shows it.
    pub visible: F::Mask,
    /// Second derivatives of the pixel coordinates: the derivatives of `jacobian`.
    second: [[F; 6]; 2],
    depth_gradient: [F; 3],
    limited: Option<Limited<F>>,
}

/// How a position beyond a perspective lens's limit is moved to the limit: along the radius, at the same depth.
struct Limited<F: Lanes> {
    /// Where the limit is exceeded.
    beyond: F::Mask,
    /// The position minus that at which the lens is evaluated; zero within the limit.
    rest: [F; 2],
    /// Unit vector away from the axis.
    outwards: [F; 2],
    limit: F,
    /// Ratio of the radii.
    shrunk: F,
}

impl<F: Lanes> LensLanes<F> {
    /// The lens at `x`, in the camera.
    #[inline(always)]
    pub(super) fn at(&self, x: [F; 3], focal: [F; 2], principal: [F; 2]) -> LensAt<F> {
        let zero = x[0].splat(0.0);
        let one = x[0].splat(1.0);
        let radius = (x[0] * x[0] + x[1] * x[1]).sqrt();
        let is_wide = matches!(self.model, LensModel::Fisheye { .. } | LensModel::Equirectangular);
        let (from, limited, depth, depth_gradient, visible) = if is_wide {
            let distance = radius.mul_add(radius, x[2] * x[2]).sqrt();
            let direction = unroll!(i in 3 => x[i] / distance);
            (x, None, distance, direction, self.limit.lt(direction[2]))
        } else {
            let largest = self.limit * x[2];
            let beyond = largest.lt(radius);
            let outwards = unroll!(i in 2 => (x[i] / radius).masked(beyond));
            let shrunk = (largest / radius).select(beyond, one);
            let rest = unroll!(i in 2 => x[i] - x[i] * shrunk);
            let limited = Limited {
                beyond,
                rest,
                outwards,
                limit: self.limit,
                shrunk,
            };
            let from = [x[0] - rest[0], x[1] - rest[1], x[2]];
            let visible = zero.lt(x[2]);
            let visible = if self.ends { visible.and_not(beyond) } else { visible };
            (from, Some(limited), x[2], [zero, zero, one], visible)
        };
        let position = unroll!(i in 3 => Jet::variable(from[i], i));
        let plane = match &self.shutter {
            None => self.plane(position),
            Some(shutter) => self.plane(self.when_exposed(shutter, position, focal, principal)),
        };
        let jacobian: [[F; 3]; 2] = unroll!(r in 2 => unroll!(i in 3 => focal[r] * plane[r].first[i]));
        let mut xy: [F; 2] = unroll!(r in 2 => focal[r].mul_add(plane[r].value, principal[r]));
        if let Some(Limited { rest, .. }) = &limited {
            for r in 0..2 {
                xy[r] += jacobian[r][0] * rest[0] + jacobian[r][1] * rest[1];
            }
        }
        LensAt {
            xy,
            depth,
            jacobian,
            visible,
            second: unroll!(r in 2 => unroll!(i in 6 => focal[r] * plane[r].second[i])),
            depth_gradient,
            limited,
        }
    }

    /// The position in the camera at the time at which its row is exposed; see [`RollingShutter`].
    #[inline(always)]
    fn when_exposed(
        &self,
        shutter: &ShutterLanes<F>,
        position: [Jet<F>; 3],
        focal: [F; 2],
        principal: [F; 2],
    ) -> [Jet<F>; 3] {
        let axis = shutter.axis;
        let [a, b, c] = shutter.rotation;
        let [x, y, z] = position;
        let turned = [
            z.scale(b) + y.scale(-c),
            x.scale(c) + z.scale(-a),
            y.scale(a) + x.scale(-b),
        ];
        let back = unroll!(i in 3 => turned[i].plus(shutter.translation[i]).scale(-shutter.rate));
        let mut seen = position;
        for _ in 0..RollingShutter::ROUNDS {
            let pixel = self.plane(seen)[axis].scale(focal[axis]);
            let rows = pixel.plus(principal[axis] - shutter.middle);
            seen = unroll!(i in 3 => position[i] + back[i] * rows);
        }
        seen
    }

    /// The point of the lens's plane; see [`Lens::project`].
    #[inline(always)]
    fn plane(&self, [x, y, z]: [Jet<F>; 3]) -> [Jet<F>; 2] {
        let two = z.value.splat(2.0);
        match &self.model {
            LensModel::None => {
                let inverse = z.recip();
                [x * inverse, y * inverse]
            }
            LensModel::Equirectangular => {
                let level2 = x * x + z * z;
                let level = level2.sqrt();
                let distance = (level2 + y * y).sqrt();
                [angle(x, level + z), angle(y, distance + level)]
            }
            LensModel::Opencv { k, p } => {
                let inverse = z.recip();
                let plane = [x * inverse, y * inverse];
                let r2 = plane[0] * plane[0] + plane[1] * plane[1];
                let above = ((r2.scale(k[2]).plus(k[1]) * r2).plus(k[0]) * r2).plus(two.splat(1.0));
                let below = ((r2.scale(k[5]).plus(k[4]) * r2).plus(k[3]) * r2).plus(two.splat(1.0));
                tangential(plane, r2, above * below.recip(), *p)
            }
            LensModel::Fisheye { k, p, s } => {
                // theta / rho = 2 atan(t) / (t (d + z)) with the half angle's tangent t = rho / (d + z), which is smooth on the axis.
                let rho2 = x * x + y * y;
                let inverse = ((rho2 + z * z).sqrt() + z).recip();
                let factor = (rho2 * inverse * inverse).arctangent_ratio() * inverse.scale(two);
                let plane = [x * factor, y * factor];
                let r2 = plane[0] * plane[0] + plane[1] * plane[1];
                let inner = (r2.scale(k[3]).plus(k[2]) * r2).plus(k[1]) * r2;
                let radial = (inner.plus(k[0]) * r2).plus(two.splat(1.0));
                let bent = tangential(plane, r2, radial, *p);
                unroll!(i in 2 => bent[i] + r2.scale(s[i]))
            }
            LensModel::Fov { scale, omega } => {
                let inverse = z.recip();
                let plane = [x * inverse, y * inverse];
                let r2 = plane[0] * plane[0] + plane[1] * plane[1];
                let factor = r2.scale(*scale * *scale).arctangent_ratio().scale(*scale / *omega);
                unroll!(i in 2 => plane[i] * factor)
            }
        }
    }
}

/// Twice the arctangent of `opposite / adjacent`.
#[inline(always)]
fn angle<F: Lanes>(opposite: Jet<F>, adjacent: Jet<F>) -> Jet<F> {
    let tangent = opposite * adjacent.recip();
    let half = tangent * (tangent * tangent).arctangent_ratio();
    half + half
}

/// `radial` times a point of the plane, with OpenCV's tangential part.
#[inline(always)]
fn tangential<F: Lanes>([x, y]: [Jet<F>; 2], r2: Jet<F>, radial: Jet<F>, [p1, p2]: [F; 2]) -> [Jet<F>; 2] {
    let two = p1.splat(2.0);
    let xy = (x * y).scale(two);
    [
        x * radial + xy.scale(p1) + (r2 + (x * x).scale(two)).scale(p2),
        y * radial + xy.scale(p2) + (r2 + (y * y).scale(two)).scale(p1),
    ]
}

impl<F: Lanes> LensAt<F> {
    /// The gradient of the position in the camera, from those of the pixel coordinates, the depth and the Jacobian.
    #[inline(always)]
    pub(super) fn vjp(&self, v_xy: [F; 2], v_depth: F, mut v_jacobian: [[F; 3]; 2]) -> [F; 3] {
        let j = &self.jacobian;
        let mut v_x = unroll!(i in 3 => v_depth * self.depth_gradient[i] + j[0][i] * v_xy[0] + j[1][i] * v_xy[1]);
        if let Some(Limited { rest, .. }) = &self.limited {
            // Beyond the limit the pixel is that at the limit plus the Jacobian times the rest.
            for r in 0..2 {
                for i in 0..2 {
                    v_jacobian[r][i] += v_xy[r] * rest[i];
                }
            }
        }
        let second = |r: usize| {
            let [xx, xy, xz, yy, yz, zz] = self.second[r];
            let v = v_jacobian[r];
            [dot(v, [xx, xy, xz]), dot(v, [xy, yy, yz]), dot(v, [xz, yz, zz])]
        };
        let (from_x, from_y) = (second(0), second(1));
        let mut v_from = unroll!(i in 3 => from_x[i] + from_y[i]);
        if let Some(limited) = &self.limited {
            // Where the limit is exceeded, (x, y) = limit z outwards, and outwards turns with the position.
            let [nx, ny] = limited.outwards;
            let along = nx * v_from[0] + ny * v_from[1];
            v_from[2] += (limited.limit * along).masked(limited.beyond);
            v_from[0] = limited.shrunk * (v_from[0] - nx * along);
            v_from[1] = limited.shrunk * (v_from[1] - ny * along);
        }
        for i in 0..3 {
            v_x[i] += v_from[i];
        }
        v_x
    }
}

/// A function of the position in the camera, with its derivatives.
#[derive(Clone, Copy)]
struct Jet<F> {
    value: F,
    /// By x, y and z.
    first: [F; 3],
    /// By xx, xy, xz, yy, yz and zz.
    second: [F; 6],
}

/// The two variables of each second derivative.
const PAIRS: [[usize; 2]; 6] = [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2], [2, 2]];

impl<F: Lanes> Jet<F> {
    /// The coordinate `axis` itself.
    #[inline(always)]
    fn variable(value: F, axis: usize) -> Self {
        let zero = value.splat(0.0);
        let mut first = [zero; 3];
        first[axis] = value.splat(1.0);
        Self {
            value,
            first,
            second: [zero; 6],
        }
    }

    #[inline(always)]
    fn scale(self, by: F) -> Self {
        Self {
            value: self.value * by,
            first: unroll!(i in 3 => self.first[i] * by),
            second: unroll!(i in 6 => self.second[i] * by),
        }
    }

    #[inline(always)]
    fn plus(self, constant: F) -> Self {
        Self {
            value: self.value + constant,
            ..self
        }
    }

    /// A function of this jet, given the function's value and its first two derivatives.
    #[inline(always)]
    fn chain(self, value: F, first: F, second: F) -> Self {
        let own = &self.first;
        Self {
            value,
            first: unroll!(i in 3 => first * own[i]),
            second: unroll!(n in 6 => first * self.second[n] + second * own[PAIRS[n][0]] * own[PAIRS[n][1]]),
        }
    }

    #[inline(always)]
    fn recip(self) -> Self {
        let inverse = self.value.splat(1.0) / self.value;
        let square = inverse * inverse;
        self.chain(inverse, -square, (square + square) * inverse)
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        let root = self.value.sqrt();
        let half = self.value.splat(0.5) / root;
        self.chain(root, half, half * self.value.splat(-0.5) / self.value)
    }

    /// `atan(sqrt(w)) / sqrt(w)`, which is smooth at 0.
    #[inline(always)]
    fn arctangent_ratio(self) -> Self {
        let simd = self.value.simd();
        let mut lanes = [F::Scalar::default(); 16];
        self.value.store(&mut lanes);
        let mut derivatives = [[F::Scalar::default(); 16]; 3];
        for lane in 0..F::Simd::LANES {
            for (n, value) in arctangent_ratio(lanes[lane].to_f64()).into_iter().enumerate() {
                derivatives[n][lane] = Scalar::from_f64(value);
            }
        }
        let [value, first, second] = unroll!(n in 3 => simd.load(&derivatives[n]));
        self.chain(value, first, second)
    }
}

/// `h = atan(sqrt(w)) / sqrt(w)` and its first two derivatives, from `2 w h' + h = 1 / (1 + w)`, or near 0 from the series
/// `1 - w / 3 + w^2 / 5 - ..`.
fn arctangent_ratio(w: f64) -> [f64; 3] {
    if w < 0.02 {
        let mut sums = [0.0; 3];
        for n in (0..9).rev() {
            let coefficient = if n % 2 == 0 { 1.0 } else { -1.0 } / f64::from(2 * n + 1);
            sums = [
                sums[0] * w + coefficient,
                sums[1] * w + sums[0],
                sums[2] * w + 2.0 * sums[1],
            ];
        }
        return sums;
    }
    let (root, fraction) = (w.sqrt(), 1.0 / (1.0 + w));
    let value = root.atan() / root;
    let first = (fraction - value) / (2.0 * w);
    [value, first, -(fraction * fraction + 3.0 * first) / (2.0 * w)]
}

impl<F: Lanes> Add for Jet<F> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self {
            value: self.value + other.value,
            first: unroll!(i in 3 => self.first[i] + other.first[i]),
            second: unroll!(i in 6 => self.second[i] + other.second[i]),
        }
    }
}

impl<F: Lanes> Mul for Jet<F> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        let (a, b) = (self.value, other.value);
        Self {
            value: a * b,
            first: unroll!(i in 3 => a * other.first[i] + b * self.first[i]),
            second: unroll!(n in 6 => {
                let [i, j] = PAIRS[n];
                a * other.second[n]
                    + b * self.second[n]
                    + self.first[i] * other.first[j]
                    + self.first[j] * other.first[i]
            }),
        }
    }
}

//! Selections as data. Positions and lengths are those of the dataset, colours and opacities in \[0, 1\].

use crate::EditError;
use glam::{DQuat, DVec2, DVec3, Vec3};
use irradia_scene::{Camera, Intrinsics, Pose, Similarity};
use serde::{Deserialize, Serialize};

/// Maximum number of points of a polygon or a stroke.
const MAX_POINTS: usize = 10_000;
/// Largest coordinate or length.
const MAX_MAGNITUDE: f64 = 1e12;

/// One step of a selection: a shape, and how it changes the current selection.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SelectStep {
    /// How the shape is combined; add if absent.
    #[serde(default, skip_serializing_if = "Mode::is_add")]
    pub mode: Mode,
    /// The shape.
    #[serde(flatten)]
    pub shape: Shape,
}

/// How a step is combined with the current selection. A selection whose first step subtracts or intersects starts with all splats.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// Adds the splats in the shape.
    #[default]
    Add,
    /// Removes the splats in the shape.
    Subtract,
    /// Keeps only the splats in the shape.
    Intersect,
}

impl Mode {
    fn is_add(&self) -> bool {
        *self == Self::Add
    }
}

/// What a step selects. A splat is in a region if its centre is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "shape", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Shape {
    /// Every splat.
    All {},
    /// A box.
    Box {
        /// Its centre.
        center: [f64; 3],
        /// Lengths of its edges.
        size: [f64; 3],
        /// Rotation of its axes `w, x, y, z`.
        #[serde(default = "unrotated", skip_serializing_if = "is_unrotated")]
        rotation: [f64; 4],
    },
    /// A ball.
    Sphere {
        /// Its centre.
        center: [f64; 3],
        /// Its radius.
        radius: f64,
    },
    /// Everything on one side of a plane.
    HalfSpace {
        /// A point on the plane.
        point: [f64; 3],
        /// Normal of the plane, pointing to the side that is selected.
        normal: [f64; 3],
    },
    /// The splats inside a polygon or lasso drawn over a picture, at any depth.
    Polygon {
        /// The camera of the picture.
        camera: Viewpoint,
        /// Corners, pixels of the picture; the last is joined to the first. The inside follows the even-odd rule.
        points: Vec<[f64; 2]>,
        /// Only splats that the picture shows, not those behind others.
        #[serde(default, skip_serializing_if = "is_false")]
        visible: bool,
    },
    /// The splats that a brush touched in a picture.
    Brush {
        /// The camera of the picture.
        camera: Viewpoint,
        /// The stroke, pixels of the picture; a single point is a dab.
        points: Vec<[f64; 2]>,
        /// Radius of the brush, pixels of the picture.
        radius: f64,
        /// Only splats that the picture shows, not those behind others.
        #[serde(default, skip_serializing_if = "is_false")]
        visible: bool,
    },
    /// A range of colours, without their dependence on direction. Colours beyond black or white count as black or white.
    Color {
        /// Lowest red, green and blue.
        low: [f64; 3],
        /// Highest red, green and blue.
        high: [f64; 3],
    },
    /// A range of opacities.
    Opacity {
        /// Lowest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        min: Option<f64>,
        /// Highest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max: Option<f64>,
    },
    /// A range of sizes: the largest standard deviation.
    Size {
        /// Lowest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        min: Option<f64>,
        /// Highest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max: Option<f64>,
    },
    /// A range of ratios of the largest to the middle standard deviation: large for needles, 1 for discs and balls.
    Elongation {
        /// Lowest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        min: Option<f64>,
        /// Highest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max: Option<f64>,
    },
    /// A range of the number of training views that show the splat.
    Views {
        /// Lowest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        min: Option<u32>,
        /// Highest.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max: Option<u32>,
    },
    /// Connected groups of splats, by the number of splats. Two splats are connected if the cubes of side `gap` that contain them touch.
    Clusters {
        /// Minimum number of splats in the group.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        min: Option<usize>,
        /// Maximum number of splats in the group.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        max: Option<usize>,
        /// Side of the cubes; if absent, 4 times the median distance to the nearest neighbour.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        gap: Option<f64>,
    },
    /// Floaters, by their score.
    Floaters {
        /// Lowest score, above 0; 1 if absent. Lower values find more.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        score: Option<f64>,
    },
    /// The subject of the cameras: what surrounds the point that they look at.
    Subject {
        /// Factor on its radius; 1 if absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        margin: Option<f64>,
    },
    /// The splats that the previous edit was applied to: those it added after a duplicate or merge, none after a removal. It allows a
    /// selection that was moved to be rotated as well.
    Last {},
    /// Everything that is not in the current selection. Its mode is always add.
    Invert {},
    /// The current selection, and all splats within a distance of it. Its mode is always add.
    Grow {
        /// The distance.
        by: f64,
    },
    /// The current selection, and everything connected to it as in [`Shape::Clusters`]. Its mode is always add.
    Connected {
        /// Side of the cubes; if absent, 4 times the median distance to the nearest neighbour.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        gap: Option<f64>,
    },
}

fn unrotated() -> [f64; 4] {
    [1.0, 0.0, 0.0, 0.0]
}

fn is_unrotated(rotation: &[f64; 4]) -> bool {
    *rotation == unrotated()
}

fn is_false(value: &bool) -> bool {
    !value
}

/// A camera from which a selection was drawn, in the coordinates of the dataset.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Viewpoint {
    /// Its centre.
    pub position: [f64; 3],
    /// World from camera (x right, y down, z forward), `w, x, y, z`.
    pub rotation: [f64; 4],
    /// Focal lengths, pixels.
    pub focal: [f64; 2],
    /// Principal point, pixels; the picture's upper left corner is (0, 0).
    pub principal: [f64; 2],
    /// Width and height of the picture, pixels.
    pub size: [u32; 2],
}

impl Viewpoint {
    /// The viewpoint of a camera in the world of `world_from_dataset`.
    pub fn of(camera: &Camera, world_from_dataset: &Similarity) -> Self {
        let (k, q) = (&camera.intrinsics, camera.pose.rotation);
        Self {
            position: world_from_dataset.invert(camera.pose.position.as_dvec3()).to_array(),
            rotation: [q.w, q.x, q.y, q.z].map(f64::from),
            focal: [k.fx, k.fy].map(f64::from),
            principal: [k.cx, k.cy].map(f64::from),
            size: [k.width, k.height],
        }
    }

    /// The camera in the world of `world_from_dataset`.
    pub(crate) fn camera(&self, world_from_dataset: &Similarity) -> Camera {
        let [fx, fy] = self.focal.map(|v| v as f32);
        let [cx, cy] = self.principal.map(|v| v as f32);
        let [width, height] = self.size;
        let mut intrinsics = Intrinsics::from_fov_x(width, height, 1.0);
        (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) = (fx, fy, cx, cy);
        let position: Vec3 = world_from_dataset.apply(self.position.into()).as_vec3();
        let rotation = quat(self.rotation).as_quat();
        Camera::new(Pose { rotation, position }, intrinsics)
    }

    /// Where a point is in the picture, pixels; `None` if it is not in front of the camera.
    pub(crate) fn project(&self, point: DVec3) -> Option<DVec2> {
        let p = quat(self.rotation).inverse() * (point - DVec3::from(self.position));
        let at = DVec2::new(p.x, p.y) / p.z * DVec2::from(self.focal) + DVec2::from(self.principal);
        (p.z > 0.0 && at.is_finite()).then_some(at)
    }

    fn check(&self, of: &str) -> Result<(), EditError> {
        check_finite(&format!("{of} camera.position"), &self.position)?;
        check_rotation(&format!("{of} camera.rotation"), &self.rotation)?;
        check_finite(&format!("{of} camera.principal"), &self.principal)?;
        for focal in self.focal {
            check_positive(&format!("{of} camera.focal"), focal)?;
        }
        if self.size.iter().any(|side| !(1..=16384).contains(side)) {
            return Err(EditError::value(
                format!("{of} camera.size"),
                "each side must be 1 to 16384 pixels",
            ));
        }
        Ok(())
    }
}

/// A quaternion `w, x, y, z`, normalised.
pub(crate) fn quat([w, x, y, z]: [f64; 4]) -> DQuat {
    DQuat::from_xyzw(x, y, z, w).normalize()
}

impl SelectStep {
    /// A step that adds `shape`.
    pub fn add(shape: Shape) -> Self {
        Self { mode: Mode::Add, shape }
    }

    /// Checks that every number is in range.
    ///
    /// # Errors
    /// [`EditError::Value`] for the first that is not.
    pub fn check(&self) -> Result<(), EditError> {
        let changes_selection = matches!(
            self.shape,
            Shape::Invert {} | Shape::Grow { .. } | Shape::Connected { .. }
        );
        if changes_selection && self.mode != Mode::Add {
            return Err(EditError::Selection(
                "invert, grow and connected change the current selection and take no mode".into(),
            ));
        }
        match &self.shape {
            Shape::All {} | Shape::Last {} | Shape::Invert {} => Ok(()),
            Shape::Box {
                center,
                size,
                rotation: r,
            } => {
                check_finite("box center", center)?;
                for edge in size {
                    check_positive("box size", *edge)?;
                }
                check_rotation("box rotation", r)
            }
            Shape::Sphere { center, radius } => {
                check_finite("sphere center", center)?;
                check_positive("sphere radius", *radius)
            }
            Shape::HalfSpace { point, normal } => {
                check_finite("half-space point", point)?;
                check_direction("half-space normal", normal)
            }
            Shape::Polygon { camera, points, .. } => {
                camera.check("polygon")?;
                check_points("polygon points", points, 3)
            }
            Shape::Brush {
                camera, points, radius, ..
            } => {
                camera.check("brush")?;
                check_points("brush points", points, 1)?;
                check_positive("brush radius", *radius)
            }
            Shape::Color { low, high } => {
                check_finite("color low", low)?;
                check_finite("color high", high)?;
                if low.iter().zip(high).all(|(low, high)| low <= high) {
                    Ok(())
                } else {
                    Err(EditError::value("color", "low must not be above high"))
                }
            }
            Shape::Opacity { min, max } => check_range("opacity", min.as_ref(), max.as_ref()),
            Shape::Size { min, max } => check_range("size", min.as_ref(), max.as_ref()),
            Shape::Elongation { min, max } => check_range("elongation", min.as_ref(), max.as_ref()),
            Shape::Views { min, max } => check_range("views", min.as_ref(), max.as_ref()),
            Shape::Clusters { min, max, gap } => {
                check_range("clusters", min.as_ref(), max.as_ref())?;
                gap.map_or(Ok(()), |gap| check_positive("clusters gap", gap))
            }
            Shape::Floaters { score } => score.map_or(Ok(()), |score| check_positive("floaters score", score)),
            Shape::Subject { margin } => margin.map_or(Ok(()), |margin| check_positive("subject margin", margin)),
            Shape::Grow { by } => check_positive("grow by", *by),
            Shape::Connected { gap } => gap.map_or(Ok(()), |gap| check_positive("connected gap", gap)),
        }
    }
}

/// Checks that all values are numbers of a sensible magnitude.
pub(crate) fn check_finite(name: &str, values: &[f64]) -> Result<(), EditError> {
    if values.iter().all(|v| v.abs() <= MAX_MAGNITUDE) {
        Ok(())
    } else {
        Err(EditError::value(name, "must be numbers between -1e12 and 1e12"))
    }
}

/// Checks that a value is a positive number of a sensible magnitude.
pub(crate) fn check_positive(name: &str, value: f64) -> Result<(), EditError> {
    if value > 1e-12 && value <= MAX_MAGNITUDE {
        Ok(())
    } else {
        Err(EditError::value(name, "must be a number above 0 and at most 1e12"))
    }
}

/// Checks that a vector has a direction.
pub(crate) fn check_direction(name: &str, vector: &[f64; 3]) -> Result<(), EditError> {
    check_finite(name, vector)?;
    if DVec3::from(*vector).length() > 1e-9 {
        Ok(())
    } else {
        Err(EditError::value(name, "must not be of length zero"))
    }
}

fn check_rotation(name: &str, values: &[f64; 4]) -> Result<(), EditError> {
    check_finite(name, values)?;
    if values.iter().map(|v| v * v).sum::<f64>() > 1e-18 {
        Ok(())
    } else {
        Err(EditError::value(name, "must not be the zero quaternion"))
    }
}

fn check_points(name: &str, points: &[[f64; 2]], min_points: usize) -> Result<(), EditError> {
    if !(min_points..=MAX_POINTS).contains(&points.len()) {
        let message = format!("has {} points, must have {min_points} to {MAX_POINTS}", points.len());
        return Err(EditError::value(name, message));
    }
    check_finite(name, points.as_flattened())
}

fn check_range<T: PartialOrd>(name: &str, min: Option<&T>, max: Option<&T>) -> Result<(), EditError> {
    // NaN does not compare even to itself.
    let is_number = |bound: Option<&T>| bound.is_none_or(|bound| bound.partial_cmp(bound).is_some());
    if !is_number(min) || !is_number(max) {
        return Err(EditError::value(name, "min and max must be numbers"));
    }
    match (min, max) {
        (None, None) => Err(EditError::value(name, "needs min, max or both")),
        (Some(min), Some(max)) if min > max => Err(EditError::value(name, "min must not be above max")),
        _ => Ok(()),
    }
}

//! Photographs whose rows are exposed one after another while the camera moves.

use glam::{Vec2, Vec3};
use std::fmt;
use std::str::FromStr;

/// The side of a photograph that is exposed first. Phones read out their sensor along the short side of a photograph: from the top in
/// landscape format, from the left or the right in portrait format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum FirstSide {
    Top,
    Bottom,
    Left,
    Right,
}

impl FirstSide {
    const ALL: [Self; 4] = [Self::Top, Self::Bottom, Self::Left, Self::Right];

    /// The image axis along which time passes: 0 for x, 1 for y.
    pub fn axis(self) -> usize {
        match self {
            Self::Left | Self::Right => 0,
            Self::Top | Self::Bottom => 1,
        }
    }

    /// Whether time passes towards smaller coordinates.
    pub fn is_reversed(self) -> bool {
        matches!(self, Self::Bottom | Self::Right)
    }

    fn name(self) -> &'static str {
        match self {
            Self::Top => "top",
            Self::Bottom => "bottom",
            Self::Left => "left",
            Self::Right => "right",
        }
    }
}

impl fmt::Display for FirstSide {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for FirstSide {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let named = Self::ALL.into_iter().find(|side| side.name() == name);
        named.ok_or_else(|| "expected top, bottom, left or right".to_owned())
    }
}

/// How a camera moves while a photograph is read out (rolling shutter), to first order: a point `p` in the camera space of the middle row
/// is at `p - t (translation + rotation x p)` in the camera space of time `t`, which is -0.5 at the first row and 0.5 after the last
/// (Seiskari et al. 2024, "Gaussian Splatting on the Move").
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RollingShutter {
    /// The side at which the readout begins.
    pub first: FirstSide,
    /// Translation of the camera during the readout, along its own axes, world units.
    pub translation: Vec3,
    /// Rotation of the camera during the readout, axis times angle about its own axes, radians.
    pub rotation: Vec3,
}

impl RollingShutter {
    /// Number of iterations that find the time at which a point is seen: it depends on the row, which depends on the time. Each iteration
    /// divides the error by the ratio of the readout's speed to that of the point in the image, which is 10 or more.
    pub const ROUNDS: usize = 4;
    /// Maximum turn of a camera during a readout, radians; a first-order model is far off well below it.
    pub const MOST_TURNED: f32 = 0.5;

    /// The time at which a position in an image of `size` pixels is exposed, -0.5 to 0.5.
    pub fn time(&self, pixel: Vec2, size: [u32; 2]) -> f32 {
        let axis = self.first.axis();
        let along = pixel[axis] / size[axis] as f32 - 0.5;
        if self.first.is_reversed() { -along } else { along }
    }

    /// Transforms `point` from the camera space of the middle row to that of `time`.
    pub fn at(&self, point: Vec3, time: f32) -> Vec3 {
        point - time * (self.translation + self.rotation.cross(point))
    }

    /// The line, in the camera space of the middle row, of the points `k ray` in that of `time`: its start and its direction, by which
    /// `k` is multiplied.
    pub fn line(&self, ray: Vec3, time: f32) -> (Vec3, Vec3) {
        let turn = time * self.rotation;
        // The inverse of p - turn x p.
        let back = |p: Vec3| (p + turn.cross(p) + turn * turn.dot(p)) / (1.0 + turn.length_squared());
        (back(time * self.translation), back(ray))
    }

    /// The pixel at which a point is seen, given its pixel `project(time)` at any time.
    pub(crate) fn seen(&self, size: [u32; 2], project: impl Fn(f32) -> Option<Vec2>) -> Option<Vec2> {
        let mut found = project(0.0)?;
        for _ in 0..Self::ROUNDS {
            found = project(self.time(found, size))?;
        }
        Some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_where_its_points_are_seen() {
        for first in FirstSide::ALL {
            let shutter = RollingShutter {
                first,
                translation: Vec3::new(0.2, -0.1, 0.3),
                rotation: Vec3::new(-0.05, 0.1, 0.2),
            };
            let (ray, time) = (
                Vec3::new(0.3, -0.2, 1.0),
                shutter.time(Vec2::new(20.0, 90.0), [80, 120]),
            );
            assert_eq!(
                time,
                match first {
                    FirstSide::Top => 0.25,
                    FirstSide::Bottom => -0.25,
                    FirstSide::Left => -0.25,
                    FirstSide::Right => 0.25,
                }
            );
            let (from, along) = shutter.line(ray, time);
            assert!(shutter.at(from + 3.0 * along, time).distance(3.0 * ray) < 1e-5);
            assert_eq!(first.to_string().parse(), Ok(first));
        }
    }
}

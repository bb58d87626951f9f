//! Photographs whose rows are exposed one after another while the camera moves.

use glam::{Vec2, Vec3};
use std::fmt;
use std::str::FromStr;

/// The side of a picture that is exposed first. Phones read their sensor along the short side of a picture: from the top of one in landscape format,
/// from the left or the right of one in portrait format.
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

/// How a camera moves while a photograph is read out (rolling shutter), to first order: a point `p` in the camera of the middle row is at
/// `p - t (translation + rotation x p)` in the camera of time `t`, which is -0.5 at the first row and 0.5 after the last (Seiskari et al. 2024,
/// "Gaussian Splatting on the Move").
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RollingShutter {
    /// Where the readout begins.
    pub first: FirstSide,
    /// The way of the camera during the readout, along its own axes, world units.
    pub translation: Vec3,
    /// Its turn during the readout, axis times angle about its own axes, radians.
    pub rotation: Vec3,
}

impl RollingShutter {
    /// Rounds in which the time at which a point is seen is found: it depends on the row, which depends on the time. Each round divides the error by
    /// the ratio of the readout's speed to the picture's, which is 10 and more.
    pub const ROUNDS: usize = 4;
    /// Radians by which a camera may turn during a readout: a first-order model is far off before.
    pub const MOST_TURNED: f32 = 0.5;

    /// When a position in an image of `size` pixels is exposed.
    pub fn time(&self, pixel: Vec2, size: [u32; 2]) -> f32 {
        let axis = self.first.axis();
        let along = pixel[axis] / size[axis] as f32 - 0.5;
        if self.first.is_reversed() { -along } else { along }
    }

    /// Where `point`, in the camera of the middle row, is in that of `time`.
    pub fn at(&self, point: Vec3, time: f32) -> Vec3 {
        point - time * (self.translation + self.rotation.cross(point))
    }

    /// The line, in the camera of the middle row, of the points `k` times `ray` in that of `time`: a point on it, and what `k` is multiplied by.
    pub fn line(&self, ray: Vec3, time: f32) -> (Vec3, Vec3) {
        let turn = time * self.rotation;
        // The inverse of p - turn x p.
        let back = |p: Vec3| (p + turn.cross(p) + turn * turn.dot(p)) / (1.0 + turn.length_squared());
        (back(time * self.translation), back(ray))
    }

    /// Where a point is seen whose pixel at a time is `project`.
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

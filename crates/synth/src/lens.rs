//! The lenses that scenes are seen through.

use glam::{DVec2, Vec2, Vec3};
use irradia_scene::{Intrinsics, Lens};
use std::f32::consts::{PI, TAU};
use std::f64::consts;
use std::fmt;
use std::str::FromStr;

/// Field of view of the fisheye across the shorter side, radians: 190 degrees.
const FISHEYE_FOV: f32 = 190.0 / 180.0 * PI;

/// A lens.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SynthLens {
    /// The scene's own field of view, without distortion.
    #[default]
    Pinhole,
    /// 190 degrees across the shorter side at equal angles, black around the image circle.
    Fisheye,
    /// All directions, as an equirectangular panorama; twice as wide as high for square pixels.
    Equirectangular,
}

/// An unknown name of a lens.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown lens `{0}`; use pinhole, fisheye or equirectangular")]
pub struct UnknownLens(String);

impl SynthLens {
    /// All lenses.
    pub const ALL: [Self; 3] = [Self::Pinhole, Self::Fisheye, Self::Equirectangular];

    fn name(self) -> &'static str {
        match self {
            Self::Pinhole => "pinhole",
            Self::Fisheye => "fisheye",
            Self::Equirectangular => "equirectangular",
        }
    }

    /// The intrinsics of this lens at the size of `pinhole`.
    pub fn intrinsics(self, pinhole: Intrinsics) -> Intrinsics {
        let (width, height) = (pinhole.width as f32, pinhole.height as f32);
        let (focal, lens) = match self {
            Self::Pinhole => return pinhole,
            Self::Fisheye => ([width.min(height) / FISHEYE_FOV; 2], Lens::fisheye([0.0; 4])),
            Self::Equirectangular => ([width / TAU, height / PI], Lens::Equirectangular),
        };
        Intrinsics {
            fx: focal[0],
            fy: focal[1],
            cx: 0.5 * width,
            cy: 0.5 * height,
            lens,
            ..pinhole
        }
    }
}

impl fmt::Display for SynthLens {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for SynthLens {
    type Err = UnknownLens;

    fn from_str(name: &str) -> Result<Self, UnknownLens> {
        let found = Self::ALL.into_iter().find(|lens| lens.name() == name);
        found.ok_or_else(|| UnknownLens(name.to_owned()))
    }
}

/// Unit direction, in the camera's axes, of the ray through pixel coordinates; `None` outside a fisheye's image circle.
pub(crate) fn direction(k: &Intrinsics, pixel: Vec2) -> Option<Vec3> {
    let plane = Vec2::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
    let is_outside = matches!(k.lens, Lens::Fisheye { .. }) && plane.length() > 0.5 * FISHEYE_FOV;
    if k.lens == Lens::Pinhole {
        return Some(plane.extend(1.0).normalize());
    }
    let mut point = DVec2::new(plane.x.into(), plane.y.into());
    if k.lens == Lens::Equirectangular {
        // Samples at the edges of a panorama may be beyond them.
        point = DVec2::new(
            (point.x + consts::PI).rem_euclid(consts::TAU) - consts::PI,
            point.y.clamp(-consts::FRAC_PI_2, consts::FRAC_PI_2),
        );
    }
    let direction = k.lens.direction(point);
    direction.filter(|_| !is_outside).map(|d| d.as_vec3().normalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(lens: SynthLens, width: u32, height: u32) -> Intrinsics {
        lens.intrinsics(Intrinsics::from_fov_x(width, height, 1.0))
    }

    #[test]
    fn each_lens_has_its_field() {
        let at = |k: &Intrinsics, x: f32, y: f32| direction(k, Vec2::new(x, y));
        let near = |found: Option<Vec3>, expected: Vec3| found.expect("a ray").distance(expected) < 1e-3;
        let panorama = camera(SynthLens::Equirectangular, 200, 100);
        assert!(near(at(&panorama, 100.0, 50.0), Vec3::Z) && near(at(&panorama, 150.0, 50.0), Vec3::X));
        assert!(
            near(at(&panorama, 201.0, 50.0), Vec3::new(-0.0314, 0.0, -1.0))
                && near(at(&panorama, 9.0, 0.0), Vec3::NEG_Y)
        );
        let fisheye = camera(SynthLens::Fisheye, 190, 200);
        assert!(near(at(&fisheye, 185.0, 100.0), Vec3::X) && at(&fisheye, 1.0, 1.0).is_none());
        let pinhole = camera(SynthLens::Pinhole, 200, 100);
        assert!(near(
            at(&pinhole, 200.0, 50.0),
            Vec3::new(0.5f32.tan(), 0.0, 1.0).normalize()
        ));
    }

    #[test]
    fn names_are_read_as_they_are_written() {
        for lens in SynthLens::ALL {
            assert_eq!(lens.to_string().parse(), Ok(lens));
        }
        assert!(
            "fish"
                .parse::<SynthLens>()
                .is_err_and(|error| error.to_string().contains("fisheye"))
        );
    }
}

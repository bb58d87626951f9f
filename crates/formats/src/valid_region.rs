//! The usable part of photographs that keep the distortion of their lens.

use glam::DVec2;
use irradia_scene::{Intrinsics, Lens};
use std::f64::consts::PI;

/// Distance from the axis up to which a perspective lens is searched for its fold: the tangent of 80 degrees.
const MAX_TANGENT: f64 = 5.671;
/// Maximum angle of a fisheye from its axis, radians: straight behind the camera, the position in the photograph is ambiguous.
const MAX_FISHEYE_ANGLE: f64 = PI - 1e-6;
/// Maximum latitude used of a panorama, radians: beyond it, splats cover many longitudes, which their affine approximations do not
/// follow. 75 degrees leave out 3 % of all directions.
const MAX_LATITUDE: f64 = 75.0 * PI / 180.0;
/// Maximum longitude used of a panorama, radians (176 degrees): a splat that crosses the edge straight behind appears on one side only.
const MAX_LONGITUDE: f64 = 176.0 * PI / 180.0;

/// The part of a camera's photographs that is compared with renderings through its lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ValidRegion {
    source: Intrinsics,
    region: Region,
}

/// A region of the lens's plane.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Region {
    /// A disc of this radius: the image circle, or the region in which the lens model can be inverted.
    Disc(f64),
    /// Panoramas without their poles and their edges.
    Band,
}

impl Region {
    fn contains(self, at: DVec2) -> bool {
        match self {
            Region::Disc(radius) => at.length() <= radius,
            Region::Band => at.x.abs() <= MAX_LONGITUDE && at.y.abs() <= MAX_LATITUDE,
        }
    }
}

impl ValidRegion {
    /// The usable part of photographs by `source`; `None` if all of it is usable. `rim` gives the angle from the axis, radians, at which
    /// photographs of a fisheye become black.
    pub fn of(source: &Intrinsics, rim: impl FnOnce() -> Option<f64>) -> Option<Self> {
        let lens = &source.lens;
        let region = match lens {
            Lens::Equirectangular => Region::Band,
            Lens::Fisheye { .. } => {
                let max_angle = lens.reach_in_angle().min(MAX_FISHEYE_ANGLE);
                Region::Disc(lens.radius_of_angle(rim().map_or(max_angle, |rim| rim.min(max_angle))))
            }
            _ => {
                let max_radius = lens.reach_on_plane(MAX_TANGENT);
                if max_radius.is_infinite() {
                    return None;
                }
                Region::Disc(lens.radius_of_angle(max_radius.atan()))
            }
        };
        let (right, lower) = (f64::from(source.width), f64::from(source.height));
        let corners = [[0.0, 0.0], [right, 0.0], [0.0, lower], [right, lower]];
        let is_whole = corners
            .iter()
            .all(|[x, y]| region.contains(source.plane_of(DVec2::new(*x, *y))));
        (!is_whole).then_some(Self {
            source: *source,
            region,
        })
    }

    /// Masks everything else in a photograph of this size; creates the mask if there is none.
    pub fn restrict_mask(&self, width: u32, height: u32, mask: &mut Option<Vec<u8>>) {
        let k = self.source.resized(width, height);
        let mask = mask.get_or_insert_with(|| vec![255; width as usize * height as usize]);
        for (row, y) in mask.chunks_exact_mut(width as usize).zip(0u32..) {
            for (value, x) in row.iter_mut().zip(0u32..) {
                if !self
                    .region
                    .contains(k.plane_of(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)))
                {
                    *value = 0;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(lens: Lens) -> Intrinsics {
        Intrinsics {
            width: 200,
            height: 100,
            fx: 60.0,
            fy: 60.0,
            cx: 100.0,
            cy: 50.0,
            lens,
        }
    }

    #[test]
    fn what_is_beyond_the_rim_or_the_fold_is_masked() {
        let fisheye = Lens::fisheye([0.0; 4]);
        let folding = Lens::Opencv {
            k: [-0.3, 0.0, 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
        };
        // The maximum of r - 0.3 r^3 is 0.7027, at r = 1.0541.
        for (lens, rim, radius) in [(fisheye, Some(1.2), 1.2), (folding, None, 0.7027)] {
            let region = ValidRegion::of(&camera(lens), || rim).expect("corners are beyond");
            let mut mask = None;
            region.restrict_mask(100, 50, &mut mask);
            let mask = mask.expect("made");
            for (at, value) in mask.iter().enumerate() {
                let [x, y] = [at % 100, at / 100].map(|v| v as f64 + 0.5);
                let distance = (x - 50.0).hypot(y - 25.0) / 30.0;
                assert!((distance - radius).abs() < 0.002 || (*value == 255) == (distance < radius));
            }
        }
        let mut mask = Some(vec![0; 5000]);
        ValidRegion::of(&camera(fisheye), || Some(1.2))
            .unwrap()
            .restrict_mask(100, 50, &mut mask);
        assert_eq!(mask, Some(vec![0; 5000]), "what is masked stays masked");
    }

    #[test]
    fn poles_and_edges_of_a_panorama_are_masked() {
        let panorama = Intrinsics {
            fx: 200.0 / (2.0 * std::f32::consts::PI),
            fy: 100.0 / std::f32::consts::PI,
            ..camera(Lens::Equirectangular)
        };
        let mut mask = None;
        ValidRegion::of(&panorama, || None)
            .unwrap()
            .restrict_mask(200, 100, &mut mask);
        let mask = mask.unwrap();
        let kept = |row: usize, column: usize| mask[row * 200 + column] == 255;
        // 1.8 degrees per pixel.
        assert!(!kept(7, 100) && kept(9, 100) && kept(90, 100) && !kept(92, 100));
        assert!(!kept(50, 1) && kept(50, 3) && kept(50, 196) && !kept(50, 198));
    }

    #[test]
    fn a_lens_that_fills_the_photograph_has_no_mask() {
        let barrel = Lens::Opencv {
            k: [-0.03, 0.0, 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
        };
        for lens in [Lens::Pinhole, Lens::Fov { omega: 0.9 }, barrel, Lens::fisheye([0.0; 4])] {
            assert_eq!(ValidRegion::of(&camera(lens), || None), None, "{lens:?}");
        }
    }
}

//! Wide lenses: photographs that one pinhole image cannot show become several images, the faces of a cube around the camera.
//!
//! A pinhole image of 90 degrees stretches its borders to twice the size of its centre, one of 150 degrees to fifteen times, and
//! beyond 180 degrees there is none. Faces show the whole photograph at its own resolution, and anything that trains on pinhole images
//! can train on them.

use crate::FormatError;
use crate::Pixels;
use crate::image_file::decode;
use crate::undistort::Undistortion;
use glam::{DQuat, DVec2, DVec3};
use image::metadata::Orientation;
use irradia_scene::{Intrinsics, Lens, resize_area};
use std::collections::BTreeMap;
use std::f64::consts::{FRAC_PI_2, PI};
use std::path::Path;

/// A photograph of a wide lens is cut into faces if one pinhole image shows less than this fraction of it.
const MIN_SHOWN_FRACTION: f64 = 0.7;
/// Samples along each side of the photograph by which that fraction is measured.
const SAMPLES_PER_SIDE: u32 = 48;
/// Minimum side of a face relative to that of the cube: a smaller face is a strip that only costs time.
const MIN_FACE_FRACTION: f64 = 1.0 / 8.0;
/// Maximum side of the cube relative to the longer side of the photograph. Beyond it, a photograph shows less than 30 degrees, and one
/// image shows all of it, unless its focal length is wrong.
const MAX_CUBE_FRACTION: f64 = 4.0;
/// Longer side of the small copies in which the image circle is searched, pixels.
const CIRCLE_IMAGE_SIDE: u32 = 256;
/// Maximum value, of 255, of the black around an image circle.
const MAX_BLACK: u8 = 20;
/// Fraction of the image circle's radius that faces use: the rim is dark and blurred.
const USED_RADIUS_FRACTION: f64 = 0.98;

/// A side of the cube around a camera: the suffix of the photograph's name, and the rotation from its axes to the photograph's.
type CubeFace = (&'static str, DQuat);

/// The sides in the order of their names.
pub(crate) fn cube_faces() -> [CubeFace; 6] {
    [
        ("back", DQuat::from_xyzw(0.0, 1.0, 0.0, 0.0)),
        ("down", DQuat::from_rotation_x(-FRAC_PI_2)),
        ("front", DQuat::IDENTITY),
        ("left", DQuat::from_rotation_y(-FRAC_PI_2)),
        ("right", DQuat::from_rotation_y(FRAC_PI_2)),
        ("up", DQuat::from_rotation_x(FRAC_PI_2)),
    ]
}

/// The pinhole images made from each photograph of a camera.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum PinholeImages {
    /// One image.
    Single(Box<Undistortion>),
    /// Several images, each with its suffix of the photograph's name.
    Faces(Vec<(&'static str, Undistortion)>),
}

impl PinholeImages {
    /// One image if it shows most of a photograph; otherwise faces, limited to `circle_angle` (radians from the axis) if there is
    /// one. `None` if the lens leaves no valid image.
    pub fn plan(source: &Intrinsics, circle_angle: impl FnOnce() -> Option<f64>) -> Option<Self> {
        let whole = (source.lens != Lens::Equirectangular)
            .then(|| Undistortion::plan(source))
            .flatten();
        if !source.lens.is_wide() {
            return whole.map(|plan| PinholeImages::Single(Box::new(plan)));
        }
        let max_angle = source.lens.reach_in_angle();
        if let Some(plan) = whole
            && shown_fraction(source, max_angle, &plan) >= MIN_SHOWN_FRACTION
        {
            return Some(PinholeImages::Single(Box::new(plan)));
        }
        let max_angle = circle_angle().map_or(max_angle, |circle_angle| circle_angle.min(max_angle));
        let faces = plan_faces(source, max_angle);
        (!faces.is_empty()).then_some(PinholeImages::Faces(faces))
    }
}

/// The six faces of a panorama.
pub(crate) fn panorama_faces(width: u32, height: u32) -> Vec<(&'static str, Undistortion)> {
    let focal = (f64::from(width) / (2.0 * PI)) as f32;
    let source = Intrinsics {
        width,
        height,
        fx: focal,
        fy: (f64::from(height) / PI) as f32,
        cx: 0.5 * width as f32,
        cy: 0.5 * height as f32,
        lens: Lens::Equirectangular,
    };
    plan_faces(&source, PI)
}

/// The angle between a direction and the axis, radians.
fn angle(direction: DVec3) -> f64 {
    direction.truncate().length().atan2(direction.z)
}

/// The fraction of the photograph's pixels within `max_angle` (radians from the axis) that `plan`'s image shows.
fn shown_fraction(source: &Intrinsics, max_angle: f64, plan: &Undistortion) -> f64 {
    let (mut total, mut shown) = (0u32, 0u32);
    for row in 0..SAMPLES_PER_SIDE {
        for column in 0..SAMPLES_PER_SIDE {
            let at = [(column, source.width), (row, source.height)];
            let [x, y] = at.map(|(i, side)| (f64::from(i) + 0.5) / f64::from(SAMPLES_PER_SIDE) * f64::from(side));
            let direction = source.lens.direction(source.plane_of(DVec2::new(x, y)));
            if direction.is_some_and(|direction| angle(direction) < max_angle) {
                total += 1;
                shown += u32::from(plan.shows(x, y));
            }
        }
    }
    f64::from(shown) / f64::from(total.max(1))
}

/// The sides of a cube, cropped to what the photograph shows within `max_angle` (radians from its axis), at its resolution at their
/// centres.
fn plan_faces(source: &Intrinsics, max_angle: f64) -> Vec<(&'static str, Undistortion)> {
    let focal = 0.5 * (source.fx + source.fy);
    let side = (2.0 * focal).round().max(1.0) as u32;
    if f64::from(side) > MAX_CUBE_FRACTION * f64::from(source.width.max(source.height)) {
        return Vec::new();
    }
    let pinhole = Intrinsics::from_fov_x(side, side, FRAC_PI_2 as f32);
    let face = |(name, rotation): CubeFace| {
        // The back face of a camera that does not see straight behind itself would have a hole.
        if rotation * DVec3::Z == DVec3::NEG_Z && max_angle < PI {
            return None;
        }
        let plan = Undistortion::rotated(source, pinhole, rotation, |direction| angle(direction) < max_angle)?;
        let k = plan.pinhole();
        let is_large = f64::from(k.width.min(k.height)) >= MIN_FACE_FRACTION * f64::from(side);
        is_large.then_some((name, plan))
    };
    cube_faces().into_iter().filter_map(face).collect()
}

/// The radius of a fisheye's image circle, as the angle from its axis in radians; `None` if the corners of the photographs are not
/// black.
///
/// # Errors
/// When a photograph cannot be read.
pub(crate) fn image_circle<'a>(
    source: &Intrinsics,
    photographs: impl Iterator<Item = (&'a Path, Orientation)>,
) -> Result<Option<f64>, FormatError> {
    let (width, height) = circle_image_size(source);
    let mut brightest = vec![0u8; (width * height) as usize];
    for (path, orientation) in photographs {
        let pixels = decode(path, orientation)?;
        for (max, pixel) in brightest.iter_mut().zip(max_channels(&pixels, width, height)) {
            *max = (*max).max(pixel);
        }
    }
    Ok(circle_angle(source, width, height, &brightest))
}

/// The size at which the circle is searched.
fn circle_image_size(source: &Intrinsics) -> (u32, u32) {
    let k = source.scaled((CIRCLE_IMAGE_SIDE as f32 / source.width.max(source.height) as f32).min(1.0));
    (k.width, k.height)
}

/// The largest channel of each pixel of a smaller copy, 0 where it is transparent.
fn max_channels(from: &Pixels, width: u32, height: u32) -> Vec<u8> {
    let channels = from.channels as usize;
    let data = resize_area(&from.data, from.channels, [from.width, from.height], [width, height]);
    let value = |pixel: &[u8]| match pixel {
        [r, g, b, alpha] if *alpha >= 128 => *r.max(g).max(b),
        [r, g, b] => *r.max(g).max(b),
        [grey] => *grey,
        _ => 0,
    };
    data.chunks_exact(channels).map(value).collect()
}

/// See [`image_circle`]; `brightest` is `[height, width]`, the largest value of each pixel in any photograph.
fn circle_angle(source: &Intrinsics, width: u32, height: u32, brightest: &[u8]) -> Option<f64> {
    let k = source.resized(width, height);
    let corners = [0, width - 1, (height - 1) * width, height * width - 1];
    if corners.iter().any(|at| brightest[*at as usize] > MAX_BLACK) {
        return None;
    }
    // Rings one pixel wide; from the outermost inwards, the first that is mostly not black.
    let ring_width = 1.0 / f64::from(k.fx.min(k.fy));
    let mut rings: BTreeMap<usize, [u32; 2]> = BTreeMap::new();
    for (at, value) in (0u32..).zip(brightest) {
        let (x, y) = (f64::from(at % width) + 0.5, f64::from(at / width) + 0.5);
        let index = (k.plane_of(DVec2::new(x, y)).length() / ring_width) as usize;
        let [all, lit] = rings.entry(index).or_default();
        *all += 1;
        *lit += u32::from(*value > MAX_BLACK);
    }
    let (rim, _) = rings.iter().rfind(|(_, [all, lit])| 2 * lit > *all)?;
    let direction = k
        .lens
        .direction(DVec2::new(USED_RADIUS_FRACTION * (*rim as f64 + 0.5) * ring_width, 0.0))?;
    Some(angle(direction))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(lens: Lens, width: u32, height: u32, focal: [f64; 2]) -> Intrinsics {
        Intrinsics {
            width,
            height,
            fx: focal[0] as f32,
            fy: focal[1] as f32,
            cx: 0.5 * width as f32,
            cy: 0.5 * height as f32,
            lens,
        }
    }

    fn panorama(width: u32) -> Intrinsics {
        let focal = f64::from(width) / (2.0 * PI);
        camera(Lens::Equirectangular, width, width / 2, [focal; 2])
    }

    /// The colour of a direction: smooth everywhere, different for each.
    fn color(direction: DVec3) -> [f64; 3] {
        let d = direction.normalize();
        [d.x, d.y, d.z].map(|v| 128.0 + 90.0 * v)
    }

    /// What a lens sees of [`color`].
    fn photograph(k: &Intrinsics) -> Pixels {
        let mut data = Vec::new();
        for y in 0..k.height {
            for x in 0..k.width {
                let direction = k
                    .lens
                    .direction(k.plane_of(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)));
                data.extend(direction.map_or([0.0; 3], color).map(|v| v.round() as u8));
            }
        }
        Pixels {
            width: k.width,
            height: k.height,
            channels: 3,
            data,
        }
    }

    fn faces_of(k: &Intrinsics) -> Vec<(&'static str, Undistortion)> {
        match PinholeImages::plan(k, || None).expect("a plan") {
            PinholeImages::Faces(faces) => faces,
            PinholeImages::Single(whole) => panic!("{whole:?}"),
        }
    }

    #[test]
    fn faces_show_what_is_in_their_directions() {
        for k in [
            panorama(512),
            camera(Lens::fisheye([0.01, 0.002, 0.0, 0.0]), 360, 360, [100.0, 102.0]),
        ] {
            let photo = photograph(&k);
            for (name, plan) in faces_of(&k) {
                let image = plan.apply(&photo);
                let pinhole = plan.pinhole();
                assert_eq!((image.width, image.height), (pinhole.width, pinhole.height));
                let mut worst = 0f64;
                for (at, pixel) in (0u32..).zip(image.data.chunks_exact(3)) {
                    let (x, y) = (at % image.width, at / image.width);
                    let ray = pinhole
                        .plane_of(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5))
                        .extend(1.0);
                    for (value, expected) in pixel.iter().zip(color(plan.rotation() * ray)) {
                        worst = worst.max((f64::from(*value) - expected).abs());
                    }
                }
                // Roundings to 8 bits, of the photograph and of the face.
                assert!(worst < 2.0, "{name} of {:?}: {worst}", k.lens);
            }
        }
    }

    /// Stripes of five pixels; bilinear samples would be off by up to 16.
    #[test]
    fn faces_keep_what_is_almost_as_fine_as_the_pixels() {
        let k = panorama(512);
        let stripes = |longitude: f64| 128.0 + 90.0 * (100.0 * longitude).sin();
        let row = (0..k.width).map(|x| stripes(k.plane_of(DVec2::new(f64::from(x) + 0.5, 0.0)).x).round() as u8);
        let photo = Pixels {
            width: k.width,
            height: k.height,
            channels: 1,
            data: row.collect::<Vec<_>>().repeat(k.height as usize),
        };
        for (name, plan) in faces_of(&k)
            .into_iter()
            .filter(|(name, _)| !matches!(*name, "up" | "down"))
        {
            let (image, pinhole) = (plan.apply(&photo), plan.pinhole());
            let y = image.height / 2;
            let mut worst = 0f64;
            for x in 0..image.width {
                let ray = pinhole
                    .plane_of(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5))
                    .extend(1.0);
                let direction = plan.rotation() * ray;
                let value = image.data[(y * image.width + x) as usize];
                worst = worst.max((f64::from(value) - stripes(direction.x.atan2(direction.z))).abs());
            }
            assert!(worst < 3.0, "{name}: {worst}");
        }
    }

    #[test]
    fn a_panorama_has_six_whole_faces() {
        let faces = faces_of(&panorama(512));
        let names: Vec<_> = faces.iter().map(|(name, _)| *name).collect();
        assert_eq!(names, ["back", "down", "front", "left", "right", "up"]);
        for (name, plan) in faces {
            let k = plan.pinhole();
            // 512 pixels for a full turn are 81.5 per radian.
            assert!(
                k.width.min(k.height) >= 161 && k.width.max(k.height) <= 163,
                "{name} {k:?}"
            );
        }
    }

    #[test]
    fn a_half_turn_has_a_front_and_half_of_four_sides() {
        let k = camera(Lens::fisheye([0.0; 4]), 314, 314, [100.0; 2]);
        // The corners are beyond the half turn, and would be black in a photograph of such a lens.
        let Some(PinholeImages::Faces(faces)) = PinholeImages::plan(&k, || Some(FRAC_PI_2)) else {
            panic!("faces")
        };
        let sizes: Vec<_> = faces
            .iter()
            .map(|(name, plan)| (*name, plan.pinhole().width, plan.pinhole().height))
            .collect();
        for (name, width, height) in sizes {
            let expected = match name {
                "front" => [200, 200],
                "left" | "right" => [100, 200],
                "up" | "down" => [200, 100],
                other => panic!("{other} {width}x{height}"),
            };
            assert!(
                width.abs_diff(expected[0]) <= 4 && height.abs_diff(expected[1]) <= 4,
                "{name} {width}x{height}"
            );
        }
    }

    #[test]
    fn focal_lengths_that_are_far_too_long_leave_no_image() {
        let lens = Lens::Fisheye {
            k: [0.0; 4],
            p: [0.0, 1e20],
            s: [0.0; 2],
        };
        let k = camera(lens, 40, 30, [1e6; 2]);
        assert_eq!(PinholeImages::plan(&k, || None), None);
    }

    #[test]
    fn a_principal_point_far_away_leaves_no_circle_and_takes_no_memory() {
        let mut k = camera(Lens::fisheye([0.0; 4]), 64, 48, [20.0; 2]);
        k.cx = 1e20;
        assert_eq!(circle_angle(&k, 64, 48, &[0; 64 * 48]), None);
    }

    #[test]
    fn moderate_fisheyes_stay_one_image() {
        let k = camera(Lens::fisheye([0.02, -0.01, 0.003, -0.0005]), 320, 240, [250.0; 2]);
        assert!(matches!(
            PinholeImages::plan(&k, || panic!("not asked for")),
            Some(PinholeImages::Single(_))
        ));
    }

    #[test]
    fn the_image_circle_is_found_and_full_frames_have_none() {
        let k = camera(Lens::fisheye([0.0; 4]), 256, 192, [60.0; 2]);
        let lit = |radius: f64| -> Vec<u8> {
            let distance = |at: u32| DVec2::new(f64::from(at % 256) - 127.5, f64::from(at / 256) - 95.5).length();
            (0..256 * 192)
                .map(|at| if distance(at) < radius { 90 } else { 5 })
                .collect()
        };
        let found = circle_angle(&k, 256, 192, &lit(94.0)).expect("a circle");
        assert!((found - USED_RADIUS_FRACTION * 94.0 / 60.0).abs() < 0.02, "{found}");
        assert_eq!(circle_angle(&k, 256, 192, &lit(1000.0)), None);
        assert_eq!(circle_angle(&k, 256, 192, &lit(0.0)), None);
    }
}

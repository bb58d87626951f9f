//! VisualSfM's `.nvm`, version 3 (<http://ccwu.me/vsfm/doc.html#nvm>). Rotations are camera-from-world with x right, y down and z
//! forward, positions are camera centres.

use super::declared::{DeclaredCamera, DeclaredDataset, DeclaredPose, DeclaredView, Focal, lens_or_pinhole};
use super::files::{first_file, locate_image};
use super::tokens::Tokens;
use super::tracks::{TrackPoint, declared_points, parse_track_point};
use crate::error::read_and_parse;
use crate::image_file::read_header;
use crate::text::text;
use crate::{FormatError, Malformed};
use glam::{DMat3, DQuat, DVec3};
use irradia_scene::Lens;
use std::path::{Path, PathBuf};

/// Where the photographs are, relative to the file.
const IMAGE_FOLDERS: [&str; 3] = ["", "images", "../images"];
/// Half of a photograph's diagonal relative to the focal length if its size is unknown: a field of view of 90 degrees.
const UNKNOWN_CORNER: f64 = 1.0;
/// Numbers after a photograph's name.
const NUMBERS_PER_IMAGE: usize = 10;

/// A model: photographs, and points with the photographs that see them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NvmModel {
    /// Photographs.
    pub images: Vec<NvmImage>,
    /// Points that [`Self::images`] see.
    pub points: Vec<TrackPoint>,
}

/// A photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct NvmImage {
    /// File, relative to the model's.
    pub name: String,
    /// fx and fy, pixels.
    pub focal: [f64; 2],
    /// The principal point, pixels; the photograph's centre if `None`.
    pub principal: Option<[f64; 2]>,
    /// Camera-from-world, `w, x, y, z`.
    pub rotation: [f64; 4],
    /// The camera's centre.
    pub center: [f64; 3],
    /// r in undistorted = distorted (1 + r |distorted|^2), in units of the focal length.
    pub radial: f64,
}

pub(super) fn find(path: &Path) -> Option<PathBuf> {
    first_file(path, |file| {
        file.extension().is_some_and(|e| e.eq_ignore_ascii_case("nvm"))
    })
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let file = find(path).ok_or_else(|| FormatError::malformed(path, "contains no .nvm file"))?;
    let models = read_and_parse(&file, parse_nvm)?;
    let root = file.parent().unwrap_or(Path::new(".")).to_owned();
    let count = models.len();
    let largest = models.into_iter().rev().max_by_key(|model| model.images.len());
    let Some(model) = largest else {
        return Err(FormatError::malformed(&file, "it has no model with photographs"));
    };
    let mut warnings = Vec::new();
    if count > 1 {
        let n = model.images.len();
        warnings.push(format!("the largest of {count} models is used, with {n} photographs"));
    }
    let (points, mut points_seen) = declared_points(model.points);
    let views = model.images.iter().enumerate().map(|(i, image)| {
        let name = image.name.replace('\\', "/");
        let image_path = locate_image(&root, &IMAGE_FOLDERS, &name);
        // Only distortion depends on the size. A photograph that cannot be read is reported later.
        let distorted = image_path.as_deref().filter(|_| image.radial != 0.0);
        let header = distorted.and_then(|path| read_header(path).ok());
        let camera = declared_camera(image, header.map(|header| (header.width, header.height)));
        DeclaredView {
            points_seen: points_seen.remove(&i).unwrap_or_default(),
            ..DeclaredView::posed(&root, &name, image_path, pose(image), camera)
        }
    });
    Ok(DeclaredDataset {
        kind: "VisualSfM",
        views: views.collect(),
        root,
        points: Some(points),
        downscale,
        warnings,
    })
}

/// Parses an `.nvm` file: its models with photographs.
///
/// # Errors
/// When it is of another version, truncated, or has a word where a number is expected.
pub fn parse_nvm(bytes: &[u8]) -> Result<Vec<NvmModel>, Malformed> {
    let text = text(bytes);
    let mut lines = text
        .lines()
        .filter(|line| !line.trim().is_empty() && !line.starts_with('#'));
    let Some(header) = lines.next().filter(|line| line.starts_with("NVM_V3")) else {
        return Err(Malformed("not an NVM file of version 3".into()));
    };
    let calibration = fixed_calibration(header)?;
    let count = |line: Option<&str>| -> Result<usize, Malformed> { Tokens::new(line.unwrap_or("0")).next("a count") };
    let mut models = Vec::new();
    loop {
        let images = count(lines.next())?;
        if images == 0 {
            break;
        }
        let mut model = NvmModel::default();
        for _ in 0..images {
            let mut image = parse_image(lines.next().unwrap_or_default())?;
            if let Some([fx, cx, fy, cy]) = calibration {
                (image.focal, image.principal) = ([fx, fy], Some([cx, cy]));
            }
            model.images.push(image);
        }
        for _ in 0..count(lines.next())? {
            model
                .points
                .push(parse_track_point(&mut Tokens::new(lines.next().unwrap_or_default()))?);
        }
        models.push(model);
    }
    Ok(models)
}

/// fx, cx, fy and cy of all photographs, if the first line has them: `NVM_V3 FixedK fx cx fy cy r`. Each photograph has its own r.
fn fixed_calibration(header: &str) -> Result<Option<[f64; 4]>, Malformed> {
    let numbers = header.split_once("FixedK").map(|(_, numbers)| numbers);
    numbers
        .map(|numbers| Tokens::new(numbers).numbers("a number of the fixed calibration"))
        .transpose()
}

fn parse_image(line: &str) -> Result<NvmImage, Malformed> {
    // Some programs write spaces in names, so the numbers are counted from the end.
    let words: Vec<&str> = line.split_whitespace().collect();
    let Some(length) = words.len().checked_sub(NUMBERS_PER_IMAGE).filter(|length| *length > 0) else {
        return Err(Malformed(format!(
            "a photograph has a name and {NUMBERS_PER_IMAGE} numbers, not `{line}`"
        )));
    };
    let numbers = words[length..].join(" ");
    let [focal, w, x, y, z, cx, cy, cz, radial, _] = Tokens::new(&numbers).numbers("a number of a photograph")?;
    Ok(NvmImage {
        // VisualSfM itself writes `"` for a space.
        name: words[..length].join(" ").replace('"', " "),
        focal: [focal; 2],
        principal: None,
        rotation: [w, x, y, z],
        center: [cx, cy, cz],
        radial,
    })
}

fn pose(image: &NvmImage) -> Option<DeclaredPose> {
    let [w, x, y, z] = image.rotation;
    let camera_from_world = DQuat::from_xyzw(x, y, z, w);
    let length = camera_from_world.length();
    if !(length.is_finite() && length > 1e-6) {
        return None;
    }
    DeclaredPose {
        rotation: (camera_from_world / length).inverse(),
        position: image.center.into(),
    }
    .checked()
}

/// The camera of a photograph of the size `size`, if that is known.
fn declared_camera(image: &NvmImage, size: Option<(u32, u32)>) -> DeclaredCamera {
    let corner = size.map_or(UNKNOWN_CORNER, |(width, height)| {
        0.5 * f64::from(width).hypot(f64::from(height)) / image.focal[0]
    });
    DeclaredCamera {
        size: None,
        focal: Focal::Pixels(image.focal),
        center: image.principal,
        lens: lens_or_pinhole(Lens::brown(
            distortion_from_undistortion(image.radial, corner),
            [0.0; 2],
        )),
    }
}

/// VisualSfM's model goes from distorted to undistorted, u = d (1 + r d^2), and ours the other way, d = u (1 + k1 u^2 + k2 u^4 + k3 u^6).
/// Returns the `k` that fit the model best for d up to `corner`: for r between -0.2 and 0.3 to 2e-4 at 0.72, half the diagonal of a
/// photograph whose focal length is 0.83 of its width. The reversed power series is wrong by up to 4e-2 there.
fn distortion_from_undistortion(r: f64, corner: f64) -> [f64; 3] {
    const SAMPLES: u32 = 64;
    // Beyond its maximum, u does not determine d.
    let maximum = if r < 0.0 {
        (-1.0 / (3.0 * r)).sqrt()
    } else {
        f64::INFINITY
    };
    let corner = corner.min(0.95 * maximum);
    if r == 0.0 || !(corner > 0.0 && corner.is_finite()) {
        return [0.0; 3];
    }
    let undistorted = |d: f64| d * (1.0 + r * d * d);
    // In units of the corner, so that the equations are well conditioned.
    let unit = undistorted(corner);
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for i in 1..=SAMPLES {
        let d = corner * f64::from(i) / f64::from(SAMPLES);
        let u = undistorted(d) / unit;
        let basis = DVec3::new(u.powi(3), u.powi(5), u.powi(7));
        normal += DMat3::from_cols(basis * basis.x, basis * basis.y, basis * basis.z);
        right += basis * (d / unit - u);
    }
    let k = normal.inverse() * right;
    [k.x / unit.powi(2), k.y / unit.powi(4), k.z / unit.powi(6)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distortion_is_that_of_the_undistortion_up_to_the_corner() {
        for r in [-0.2, -0.05, 0.0, 0.04, 0.15, 0.3] {
            let k = distortion_from_undistortion(r, 0.72);
            for i in 0..=72 {
                let d = 0.01 * f64::from(i);
                let u = d * (1.0 + r * d * d);
                let distorted = u * (1.0 + k[0] * u.powi(2) + k[1] * u.powi(4) + k[2] * u.powi(6));
                assert!((distorted - d).abs() < 2e-4, "{r}, {d}: {distorted}");
            }
        }
        let beyond = distortion_from_undistortion(-2.0, 0.72);
        assert!(beyond.iter().all(|k| k.is_finite()), "{beyond:?}");
        assert_eq!(distortion_from_undistortion(0.1, f64::NAN), [0.0; 3]);
    }

    #[test]
    fn names_with_spaces_are_read_as_they_are_written() {
        for written in ["my photo 1.jpg", "my\"photo\"1.jpg"] {
            let text = format!("NVM_V3\n\n1\n{written} 400 1 0 0 0 1 2 3 0.1 0\n\n0\n0\n");
            let models = parse_nvm(text.as_bytes()).unwrap();
            assert_eq!(models[0].images[0].name, "my photo 1.jpg", "{written}");
        }
    }

    #[test]
    fn a_fixed_calibration_is_that_of_all_photographs() {
        let model = |header: &str| format!("{header}\n\n1\na.png 400 1 0 0 0 1 2 3 0.1 0\n\n0\n0\n");
        let camera = |header: &str| {
            let models = parse_nvm(model(header).as_bytes()).unwrap();
            let image = &models[0].images[0];
            (image.focal, image.principal, image.radial)
        };
        assert_eq!(camera("NVM_V3 "), ([400.0; 2], None, 0.1));
        let fixed = camera("NVM_V3 FixedK 500 33 510 24 0.1");
        assert_eq!(fixed, ([500.0, 510.0], Some([33.0, 24.0]), 0.1));
        assert!(parse_nvm(model("NVM_V3 FixedK 500 33").as_bytes()).is_err());
    }
}

//! Cameras exported by RealityCapture: a `.csv` of internal and external parameters, or an `.xmp` beside each photograph.
//!
//! Focal lengths are in mm for film 36 mm wide, which corresponds to the longer side of the image; offsets of the principal point are
//! fractions of that side, in both files (Epic's "Camera math" of RealityScan). Angles of the CSV, in degrees, rotate
//! a camera that looks along -Z with Y up: roll about Y, pitch about X, then the negative heading about Z (nerfstudio's
//! `realitycapture_utils.py`). An XMP has camera-from-world with OpenCV axes. The tangential coefficients t1 and t2 are OpenCV's p2 and
//! p1, as in the program's own export template for OpenCV and in AliceVision's importer.

use super::declared::{
    DeclaredCamera, DeclaredDataset, DeclaredPose, DeclaredView, Focal, lens_or_pinhole, pose_from_axes,
};
use super::files::{first_file, is_image_name, list_files, locate_image, relative_name, start_matches};
use crate::error::read_and_parse;
use crate::image_file::read_header;
use crate::text::text;
use crate::xml::{numbers, parse_xml, property};
use crate::{FormatError, Malformed};
use glam::{DMat3, DVec3};
use irradia_scene::Lens;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Width of the film, mm.
const FILM_WIDTH_MM: f64 = 36.0;
/// Where the photographs are, relative to the file.
const IMAGE_FOLDERS: [&str; 3] = ["images", "", "../images"];
/// Text that only an XMP with a pose contains.
const POSE_TAG: &[u8] = b"xcr:Rotation";
/// How the CSV begins.
const CSV_HEADER_START: &[u8] = b"#name,x,y,alt,heading,pitch,roll";

/// A photograph, with lengths as fractions of the longer side of its image.
#[derive(Clone, Debug, PartialEq)]
pub struct RealityCaptureView {
    /// File name.
    pub name: String,
    /// Camera axes (right, down, forward) in the world.
    axes: [DVec3; 3],
    position: DVec3,
    focal: f64,
    /// Offset of the principal point from the image's centre.
    offset: [f64; 2],
    k: [f64; 3],
    p: [f64; 2],
}

/// Where cameras are declared.
pub(super) enum CameraSource {
    /// One table.
    Csv(PathBuf),
    /// Photographs, each with an XMP beside it.
    Xmp(Vec<PathBuf>),
}

pub(super) fn find(path: &Path) -> Option<CameraSource> {
    let is_table = |file: &Path| {
        file.extension().is_some_and(|e| e.eq_ignore_ascii_case("csv"))
            && start_matches(file, |start| {
                start
                    .strip_prefix(b"\xef\xbb\xbf")
                    .unwrap_or(start)
                    .starts_with(CSV_HEADER_START)
            })
    };
    if let Some(file) = first_file(path, is_table) {
        return Some(CameraSource::Csv(file));
    }
    // Other XMP files have only a calibration.
    let has_camera = |start: &[u8]| start.windows(POSE_TAG.len()).any(|word| word == POSE_TAG);
    [path.to_owned(), path.join("images")].into_iter().find_map(|folder| {
        let images = list_files(&folder, is_image_name).ok()?;
        let posed: Vec<PathBuf> = images
            .into_iter()
            .filter(|image| start_matches(&xmp_path(image), has_camera))
            .collect();
        (!posed.is_empty()).then_some(CameraSource::Xmp(posed))
    })
}

/// The `.xmp` of a photograph.
fn xmp_path(image: &Path) -> PathBuf {
    image.with_extension("xmp")
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let (root, views) = match find(path) {
        Some(CameraSource::Csv(file)) => {
            let root = file.parent().unwrap_or(Path::new(".")).to_owned();
            let rows = read_and_parse(&file, parse_realitycapture_csv)?;
            let located = rows
                .into_iter()
                .map(|row| (locate_image(&root, &IMAGE_FOLDERS, &row.name), row));
            let views = located.map(|(image, row)| view(&root, image, row)).collect();
            (root, views)
        }
        Some(CameraSource::Xmp(images)) => {
            let mut views = Vec::with_capacity(images.len());
            for image in images {
                let mut row = read_and_parse(&xmp_path(&image), parse_realitycapture_xmp)?;
                row.name = relative_name(path, &image);
                views.push(view(path, Some(image), row));
            }
            (path.to_owned(), views)
        }
        None => return Err(FormatError::malformed(path, "contains no RealityCapture cameras")),
    };
    Ok(DeclaredDataset {
        kind: "RealityCapture",
        root,
        views,
        points: None,
        downscale,
        warnings: Vec::new(),
    })
}

fn view(root: &Path, image: Option<PathBuf>, row: RealityCaptureView) -> DeclaredView {
    // The size is that of the photograph; one that cannot be read is reported later.
    let header = image.as_deref().and_then(|image| read_header(image).ok());
    let size = header.map_or([1.0; 2], |header| [f64::from(header.width), f64::from(header.height)]);
    let longer_side = size[0].max(size[1]);
    let camera = DeclaredCamera {
        size: Some(size),
        focal: Focal::Pixels([row.focal * longer_side; 2]),
        center: Some([0, 1].map(|i| 0.5 * size[i] + row.offset[i] * longer_side)),
        lens: lens_or_pinhole(Lens::brown(row.k, row.p)),
    };
    let [right, down, forward] = row.axes;
    let pose: Option<DeclaredPose> = pose_from_axes(right, down, forward, row.position);
    DeclaredView::posed(root, &row.name.replace('\\', "/"), image, pose, camera)
}

/// Parses the CSV.
///
/// # Errors
/// When a column is missing, or a value is not a number.
pub fn parse_realitycapture_csv(bytes: &[u8]) -> Result<Vec<RealityCaptureView>, Malformed> {
    let text = text(bytes);
    let mut lines = text.lines();
    let header: HashMap<&str, usize> = lines
        .next()
        .unwrap_or_default()
        .split(',')
        .enumerate()
        .map(|(i, name)| (name.trim(), i))
        .collect();
    let mut rows = Vec::new();
    for line in lines.filter(|line| !line.trim().is_empty()) {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let cell = |name: &str| {
            let found = header.get(name).and_then(|i| cells.get(*i)).copied();
            found.ok_or_else(|| Malformed(format!("`{line}` has no column {name}")))
        };
        let number = |name: &str| -> Result<f64, Malformed> {
            let text = cell(name)?;
            text.parse()
                .map_err(|_| Malformed(format!("{name} is `{text}`, not a number")))
        };
        let optional = |name: &str| {
            if header.contains_key(name) {
                number(name)
            } else {
                Ok(0.0)
            }
        };
        let [heading, pitch, roll] = [number("heading")?, number("pitch")?, number("roll")?].map(f64::to_radians);
        let rotation = DMat3::from_rotation_z(-heading) * DMat3::from_rotation_x(pitch) * DMat3::from_rotation_y(roll);
        if optional("k4")? != 0.0 {
            let name = cell("#name")?;
            return Err(Malformed(format!(
                "{name} has a k4, which is not supported; export with another distortion model"
            )));
        }
        rows.push(RealityCaptureView {
            name: cell("#name")?.to_owned(),
            axes: [rotation.x_axis, -rotation.y_axis, -rotation.z_axis],
            position: DVec3::new(number("x")?, number("y")?, number("alt")?),
            focal: number("f")? / FILM_WIDTH_MM,
            offset: [optional("px")?, optional("py")?],
            k: [optional("k1")?, optional("k2")?, optional("k3")?],
            p: [optional("t2")?, optional("t1")?],
        });
    }
    Ok(rows)
}

/// Parses an XMP; the name is left empty.
///
/// # Errors
/// When it has no pose or focal length, or a distortion model that is not supported.
pub fn parse_realitycapture_xmp(bytes: &[u8]) -> Result<RealityCaptureView, Malformed> {
    let document = parse_xml(bytes)?;
    let numbers_of = |name: &str| property(&document, name).map(numbers).unwrap_or_default();
    let number_of = |name: &str| numbers_of(name).first().copied();
    let missing = |name: &str| Malformed(format!("has no {name}; export metadata with poses from RealityCapture"));
    let rotation: [f64; 9] = numbers_of("xcr:Rotation")
        .try_into()
        .map_err(|_| missing("xcr:Rotation of 9 numbers"))?;
    let position: [f64; 3] = numbers_of("xcr:Position")
        .try_into()
        .map_err(|_| missing("xcr:Position of 3 numbers"))?;
    let model = property(&document, "xcr:DistortionModel").unwrap_or("perspective");
    let coefficients = numbers_of("xcr:DistortionCoeficients");
    let k = |i: usize| coefficients.get(i).copied().unwrap_or(0.0);
    let distorts = coefficients.iter().any(|v| *v != 0.0);
    let is_brown = model.starts_with("brown") && k(3) == 0.0;
    if distorts && !is_brown {
        return Err(Malformed(format!(
            "the distortion model `{model}` with these coefficients is not supported; export with brown3 or undistorted photographs"
        )));
    }
    Ok(RealityCaptureView {
        name: String::new(),
        axes: [0, 1, 2].map(|row| DVec3::from_slice(&rotation[3 * row..])),
        position: position.into(),
        focal: number_of("xcr:FocalLength35mm").ok_or_else(|| missing("xcr:FocalLength35mm"))? / FILM_WIDTH_MM,
        offset: [
            number_of("xcr:PrincipalPointU").unwrap_or(0.0),
            number_of("xcr:PrincipalPointV").unwrap_or(0.0),
        ],
        k: [k(0), k(1), k(2)],
        p: [k(5), k(4)],
    })
}

//! Cameras exported by Agisoft Metashape as XML. Poses are world-from-camera with OpenCV axes, row by row, in the coordinates of a
//! chunk; its transform leads to the world. Lens: the manual's appendix "Camera models", whose P1 and P2 are OpenCV's p2 and p1.

use super::declared::{
    DeclaredCamera, DeclaredDataset, DeclaredPose, DeclaredView, Focal, lens_or_pinhole, pose_from_axes,
};
use super::files::{first_file, locate_image, start_matches};
use super::images::PhotographsBelow;
use crate::error::read_and_parse;
use crate::xml::{Element, parse_xml};
use crate::{FormatError, Malformed};
use glam::{DMat3, DVec3};
use irradia_scene::Lens;
use std::cell::LazyCell;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Where the photographs are, relative to the file.
const IMAGE_FOLDERS: [&str; 3] = ["images", "", "../images"];

pub(super) fn find(path: &Path) -> Option<PathBuf> {
    let has_document = |start: &[u8]| start.windows(9).any(|word| word == b"<document");
    first_file(path, |file| {
        file.extension().is_some_and(|e| e.eq_ignore_ascii_case("xml")) && start_matches(file, has_document)
    })
}

pub(super) fn read(path: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let file = find(path).ok_or_else(|| FormatError::malformed(path, "contains no Metashape cameras"))?;
    let cameras = read_and_parse(&file, parse_metashape)?;
    let root = file.parent().unwrap_or(Path::new(".")).to_owned();
    let (enabled, disabled): (Vec<_>, Vec<_>) = cameras.into_iter().partition(|camera| camera.is_enabled);
    let count = enabled.len();
    let posed: Vec<(String, Aligned)> = enabled
        .into_iter()
        .filter_map(|camera| Some((camera.label, camera.aligned?)))
        .collect();
    let mut warnings = Vec::new();
    if !disabled.is_empty() {
        warnings.push(format!("{} photographs are disabled and are skipped", disabled.len()));
    }
    if posed.len() < count {
        let unposed = count - posed.len();
        warnings.push(format!("{unposed} photographs are not aligned and are skipped"));
    }
    type Has = fn(&Sensor) -> bool;
    let ignored: [(&str, Has); 2] = [
        ("skew (b2)", |sensor| sensor.is_skewed),
        ("p3 and p4", |sensor| sensor.has_p3_or_p4),
    ];
    for (name, has) in ignored {
        let count = posed.iter().filter(|(_, aligned)| has(&aligned.sensor)).count();
        if count > 0 {
            warnings.push(format!(
                "the {name} of {count} photographs is ignored; optimise the cameras without it, or undistort the photographs"
            ));
        }
    }
    // Labels have no folders.
    let below = LazyCell::new(|| PhotographsBelow::find(&root));
    let view = |(label, aligned): (String, Aligned)| {
        let name = label.replace('\\', "/");
        let image = locate_image(&root, &IMAGE_FOLDERS, &name).or_else(|| below.only(&name));
        DeclaredView::posed(&root, &name, image, Some(aligned.pose), aligned.sensor.camera)
    };
    Ok(DeclaredDataset {
        kind: "Metashape",
        views: posed.into_iter().map(view).collect(),
        points: None,
        downscale,
        warnings,
        root,
    })
}

/// A photograph of a chunk.
pub(crate) struct MetashapeCamera {
    label: String,
    /// Whether its user has left it enabled.
    is_enabled: bool,
    /// `None` if it is disabled or not aligned.
    aligned: Option<Aligned>,
}

struct Aligned {
    pose: DeclaredPose,
    sensor: Sensor,
}

/// The intrinsics of photographs, and what they have that these cannot say.
#[derive(Clone, Copy)]
struct Sensor {
    camera: DeclaredCamera,
    /// Whether the columns of pixels are not perpendicular to the rows.
    is_skewed: bool,
    /// Whether the tangential distortion grows with the distance from the middle, as in old versions.
    has_p3_or_p4: bool,
}

/// Rotation, translation and scale from a chunk to the world.
struct Transform {
    rotation: DMat3,
    translation: DVec3,
    scale: f64,
}

/// Parses the XML; every camera of its first chunk.
pub(crate) fn parse_metashape(bytes: &[u8]) -> Result<Vec<MetashapeCamera>, Malformed> {
    let document = parse_xml(bytes)?;
    let missing = |tag: &str| Malformed(format!("has no <{tag}>; export cameras in the format Agisoft XML"));
    let chunk = document.child("chunk").ok_or_else(|| missing("chunk"))?;
    let mut sensors = HashMap::new();
    for sensor in chunk.descendants("sensor") {
        // A panorama needs no calibration, and a sensor that took no aligned photograph has none.
        if let (Some(id), Some("spherical")) = (sensor.attribute("id"), sensor.attribute("type")) {
            let sensor = Sensor {
                camera: DeclaredCamera::panorama(),
                is_skewed: false,
                has_p3_or_p4: false,
            };
            sensors.insert(id, Ok(sensor));
        } else if let (Some(id), Some(calibration)) = (sensor.attribute("id"), calibration(sensor)) {
            // An unsupported one is an error only if it took an aligned photograph.
            sensors.insert(id, parse_sensor(sensor, calibration));
        }
    }
    let world_from_chunk = chunk.child("transform").and_then(transform);
    let components: HashMap<&str, Transform> = chunk
        .descendants("component")
        .into_iter()
        .filter_map(|component| Some((component.attribute("id")?, transform(component.child("transform")?)?)))
        .collect();
    let cameras = chunk.child("cameras").ok_or_else(|| missing("cameras"))?;
    let mut found = Vec::new();
    for camera in cameras.descendants("camera") {
        let label = camera
            .attribute("label")
            .ok_or_else(|| Malformed("a <camera> has no label".into()))?;
        let is_enabled = !matches!(camera.attribute("enabled"), Some("false" | "0"));
        let matrix = camera.child("transform").map(Element::numbers);
        let sensor = camera.attribute("sensor_id").and_then(|id| sensors.get(id));
        let aligned = match (matrix, sensor) {
            (Some(matrix), Some(sensor)) if is_enabled => {
                if matrix.len() != 16 {
                    return Err(Malformed(format!(
                        "the transform of camera {label} has {} numbers, not 16",
                        matrix.len()
                    )));
                }
                let component = camera.attribute("component_id").and_then(|id| components.get(id));
                let pose = pose(&matrix, component.or(world_from_chunk.as_ref()));
                let sensor = sensor.clone()?;
                pose.map(|pose| Aligned { pose, sensor })
            }
            _ => None,
        };
        found.push(MetashapeCamera {
            label: label.to_owned(),
            is_enabled,
            aligned,
        });
    }
    Ok(found)
}

/// The adjusted calibration, else the first.
fn calibration(sensor: &Element) -> Option<&Element> {
    let calibrations = || sensor.children.iter().filter(|child| child.name == "calibration");
    calibrations()
        .find(|child| child.attribute("class") == Some("adjusted"))
        .or_else(|| calibrations().next())
}

fn pose(matrix: &[f64], world: Option<&Transform>) -> Option<DeclaredPose> {
    let column = |c: usize| DVec3::new(matrix[c], matrix[4 + c], matrix[8 + c]);
    let [right, down, forward, mut position] = [0, 1, 2, 3].map(column);
    let rotation = world.map_or(DMat3::IDENTITY, |world| world.rotation);
    if let Some(world) = world {
        position = world.scale * (world.rotation * position) + world.translation;
    }
    pose_from_axes(rotation * right, rotation * down, rotation * forward, position)
}

/// `None` if it is incomplete: the chunk has not been placed in the world yet.
fn transform(element: &Element) -> Option<Transform> {
    let numbers = |name: &str| element.child(name).map(Element::numbers);
    let rotation: [f64; 9] = numbers("rotation")?.try_into().ok()?;
    let translation: [f64; 3] = numbers("translation")?.try_into().ok()?;
    Some(Transform {
        rotation: DMat3::from_cols_array(&rotation).transpose(),
        translation: translation.into(),
        scale: numbers("scale").and_then(|scale| scale.first().copied()).unwrap_or(1.0),
    })
}

fn parse_sensor(sensor: &Element, calibration: &Element) -> Result<Sensor, Malformed> {
    let resolution = calibration.child("resolution").or_else(|| sensor.child("resolution"));
    let side = |name: &str| -> Option<f64> { resolution?.attribute(name)?.parse().ok() };
    let size = side("width")
        .zip(side("height"))
        .filter(|(w, h)| *w >= 1.0 && *h >= 1.0);
    let Some((width, height)) = size else {
        return Err(Malformed("a sensor has no resolution".into()));
    };
    let number = |name: &str| calibration.child(name)?.numbers().first().copied();
    let coefficient = |name: &str| number(name).unwrap_or(0.0);
    let kind = calibration
        .attribute("type")
        .or_else(|| sensor.attribute("type"))
        .unwrap_or("frame");
    let p = [coefficient("p2"), coefficient("p1")];
    let lens = match kind {
        "frame" if coefficient("k4") == 0.0 => Lens::brown(["k1", "k2", "k3"].map(coefficient), p),
        "frame" => {
            return Err(Malformed(
                "a sensor has a k4, which is not supported; optimise the cameras without it, or undistort the photographs".into(),
            ));
        }
        "fisheye" | "equidistant_fisheye" => Lens::Fisheye {
            k: ["k1", "k2", "k3", "k4"].map(coefficient),
            p,
            s: [0.0; 2],
        },
        other => {
            return Err(Malformed(format!(
                "the sensor type `{other}` is not supported; undistort the photographs as frame cameras"
            )));
        }
    };
    // Old versions write fx and fy, and measure the principal point from the corner.
    let (focal, center) = match (number("f"), number("fx")) {
        (Some(f), _) => (
            [f + coefficient("b1"), f],
            [0.5 * width + coefficient("cx"), 0.5 * height + coefficient("cy")],
        ),
        (None, Some(fx)) => (
            [fx, number("fy").unwrap_or(fx)],
            [
                number("cx").unwrap_or(0.5 * width),
                number("cy").unwrap_or(0.5 * height),
            ],
        ),
        (None, None) => return Err(Malformed("a sensor's calibration has no <f>".into())),
    };
    let camera = DeclaredCamera {
        size: Some([width, height]),
        focal: Focal::Pixels(focal),
        center: Some(center),
        lens: lens_or_pinhole(lens),
    };
    let is_any = |names: [&str; 2]| names.into_iter().any(|name| coefficient(name) != 0.0);
    Ok(Sensor {
        camera,
        // Old versions write the skew under its name.
        is_skewed: is_any(["b2", "skew"]),
        has_p3_or_p4: is_any(["p3", "p4"]),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fisheye_has_tangential_distortion_and_skew_is_noticed() {
        let text = br#"<document><chunk><sensors><sensor id="0" type="fisheye"><calibration type="fisheye">
            <resolution width="64" height="48"/><f>20</f><k1>0.1</k1><k4>0.4</k4><p1>0.01</p1><p2>0.02</p2><b2>0.5</b2>
            </calibration></sensor></sensors><cameras><camera id="0" sensor_id="0" label="a">
            <transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk></document>"#;
        let cameras = parse_metashape(text).unwrap();
        let lens = Lens::Fisheye {
            k: [0.1, 0.0, 0.0, 0.4],
            p: [0.02, 0.01],
            s: [0.0; 2],
        };
        let sensor = cameras[0].aligned.as_ref().unwrap().sensor;
        assert_eq!(sensor.camera.lens, lens);
        assert!(sensor.is_skewed && !sensor.has_p3_or_p4);
    }

    #[test]
    fn an_unsupported_sensor_is_an_error_only_if_it_is_used() {
        let text = |camera: &str| {
            format!(
                r#"<document><chunk><sensors><sensor id="0"><resolution width="64" height="48"/><calibration><f>20</f><p3>2</p3>
                </calibration></sensor><sensor id="1"><resolution width="64" height="48"/><calibration><f>20</f><k4>2</k4></calibration>
                </sensor></sensors><cameras><camera id="0" sensor_id="0" label="a">
                <transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>{camera}</cameras></chunk></document>"#
            )
        };
        let cameras = parse_metashape(text(r#"<camera id="1" sensor_id="1" label="b"/>"#).as_bytes()).unwrap();
        assert!(cameras[0].aligned.as_ref().unwrap().sensor.has_p3_or_p4);
        assert!(cameras[1].aligned.is_none());
        let used =
            r#"<camera id="1" sensor_id="1" label="b"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>"#;
        assert!(parse_metashape(text(used).as_bytes()).err().unwrap().0.contains("k4"));
        assert!(parse_metashape(text(&used.replace("label", r#"enabled="0" label"#)).as_bytes()).is_ok());
    }
}
